"""The last seconds of all topics in memory, for a snapshot on request."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from instant_ic.bag.latched import LatchedValues
from instant_ic.bag.message import BagError, BagMessage
from instant_ic.bag.writer import BagWriter

log = logging.getLogger(__name__)


@dataclass
class BagSnapshot:
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


class SnapshotCache:
    """Keeps the latest messages in memory; not thread-safe.

    Args:
        seconds: how long to keep a message, by the clock passed to :meth:`add`.
        max_bytes: total size above which the oldest messages are dropped earlier.
    """

    def __init__(self, seconds: float, max_bytes: int) -> None:
        self.seconds = seconds
        self.max_bytes = max_bytes
        self.bytes = 0
        self._entries: deque[tuple[float, BagMessage]] = deque()
        self._before = LatchedValues()

    def add(self, entry: BagMessage, now_s: float) -> None:
        """Add a message received at ``now_s``; drop expired ones."""
        self._entries.append((now_s, entry))
        self.bytes += len(entry.payload)
        while self._entries and (self._entries[0][0] < now_s - self.seconds or self.bytes > self.max_bytes):
            _, old = self._entries.popleft()
            self.bytes -= len(old.payload)
            if old.qos.latched:  # its value is still valid at the start of the window
                self._before.put(old)

    @property
    def span_s(self) -> float:
        """Seconds between the oldest and the newest message."""
        return self._entries[-1][0] - self._entries[0][0] if self._entries else 0.0

    def content(self) -> list[BagMessage]:
        """Return the messages, oldest first, preceded by the latched values valid at their start, with that stamp."""
        entries = [entry for _, entry in self._entries]
        if not entries:
            return []
        begin_ns = min(entry.stamp_ns for entry in entries)
        return [replace(value, stamp_ns=begin_ns) for value in self._before.values()] + entries


def save_snapshot(
    snapshot: BagSnapshot, content: list[BagMessage], compressed: bool, set_custom: Callable[[BagWriter], None]
) -> bool:
    """Write a snapshot; return whether it was written. An error concerns this snapshot only; the next may succeed."""
    try:
        if not content:
            raise BagError(f"snapshot {snapshot.path}: no message has been received yet")
        with BagWriter(snapshot.path, compressed) as writer:
            for entry in content:
                writer.write(entry.topic, entry.type_name, entry.payload, entry.stamp_ns, entry.qos)
            set_custom(writer)
    except BagError as error:
        snapshot.words, snapshot.state = str(error), "failed"
        log.error("%s", error)
        return False
    span_s = (max(e.stamp_ns for e in content) - min(e.stamp_ns for e in content)) / 1e9
    snapshot.words, snapshot.state = f"{len(content)} messages, {span_s:.1f} s", "done"
    log.info("snapshot %s: %s", snapshot.path, snapshot.words)
    return True
