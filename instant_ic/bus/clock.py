"""Clocks: a node reads the time from its clock, never from the system.

There are two kinds of time. ``now_ns`` is for stamps, which other processes and machines compare with their own; it
jumps when somebody sets the machine's clock. ``steady_ns`` is for durations, timers and time-outs; it never jumps.
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
        """Nanoseconds for which the machine was suspended since it started; the steady clock stood still then."""
        ...


class SystemClock:
    """The machine's clock, at this process's pace (:mod:`instant_ic.util.pace`), which :func:`pace.use` sets before.

    Attributes:
        now_ns: returns nanoseconds since the epoch.
        steady_ns: returns nanoseconds of a clock that never jumps, even when somebody sets the machine's clock.
        suspended_ns: :func:`instant_ic.util.pace.suspended_ns`.
    """

    def __init__(self) -> None:
        current = pace.current()
        self.now_ns = time.time_ns if current.real else current.now_ns
        self.steady_ns = time.monotonic_ns if current.real else current.steady_ns
        self.suspended_ns = pace.suspended_ns


class ManualClock:
    """A clock that is set from outside: by ``/clock`` in replay, by the lockstep bus in tests."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns
        self._suspended_ns = 0

    def now_ns(self) -> int:
        """Return the time that was set last."""
        return self._now_ns

    def steady_ns(self) -> int:
        """Return the same value as ``now_ns``: time-outs also run in simulated time."""
        return self._now_ns

    def suspended_ns(self) -> int:
        """Return the sum of all :meth:`suspend`."""
        return self._suspended_ns

    def suspend(self, seconds: float) -> None:
        """Let the machine have been suspended for a time."""
        self._suspended_ns += round(seconds * 1e9)

    def set(self, now_ns: int) -> None:
        """Set the time. It may go back, for example when a player loops."""
        self._now_ns = int(now_ns)
