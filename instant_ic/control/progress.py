"""Progress towards a goal, against driving in circles between ways that turn out to be closed."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.planner import Plan

_NEARER_M = 0.2
"""Smallest approach that counts as progress; poses and paths are noisy."""
_OTHER_WAY_M = 1.0
"""A path that is this much longer counts as another way."""
_OTHER_WAYS = 2
"""Number of longer ways tried to one goal; after these, only a new shortest way is progress."""
_SAME_GOAL_M = 0.5
_NO_WAY_M = 1000.0
"""A path that does not end at the goal counts as this much longer, so that a way to the goal is always progress."""


class Progress:
    """A monitor of the length of the path to one goal. Time is measured by the clock, not in plans."""

    def __init__(self, patience_s: float) -> None:
        self.patience_s = patience_s
        self.reset()

    def reset(self) -> None:
        """Forget the goal, for example when it was reached."""
        self._goal: NDArray[np.float64] | None = None
        self._best_m, self._nearer_ns, self._ways = math.inf, 0, 0
        self._free_since_ns: int | None = None
        self._given_up = 0

    def lost(self, plan: Plan, pose: NDArray[np.float64], goal: NDArray[np.float64], now_ns: int) -> bool:
        """Record the newest plan from ``pose`` to ``goal`` (3,); return whether none made progress for ``patience_s``.

        After that, a way must stay open for some time, longer each time, before it is tried again.
        """
        if self._goal is None or math.dist(goal[:2], self._goal[:2]) > _SAME_GOAL_M:
            self.reset()
            self._start(goal, now_ns)
        left_m = _left_m(plan, pose)
        if left_m < self._best_m - _NEARER_M:
            self._best_m, self._nearer_ns = left_m, now_ns
        elif left_m > self._best_m + _OTHER_WAY_M and self._ways < _OTHER_WAYS:
            self._best_m, self._nearer_ns, self._ways = left_m, now_ns, self._ways + 1
        if (now_ns - self._nearer_ns) / 1e9 < self.patience_s or left_m < _NEARER_M:
            self._free_since_ns = None
            return False
        if not plan.reached:
            self._free_since_ns = None
            return True
        if self._free_since_ns is None:
            self._free_since_ns = now_ns
        if (now_ns - self._free_since_ns) / 1e9 < 2.0**self._given_up:
            return True
        self._given_up += 1
        self._start(goal, now_ns)
        return False

    def _start(self, goal: NDArray[np.float64], now_ns: int) -> None:
        self._goal, self._best_m, self._nearer_ns, self._ways = np.array(goal), math.inf, now_ns, 0


def _left_m(plan: Plan, pose: NDArray[np.float64]) -> float:
    """Return metres along the plan from the pose to its end."""
    if len(plan.poses) == 0:
        return _NO_WAY_M
    near = int(np.argmin(np.linalg.norm(plan.poses[:, :2] - pose[:2], axis=1)))
    length = float(np.linalg.norm(np.diff(plan.poses[near:, :2], axis=0), axis=1).sum())
    return length + (0.0 if plan.reached else _NO_WAY_M)
