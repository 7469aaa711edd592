"""Records topics byte for byte into a rosbag2 folder (MCAP). In snapshot mode, it keeps only the last seconds."""

from __future__ import annotations

import threading
import time
from typing import Any

from instant_ic.bag import BagError
from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.recorder import Recorder, TakeMessage
from instant_ic.bag.recording import BagRecorderConfig
from instant_ic.bus import RECORD, Node, NodeError, main
from instant_ic.bus.registry import NodeInfo, TopicWatch, list_nodes
from instant_ic.bus.transport import Received, Stats
from instant_ic.msg import Bool, ControlState

_NODES_S = 2.0  # period of the search for nodes, which costs more than the search for topics


class BagRecorderNode(Node[BagRecorderConfig]):
    """Discovers topics, passes their messages to the recorder, and reports size and losses."""

    name = "bag_recorder"
    live_parameters = ("duration_s", "snapshot_after_s")
    recorder: Recorder

    def setup(self) -> None:
        if self.run_dir is None:
            raise NodeError("the recorder needs the real bus; lockstep replay records by itself")
        self._topics = TopicWatch(self.run_dir)
        self._next_nodes_s = 0.0
        choice = TopicChoice(self.config.topics, self.config.exclude)
        sim_now_ns = self.clock.now_ns if self.use_sim_time else None
        try:
            self.recorder = Recorder(self.config.folder(), choice, self._listen, sim_now_ns, self.config)
        except BagError as error:
            raise NodeError(str(error)) from None
        what = f"keeping the last {self.config.snapshot_seconds:g} s for" if self.config.snapshot else "recording into"
        self.log.info("%s %s", what, self.recorder.path)
        self._stopped: dict[str, bool] = {}
        if self.config.snapshot:
            self.subscribe("/operator/estop", Bool, lambda m: self._on_stop("operator", bool(m.data)))
            self.subscribe("/ic/state", ControlState, lambda m: self._on_stop("arbiter", bool(m.estop)))
            self.be_patient(True)  # the discovery wakes the node
        self.commands = {
            "snapshot": self._snapshot,
            "record": self._record,
            "stop": lambda: {"path": str(self.recorder.stop())},
            "status": self.recorder.status,
        }
        self._began_s = time.monotonic()
        self._discover()
        # Use a thread, because timers on simulated time may stand still while messages already arrive.
        threading.Thread(target=self._look, name="discovery", daemon=True).start()

    def _look(self) -> None:
        next_report_s = 0.0
        while not self._stop.wait(self.config.discovery_period_s):
            self.call_soon(self._discover)
            if time.monotonic() >= next_report_s:
                next_report_s = time.monotonic() + 1.0
                self.call_soon(lambda: self.diagnose_all(*self.recorder.diagnoses()))
            if self.config.duration_s and time.monotonic() >= self._began_s + self.config.duration_s:
                self.stop()

    def _listen(self, topic: str, take: TakeMessage) -> Stats:
        def forward(message: Received) -> None:
            take(message.topic, message.type_name, message.payload, message.publish_ns, message.publisher)

        return self.subscribe_received(topic, forward, RECORD).raw.stats

    def _discover(self) -> None:
        assert self.run_dir is not None
        nodes: list[NodeInfo] = []
        if time.monotonic() >= self._next_nodes_s:
            self._next_nodes_s = time.monotonic() + _NODES_S
            nodes = list_nodes(self.run_dir)
        self.recorder.discover(self._topics.topics(), nodes)
        self.recorder.tick()

    def _snapshot(self, reason: str = "") -> dict[str, Any]:
        path = self.recorder.snapshot(reason, self.config.snapshot_after_s).path
        self.log.info("snapshot %s, with %g s more", path, self.config.snapshot_after_s)
        return {"path": str(path)}

    def _record(self, name: str = "") -> dict[str, Any]:
        try:
            path = self.recorder.record(name)
        except BagError as error:
            raise NodeError(str(error)) from None
        self.log.info("recording into %s", path)
        return {"path": str(path)}

    def _on_stop(self, who: str, stopped: bool) -> None:
        """Write a snapshot at each emergency stop, except one that was latched before this recorder started."""
        before = self._stopped.get(who)
        self._stopped[who] = stopped
        if stopped and before is False:
            try:
                self._snapshot("estop")
            except ValueError as error:
                self.log.error("no snapshot of the stop: %s", error)

    def teardown(self) -> None:
        if not hasattr(self, "recorder"):
            return
        self.read_all()  # messages published before the end belong to the bag
        try:
            self.recorder.close()
        except BagError as error:
            self.log.error("%s", error)
            raise SystemExit(1) from None
        bag = self.recorder.bag
        if bag is not None and not self.config.snapshot:
            self.log.info("%s: %d messages", bag.path, bag.status()["messages"])
        if self.recorder.failed:
            self.log.error(
                "the bag is incomplete: %s", (bag.error if bag is not None else "") or "see the errors above"
            )
            raise SystemExit(1)


if __name__ == "__main__":
    main(BagRecorderNode)
