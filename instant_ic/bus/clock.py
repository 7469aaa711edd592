"""Clocks: a node asks its clock for the time, never the system.

Two kinds of time: ``now_ns`` for stamps, which other processes and machines compare with theirs and which jumps when
somebody sets the machine's clock; ``steady_ns`` for how long something has taken, timers and time-outs, which never
does.
"""

from __future__ import annotations

import time
from typing import Protocol

from instant_ic import pace


class Clock(Protocol):
    """Source of a node's time."""

    def now_ns(self) -> int:
        """Nanoseconds since the epoch; 0 while a simulated clock has not started."""
        ...

    def steady_ns(self) -> int:
        """Nanoseconds since some moment; only differences mean something."""
        ...


class SystemClock:
    """The machine's clock, at this process's pace (:mod:`instant_ic.pace`)."""

    def now_ns(self) -> int:
        """Nanoseconds since the epoch."""
        return pace.current().now_ns()

    def steady_ns(self) -> int:
        """Time that goes on evenly when the machine's clock is set."""
        return pace.current().steady_ns()


class ManualClock:
    """A clock that somebody sets: ``/clock`` in replay, the lockstep bus in tests."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """The time last set."""
        return self._now_ns

    def steady_ns(self) -> int:
        """The same: simulated time is all there is, and a second of it is a second for time-outs too."""
        return self._now_ns

    def set(self, now_ns: int) -> None:
        """Sets the time; it may go back, as when a player loops."""
        self._now_ns = int(now_ns)


class JumpDetector:
    """Sees that the machine's clock was set, by what it has gone beside the steady one.

    Args:
        tolerance_s: smaller differences are the machine's own corrections.
    """

    def __init__(self, tolerance_s: float = 0.5) -> None:
        self._tolerance_ns = int(tolerance_s * 1e9)
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def jump_s(self) -> float:
        """Seconds that the clock was set forward (back: negative) since the last call; 0.0 for none."""
        offset_ns = time.time_ns() - time.monotonic_ns()
        jumped_ns = offset_ns - self._offset_ns
        self._offset_ns = offset_ns
        return jumped_ns / 1e9 if abs(jumped_ns) > self._tolerance_ns else 0.0
