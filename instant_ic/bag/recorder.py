"""Records topics without decoding them, finds new publishers while it runs, and counts losses.

The node never waits for the disk: messages go into a queue, bounded by bytes, and a thread writes them. Messages that
do not fit are counted by topic and reported.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.errors import BagError, DiskFullError
from instant_ic.bag.latched import LatchedValues
from instant_ic.bag.message import BagMessage
from instant_ic.bag.snapshot import SnapshotCache
from instant_ic.bag.writer import BagWriter
from instant_ic.bus.qos import PRESETS, SENSOR, QoS
from instant_ic.bus.registry import NodeInfo, TopicInfo
from instant_ic.bus.transport import Stats
from instant_ic.config.ranges import Checked, NotNegative, NotNegativeInt, Positive, PositiveInt, Range
from instant_ic.util.diagnosis import Diagnosis, Level, RecentCount

FOREIGN_CLOCK_NS = 10_000_000_000
"""A stamp farther than this from the simulated clock comes from another clock."""

FLUSH_S = 1.0
"""Longest time of the recording that a killed recorder loses."""

SYNC_S = 5.0
"""Longest time of the recording that a power failure loses, beside what the disk itself holds back."""

SPACE_S = 1.0
"""Seconds between two looks at the free space of the disk."""

RECORDING, PAUSED, DISK_FULL, FAILED, ENDED = "recording", "paused", "disk full", "failed", "ended"

_MB = 1_000_000
_KEEP_CUSTOM_S = 10.0
_RECENT_S = 10.0  # losses longer ago are no warning
_ROOM_AGAIN = 64_000_000  # free space above the reserve before recording restarts

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
        start_paused: record only after a resume command.
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
    start_paused: bool = False
    snapshot_after_s: NotNegative = 2.0

    def folder(self) -> Path:
        if self.path:
            return Path(self.path).expanduser()
        return Path("runs") / f"{'snapshots' if self.snapshot else 'bag'}_{datetime.now():%Y%m%d_%H%M%S}"


class _Queue:
    """Messages and calls queued for the writing thread."""

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self.bytes = self.messages = 0  # including those in the thread's hands
        self._items: deque[BagMessage | Callable[[], None]] = deque()
        self._condition = threading.Condition()

    def put(self, item: BagMessage | Callable[[], None]) -> bool:
        """Queue an item; return False if a message does not fit. Latched messages and calls always fit."""
        size = len(item.payload) if isinstance(item, BagMessage) else 0
        with self._condition:
            if isinstance(item, BagMessage) and not item.qos.latched and self.bytes + size > self.max_bytes:
                return False
            self._items.append(item)
            self.bytes += size
            self.messages += isinstance(item, BagMessage)
            self._condition.notify()
        return True

    def take(self, timeout_s: float) -> BagMessage | Callable[[], None] | None:
        """Return the next item, or None after `timeout_s`."""
        with self._condition:
            if not self._items and not self._condition.wait_for(lambda: bool(self._items), timeout_s):
                return None
            return self._items.popleft()

    def done(self, item: BagMessage) -> None:
        """Release the bytes of a message that has been written."""
        with self._condition:
            self.bytes -= len(item.payload)
            self.messages -= 1


@dataclass
class Snapshot:
    """One snapshot.

    Attributes:
        state: ``waiting``, ``writing``, ``done`` or ``failed``.
        words: content of the bag, or why it failed.
        due_s: time at which it is written, by the monotonic clock.
    """

    path: Path
    state: str = "waiting"
    words: str = ""
    due_s: float = 0.0


@dataclass
class _Dropped:
    """Counts for the metadata, written at the end."""

    overflow: Counter[str] = field(default_factory=Counter)
    paused: Counter[str] = field(default_factory=Counter)
    disk_full: Counter[str] = field(default_factory=Counter)
    no_type: Counter[str] = field(default_factory=Counter)


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
        self.early = 0
        self.error = ""
        """Why recording failed or waits."""
        self.failed = False
        """Whether an error occurred since the start."""
        self.dropped = _Dropped()
        self.snapshots: list[Snapshot] = []
        self._choice = choice
        self._subscribe = subscribe
        self._sim_now_ns = sim_now_ns
        self._free_bytes = free_bytes
        self._paused = False
        self._state = RECORDING
        self._begun_ns = 0
        self._held: list[BagMessage] = []
        self._missed = LatchedValues()
        self._not_written: deque[BagMessage] = deque()
        self._losses: dict[str, Stats] = {}
        self._recent_lost, self._recent_dropped = RecentCount(_RECENT_S), RecentCount(_RECENT_S)
        self._qos: dict[str, QoS] = {}
        self._parameters: dict[str, object] = {}
        self._writer: BagWriter | None = None
        self._cache: SnapshotCache | None = None
        if self.options.snapshot:
            if not (above := on_disk(path)).is_dir() or not os.access(above, os.W_OK):
                raise BagError(f"folder {path} for snapshots cannot be created: {above} is not a writable folder")
            self._cache = SnapshotCache(self.options.snapshot_seconds, self.options.max_cache_mb * _MB)
        else:
            self._writer = BagWriter(
                path, self.options.compressed, self.options.max_bag_size, self.options.max_bag_duration
            )
        self._queue = _Queue(self.options.queue_mb * _MB)
        self._counting = threading.Lock()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._thread.start()

    # -- on the node's thread ----------------------------------------------------------------------

    @property
    def topics(self) -> Collection[str]:
        return self._losses.keys()

    @property
    def state(self) -> str:
        """``recording``, ``paused``, ``disk full``, ``failed`` or ``ended``."""
        return PAUSED if self._paused and self._state == RECORDING else self._state

    @property
    def count(self) -> int:
        """Messages written; in snapshot mode, messages in memory or written."""
        return self._writer.count if self._writer is not None else self._kept

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
        if not type_name:
            self.dropped.no_type[topic] += 1
        elif stamp_ns <= 0:  # a node on simulated time before the first /clock: the message has no time
            self.early += 1
        else:
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

    def toggle(self) -> None:
        if self.state == PAUSED:
            self.resume()
        else:
            self.pause()

    def split(self) -> None:
        """End the current file; the next message starts another.

        Raises:
            ValueError: snapshot mode has no file to split.
        """
        if self._writer is None:
            raise ValueError("snapshot mode has no file to split")
        self._queue.put(self._end_part)

    def snapshot(self, reason: str = "", after_s: float = 0.0) -> Snapshot:
        """Write the messages in memory into a separate bag after ``after_s`` more seconds.

        Raises:
            ValueError: not in snapshot mode.
        """
        if self._cache is None:
            raise ValueError("the recorder is not in snapshot mode: start it with --snapshot")
        for waiting in self.snapshots:
            if waiting.state == "waiting":  # a pending snapshot will contain this moment too
                return waiting
        found = Snapshot(dated(self.path, reason), due_s=time.monotonic() + after_s)
        self.snapshots.append(found)
        self.tick()
        return found

    def tick(self) -> None:
        """Run periodic work: start due snapshots, and queue latched values again after a full disk."""
        while self._not_written:
            self._missed.put(self._not_written.popleft())
        if self.state == RECORDING:
            self._hand_on_missed()
        for waiting in self.snapshots:
            if waiting.state == "waiting" and time.monotonic() >= waiting.due_s:
                self._write_snapshot(waiting)

    def lost(self) -> dict[str, int]:
        """Messages lost in transit, by topic; only topics with losses."""
        # A copy: the writing thread reads while this one may add topics.
        return {topic: counter.lost for topic, counter in list(self._losses.items()) if counter.lost}

    def lost_by(self) -> dict[str, dict[str, int]]:
        """Messages lost in transit: topic → publisher → messages."""
        return {topic: dict(counter.lost_by) for topic, counter in list(self._losses.items()) if counter.lost_by}

    def not_written(self) -> Counter[str]:
        """Messages by topic that were lost because the disk was full, or failed."""
        with self._counting:
            return self.dropped.disk_full + (self._writer.lost if self._writer is not None else Counter())

    def unknown_types(self) -> dict[str, str]:
        """Types recorded without a definition → one of their topics."""
        return dict(self._writer.unknown_types) if self._writer is not None else {}

    def status(self) -> dict[str, Any]:
        """Return the values that ``ic bag status`` shows."""
        writer, cache = self._writer, self._cache
        status: dict[str, Any] = {
            "path": str(self.path),
            "state": self.state,
            "error": self.error,
            "topics": len(self._losses),
            "messages": self.count,
            "queued_bytes": self._queue.bytes,
            "lost": self.lost_by(),
            "overflow": dict(self.dropped.overflow),
            "paused": dict(self.dropped.paused),
            "disk_full": dict(self.not_written()),
        }
        if writer is not None:
            status |= {"bytes": writer.bytes, "files": writer.parts}
        if cache is not None:
            status |= {"cached_bytes": cache.bytes, "cached_s": round(cache.span_s, 1)}
            status["snapshots"] = [{"path": str(s.path), "state": s.state, "words": s.words} for s in self.snapshots]
        return status

    def summary(self) -> str:
        """One line on the content of the recording."""
        status = self.status()
        text = f"{status['messages']} messages, {status['topics']} topics, {self.state}"
        if "bytes" in status:
            return f"{text}, {status['bytes'] / 1e6:.1f} MB in {status['files']} files"
        return f"{text}, the last {status['cached_s']:g} s at hand ({status['cached_bytes'] / 1e6:.0f} MB)"

    def diagnoses(self, fault: str = "") -> Iterator[Diagnosis]:
        """State of the recording; ``fault`` is one of another recording that goes before its own."""
        lost, now_ns = self.lost(), time.monotonic_ns()
        overflow, now_lost = self.dropped.overflow, self._recent_lost.rise(sum(lost.values()), now_ns)
        now_dropped = self._recent_dropped.rise(sum(overflow.values()), now_ns)
        if not fault and self.state in (FAILED, DISK_FULL):
            gone = self.not_written()
            fault = f"{self.error}; not recorded: {_counts(gone)}" if gone else self.error
        elif not fault and now_dropped:
            fault = f"{self.summary()}; the disk is too slow, dropped: {_counts(overflow)}"
        if fault:
            yield Diagnosis("bag", Level.ERROR, fault)
        else:
            missing = lost or overflow
            text = self.summary() + (f"; lost: {_counts(missing)}" if missing else "")
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
        self._ending.set()
        self._queue.put(lambda: None)  # wakes the thread
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise BagError(
                f"bag {self.path}: the disk did not take the last {self._queue.messages} messages "
                f"({self._queue.bytes / 1e6:.1f} MB) within {timeout_s:g} s; ic bag recover {self.path}"
            )
        if self._state == FAILED:
            raise BagError(self.error)

    def _count(self, counter: Counter[str], topic: str) -> None:
        with self._counting:  # two threads skip messages
            counter[topic] += 1

    def _begin(self, stamp_ns: int) -> None:
        self._begun_ns = stamp_ns
        held, self._held = self._held, []
        for message in held:
            self._hand_on(message)

    def _hand_on(self, message: BagMessage) -> None:
        if message.qos.latched:
            message = replace(message, stamp_ns=max(message.stamp_ns, self._begun_ns))
        if self._paused or self._state in (DISK_FULL, FAILED):
            if message.qos.latched:
                self._not_written.append(message)
            self._count(self.dropped.paused if self._paused else self.dropped.disk_full, message.topic)
            return
        if self._cache is not None:
            self._cache.add(message, time.monotonic())
        elif not self._queue.put(message):
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

    def _write_snapshot(self, snapshot: Snapshot) -> None:
        assert self._cache is not None
        snapshot.state = "writing"
        content = self._cache.content()
        self._queue.put(lambda: self._save(snapshot, content))

    # -- on the writing thread ---------------------------------------------------------------------

    def _run(self) -> None:
        next_flush = next_space = 0.0
        next_custom, next_sync = time.monotonic() + _KEEP_CUSTOM_S, time.monotonic() + SYNC_S
        while True:
            item = self._queue.take(0.0 if self._ending.is_set() else SPACE_S)
            if item is None and self._ending.is_set():
                break
            try:
                if isinstance(item, BagMessage):
                    self._write(item)
                elif item is not None:
                    item()
                now = time.monotonic()
                if now >= next_space:
                    next_space = now + SPACE_S
                    self._look_for_space()
                if self._writer is None or self._state != RECORDING:
                    continue
                if now >= next_flush:
                    next_flush = now + FLUSH_S
                    self._writer.flush()
                if now >= next_custom:
                    next_custom = now + _KEEP_CUSTOM_S
                    self._set_custom(self._writer)
                    self._writer.keep_custom()
                if now >= next_sync:
                    next_sync = now + SYNC_S
                    self._writer.sync()
            except DiskFullError as error:
                self._stop(DISK_FULL, str(error))
            except BagError as error:
                self._stop(FAILED, str(error))
            except Exception as error:  # a bug here must not leave a recorder that only appears to record
                log.exception("bag writer")
                self._stop(FAILED, f"{type(error).__name__}: {error}")
        self._finish()

    def _write(self, entry: BagMessage) -> None:
        try:
            if self._writer is None or self._state != RECORDING:
                self._count(self.dropped.disk_full, entry.topic)
                if entry.qos.latched:
                    self._not_written.append(entry)
                return
            self._writer.write(
                entry.topic, entry.type_name, entry.payload, entry.stamp_ns, entry.qos, publisher=entry.publisher
            )
        finally:
            self._queue.done(entry)

    def _end_part(self) -> None:
        if self._writer is not None and self._state == RECORDING and not self._writer.part_is_empty:
            self._set_custom(self._writer)
            self._writer.end_part()

    def _look_for_space(self) -> None:
        if self._state == FAILED:
            return
        try:
            # Without a snapshot so far, the folder for snapshots need not exist.
            free = self._free_bytes(self.path if self._cache is None else on_disk(self.path))
        except OSError as error:
            self._stop(FAILED, f"bag {self.path}: {error.strerror}: its folder was removed")
            return
        reserve = self.options.min_free_mb * _MB
        if self._state == RECORDING and free < reserve:
            words = f"only {free / 1e6:.0f} MB are free where {self.path} is, {reserve / 1e6:.0f} MB are the reserve"
            if self._writer is not None:
                self._set_custom(self._writer)
                self._writer.end_part()
            self._stop(DISK_FULL, f"{words}: not recording; the bag is complete up to here")
        elif self._state == DISK_FULL and free >= reserve + _ROOM_AGAIN:
            log.warning(
                "%s: space is available again; recording continues in a new file. Not recorded so far: %s",
                self.path,
                _counts(self.not_written()) or "nothing",
            )
            self._state, self.error = RECORDING, ""

    def _stop(self, state: str, words: str) -> None:
        self._state, self.error, self.failed = state, words, True
        log.debug("%s", words)  # reported by the node's diagnostics and by close()

    def _save(self, snapshot: Snapshot, content: list[BagMessage]) -> None:
        """Write a snapshot. An error concerns this snapshot only; the next may succeed."""
        try:
            if not content:
                raise BagError(f"snapshot {snapshot.path}: no message has been received yet")
            with BagWriter(snapshot.path, self.options.compressed) as writer:
                for entry in content:
                    writer.write(entry.topic, entry.type_name, entry.payload, entry.stamp_ns, entry.qos)
                self._set_custom(writer)
        except BagError as error:
            snapshot.words, snapshot.state = str(error), "failed"
            self.failed = True
            log.error("%s", error)
        else:
            span_s = (max(e.stamp_ns for e in content) - min(e.stamp_ns for e in content)) / 1e9
            snapshot.words, snapshot.state = f"{len(content)} messages, {span_s:.1f} s", "done"
            log.info("snapshot %s: %s", snapshot.path, snapshot.words)

    def _set_custom(self, writer: BagWriter) -> None:
        for key, value in (
            ("lost", self.lost()),
            ("lost_by", self.lost_by()),
            ("overflow", self.dropped.overflow),
            ("paused", self.dropped.paused),
            ("disk_full", self.not_written()),
            ("no_type", self.dropped.no_type),
            ("parameters", self._parameters),
        ):
            if value or key in ("lost", "parameters"):
                writer.set_custom(f"instant_ic.{key}", json.dumps(dict(value), sort_keys=True))
        writer.set_custom("instant_ic.before_clock", str(self.early))

    def _finish(self) -> None:
        if self._writer is None:
            self._state = ENDED
            return
        for step in (self._writer.end_part, self._writer.close):  # the second writes what the first has lost
            self._set_custom(self._writer)
            try:
                step()
            except BagError as error:
                if self._state != FAILED:  # otherwise keep the first reason
                    self._stop(FAILED, str(error))
        if self._state != FAILED:
            self._state = ENDED
        if self.error and (gone := self.not_written()):
            self.error += f"; not recorded: {_counts(gone)}"


def on_disk(path: Path) -> Path:
    """Return the path, or the nearest one above it that exists."""
    return next(above for above in (path, *path.absolute().parents) if above.exists())


def dated(folder: Path, words: str, prefix: str = "") -> Path:
    """Return an unused path in ``folder``, named by date, time and the characters of ``words`` valid in file names."""
    slug = "".join(c if c.isalnum() else "_" for c in words.strip())[:40].strip("_")
    name = f"{prefix}{datetime.now():%Y%m%d_%H%M%S}" + (f"_{slug}" if slug else "")
    path, number = folder / name, 1
    while path.exists():
        number += 1
        path = folder / f"{name}_{number}"
    return path


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{topic} {number}" for topic, number in sorted(counts.items()))
