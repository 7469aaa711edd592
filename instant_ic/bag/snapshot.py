"""The last seconds of all topics in memory, for a snapshot on request."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from instant_ic.bag.latched import LatchedValues
from instant_ic.bag.message import BagMessage


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
