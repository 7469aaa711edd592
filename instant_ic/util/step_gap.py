"""Watch over a process's own steps, so that a process that was frozen does not continue as if nothing had happened.

Time-outs watch the inputs of a process, but not the process itself while it is frozen (SIGSTOP, swapping, a suspended
machine). When it continues, it finds old messages, and perhaps an operator's key that is still held. Each process that
commands motion therefore checks the time since its own last step.
"""

from __future__ import annotations

import math

BRIEF_S = 0.3
"""Longest time between two steps that does not count as a gap, in seconds of the stack."""
SETTLE_S = 0.3
"""Time after a gap during which nothing moves, in seconds. Afterwards, old messages are read and dead inputs stale."""
_SUSPENDED_NS = 50_000_000
"""Growth of the difference between the machine's two clocks above which it was suspended."""


class StepGap:
    """Time between the steps of one process. The caller passes the times of a :class:`~instant_ic.bus.clock.Clock`."""

    def __init__(self) -> None:
        self._stepped_ns: int | None = None
        self._ended_ns: int | None = None  # steady time at which the last gap ended
        self._suspended_ns = 0

    def step(self, steady_ns: int, suspended_ns: int) -> float:
        """Record a step.

        Returns:
            Seconds since the previous step if that is a gap, otherwise 0; inf if the machine was suspended.
        """
        before_ns, self._stepped_ns = self._stepped_ns, steady_ns
        slept_ns, self._suspended_ns = suspended_ns - self._suspended_ns, max(suspended_ns, self._suspended_ns)
        if before_ns is None:
            return 0.0
        gap_s = math.inf if slept_ns > _SUSPENDED_NS else (steady_ns - before_ns) / 1e9
        if gap_s <= BRIEF_S:
            return 0.0
        self._ended_ns = steady_ns
        return gap_s

    def pause(self) -> None:
        """Do not count the time until the next step as a gap, because the process has nothing to do."""
        self._stepped_ns = None

    def settles(self, steady_ns: int) -> bool:
        """Return whether a gap ended less than ``SETTLE_S`` ago."""
        return self._ended_ns is not None and steady_ns - self._ended_ns < SETTLE_S * 1e9
