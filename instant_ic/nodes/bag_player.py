"""Plays a bag onto the bus, with /clock before each message; ends with the bag."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from pathlib import Path

from instant_ic.bag import BagError, BagMessage
from instant_ic.bag.player import BagPlayer, PlayOptions
from instant_ic.bag.recorder import TopicChoice
from instant_ic.bag.transforms import TRANSFORM_TOPICS, without_children
from instant_ic.bus import RELIABLE, Node, NodeError, Publisher, main, registry
from instant_ic.bus.clock import ManualClock
from instant_ic.bus.zmq_transport import ZmqTransport
from instant_ic.msg import message_type, to_time


@dataclass(frozen=True)
class BagPlayerConfig:
    """Parameters of the player.

    Attributes:
        bag: folder of the bag, or a ``.mcap`` file.
        rate: 2 plays twice as fast.
        start_offset_s: seconds of the beginning to skip; latched values of it are still sent.
        duration_s: seconds of the bag to play; 0 plays to the end.
        loop: begin again at the end.
        topics: names or patterns to play; empty plays everything.
        exclude: names or patterns to leave out.
        drop_transforms: transforms with these child frames are left out of ``/tf``: somebody broadcasts them anew.
        publish_clock: whether to send ``/clock``.
        wait_for: nodes that must run, and be connected to what they read, before it begins.
        wait_timeout_s: how long to wait for them before it gives up, s.
        linger_s: how long it stays after the last message, so that the others finish their work, s.
    """

    bag: str = ""
    rate: float = 1.0
    start_offset_s: float = 0.0
    duration_s: float = 0.0
    loop: bool = False
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    drop_transforms: tuple[str, ...] = ()
    publish_clock: bool = True
    wait_for: tuple[str, ...] = ()
    wait_timeout_s: float = 60.0
    linger_s: float = 1.0

    def __post_init__(self) -> None:
        """Checks the values."""
        if not self.bag:
            raise ValueError("bag must name a folder (got '')")
        if self.wait_timeout_s <= 0:
            raise ValueError(f"wait_timeout_s must be > 0 (got {self.wait_timeout_s})")
        if self.linger_s < 0:
            raise ValueError(f"linger_s must be >= 0 (got {self.linger_s})")
        self.play_options()

    def play_options(self) -> PlayOptions:
        """The part of it that the player takes."""
        choice = TopicChoice(self.topics, self.exclude)
        return PlayOptions(self.rate, self.start_offset_s, self.duration_s, self.loop, choice)


class BagPlayerNode(Node[BagPlayerConfig]):
    """Sends a bag's bytes from a thread of its own; with ``use_sim_time`` its own clock is the bag's."""

    name = "bag_player"
    player: BagPlayer | None = None

    def setup(self) -> None:
        """Opens the bag, makes its topics, starts the thread."""
        try:
            self.player = BagPlayer(Path(self.config.bag).expanduser(), self.config.play_options())
        except BagError as error:
            raise NodeError(str(error)) from None
        self._clock_out: Publisher | None = None
        if self.config.publish_clock:
            self._clock_out = self.publisher("/clock", message_type("Clock"), RELIABLE)
        self._out = {t.topic: self.publisher_raw(t.topic, t.type_name, t.qos) for t in self.player.topics}
        self._failed = ""
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        assert self.player is not None
        try:
            self._wait_for_readers()
            length_s = (self.player.end_ns - self.player.start_ns) / 1e9
            self.log.info("playing %.1f s of %s", length_s, self.config.bag)
            began_s = time.monotonic()
            if self.player.play(self._send, self._stop):
                self.log.info("played to the end in %.1f s", time.monotonic() - began_s)
                self._stop.wait(self.config.linger_s)
        except (BagError, NodeError) as error:
            self._failed = str(error)
        self.stop()

    def _send(self, message: BagMessage) -> None:
        payload: bytes | None = message.payload
        if self.config.drop_transforms and message.topic in TRANSFORM_TOPICS:
            payload = without_children(message, self.config.drop_transforms)
        if isinstance(self.clock, ManualClock):
            self.clock.set(message.stamp_ns)
        if self._clock_out is not None:
            self._clock_out.publish(message_type("Clock")(clock=to_time(message.stamp_ns)))
        if payload is not None:
            self._out[message.topic].publish_bytes(payload)

    def _wait_for_readers(self) -> None:
        """Until each node of ``wait_for`` runs, reads something of the bag, and is connected to all that it reads."""
        if not self.config.wait_for or not isinstance(self._transport, ZmqTransport):
            return
        deadline_s = time.monotonic() + self.config.wait_timeout_s
        missing = ""
        while time.monotonic() < deadline_s:
            nodes = {info.name: info for info in registry.list_nodes(self._transport.run_dir)}
            played = {publisher.topic for publisher in self._out.values()}
            # A recorder subscribes only once it has found the topics: it is ready when it reads one of them.
            absent = [
                name for name in self.config.wait_for if name not in nodes or played.isdisjoint(nodes[name].subscribes)
            ]
            readers = [topic for name in self.config.wait_for if name in nodes for topic in nodes[name].subscribes]
            unread = [
                topic
                for topic, publisher in self._out.items()
                if publisher.subscriber_count < readers.count(publisher.topic)
            ]
            if not absent and not unread:
                return
            missing = ", ".join(
                [f"node {name} to read what is played" for name in absent]
                + [f"a reader of {topic}" for topic in unread]
            )
            if self._stop.wait(0.1):
                return
        raise NodeError(f"waited {self.config.wait_timeout_s:.0f} s for {missing}")

    def teardown(self) -> None:
        """Ends the thread, closes the bag."""
        if self.player is None:
            return
        self._thread.join(timeout=3.0)
        self.player.close()
        if self._failed:
            self.log.error("%s", self._failed)
            raise SystemExit(1)


if __name__ == "__main__":
    main(BagPlayerNode)
