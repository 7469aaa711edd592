"""Records topics without decoding them, finds new publishers while it runs, and counts losses.

The node never waits for the disk: messages go into a queue, bounded by bytes, and a thread writes them. Messages that
do not fit are counted by topic and reported.
"""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.latched import LatchedValues
from instant_ic.bag.message import BagError, BagMessage
from instant_ic.bag.recorder_thread import (
    DISK_FULL,
    FAILED,
    PAUSED,
    RECORDING,
    RecorderThread,
    counts_text,
    on_disk,
)
from instant_ic.bag.snapshot import BagSnapshot, SnapshotCache, save_snapshot
from instant_ic.bag.writer import BagWriter
from instant_ic.bus.qos import PRESETS, SENSOR, QoS
from instant_ic.bus.registry import NodeInfo, TopicInfo
from instant_ic.bus.transport import Stats
from instant_ic.config.ranges import Checked, NotNegative, NotNegativeInt, Positive, PositiveInt, Range
from instant_ic.util.diagnosis import Diagnosis, Level, RecentCount

FOREIGN_CLOCK_NS = 10_000_000_000
"""A stamp farther than this from the simulated clock comes from another clock."""

_MB = 1_000_000
_RECENT_S = 10.0  # losses longer ago are no warning

log = logging.getLogger(__name__)


TakeMessage = Callable[..., None]
"""Accepts ``(topic, type_name, payload, publish_ns, publisher)``; see :meth:`Recorder.take`."""
Subscribe = Callable[[str, TakeMessage], Stats]


@dataclass(frozen=True)
class BagRecorderConfig(Checked):
    """Parameters of ``bag_recorder``.

    Attributes:
        compressed: compress with zstd.
        max_bag_size: size in bytes at which the next file begins; 0 writes one file.
        max_bag_duration: length in seconds at which the next file begins; 0 writes one file.
        queue_mb: largest queue for the disk, MB; messages beyond it are dropped and counted.
        min_free_mb: stop recording when the disk has less free space, MB.
        snapshot: keep the last seconds in memory and write only on request (``ic bag snapshot``, emergency stop).
            Between the commands ``record`` and ``stop`` (the page's button) it records into a bag of its own.
        snapshot_seconds: seconds before the request that a snapshot holds.
        max_cache_mb: memory for the last seconds, MB; with more traffic the snapshot is shorter.
        path: folder of the bag, which must not exist; empty creates ``runs/bag_DATE_TIME`` in the working directory. In
            snapshot mode, the folder for the snapshots.
        topics: names or patterns of the topics to record; empty records everything.
        exclude: names or patterns of the topics to leave out.
        discovery_period_s: seconds between searches for new topics.
        duration_s: seconds after which recording ends; 0 records until stopped.
        snapshot_after_s: seconds after the request that a snapshot also holds.
    """

    compressed: bool = False
    max_bag_size: NotNegativeInt = 0
    max_bag_duration: NotNegative = 0.0
    queue_mb: PositiveInt = 256
    min_free_mb: NotNegativeInt = 100
    snapshot: bool = False
    snapshot_seconds: Positive = 30.0
    max_cache_mb: PositiveInt = 256
    path: str = ""
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    discovery_period_s: Annotated[float, Range(0.01, 10.0)] = 0.2
    duration_s: NotNegative = 0.0
    snapshot_after_s: NotNegative = 2.0

    def folder(self) -> Path:
        if self.path:
            return Path(self.path).expanduser()
        return Path("runs") / f"{'snapshots' if self.snapshot else 'bag'}_{datetime.now():%Y%m%d_%H%M%S}"


@dataclass
class _Dropped:
    """Counts for the metadata, written at the end."""

    overflow: Counter[str] = field(default_factory=Counter)
    paused: Counter[str] = field(default_factory=Counter)


class Recorder:
    """The recording, independent of the bus: the caller reports publishers and passes bytes.

    Args:
        path: the bag's folder; with snapshots, the parent folder of one bag per snapshot.
        subscribe: ``(topic, take)`` subscribes to raw bytes and returns the counter of lost messages.
        sim_now_ns: the simulated clock, if there is one. Nodes that do not follow it (the recorder itself, the console)
            stamp with the machine's time; their messages get the simulated time of their arrival instead.
        free_bytes: free space on the bag's disk; replaced in tests.

    Raises:
        BagError: the bag cannot be created.
    """

    def __init__(
        self,
        path: Path,
        choice: TopicChoice,
        subscribe: Subscribe,
        sim_now_ns: Callable[[], int] | None = None,
        options: BagRecorderConfig | None = None,
        free_bytes: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free,
    ) -> None:
        self.path = path
        self.options = options or BagRecorderConfig()
        self._kept = 0  # in memory
        self.dropped = _Dropped()
        self.snapshots: list[BagSnapshot] = []
        self._choice = choice
        self._subscribe = subscribe
        self._sim_now_ns = sim_now_ns
        self._paused = self._failed = False
        self._begun_ns = 0
        self._held: list[BagMessage] = []
        self._missed = LatchedValues()
        self._losses: dict[str, Stats] = {}
        self._recent_lost, self._recent_dropped = RecentCount(_RECENT_S), RecentCount(_RECENT_S)
        self._qos: dict[str, QoS] = {}
        self._parameters: dict[str, object] = {}
        writer: BagWriter | None = None
        self._cache: SnapshotCache | None = None
        if self.options.snapshot:
            if not (above := on_disk(path)).is_dir() or not os.access(above, os.W_OK):
                raise BagError(f"folder {path} for snapshots cannot be created: {above} is not a writable folder")
            self._cache = SnapshotCache(self.options.snapshot_seconds, self.options.max_cache_mb * _MB)
        else:
            size, duration_s = self.options.max_bag_size, self.options.max_bag_duration
            writer = BagWriter(path, self.options.compressed, size, duration_s)
        self._thread = RecorderThread(
            path, writer, self._custom, self.options.queue_mb, self.options.min_free_mb, free_bytes
        )
        self._thread.start()

    # -- on the node's thread ----------------------------------------------------------------------

    @property
    def topics(self) -> Collection[str]:
        return self._losses.keys()

    @property
    def state(self) -> str:
        """``recording``, ``paused``, ``disk full``, ``failed`` or ``ended``."""
        return PAUSED if self._paused and self._thread.state == RECORDING else self._thread.state

    @property
    def error(self) -> str:
        """Why recording failed or waits."""
        return self._thread.error

    @property
    def failed(self) -> bool:
        """True if an error occurred since the start."""
        return self._failed or self._thread.failed

    @property
    def count(self) -> int:
        """Messages written; in snapshot mode, messages in memory or written."""
        return self._thread.writer.count if self._thread.writer is not None else self._kept

    def discover(self, topics: Collection[TopicInfo], nodes: Collection[NodeInfo] = ()) -> None:
        """Subscribe to new selected topics and store the parameters of nodes."""
        for info in topics:
            if info.topic not in self._losses and self._choice.takes(info.topic):
                offered = [PRESETS.get(publisher.qos, SENSOR) for publisher in info.publishers]
                # With several publishers of one topic, a reader must know that it is latched if any of them is.
                self._qos[info.topic] = max(offered, key=lambda qos: (qos.latched, qos.reliable))
                self._losses[info.topic] = self._subscribe(info.topic, self.take)
        for node in nodes:
            self._parameters[node.name] = {"executable": node.executable, "params": node.params}

    def take(
        self, topic: str, type_name: str, payload: bytes | memoryview, publish_ns: int, publisher: str = ""
    ) -> None:
        """Queue one message; never waits. The payload is copied, since its memory may be overwritten."""
        stamp_ns = self._stamp_ns(publish_ns)
        if stamp_ns > 0:  # otherwise from a node on simulated time before the first /clock: it has no time
            qos = self._qos.get(topic, SENSOR)
            message = BagMessage(topic, type_name, bytes(payload), stamp_ns, qos, publisher)
            if not self._begun_ns and qos.latched:
                # The value may be minutes old: keep it until the first other message sets the start of this bag.
                self._held.append(message)
                return
            if not self._begun_ns:
                self._begin(stamp_ns)
            self._hand_on(message)

    def pause(self) -> None:
        """Stop recording; latched values received meanwhile are recorded on resume."""
        self._paused = True

    def resume(self) -> None:
        """Continue recording, starting with the latched values received meanwhile."""
        if self._paused:
            self._paused = False
            self.tick()

    def snapshot(self, reason: str = "", after_s: float = 0.0) -> BagSnapshot:
        """Write the messages in memory into a separate bag after ``after_s`` more seconds.

        Raises:
            ValueError: not in snapshot mode.
        """
        if self._cache is None:
            raise ValueError("the recorder is not in snapshot mode: start it with --snapshot")
        for waiting in self.snapshots:
            if waiting.state == "waiting":  # a pending snapshot will contain this moment too
                return waiting
        found = BagSnapshot(dated(self.path, reason), due_s=time.monotonic() + after_s)
        self.snapshots.append(found)
        self.tick()
        return found

    def tick(self) -> None:
        """Run periodic work: start due snapshots, and queue latched values again after a full disk."""
        while self._thread.not_written:
            self._missed.put(self._thread.not_written.popleft())
        if self.state == RECORDING:
            self._hand_on_missed()
        for waiting in self.snapshots:
            if waiting.state == "waiting" and time.monotonic() >= waiting.due_s:
                self._write_snapshot(waiting)

    def lost(self) -> dict[str, int]:
        """Return the messages lost in transit, by topic; only topics with losses."""
        # A copy: the writing thread reads while this one may add topics.
        return {topic: counter.lost for topic, counter in list(self._losses.items()) if counter.lost}

    def lost_by(self) -> dict[str, dict[str, int]]:
        """Return the messages lost in transit: topic → publisher → messages."""
        return {topic: dict(counter.lost_by) for topic, counter in list(self._losses.items()) if counter.lost_by}

    def unknown_types(self) -> dict[str, str]:
        """Return the types recorded without a definition, with one of their topics each."""
        return dict(self._thread.writer.unknown_types) if self._thread.writer is not None else {}

    def status(self) -> dict[str, Any]:
        """Return the values that ``ic bag status`` shows."""
        writer, cache = self._thread.writer, self._cache
        status: dict[str, Any] = {
            "path": str(self.path),
            "state": self.state,
            "error": self.error,
            "topics": len(self._losses),
            "messages": self.count,
            "queued_bytes": self._thread.queue.bytes,
            "lost": self.lost_by(),
            "overflow": dict(self.dropped.overflow),
            "paused": dict(self.dropped.paused),
            "disk_full": dict(self._thread.lost()),
        }
        if writer is not None:
            status |= {"bytes": writer.bytes, "files": writer.files}
        if cache is not None:
            status |= {"cached_bytes": cache.bytes, "cached_s": round(cache.span_s, 1)}
            status["snapshots"] = [{"path": str(s.path), "state": s.state, "words": s.words} for s in self.snapshots]
        return status

    def summary(self) -> str:
        """Return the content of the recording in one line."""
        status = self.status()
        text = f"{status['messages']} messages, {status['topics']} topics, {self.state}"
        if "bytes" in status:
            return f"{text}, {status['bytes'] / 1e6:.1f} MB in {status['files']} files"
        return f"{text}, the last {status['cached_s']:g} s at hand ({status['cached_bytes'] / 1e6:.0f} MB)"

    def diagnoses(self, fault: str = "") -> Iterator[Diagnosis]:
        """Yield the diagnoses of the recording; ``fault`` of another recording replaces its own."""
        lost, now_ns = self.lost(), time.monotonic_ns()
        overflow, now_lost = self.dropped.overflow, self._recent_lost.rise(sum(lost.values()), now_ns)
        now_dropped = self._recent_dropped.rise(sum(overflow.values()), now_ns)
        if not fault and self.state in (FAILED, DISK_FULL):
            gone = self._thread.lost()
            fault = f"{self.error}; not recorded: {counts_text(gone)}" if gone else self.error
        elif not fault and now_dropped:
            fault = f"{self.summary()}; the disk is too slow, dropped: {counts_text(overflow)}"
        if fault:
            yield Diagnosis("bag", Level.ERROR, fault)
        else:
            missing = lost or overflow
            text = self.summary() + (f"; lost: {counts_text(missing)}" if missing else "")
            values = {"messages": self.count, **{topic.strip("/"): count for topic, count in missing.items()}}
            yield Diagnosis("bag", Level.WARN if now_lost else Level.OK, text, values)
        if unknown := self.unknown_types():
            named = ", ".join(f"{type_name} ({topic})" for type_name, topic in sorted(unknown.items()))
            yield Diagnosis("types", Level.WARN, f"recorded without type definition, which is unknown here: {named}")

    def close(self, timeout_s: float = 30.0) -> None:
        """Complete the bag; its metadata contain the losses and the nodes' parameters.

        Raises:
            BagError: the bag could not be written completely.
        """
        if self._held:
            self._begin(max(message.stamp_ns for message in self._held))
        for waiting in self.snapshots:
            if waiting.state == "waiting":
                self._write_snapshot(waiting)
        self._thread.close(timeout_s)

    def _begin(self, stamp_ns: int) -> None:
        self._begun_ns = stamp_ns
        held, self._held = self._held, []
        for message in held:
            self._hand_on(message)

    def _hand_on(self, message: BagMessage) -> None:
        if message.qos.latched:
            message = replace(message, stamp_ns=max(message.stamp_ns, self._begun_ns))
        if self._paused:
            self.dropped.paused[message.topic] += 1
            if message.qos.latched:
                self._thread.not_written.append(message)
            return
        if self._thread.state in (DISK_FULL, FAILED):
            self._thread.skip(message)
            return
        if self._cache is not None:
            self._cache.add(message, time.monotonic())
        elif not self._thread.queue.put(message):
            self.dropped.overflow[message.topic] += 1
            return
        self._kept += 1

    def _hand_on_missed(self) -> None:
        missed, self._missed = self._missed, LatchedValues()
        for message in missed.values():
            self._hand_on(message)

    def _stamp_ns(self, publish_ns: int) -> int:
        if self._sim_now_ns is None:
            return publish_ns
        now_ns = self._sim_now_ns()
        return publish_ns if abs(publish_ns - now_ns) < FOREIGN_CLOCK_NS else now_ns

    def _write_snapshot(self, snapshot: BagSnapshot) -> None:
        assert self._cache is not None
        snapshot.state = "writing"
        content = self._cache.content()

        def save() -> None:
            if not save_snapshot(snapshot, content, self.options.compressed, self._thread.set_custom):
                self._failed = True

        self._thread.queue.put(save)

    def _custom(self) -> dict[str, Any]:
        """Return what is stored with the bag, by name."""
        found: dict[str, Any] = {
            "lost": self.lost(),
            "lost_by": self.lost_by(),
            "overflow": self.dropped.overflow,
            "paused": self.dropped.paused,
            "disk_full": self._thread.lost(),
            "parameters": self._parameters,
        }
        return {key: dict(value) for key, value in found.items() if value or key in ("lost", "parameters")}


def dated(folder: Path, words: str, prefix: str = "") -> Path:
    """Return an unused path in ``folder``, named by date, time and the characters of ``words`` valid in file names."""
    slug = "".join(c if c.isalnum() else "_" for c in words.strip())[:40].strip("_")
    name = f"{prefix}{datetime.now():%Y%m%d_%H%M%S}" + (f"_{slug}" if slug else "")
    path, number = folder / name, 1
    while path.exists():
        number += 1
        path = folder / f"{name}_{number}"
    return path
