"""Plays a bag onto the bus, with /clock before each message, and ends with the bag."""

from __future__ import annotations

import threading
import time
from typing import Any

from instant_ic.bag import BagError, BagMessage
from instant_ic.bag.live_nodes import refuse_base, wait_for_readers
from instant_ic.bag.player import CLOCK_HZ, BagPlayer, BagPlayerConfig
from instant_ic.bag.transforms import TRANSFORM_TOPICS, without_children
from instant_ic.bus import RELIABLE, Node, NodeError, Publisher, main, registry
from instant_ic.bus.clock import ManualClock
from instant_ic.msg import message_type, register_type, to_time

_BASE_PERIOD_S = 0.5
_LINGER_S = 1.0  # wait after the last message, so that other nodes can finish their work


class BagPlayerNode(Node[BagPlayerConfig]):
    """Publishes a bag's messages from a thread of its own. With ``use_sim_time``, the node's clock follows the bag."""

    name = "bag_player"
    live_parameters = ("rate",)
    player: BagPlayer | None = None
    _thread: threading.Thread | None = None
    _failed = ""
    _next_base_s = 0.0

    def setup(self) -> None:
        try:
            self.player = BagPlayer(self.config)
            self.check_base()
        except BagError as error:
            if self.player is not None:
                self.player.close()
            raise NodeError(str(error)) from None
        self._clock_out: Publisher | None = None
        if self.config.publish_clock:
            self._clock_out = self.publisher("/clock", message_type("Clock"), RELIABLE)
        for topic in self.player.topics:  # the bag contains the definitions of foreign message types
            register_type(topic.type_name, topic.schema.text)
        self._out = {t.topic: self.publisher_raw(t.topic, t.type_name, t.qos) for t in self.player.topics}
        for name, why in self.player.left_out.items():
            self.log.warning("%s is not played: %s", name, why)
        self.commands = {
            "pause": self.player.pause,
            "resume": self.player.resume,
            "step": self.player.step,
            "rate": self.player.set_rate,
            "status": self.status,
        }
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    def check_base(self) -> None:
        """Check the run directory for a base, real or simulated, that could obey the played messages.

        Raises:
            BagError: there is such a base, and ``force`` is not set.
        """
        assert self.player is not None
        if self.run_dir is not None and not self.config.force:
            nodes = [node for node in registry.list_nodes(self.run_dir) if node.name != self.node_name]
            played = {self.resolve(topic.topic): topic.topic for topic in self.player.topics}
            refuse_base(self.config.bag, self.run_dir, nodes, played)

    def _run(self) -> None:
        assert self.player is not None
        try:
            self._wait_for_readers()
            length_s = (self.player.end_ns - self.player.start_ns) / 1e9
            self.log.info("playing %.1f s of %s", length_s, self.config.bag)
            began_s = time.monotonic()
            if self.player.play(self._send, self._stop, on_clock=self._publish_time):
                late = f", up to {self.player.latest_s:.2f} s late" if self.player.latest_s > 0.1 else ""
                self.log.info("played to the end in %.1f s%s", time.monotonic() - began_s, late)
                self._stop.wait(_LINGER_S)
        except (BagError, NodeError) as error:
            self._failed = str(error)
        except Exception as error:  # otherwise the thread would end silently and the node would wait for ever
            self.log.exception("player")
            self._failed = f"{type(error).__name__}: {error}"
        self.stop()

    def _send(self, message: BagMessage) -> None:
        if (now_s := time.monotonic()) >= self._next_base_s:
            self._next_base_s = now_s + _BASE_PERIOD_S
            self.check_base()
        drops = self.config.drop_transforms if message.topic in TRANSFORM_TOPICS else ()
        payload = without_children(message, drops) if drops else message.payload
        self._publish_time(message.stamp_ns)
        if payload is not None:
            # Do not read the clock: this node also receives its own /clock, slightly later, which sets the time back.
            stamp_ns = message.stamp_ns if isinstance(self.clock, ManualClock) else None
            self._out[message.topic].publish_bytes(payload, stamp_ns)

    def _publish_time(self, stamp_ns: int) -> None:
        """Publish the time, before each message and at intervals between messages."""
        if isinstance(self.clock, ManualClock):
            self.clock.set(stamp_ns)
        if self._clock_out is not None:
            self._clock_out.publish(message_type("Clock")(clock=to_time(stamp_ns)))

    def reconfigure(self, config: BagPlayerConfig) -> None:
        """Apply a new rate at once."""
        if self.player is not None and config.rate != self.config.rate:
            self.player.set_rate(config.rate)
        super().reconfigure(config)

    def status(self) -> dict[str, Any]:
        assert self.player is not None
        return {"bag": self.config.bag, **self.player.status()}

    def _wait_for_readers(self) -> None:
        """Give subscribers time to find the topics, then wait until the nodes of ``wait_for`` are connected to all."""
        assert self.player is not None
        start_ns = self.player.start_ns

        def wait(seconds: float) -> bool:  # meanwhile, the published time stands still
            self._publish_time(start_ns)
            return self._stop.wait(seconds)

        begin_s = time.monotonic() + self.config.delay_s
        while self.run_dir is not None and time.monotonic() < begin_s and not wait(1.0 / CLOCK_HZ):
            pass
        if self.run_dir is not None and self.config.wait_for:
            wait_for_readers(self.config.wait_for, self.run_dir, self._out, wait)

    def teardown(self) -> None:
        if self.player is None:
            return
        if self._thread is not None:
            self._thread.join(timeout=3.0)
        self.player.close()
        if self._failed:
            self.log.error("%s", self._failed)
            raise SystemExit(1)


if __name__ == "__main__":
    main(BagPlayerNode)
