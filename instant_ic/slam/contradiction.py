"""Detection of contradictions between wheel odometry and scan matching.

Each scan gives a step of the wheels and a step seen by the LiDAR, each with a part along, across and in rotation.

1. Add up steps until they reach `STEP_M` or have lasted `STEP_S`, so that noise does not count as motion even at low
   speed. Scans in a burst count as one step, because their stamps are not the times at which they were measured.
2. For each of the three parts and each sign, a cumulative sum (Page, 1954) adds the difference between the seen motion
   and the tracks' motion, less what ordinary slip explains. It does not fall below zero. A contradiction begins where
   its sum was last zero.
3. A contradiction is certain once its sum exceeds the error of the comparison in several comparisons. This error covers
   scan matching and the motion in half a period, by which the stamps of scans and odometry may differ. The
   contradiction counts after `LONGEST_S` or `LONGEST_M`.

A direction is judged only if the scan alone fixes the pose in it. Along a bare corridor, odometry decides the match.
"""

from __future__ import annotations

import numpy as np

from instant_ic.slam.scan import FloatArray
from instant_ic.util.contradiction import Contradiction

LONGEST_S, LONGEST_M = 0.5, 0.15
"""Duration of a contradiction, and distance between wheels and LiDAR, above which it counts."""
STEP_M, STEP_S = 0.01, 0.5
"""Motion, or time, after which the steps so far are compared."""
BURST = 0.5
"""Share of the usual period below which a scan belongs to a burst."""
COMPARISONS = 3
"""Smallest number of contradicting comparisons. One bad match or one late odometry message changes two steps."""
CERTAIN_M, CERTAIN_SIGMAS, CERTAIN_STEPS = 0.02, 4.0, 0.5
"""Terms of a comparison's error: constant, factor on the match's standard deviation, factor on the usual step."""
USUAL_SCANS = 20
"""Number of scans over which the usual period and step are averaged."""
MOST = 0.5
"""Largest share of the error that one comparison may add, because a pose that jumps is not a motion."""
LEVER_M = 0.3
"""Metres per radian: half the distance of the tracks."""
SLIP = np.array([0.5, 0.5, 0.65])
"""Shares of the tracks' motion that ordinary slip explains. Skid steering may turn by only a third."""
UNEVEN = 0.1
"""Difference of the two tracks as a share of the way along. It explains a rotation, times LEVER_M."""
TURN_SHIFT_M = 0.15
"""Metres per radian by which a robot moves while turning on the spot, because it does not turn about base_link."""
STAND_M_S = 0.003
"""Speed below which the tracks count as standing."""
DRIFT_M_S, STILL_M_S = 0.0005, 0.05
"""Speeds that do not count as motion, while the tracks turn and while they stand, so that accumulated errors decay."""
FIXED = np.array([0.01, 0.01, 0.005])
"""Largest standard deviation of the scan alone at which a direction is judged; along a bare corridor it is 0.02 m."""
AGREED_M = 0.3
"""Motion of the tracks in agreement with the LiDAR after which a contradiction ends."""
_STANDS = 0.1
"""Share of the other motion below which a motion counts as none."""
_TO_M = np.array([1.0, 1.0, LEVER_M])


class ContradictionMonitor:
    """Compares the steps of wheels and LiDAR.

    Attributes:
        state: newest contradiction; none after tracks and LiDAR have agreed over `AGREED_M`.
        count: number of contradictions so far. It grows again while a contradiction lasts.
    """

    def __init__(self) -> None:
        self.state = Contradiction.NONE
        self.count = 0
        self._agreed_m = 0.0
        self._scans, self._period_s, self._usual_m = 0, 0.0, np.zeros(3)
        self._begin_step()
        self._restart()

    def _begin_step(self) -> None:
        # Rows: wheels and LiDAR; columns: along, across, rotation times LEVER_M.
        self._step_m, self._step_s, self._step_judged = np.zeros((2, 3)), 0.0, np.ones(3, np.bool_)

    def _restart(self) -> None:
        # Rows: seen motion above and below the tracks'; columns: along, across, rotation times LEVER_M.
        self._sum, self._apart_m, self._seconds = np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3))
        self._wheels_m, self._seen_m = np.zeros((2, 3)), np.zeros((2, 3))
        self._comparisons = np.zeros((2, 3))

    def update(self, wheels: FloatArray, seen: FloatArray, elapsed_s: float, scan_sigma: FloatArray | None) -> None:
        """Add a step. A non-finite step is ignored, because it would make the sums invalid.

        Args:
            wheels: odometry step (3,) in the base's frame.
            seen: matched step (3,).
            elapsed_s: duration of the step.
            scan_sigma: standard deviations (3,) of the match without odometry; None if the scan was not matched.
        """
        sigma = np.full(3, np.inf) if scan_sigma is None else scan_sigma
        judged = sigma < FIXED
        step_m = np.stack([wheels, np.where(judged, seen, wheels)]) * _TO_M
        if not (np.isfinite(step_m).all() and 0.0 <= elapsed_s < np.inf):
            return
        # Limit the outliers, so that a single pause or jump hardly changes the usual values.
        pause_s = 4.0 * self._period_s if self._scans else elapsed_s
        self._scans = min(self._scans + 1, USUAL_SCANS)
        self._period_s += (min(elapsed_s, pause_s) - self._period_s) / self._scans
        self._usual_m += (np.abs(step_m).min(axis=0) - self._usual_m) / self._scans
        self._step_m += step_m
        self._step_s += elapsed_s
        self._step_judged &= judged
        moved = float(np.abs(self._step_m).max()) >= STEP_M and self._step_s >= BURST * self._period_s
        if moved or self._step_s >= STEP_S - 1e-6:
            sigma_m = np.where(judged, sigma, FIXED) * _TO_M
            self._compare(CERTAIN_M + CERTAIN_SIGMAS * sigma_m + CERTAIN_STEPS * self._usual_m)
            self._begin_step()

    def _compare(self, error_m: FloatArray) -> None:
        """Compare wheels and LiDAR over a step; ``error_m`` (3,) is the error of the comparison."""
        (wheels_m, seen_m), elapsed_s = self._step_m, self._step_s
        stand = float(np.abs(wheels_m).sum()) < STAND_M_S * elapsed_s
        explained = SLIP * np.abs(wheels_m) + (STILL_M_S if stand else DRIFT_M_S) * elapsed_s
        explained[:2] += TURN_SHIFT_M / LEVER_M * float(np.abs(self._step_m[:, 2]).max())
        explained[2] += UNEVEN * abs(float(wheels_m[0]))
        apart_m = np.stack([seen_m - wheels_m, wheels_m - seen_m])
        self._sum = np.maximum(0.0, self._sum + np.minimum(apart_m - explained, MOST * error_m))
        going, contradicts = self._sum > 0.0, apart_m > explained
        for total, step in (
            (self._apart_m, apart_m),
            (self._seconds, elapsed_s * contradicts),
            (self._wheels_m, wheels_m),
            (self._seen_m, seen_m),
            (self._comparisons, contradicts),
        ):
            total += step
            total[~going] = 0
        certain = (self._sum > error_m) & (self._comparisons >= COMPARISONS)
        found = certain & ((self._apart_m > LONGEST_M) | (self._seconds > LONGEST_S))
        if found.any():
            worst = np.unravel_index(np.argmax(np.where(found, self._sum, 0.0)), found.shape)
            self.state = _kind(float(self._wheels_m[worst]), float(self._seen_m[worst]))
            self.count += 1
            self._agreed_m = 0.0
            self._restart()
        elif self.state:
            agrees = self._step_judged[[0, 2]].all() and not (self._sum > 0.5 * error_m).any()
            self._agreed_m = self._agreed_m + float(np.abs(wheels_m).sum()) if agrees else 0.0
            if self._agreed_m > AGREED_M:
                self.state = Contradiction.NONE


def _kind(wheels_m: float, seen_m: float) -> Contradiction:
    if abs(wheels_m) < _STANDS * abs(seen_m):
        return Contradiction.PUSHED
    if wheels_m * seen_m < 0.0 and abs(seen_m) > _STANDS * abs(wheels_m):
        return Contradiction.OTHER_WAY
    return Contradiction.FARTHER if abs(seen_m) > abs(wheels_m) else Contradiction.SLIPPING
