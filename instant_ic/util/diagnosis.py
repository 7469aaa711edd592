"""State of a device or an algorithm, for a node's diagnostics."""

from __future__ import annotations

import enum
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


class Level(enum.IntEnum):
    """Severity, as in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Diagnosis:
    """One named state.

    Attributes:
        name: name of the diagnosis; it replaces the previous one of this name.
        level: severity.
        text: what happened, then what to do.
        values: further values to publish.
    """

    name: str
    level: Level
    text: str
    values: Mapping[str, Any] = field(default_factory=dict)


class RecentCount:
    """Counts the events of the last ``window_s`` seconds. The caller supplies the time.

    ``total`` is the newest argument of :meth:`rise`. Diagnoses use the recent count, because a total since the start
    does not show whether the fault persists.
    """

    def __init__(self, window_s: float) -> None:
        self.window_s = window_s
        self._events: deque[tuple[int, int]] = deque()
        self.total = 0

    def add(self, events: int, now_ns: int) -> None:
        """Add a number of events at ``now_ns``."""
        if events > 0:
            self._events.append((now_ns, events))

    def rise(self, total: int, now_ns: int) -> int:
        """Add the growth of a running total since the last call. Return the number of events in the window."""
        self.add(total - self.total, now_ns)
        self.total = total
        return self.count(now_ns)

    def count(self, now_ns: int) -> int:
        """Return the number of events in the window that ends at ``now_ns``."""
        oldest_ns = now_ns - int(self.window_s * 1e9)
        while self._events and self._events[0][0] <= oldest_ns:
            self._events.popleft()
        return sum(events for _, events in self._events)
