"""Decides whether wheel odometry and scan matching contradict each other.

Each scan gives a step of the wheels and a step seen by the LiDAR: along, across and in rotation. For each of the three
and each sign, a cumulative sum (Page, 1954) adds how much farther the robot was seen to move than its tracks. It
subtracts what ordinary slip explains, and does not fall below zero. A contradiction begins where its sum was last zero.
It is certain once the sum exceeds what matching errs, over several scans; it counts after `LONGEST_S` or `LONGEST_M`.

A direction is judged only where the scan itself fixes the pose: along a bare corridor, odometry decides the match.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from instant_ic.contradiction import Contradiction
from instant_ic.slam.scan import FloatArray

LONGEST_S, LONGEST_M = 0.5, 0.15
"""Time and distance between wheels and LiDAR over which a contradiction counts."""
SCANS = 3
"""Smallest number of scans that must contradict: one bad match, or a late odometry message, moves two steps."""
CERTAIN_M = 0.05
"""Sum above which a contradiction is certain: several times the error of scan matching."""
MOST_M = CERTAIN_M / 2
"""Largest share of one scan in the sum: a pose that is found again elsewhere is no motion."""
LEVER_M = 0.3
"""Metres per radian: half the distance of the tracks."""
SLIP = np.array([0.5, 0.5, 0.65])
"""Shares of the tracks' motion that ordinary slip explains; skid steering turns by as little as a third."""
TURN_SHIFT_M = 0.15
"""Metres per radian: a robot that turns on the spot also moves, because it does not turn about base_link."""
DRIFT_M_S, STILL_M_S = 0.003, 0.05
"""Speeds that are no motion, while the tracks turn and while they stand: sums of errors fade away."""
FIXED = np.array([0.01, 0.01, 0.005])
"""A direction is judged up to this standard deviation of the scan alone; a bare corridor has 0.02 m along its axis."""
AGREED_M = 0.3
"""Motion of the tracks in agreement with the LiDAR that ends a contradiction."""
_STANDS = 0.1
"""Share of the one motion below which the other is none."""


class ContradictionMonitor:
    """Compares the steps of wheels and LiDAR.

    Attributes:
        state: the newest contradiction, until tracks and LiDAR have agreed over `AGREED_M`.
        count: number of contradictions so far. It grows again if a contradiction lasts.
    """

    def __init__(self) -> None:
        self.state = Contradiction.NONE
        self.count = 0
        self._agreed_m = 0.0
        self._restart()

    def _restart(self) -> None:
        # Rows: more and less than the tracks; columns: along, across, rotation times LEVER_M.
        self._sum, self._apart_m, self._seconds = np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3))
        self._wheels_m, self._seen_m = np.zeros((2, 3)), np.zeros((2, 3))
        self._scans: NDArray[np.int64] = np.zeros((2, 3), np.int64)

    def update(self, wheels: FloatArray, seen: FloatArray, elapsed_s: float, scan_sigma: FloatArray | None) -> None:
        """Add a step.

        Args:
            wheels: odometry step (3,) in the base's frame.
            seen: matched step (3,).
            elapsed_s: duration of the step.
            scan_sigma: standard deviations (3,) of the match by the scan alone; None if the scan was not matched.
        """
        to_m = np.array([1.0, 1.0, LEVER_M])
        judged = np.zeros(3, np.bool_) if scan_sigma is None else scan_sigma < FIXED
        wheels_m = wheels * to_m
        seen_m = np.where(judged, seen * to_m, wheels_m)
        stand = float(np.abs(wheels_m).sum()) < DRIFT_M_S * elapsed_s
        explained = SLIP * np.abs(wheels_m) + (STILL_M_S if stand else DRIFT_M_S) * elapsed_s
        explained[:2] += TURN_SHIFT_M * max(abs(float(wheels[2])), abs(float(seen[2])))
        apart_m = np.stack([seen_m - wheels_m, wheels_m - seen_m])
        self._sum = np.maximum(0.0, self._sum + np.minimum(apart_m - explained, MOST_M))
        going, contradicts = self._sum > 0.0, apart_m > explained
        for total, step in (
            (self._apart_m, apart_m),
            (self._seconds, elapsed_s * contradicts),
            (self._wheels_m, wheels_m),
            (self._seen_m, seen_m),
            (self._scans, contradicts),
        ):
            total += step
            total[~going] = 0
        certain = (self._sum > CERTAIN_M) & (self._scans >= SCANS)
        found = certain & ((self._apart_m > LONGEST_M) | (self._seconds > LONGEST_S))
        if found.any():
            worst = np.unravel_index(np.argmax(np.where(found, self._sum, 0.0)), found.shape)
            self.state = _kind(float(self._wheels_m[worst]), float(self._seen_m[worst]))
            self.count += 1
            self._agreed_m = 0.0
            self._restart()
        elif self.state:
            agrees = judged[[0, 2]].all() and not (self._sum > 0.5 * CERTAIN_M).any()
            self._agreed_m = self._agreed_m + float(np.abs(wheels_m).sum()) if agrees else 0.0
            if self._agreed_m > AGREED_M:
                self.state = Contradiction.NONE


def _kind(wheels_m: float, seen_m: float) -> Contradiction:
    if abs(wheels_m) < _STANDS * abs(seen_m):
        return Contradiction.PUSHED
    if wheels_m * seen_m < 0.0 and abs(seen_m) > _STANDS * abs(wheels_m):
        return Contradiction.OTHER_WAY
    return Contradiction.FARTHER if abs(seen_m) > abs(wheels_m) else Contradiction.SLIPPING
