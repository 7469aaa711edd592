"""Records topics into a rosbag2 folder (MCAP), byte for byte; or keeps the last seconds, and records when asked."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

from instant_ic.bag import BagError
from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.on_demand import OnDemand
from instant_ic.bag.recorder import DISK_FULL, FAILED, PAUSED, Recorder, RecordOptions, Subscribe, TakeMessage
from instant_ic.bus import ERROR, OK, RECORD, WARN, Node, NodeError, main, registry
from instant_ic.bus.node import Subscription
from instant_ic.bus.transport import Received, Stats
from instant_ic.config.ranges import NotNegative, NotNegativeInt, Positive, PositiveInt, Range, check_ranges
from instant_ic.msg import Bool, ControlState


@dataclass(frozen=True)
class BagRecorderConfig:
    """Parameters of the recorder.

    Attributes:
        path: folder of the bag, which must not exist; empty makes ``runs/bag_DATE_TIME`` in the working directory. With
            snapshots the folder that they go into.
        topics: names or patterns to record; empty records everything.
        exclude: names or patterns to leave out.
        discovery_period_s: how often to look for new topics, s.
        duration_s: end after this time, s; 0 records until it is stopped.
        parameters: whether to keep the nodes' parameters in the bag's metadata.
        compressed: compress with zstd.
        max_bag_size: a file of so many bytes is followed by the next; 0 makes one file.
        max_bag_duration: a file of so many seconds is followed by the next; 0 makes one file.
        queue_mb: how much may wait for the disk, MB; what comes beyond is left out and counted.
        min_free_mb: stop recording while the disk has less free space, MB.
        start_paused: record only once it is told to resume.
        snapshot: write nothing until asked (``ic bag snapshot``, emergency stop); keep the last seconds in memory.
            Records into a bag of its own between the commands ``record`` and ``stop`` (the page's button).
        snapshot_seconds: how many.
        snapshot_after_s: how much of what follows the moment goes into the snapshot too, s.
        snapshot_on_estop: write one at each emergency stop.
        max_cache_mb: memory for the last seconds, MB; with more traffic they are fewer.
    """

    path: str = ""
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    discovery_period_s: Annotated[float, Range(0.01, 10.0)] = 0.2
    duration_s: NotNegative = 0.0
    parameters: bool = True
    compressed: bool = False
    max_bag_size: NotNegativeInt = 0
    max_bag_duration: NotNegative = 0.0
    queue_mb: PositiveInt = 256
    min_free_mb: NotNegativeInt = 100
    start_paused: bool = False
    snapshot: bool = False
    snapshot_seconds: Positive = 30.0
    snapshot_after_s: NotNegative = 2.0
    snapshot_on_estop: bool = True
    max_cache_mb: PositiveInt = 256

    def __post_init__(self) -> None:
        """Checks the values."""
        check_ranges(self)

    def folder(self) -> Path:
        """Where the bag goes."""
        if self.path:
            return Path(self.path).expanduser()
        return Path("runs") / f"{'snapshots' if self.snapshot else 'bag'}_{datetime.now():%Y%m%d_%H%M%S}"

    def options(self) -> RecordOptions:
        """The part of it that the recorder takes."""
        return RecordOptions(
            compressed=self.compressed,
            max_bytes=self.max_bag_size,
            max_duration_s=self.max_bag_duration,
            queue_bytes=self.queue_mb * 1_000_000,
            reserve_bytes=self.min_free_mb * 1_000_000,
            snapshot_s=self.snapshot_seconds if self.snapshot else 0.0,
            cache_bytes=self.max_cache_mb * 1_000_000,
        )


class BagRecorderNode(Node[BagRecorderConfig]):
    """Finds topics, hands their bytes to the recorder, tells size and losses."""

    name = "bag_recorder"
    live_parameters = ("duration_s", "snapshot_after_s", "snapshot_on_estop")
    recorder: Recorder | None = None
    on_demand: OnDemand | None = None
    _next_look_s = 0.0
    _seen: tuple[tuple[str, int], ...] = ()

    def setup(self) -> None:
        """Makes the bag and starts looking for topics."""
        if self.run_dir is None:
            raise NodeError("the recorder needs the real bus; lockstep replay records by itself")
        self._choice = TopicChoice(self.config.topics, self.config.exclude)
        try:
            self.recorder = self._recorder(self.config.folder(), self._listen, self.config.options())
        except BagError as error:
            raise NodeError(str(error)) from None
        if self.config.start_paused:
            self.recorder.pause()
        what = f"keeping the last {self.config.snapshot_seconds:g} s for" if self.config.snapshot else "recording into"
        self.log.info("%s %s", what, self.recorder.path)
        self._stopped: dict[str, bool] = {}
        if self.config.snapshot:
            self.subscribe("/operator/estop", Bool, lambda m: self._on_stop("operator", bool(m.data)))
            self.subscribe("/ic/state", ControlState, lambda m: self._on_stop("arbiter", bool(m.estop)))
            self.on_demand = OnDemand(self.recorder.path, self._begin)
        self.commands = {
            "pause": self.recorder.pause,
            "resume": self.recorder.resume,
            "toggle": self._toggle,
            "split": self.recorder.split,
            "snapshot": self._snapshot,
            "record": self._record,
            "stop": self._end,
            "status": self._status,
        }
        self._began_s = time.monotonic()
        self._discover()
        # A thread, not a timer: with simulated time the timers stand still while topics already come.
        threading.Thread(target=self._look, name="discovery", daemon=True).start()

    def _look(self) -> None:
        next_tell_s = 0.0
        while not self._stop.wait(self.config.discovery_period_s):
            self.call_soon(self._discover)
            if time.monotonic() >= next_tell_s:
                next_tell_s = time.monotonic() + 1.0
                self.call_soon(self._tell)
            if self.config.duration_s and time.monotonic() >= self._began_s + self.config.duration_s:
                self.stop()

    def _recorder(self, path: Path, listen: Subscribe, options: RecordOptions) -> Recorder:
        return Recorder(path, self._choice, listen, self.clock.now_ns if self.use_sim_time else None, options)

    def _listen(self, topic: str, take: TakeMessage) -> Stats:
        return self._take_in(topic, take).raw.stats

    def _take_in(self, topic: str, take: TakeMessage) -> Subscription:
        def forward(message: Received) -> None:
            take(message.topic, message.type_name, message.payload, message.publish_ns, message.publisher)

        return self.subscribe_received(topic, forward, RECORD)

    def _begin(self, path: Path) -> tuple[Recorder, Callable[[], None]]:
        """A recorder with subscriptions of its own, which bring it the latched values; and what ends them."""
        taken: list[Subscription] = []

        def listen(topic: str, take: TakeMessage) -> Stats:
            taken.append(self._take_in(topic, take))
            return taken[-1].raw.stats

        def drop() -> None:
            for subscription in taken:
                self.drop(subscription)

        return self._recorder(path, listen, replace(self.config.options(), snapshot_s=0.0)), drop

    def _discover(self) -> None:
        assert self.recorder is not None and self.run_dir is not None
        due = time.monotonic() >= self._next_look_s
        changed = _changes(self.run_dir / "topics")
        # Reading every publisher's entry five times a second would cost more than recording them.
        if due or changed != self._seen:
            self._seen = changed
            nodes: list[registry.NodeInfo] = []
            if due:
                self._next_look_s = time.monotonic() + 2.0
                nodes = registry.list_nodes(self.run_dir) if self.config.parameters else []
            topics = registry.list_topics(self.run_dir)
            self.recorder.discover(topics, nodes)
            if self.on_demand is not None:
                self.on_demand.discover(topics, nodes)
        self.recorder.tick()
        if self.on_demand is not None:
            self.on_demand.tick()

    def _snapshot(self, reason: str = "") -> dict[str, Any]:
        assert self.recorder is not None
        made = self.recorder.snapshot(reason, self.config.snapshot_after_s)
        self.log.info("snapshot %s in %.1f s", made.path, max(0.0, made.due_s - time.monotonic()))
        return {"path": str(made.path)}

    def _record(self, name: str = "") -> dict[str, Any]:
        assert self.run_dir is not None
        if self.on_demand is None:
            raise NodeError("it records all the time: one with snapshot: true records when it is asked")
        try:
            path = self.on_demand.start(name)
        except BagError as error:
            raise NodeError(str(error)) from None
        self.on_demand.discover(registry.list_topics(self.run_dir), registry.list_nodes(self.run_dir))
        self.log.info("recording into %s", path)
        return {"path": str(path)}

    def _end(self) -> dict[str, Any]:
        if self.on_demand is None:
            raise NodeError("it records all the time, until it ends")
        return {"path": str(self.on_demand.stop())}

    def _status(self) -> dict[str, Any]:
        assert self.recorder is not None
        told = self.recorder.status()
        return told if self.on_demand is None else told | {"recording": self.on_demand.status()}

    def _toggle(self) -> None:
        assert self.recorder is not None
        if self.recorder.state == PAUSED:
            self.recorder.resume()
        else:
            self.recorder.pause()

    def _on_stop(self, who: str, stopped: bool) -> None:
        """A snapshot at each stop; one that was there before this recorder is none."""
        before = self._stopped.get(who)
        self._stopped[who] = stopped
        if stopped and before is False and self.config.snapshot_on_estop:
            self._snapshot("estop")

    def _tell(self) -> None:
        assert self.recorder is not None
        told = self.recorder.status()
        words = f"{told['messages']} messages, {told['topics']} topics, {self.recorder.state}"
        if "bytes" in told:
            words += f", {told['bytes'] / 1e6:.1f} MB in {told['files']} files"
        else:
            words += f", the last {told['cached_s']:g} s at hand ({told['cached_bytes'] / 1e6:.0f} MB)"
        if self.on_demand is not None and (trouble := self.on_demand.trouble()):
            self.diagnose("bag", ERROR, trouble)
        elif self.recorder.state in (FAILED, DISK_FULL):
            self.diagnose("bag", ERROR, self.recorder.error)
        elif self.recorder.told.overflow:
            self.diagnose("bag", ERROR, f"{words}; the disk is too slow, left out: {_numbers(told['overflow'])}")
        elif lost := self.recorder.lost():
            self.diagnose("bag", WARN, f"{words}; lost: {_numbers(lost)}", **{t.strip("/"): n for t, n in lost.items()})
        else:
            self.diagnose("bag", OK, words, messages=told["messages"])
        if unknown := self.recorder.unknown_types():
            named = ", ".join(f"{type_name} ({topic})" for type_name, topic in sorted(unknown.items()))
            self.diagnose("types", WARN, f"recorded without their definition, which is not known here: {named}")

    def teardown(self) -> None:
        """Completes the bag."""
        if self.recorder is None:
            return
        self.spin_once()  # what is already in the queues belongs into the bag
        try:
            if self.on_demand is not None:
                self.on_demand.close()
            self.recorder.close()
        except BagError as error:
            self.log.error("%s", error)
            raise SystemExit(1) from None
        self.log.info("%s: %d messages", self.recorder.path, self.recorder.count)
        if self.recorder.failed:
            self.log.error("not everything is in it: %s", self.recorder.error or "see the errors above")
            raise SystemExit(1)


def _changes(topics: Path) -> tuple[tuple[str, int], ...]:
    """Folders of topics with the times at which something came or went in them."""
    try:
        with os.scandir(topics) as entries:
            return tuple(sorted((entry.name, entry.stat().st_mtime_ns) for entry in entries))
    except OSError:  # one left in this moment, or nobody has published yet: the next look tells
        return ()


def _numbers(counts: dict[str, int]) -> str:
    return ", ".join(f"{topic} {number}" for topic, number in sorted(counts.items()))


if __name__ == "__main__":
    main(BagRecorderNode)
