"""Watch over a process's own steps: a process that stood still must not go on as if nothing had happened.

Time-outs watch the sources of a process, but nothing watches the process itself while it is frozen (SIGSTOP, swapping,
a suspended machine). Afterwards it finds messages that have waited, and an operator's key that is still held. So each
process that commands motion looks at the time since its own last step.
"""

from __future__ import annotations

import math

BRIEF_S = 0.3
"""Longest time between two steps without a stop, in seconds of the stack."""
SETTLE_S = 0.3
"""Time after a gap in which nothing moves: what waited meanwhile is then read, and a source that has ended is stale."""
_SUSPENDED_NS = 50_000_000
"""A machine was suspended if the difference between its two clocks has grown by more than this."""


class StepGap:
    """Time between the steps of one process; the caller passes the clocks of :class:`~instant_ic.bus.clock.Clock`."""

    def __init__(self) -> None:
        self._stepped_ns: int | None = None
        self._ended_ns: int | None = None  # when the last gap ended
        self._suspended_ns = 0

    def step(self, steady_ns: int, suspended_ns: int) -> float:
        """Note a step.

        Returns:
            Seconds since the step before if that is a gap, 0 if not; inf if the machine was suspended.
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
        """Let the time until the next step be no gap: the process has nothing to do."""
        self._stepped_ns = None

    def settles(self, steady_ns: int) -> bool:
        """Return whether a gap ended less than ``SETTLE_S`` ago."""
        return self._ended_ns is not None and steady_ns - self._ended_ns < SETTLE_S * 1e9
