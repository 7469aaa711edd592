"""Records topics into a rosbag2 folder (MCAP), byte for byte, with losses counted."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from instant_ic.bag import BagError
from instant_ic.bag.recorder import RawCallback, Recorder, TopicChoice
from instant_ic.bus import ERROR, OK, RECORD, WARN, Node, NodeError, main, registry
from instant_ic.bus.transport import Stats
from instant_ic.bus.zmq_transport import ZmqTransport


@dataclass(frozen=True)
class BagRecorderConfig:
    """Parameters of the recorder.

    Attributes:
        path: folder of the bag, which must not exist; empty makes ``runs/bag_DATE_TIME`` in the working directory.
        topics: names or patterns to record; empty records everything.
        exclude: names or patterns to leave out.
        discovery_period_s: how often to look for new topics, s.
        duration_s: end after this time, s; 0 records until it is stopped.
        parameters: whether to keep the nodes' parameters in the bag's metadata.
    """

    path: str = ""
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    discovery_period_s: float = 0.2
    duration_s: float = 0.0
    parameters: bool = True

    def __post_init__(self) -> None:
        """Checks the values."""
        if not 0.01 <= self.discovery_period_s <= 10:
            raise ValueError(f"discovery_period_s must be 0.01 to 10 s (got {self.discovery_period_s})")
        if self.duration_s < 0:
            raise ValueError(f"duration_s must be >= 0 (got {self.duration_s})")

    def folder(self) -> Path:
        """Where the bag goes."""
        if self.path:
            return Path(self.path).expanduser()
        return Path("runs") / f"bag_{datetime.now():%Y%m%d_%H%M%S}"


class BagRecorderNode(Node[BagRecorderConfig]):
    """Finds topics, hands their bytes to the recorder, tells size and losses."""

    name = "bag_recorder"
    recorder: Recorder | None = None
    failed = False
    _next_nodes_s = 0.0

    def setup(self) -> None:
        """Makes the bag and starts looking for topics."""
        if not isinstance(self._transport, ZmqTransport):
            raise NodeError("the recorder needs the real bus; lockstep replay records by itself")
        self._run_dir = self._transport.run_dir
        choice = TopicChoice(self.config.topics, self.config.exclude)
        sim_now_ns = self.clock.now_ns if self.use_sim_time else None
        try:
            self.recorder = Recorder(self.config.folder(), choice, self._listen, sim_now_ns)
        except BagError as error:
            raise NodeError(str(error)) from None
        self.log.info("recording into %s", self.recorder.path)
        self._discover()
        # A thread, not a timer: with simulated time the timers stand still while topics already come.
        threading.Thread(target=self._look, name="discovery", daemon=True).start()
        self.timer(1.0, self._tell)

    def _look(self) -> None:
        end_s = time.monotonic() + (self.config.duration_s or float("inf"))
        while not self._stop.wait(self.config.discovery_period_s):
            self.call_soon(self._discover)
            if time.monotonic() >= end_s:
                self.stop()

    def _listen(self, topic: str, callback: RawCallback) -> Stats:
        def take(name: str, type_name: str, payload: bytes | memoryview, publish_ns: int) -> None:
            try:
                callback(name, type_name, payload, publish_ns)
            except BagError as error:
                if not self.failed:
                    self.diagnose("bag", ERROR, str(error))
                self.failed = True
                self.stop()

        return self.subscribe_raw(topic, take, RECORD).raw.stats

    def _discover(self) -> None:
        assert self.recorder is not None
        nodes: list[registry.NodeInfo] = []
        if self.config.parameters and time.monotonic() >= self._next_nodes_s:
            self._next_nodes_s = time.monotonic() + 2.0
            nodes = registry.list_nodes(self._run_dir)
        self.recorder.discover(registry.list_topics(self._run_dir), nodes)
        self.recorder.tick()

    def _tell(self) -> None:
        assert self.recorder is not None
        lost = self.recorder.lost()
        count, megabytes = self.recorder.writer.count, self.recorder.writer.bytes / 1e6
        words = f"{count} messages, {megabytes:.1f} MB, {len(self.recorder.topics)} topics"
        if lost:
            missing = ", ".join(f"{topic} {number}" for topic, number in sorted(lost.items()))
            self.diagnose("bag", WARN, f"{words}; lost: {missing}", **{t.strip("/"): n for t, n in lost.items()})
        else:
            self.diagnose("bag", OK, words, messages=count)

    def teardown(self) -> None:
        """Completes the bag."""
        if self.recorder is not None:
            self.spin_once()  # what is already in the queues belongs into the bag
            try:
                self.recorder.close()
            except BagError as error:
                self.log.error("%s", error)
                self.failed = True
            self.log.info("%s: %d messages", self.recorder.path, self.recorder.writer.count)
        if self.failed:
            raise SystemExit(1)


if __name__ == "__main__":
    main(BagRecorderNode)
