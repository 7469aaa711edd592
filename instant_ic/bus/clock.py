"""Clocks. A node reads the time from its clock, never from the system.

There are two kinds of time. ``now_ns`` is for stamps, which other processes and machines compare with their own time.
It jumps when the machine's clock is set. ``steady_ns`` is for durations, timers and time-outs. It never jumps.
"""

from __future__ import annotations

import time
from typing import Protocol

from instant_ic.util import pace


class Clock(Protocol):
    """Source of a node's time."""

    def now_ns(self) -> int:
        """Nanoseconds since the epoch; 0 while a simulated clock has not started."""
        ...

    def steady_ns(self) -> int:
        """Nanoseconds since an arbitrary origin; only differences are meaningful."""
        ...

    def suspended_ns(self) -> int:
        """Nanoseconds for which the machine has been suspended since it started. The steady clock then stood still."""
        ...


class SystemClock:
    """The machine's clock at this process's pace. Set the pace (:func:`instant_ic.util.pace.use`) before creating it.

    Attributes:
        now_ns: returns nanoseconds since the epoch.
        steady_ns: returns nanoseconds of a clock that does not jump when the machine's clock is set.
        suspended_ns: :func:`instant_ic.util.pace.suspended_ns`.
    """

    def __init__(self) -> None:
        current = pace.current()
        self.now_ns = time.time_ns if current.real else current.now_ns
        self.steady_ns = time.monotonic_ns if current.real else current.steady_ns
        self.suspended_ns = pace.suspended_ns


class ManualClock:
    """A clock that others set: ``/clock`` in replay, the lockstep bus in tests."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns
        self._suspended_ns = 0

    def now_ns(self) -> int:
        """Return the time that was set last."""
        return self._now_ns

    def steady_ns(self) -> int:
        """Return the same value as ``now_ns``, so that time-outs run in simulated time."""
        return self._now_ns

    def suspended_ns(self) -> int:
        """Return the total time passed to :meth:`suspend`."""
        return self._suspended_ns

    def suspend(self, seconds: float) -> None:
        """Simulate that the machine was suspended for a time."""
        self._suspended_ns += round(seconds * 1e9)

    def set(self, now_ns: int) -> None:
        """Set the time. It may go back, for example when a player starts a bag again."""
        self._now_ns = int(now_ns)
