"""The last seconds of all topics in memory, for a snapshot on request."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from instant_ic.bag.latched import LatchedValue, LatchedValues
from instant_ic.bus.qos import QoS


@dataclass(frozen=True)
class Entry:
    """A message to be written into a bag."""

    topic: str
    type_name: str
    payload: bytes
    stamp_ns: int
    qos: QoS
    publisher: str = ""


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
        self._entries: deque[tuple[float, Entry]] = deque()
        self._before = LatchedValues()
        self._before_qos: dict[str, QoS] = {}

    def add(self, entry: Entry, now_s: float) -> None:
        """Add a message received at ``now_s``; drop expired ones."""
        self._entries.append((now_s, entry))
        self.bytes += len(entry.payload)
        while self._entries and (self._entries[0][0] < now_s - self.seconds or self.bytes > self.max_bytes):
            _, old = self._entries.popleft()
            self.bytes -= len(old.payload)
            if old.qos.latched:  # its value is still valid at the start of the window
                self._before.put(LatchedValue(old.topic, old.type_name, old.payload, old.stamp_ns), old.publisher)
                self._before_qos[old.topic] = old.qos

    @property
    def span_s(self) -> float:
        """Seconds between the oldest and the newest message."""
        return self._entries[-1][0] - self._entries[0][0] if self._entries else 0.0

    def content(self) -> list[Entry]:
        """Return the messages, oldest first, preceded by the latched values valid at their start, with that stamp."""
        entries = [entry for _, entry in self._entries]
        if not entries:
            return []
        begin_ns = min(entry.stamp_ns for entry in entries)
        held = [
            Entry(value.topic, value.type_name, bytes(value.payload), begin_ns, self._before_qos[value.topic])
            for value in self._before.values()
        ]
        return held + entries
