"""The last seconds of all topics in memory, for a snapshot on request."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from instant_ic.bag.latched import LatchedValues
from instant_ic.bag.message import BagMessage


class SnapshotCache:
    """The latest messages in memory; not thread-safe.

    Args:
        seconds: time to keep a message, by the clock passed to :meth:`add`.
        max_bytes: total size above which the oldest messages are dropped early.
    """

    def __init__(self, seconds: float, max_bytes: int) -> None:
        self.seconds = seconds
        self.max_bytes = max_bytes
        self.bytes = 0
        self._entries: deque[tuple[float, BagMessage]] = deque()
        self._before = LatchedValues()

    def add(self, entry: BagMessage, now_s: float) -> None:
        """Add a message received at ``now_s``, and drop expired messages."""
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

    def latched(self) -> list[BagMessage]:
        """Return the current value of each latched topic."""
        values = LatchedValues()
        for message in [*self._before.values(), *(entry for _, entry in self._entries if entry.qos.latched)]:
            values.put(message)
        return values.values()

    def content(self) -> list[BagMessage]:
        """Return the messages, oldest first, preceded by the latched values that were valid at their start.

        A latched value that is older than the first other message gets that message's stamp.
        """
        entries = [entry for _, entry in self._entries]
        stamps_ns = [entry.stamp_ns for entry in entries if not entry.qos.latched] or [e.stamp_ns for e in entries]
        return [
            replace(message, stamp_ns=max(message.stamp_ns, min(stamps_ns))) if message.qos.latched else message
            for message in (*self._before.values(), *entries)
        ]
