"""Recording of topics as bytes, with discovery of new publishers and counts of lost messages.

By default the recorder writes one bag from its start to its end. In snapshot mode it keeps the last seconds in memory
and writes them into a bag on request. Between the commands ``record`` and ``stop`` it also records into another bag.
"""

from __future__ import annotations

import math
import os
import shutil
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.message import BagError, BagMessage
from instant_ic.bag.recording import ENDING, RECORDING, BagRecorderConfig, Recording, counts_text, low_text
from instant_ic.bag.snapshot import SnapshotCache
from instant_ic.bus.qos import PRESETS, SENSOR, QoS
from instant_ic.bus.registry import NodeInfo, TopicInfo
from instant_ic.bus.transport import Stats
from instant_ic.util.diagnosis import Diagnosis, Level, RecentCount

FOREIGN_CLOCK_NS = 10_000_000_000
"""Difference from the simulated clock above which a stamp must come from another clock."""

_MB = 1_000_000
_RECENT_S = 10.0  # older losses cause no warning
_IDLE = "idle"

TakeMessage = Callable[..., None]
"""Accepts ``(topic, type_name, payload, publish_ns, publisher)``; see :meth:`Recorder.take`."""
Subscribe = Callable[[str, TakeMessage], Stats]


class Recorder:
    """The recorder, independent of the bus. The caller reports publishers and passes bytes.

    Args:
        path: the bag's folder; in snapshot mode, the parent folder of the bags.
        subscribe: ``(topic, take)`` subscribes to raw bytes and returns the counter of lost messages.
        sim_now_ns: returns the simulated time; None without simulation. Nodes that do not follow it (this recorder, the
            console) stamp with the machine's time, and their messages get the simulated time of their arrival instead.
        free_bytes: free space on the bag's disk; replaced in tests.

    Attributes:
        bag: the bag that is being written, or the last one; None before the first one in snapshot mode.
        snapshots: bags of the snapshots so far.

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
        self.bag: Recording | None = None
        self.snapshots: list[Recording] = []
        self._choice = choice
        self._subscribe = subscribe
        self._sim_now_ns = sim_now_ns
        self._free_bytes = free_bytes
        self._losses: dict[str, Stats] = {}
        self._recent_lost, self._recent_dropped = RecentCount(_RECENT_S), RecentCount(_RECENT_S)
        self._qos: dict[str, QoS] = {}
        self._parameters: dict[str, object] = {}
        self._cache: SnapshotCache | None = None
        if self.options.snapshot:
            if not (above := _on_disk(path)).is_dir() or not os.access(above, os.W_OK):
                raise BagError(f"folder {path} for snapshots cannot be created: {above} is not a writable folder")
            self._cache = SnapshotCache(self.options.snapshot_seconds, self.options.max_cache_mb * _MB)
        else:
            self.bag = self._open(path)

    @property
    def failed(self) -> bool:
        """True if the last bag or a snapshot is incomplete."""
        return any(bag.failed for bag in self._bags)

    def discover(self, topics: Collection[TopicInfo], nodes: Collection[NodeInfo] = ()) -> None:
        """Subscribe to newly found topics of the selection, and store the parameters of nodes."""
        for info in topics:
            if info.topic not in self._losses and self._choice.takes(info.topic):
                offered = [PRESETS.get(publisher.qos, SENSOR) for publisher in info.publishers]
                # A topic counts as latched if any of its publishers is.
                self._qos[info.topic] = max(offered, key=lambda qos: (qos.latched, qos.reliable))
                self._losses[info.topic] = self._subscribe(info.topic, self.take)
        for node in nodes:
            self._parameters[node.name] = {"executable": node.executable, "params": node.params}

    def take(
        self, topic: str, type_name: str, payload: bytes | memoryview, publish_ns: int, publisher: str = ""
    ) -> None:
        """Queue one message without waiting. The payload is copied, because its memory may be overwritten."""
        stamp_ns = self._stamp_ns(publish_ns)
        if stamp_ns <= 0:  # sent by a node on simulated time that has not received /clock yet
            return
        message = BagMessage(topic, type_name, bytes(payload), stamp_ns, self._qos.get(topic, SENSOR), publisher)
        if self._cache is not None:
            self._cache.add(message, time.monotonic())
        for bag in self._bags:
            bag.put(message)

    def record(self, name: str = "") -> Path:
        """Start a bag ``rec_DATE_TIME_NAME`` in snapshot mode, and return its folder.

        Raises:
            ValueError: another bag is being recorded or completed, or the recorder is not in snapshot mode.
            BagError: the bag cannot be created.
        """
        cache = self._snapshot_cache()
        if self.bag is not None and not self.bag.done:
            doing = "completed" if self.bag.state == ENDING else "recorded"
            raise ValueError(f"{self.bag.path} is being {doing} already")
        self.bag = self._open(self._dated(name, "rec_"), lost_before=self.lost_by())
        for value in cache.latched():
            self.bag.put(value, old=True)
        return self.bag.path

    def stop(self) -> Path:
        """Stop the bag that :meth:`record` started. Queued messages are written in the background (see :meth:`status`).

        Raises:
            ValueError: no bag is being recorded, or the recorder is not in snapshot mode.
        """
        self._snapshot_cache()
        if self.bag is None or self.bag.done or self.bag.state == ENDING:
            raise ValueError("nothing is being recorded")
        self.bag.finish()
        return self.bag.path

    def snapshot(self, reason: str = "", after_s: float = 0.0) -> Recording:
        """Write a bag ``DATE_TIME_REASON`` with the messages in memory and those of the next ``after_s`` seconds.

        Raises:
            ValueError: the recorder is not in snapshot mode, or no message has been received.
        """
        content = self._snapshot_cache().content()
        if not content:
            raise ValueError("no message has been received yet, so there is nothing to write")
        for snapshot in self.snapshots:
            if snapshot.state == RECORDING:  # a running snapshot includes this moment
                return snapshot
        path, until_s = self._dated(reason), time.monotonic() + after_s
        self.snapshots.append(self._open(path, content, until_s))
        self.tick()
        return self.snapshots[-1]

    def tick(self) -> None:
        """End the snapshots whose time is over."""
        for bag in self._bags:
            bag.tick()

    def lost_by(self) -> dict[str, dict[str, int]]:
        """Return the messages lost in transit: topic → publisher → messages."""
        # A copy: the writing thread reads while this one may add topics.
        return {topic: dict(counter.lost_by) for topic, counter in list(self._losses.items()) if counter.lost_by}

    def status(self) -> dict[str, Any]:
        """Return the values that ``ic bag control status`` and the page show.

        In snapshot mode ``recording`` describes the bag that is being recorded, or else the last one. Its state is
        ``idle`` if no bag is being recorded.
        """
        status: dict[str, Any] = {"topics": len(self._losses), "lost": self.lost_by()}
        bag = self.bag.status() if self.bag is not None else {}
        if self._cache is None:
            return bag | status
        if self.bag is None or self.bag.done:
            bag["state"] = _IDLE
        return status | {
            "path": str(self.path),
            "state": RECORDING,
            "error": self._low_disk(),
            "cached_bytes": self._cache.bytes,
            "cached_s": round(self._cache.span_s, 1),
            "snapshots": [snapshot.status() for snapshot in self.snapshots],
            "recording": bag | {"free_bytes": self._free()},
        }

    def diagnoses(self) -> Iterator[Diagnosis]:
        """Yield the diagnoses of the recording."""
        lost = Counter({topic: sum(by.values()) for topic, by in self.lost_by().items()})
        overflow = self.bag.overflow if self.bag is not None else Counter[str]()
        now_ns = time.monotonic_ns()
        now_lost = self._recent_lost.rise(lost.total(), now_ns)
        fault = (self.bag.error if self.bag is not None else "") or self._low_disk()
        if self._recent_dropped.rise(overflow.total(), now_ns) and not fault:
            fault = f"{self._summary()}; the disk is too slow; dropped: {counts_text(overflow)}"
        if fault:
            yield Diagnosis("bag", Level.ERROR, fault)
        else:
            missing = lost or overflow
            text = self._summary() + (f"; lost: {counts_text(missing)}" if missing else "")
            values = {topic.strip("/"): count for topic, count in missing.items()}
            yield Diagnosis("bag", Level.WARN if now_lost else Level.OK, text, values)

    def close(self, timeout_s: float = 30.0) -> None:
        """Complete all bags. Their metadata contain the losses and the nodes' parameters.

        Raises:
            BagError: a bag could not be written completely.
        """
        for bag in self._bags:  # all at once: the launcher waits for 5 s, and a snapshot may take longer
            bag.finish(report=False)
        errors = []
        for bag in self._bags:
            try:
                bag.close(timeout_s)
            except BagError as error:
                errors.append(str(error))
        if errors:
            raise BagError("; ".join(errors))

    # -- internals -------------------------------------------------------------------------------

    @property
    def _bags(self) -> list[Recording]:
        return [*self.snapshots, *([self.bag] if self.bag is not None else [])]

    def _open(
        self,
        path: Path,
        content: Collection[BagMessage] = (),
        until_s: float = math.inf,
        lost_before: Mapping[str, Mapping[str, int]] | None = None,
    ) -> Recording:
        """Begin a bag whose metadata contain the losses since ``lost_before``."""
        before = lost_before or {}

        def custom() -> dict[str, Any]:
            grown = {topic: Counter(by) - Counter(before.get(topic, {})) for topic, by in self.lost_by().items()}
            return {"lost_by": {topic: by for topic, by in grown.items() if by}, "parameters": dict(self._parameters)}

        return Recording(path, self.options, custom, content, until_s, self._free_bytes)

    def _dated(self, name: str, prefix: str = "") -> Path:
        """Return an unused path, made of date, time and those characters of ``name`` that a path may have."""
        slug = "".join(c if c.isalnum() else "_" for c in name.strip())[:40].strip("_")
        stem = f"{prefix}{datetime.now():%Y%m%d_%H%M%S}" + (f"_{slug}" if slug else "")
        path, number = self.path / stem, 1
        while path.exists() or any(bag.path == path for bag in self._bags):  # a snapshot's thread creates its folder
            number += 1
            path = self.path / f"{stem}_{number}"
        return path

    def _snapshot_cache(self) -> SnapshotCache:
        if self._cache is None:
            raise ValueError("the recorder records all the time; start it with --snapshot to record on request")
        return self._cache

    def _stamp_ns(self, publish_ns: int) -> int:
        if self._sim_now_ns is None:
            return publish_ns
        now_ns = self._sim_now_ns()
        return publish_ns if abs(publish_ns - now_ns) < FOREIGN_CLOCK_NS else now_ns

    def _free(self) -> int | None:
        try:
            return self._free_bytes(_on_disk(self.path))
        except OSError:
            return None

    def _low_disk(self) -> str:
        """Return a text if the disk is too full for a bag of snapshot mode; otherwise empty."""
        free, reserve = self._free() if self._cache is not None else None, self.options.min_free_mb * _MB
        return low_text(self.path, free, reserve) if free is not None and free < reserve else ""

    def _summary(self) -> str:
        topics = f"{len(self._losses)} topics"
        if self._cache is not None:
            return f"{topics}, the last {self._cache.span_s:.1f} s in memory ({self._cache.bytes / 1e6:.0f} MB)"
        assert self.bag is not None
        bag = self.bag.status()
        size = f"{bag['bytes'] / 1e6:.1f} MB in {bag['files']} files"
        return f"{bag['messages']} messages, {topics}, {bag['state']}, {size}"


def _on_disk(path: Path) -> Path:
    """Return the path, or its nearest parent that exists."""
    return next(above for above in (path, *path.absolute().parents) if above.exists())
