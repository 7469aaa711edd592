"""Records topics into a rosbag2 folder (MCAP), byte for byte; in snapshot mode keeps only the last seconds."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from instant_ic.bag import BagError
from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.live_nodes import LiveTopics
from instant_ic.bag.on_demand import OnDemand
from instant_ic.bag.recorder import BagRecorderConfig, Recorder, TakeMessage
from instant_ic.bus import RECORD, Node, NodeError, main
from instant_ic.bus.transport import Received, Stats
from instant_ic.msg import Bool, ControlState


class BagRecorderNode(Node[BagRecorderConfig]):
    """Discovers topics, passes their bytes to the recorder, reports size and losses."""

    name = "bag_recorder"
    live_parameters = ("duration_s", "snapshot_after_s")
    recorder: Recorder
    on_demand: OnDemand | None = None

    def setup(self) -> None:
        if self.run_dir is None:
            raise NodeError("the recorder needs the real bus; lockstep replay records by itself")
        self._live = LiveTopics(self.run_dir)
        self._choice = TopicChoice(self.config.topics, self.config.exclude)
        self.recorder = self._recorder(self.config.folder(), self.config, ExitStack())
        what = f"keeping the last {self.config.snapshot_seconds:g} s for" if self.config.snapshot else "recording into"
        self.log.info("%s %s", what, self.recorder.path)
        self._stopped: dict[str, bool] = {}
        if self.config.snapshot:
            self.subscribe("/operator/estop", Bool, lambda m: self._on_stop("operator", bool(m.data)))
            self.subscribe("/ic/state", ControlState, lambda m: self._on_stop("arbiter", bool(m.estop)))
            self.on_demand = OnDemand(self.recorder.path, self._begin)
            self.be_patient(True)  # the discovery wakes it
        self.commands = {
            "pause": self.recorder.pause,
            "resume": self.recorder.resume,
            "snapshot": self._snapshot,
            "record": self._record,
            "stop": lambda: {"path": str(self._on_request().stop())},
            "status": self._status,
        }
        self._began_s = time.monotonic()
        self._discover()
        # A thread, not a timer: with simulated time the timers may stand still while messages already arrive.
        threading.Thread(target=self._look, name="discovery", daemon=True).start()

    def _look(self) -> None:
        next_report_s = 0.0
        while not self._stop.wait(self.config.discovery_period_s):
            self.call_soon(self._discover)
            if time.monotonic() >= next_report_s:
                next_report_s = time.monotonic() + 1.0
                self.call_soon(self._report)
            if self.config.duration_s and time.monotonic() >= self._began_s + self.config.duration_s:
                self.stop()

    def _recorder(self, path: Path, options: BagRecorderConfig, taken: ExitStack) -> Recorder:
        def listen(topic: str, take: TakeMessage) -> Stats:
            def forward(message: Received) -> None:
                take(message.topic, message.type_name, message.payload, message.publish_ns, message.publisher)

            subscription = self.subscribe_received(topic, forward, RECORD)
            taken.callback(self.drop, subscription)
            return subscription.raw.stats

        try:
            return Recorder(path, self._choice, listen, self.clock.now_ns if self.use_sim_time else None, options)
        except BagError as error:
            raise NodeError(str(error)) from None

    def _begin(self, path: Path) -> tuple[Recorder, Callable[[], None]]:
        """Return a recorder with its own subscriptions, which get the latched messages, and a function to end them."""
        taken = ExitStack()
        return self._recorder(path, replace(self.config, snapshot=False), taken), taken.close

    def _discover(self) -> None:
        topics, nodes = self._live.look()
        for recorder in (self.recorder, self.on_demand):
            if recorder is not None:
                recorder.discover(topics, nodes)
                recorder.tick()

    def _snapshot(self, reason: str = "") -> dict[str, Any]:
        made = self.recorder.snapshot(reason, self.config.snapshot_after_s)
        self.log.info("snapshot %s in %.1f s", made.path, max(0.0, made.due_s - time.monotonic()))
        return {"path": str(made.path)}

    def _record(self, name: str = "") -> dict[str, Any]:
        path = self._on_request().start(name)
        self._on_request().discover(*self._live.look(again=True))
        self.log.info("recording into %s", path)
        return {"path": str(path)}

    def _on_request(self) -> OnDemand:
        if self.on_demand is None:
            raise NodeError("this recorder records all the time, until it is shut down; one that is started with "
                            "snapshot: true records on request")  # fmt: skip
        return self.on_demand

    def _status(self) -> dict[str, Any]:
        status = self.recorder.status()
        return status if self.on_demand is None else status | {"recording": self.on_demand.status()}

    def _on_stop(self, who: str, stopped: bool) -> None:
        """Write a snapshot at each stop, except one that was latched before this recorder started."""
        before = self._stopped.get(who)
        self._stopped[who] = stopped
        if stopped and before is False:
            self._snapshot("estop")

    def _report(self) -> None:
        self.diagnose_all(*self.recorder.diagnoses(self.on_demand.trouble() if self.on_demand else ""))

    def teardown(self) -> None:
        if not hasattr(self, "recorder"):
            return
        self.read_all()  # what was published before the end belongs to the bag
        try:
            if self.on_demand is not None:
                self.on_demand.close()
            self.recorder.close()
        except BagError as error:
            self.log.error("%s", error)
            raise SystemExit(1) from None
        if not self.config.snapshot:
            self.log.info("%s: %d messages", self.recorder.path, self.recorder.count)
        if self.recorder.failed:
            self.log.error("the bag is incomplete: %s", self.recorder.error or "see the errors above")
            raise SystemExit(1)


if __name__ == "__main__":
    main(BagRecorderNode)
