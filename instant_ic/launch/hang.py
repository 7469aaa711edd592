"""Detection of hung nodes, by the time without a heartbeat and by whether the node computes meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

BUSY_FACTOR = 6.0
"""Factor on the hang time-out of a node that computes, for example one that compiles kernels at its first image."""

_BUSY_SHARE = 0.5
_LONGEST_LOOK_S = 0.5


def active_seconds(pid: int) -> float:
    """Return the seconds for which a process's first thread has computed or waited for a CPU; 0 if it has ended."""
    try:
        computed, waited, _ = Path(f"/proc/{pid}/schedstat").read_text().split()
    except OSError:
        return 0.0
    return (int(computed) + int(waited)) / 1e9


class HeartbeatSilence:
    """Time that a process has gone without a heartbeat, as observed by the launcher.

    Args:
        active_s: function that returns ``active_seconds`` of a process.
    """

    def __init__(self, active_s: Callable[[int], float] = active_seconds) -> None:
        self.beat_s: float | None = None
        """Time of the newest heartbeat; None before the first."""
        self.lasts_s = 0.0
        self.reported = False
        """True once this silence has been reported to the operator."""
        self._active_s = active_s
        self._active_before_s = 0.0

    def look(self, beat_s: float | None, pid: int, since_last_look_s: float) -> None:
        """Record the time of the newest heartbeat, and update the length of the silence."""
        if beat_s is None or beat_s != self.beat_s:
            self.beat_s, self.lasts_s, self.reported = beat_s, 0.0, False
            self._active_before_s = self._active_s(pid)
            return
        # A pause of the launcher itself (stopped, swapped out) must not count as silence of the nodes.
        self.lasts_s += min(since_last_look_s, _LONGEST_LOOK_S)

    def busy(self, pid: int) -> bool:
        """Return whether the process has computed, or waited for a CPU, for most of the silence."""
        # A process that waits for a CPU now is busy too: the kernel counts a wait only when it ends.
        return _is_runnable(pid) or self._active_s(pid) - self._active_before_s > _BUSY_SHARE * self.lasts_s


def _is_runnable(pid: int) -> bool:
    """Return whether a process's first thread computes or waits for a CPU now."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].startswith("R")
    except OSError:
        return False
