"""Clocks: a node asks its clock for the time, never the system."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Source of a node's time."""

    def now_ns(self) -> int:
        """Nanoseconds since the epoch; 0 while a simulated clock has not started."""
        ...


class SystemClock:
    """The machine's clock."""

    def now_ns(self) -> int:
        """Nanoseconds since the epoch."""
        return time.time_ns()


class ManualClock:
    """A clock that somebody sets: ``/clock`` in replay, the lockstep bus in tests."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """The time last set."""
        return self._now_ns

    def set(self, now_ns: int) -> None:
        """Sets the time; it may go back, as when a player loops."""
        self._now_ns = int(now_ns)
