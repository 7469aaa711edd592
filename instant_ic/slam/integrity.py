"""Integrity of the pose: probability that a plausible pose is wrong, and bounds of the error.

A wrong pose may still have a good match score. The scan's rays reveal it: they pass through walls of the map, or end in
space that the map shows as free. Neither happens where the robot only sees something new. The contradiction counts
together with a drop of the match score, both relative to earlier scans. A map that has drifted contradicts new scans
too, but gradually and at a good score.

`IntegrityMonitor` is a Bayes filter on one bit, lost or not, in log-odds:

1. ``contradiction``: compute the share of a scan's rays that contradict the map.
2. ``matched``: compute the scan's log-likelihood ratio from the rise of this share and the drop of the score. It counts
   in proportion to the time since the previous scan (``_weigh``). Time without a match raises the log-odds
   (``_unseen``).
3. ``doubts``: above a first threshold, scans stay out of the map. Otherwise, later scans would agree with their copies.
4. ``compared``: a robot that was put down in a place that looks alike matches well, and each scan contradicts the map
   only a little. After a weak ``sign``, scans are therefore provisional for some metres, and the map before them is
   kept. If further scans contradict that map but agree with the one that includes the provisional scans, the robot is
   lost.
5. ``lost``: above a second threshold, the pose is not used any more until the place is recognized.
6. ``integrity``: compute bounds of the error from a mixture of the match's covariance and that of a lost robot.

The ratios were tuned on the Intel log and a generated office, with robots put down elsewhere. docs/benchmarks.md has
the results on other logs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.slam.scan import FloatArray, ScanPoints

POINTS = 120
"""Number of rays that are compared with the map, evenly chosen."""
RANGE_M, SLACK_M = 12.0, 0.25
"""Largest range of hits that are compared, and distance within which a wall and a hit agree."""
OCCUPIED_LOG_ODDS = 1.0
"""Log-odds above which a cell is a wall, after two more hits than rays through it."""
LEAST_KNOWN = 20
"""Smallest denominator of the share of contradicted rays, because few comparable rays are little evidence."""
BOUND_SIGMAS, BOUND_YAW_SIGMAS = 3.717, 3.291
"""Number of standard deviations that contain 99.9 % of a Gaussian, in the plane and on a line."""
LOST_SIGMA_RAD = math.pi / math.sqrt(3.0)
"""Standard deviation of a lost robot's heading, which is uniformly distributed."""


@dataclass(frozen=True)
class IntegrityConfig:
    """Tuning of the filter; log-odds and log-likelihood ratios are natural logarithms.

    Attributes:
        recovered: smallest evidence of a scan that only the wide search matches, so that it stays out of the map.
        full_contradiction: rise of the share of contradicted rays that is full evidence together with ``full_drop``.
        full_drop: drop of the match score that is full evidence together with ``full_contradiction``.
        long_drop: drop of the score that is evidence without a contradiction. It is weak, as the place may be new.
        long_drop_share: evidence of such a drop, as a share of the full evidence.
        evidence_s: time between scans at which a scan counts in full, in seconds. Scans closer in time see the same
            scene and count in proportion.
        evidence: limit of a scan's log-likelihood ratio, so that no single scan decides.
        per_m: evidence per metre in which all rays contradict the map before the sign and none contradicts the present
            one. At a difference of 0.3, 0.3 m turn a sign into a loss.
        agrees: difference of the two shares up to which the maps agree.
        longest_step_m: longest way between two scans that counts, in metres.
        level_share: weight of a new scan in the usual score and contradiction.
        floor: smallest log-odds of being lost; higher values cause false alarms, lower values delay detection.
        doubt: log-odds above which scans are kept out of the map.
        suspicious: evidence of the last scan above which it is kept out of the map, at any rate of scans: a quarter of
            ``evidence``.
        lost: log-odds at which the robot is lost. Scans of one place agree or disagree with the map together, so
            later scans that fit do not restore the trust. Only recognition of the place does.
        unseen_s: time without a matched scan after which the log-odds grow, in seconds.
        unseen_periods: the same in usual periods of the scans; the longer time counts.
        unseen_per_s: growth of the log-odds per second after this time.
        unseen_most: limit of this growth, in log-odds.
        new_view_m: distance since the last trusted scan, in metres, beyond which a low score counts less as evidence;
            beyond twice the distance, it does not count.
        longest_doubt: number of doubtful scans after which the doubt is dropped unless the robot is lost, because its
            map must grow.
        untrusted: probability of being lost at which a pose must not be used.
        lost_sigma_m: standard deviation of a lost robot's position, in metres; the size of a building.
    """

    recovered: float = 1.6
    full_contradiction: float = 0.25
    full_drop: float = 0.2
    long_drop: float = 0.4
    long_drop_share: float = 0.6
    evidence_s: float = 0.1
    evidence: float = 2.0
    per_m: float = 100.0
    agrees: float = 0.1
    longest_step_m: float = 0.25
    level_share: float = 0.1
    floor: float = -6.0
    doubt: float = -5.5
    suspicious: float = 0.5
    lost: float = 0.0
    unseen_s: float = 1.0
    unseen_periods: float = 2.0
    unseen_per_s: float = 0.6
    unseen_most: float = -1.0
    new_view_m: float = 0.5
    longest_doubt: int = 30
    untrusted: float = 0.5
    lost_sigma_m: float = 10.0


TUNING = IntegrityConfig()


@njit(cache=True)
def _compare_rays(cells, seen, since, origin, resolution, pose, laser, points):  # type: ignore[no-untyped-def]
    """Count the rays with a known end or wall, those that pass through a wall, and those that end in free space.

    The arguments are those of `contradiction`. The laser's centre ``laser`` (2,) and the hits ``points`` (n, 2) are in
    the base frame.
    """
    height, width = cells.shape
    cos_yaw, sin_yaw = math.cos(pose[2]), math.sin(pose[2])
    x0 = (pose[0] + cos_yaw * laser[0] - sin_yaw * laser[1] - origin[0]) / resolution
    y0 = (pose[1] + sin_yaw * laser[0] + cos_yaw * laser[1] - origin[1]) / resolution
    r = int(SLACK_M / resolution)
    known = through = free = 0
    for i in range(points.shape[0]):
        x = (pose[0] + cos_yaw * points[i, 0] - sin_yaw * points[i, 1] - origin[0]) / resolution
        y = (pose[1] + sin_yaw * points[i, 0] + cos_yaw * points[i, 1] - origin[1]) / resolution
        length = math.hypot(x - x0, y - y0)
        if length * resolution > RANGE_M or length < 1.0:
            continue
        crossed = False
        for k in range(int(length - SLACK_M / resolution)):
            u, v = math.floor(x0 + (x - x0) * k / length), math.floor(y0 + (y - y0) * k / length)
            if 0 <= u < width and 0 <= v < height and seen[v, u] >= since and cells[v, u] > OCCUPIED_LOG_ODDS:
                crossed = True
                break
        wall = unknown = False
        ix, iy = math.floor(x), math.floor(y)
        for v in range(iy - r, iy + r + 1):
            for u in range(ix - r, ix + r + 1):
                if u < 0 or v < 0 or u >= width or v >= height or seen[v, u] < since:
                    unknown = True
                elif cells[v, u] > 0.0:
                    wall = True
        if not wall and not unknown:
            free += 1
        if crossed:
            through += 1
        if crossed or wall or not unknown:
            known += 1
    return known, through, free


def contradiction(
    cells: NDArray[np.float32],
    seen: NDArray[np.int32],
    origin: FloatArray,
    resolution: float,
    pose: FloatArray,
    scan: ScanPoints,
    since: int = 1,
) -> float:
    """Return the share of a scan's rays, 0..1, that pass through walls of a map or end in its free space.

    Args:
        cells: log-odds, (H, W).
        seen: number of the scan that last changed a cell, (H, W); 0 where the map is unknown.
        origin: corner of cell (0, 0), (2,).
        resolution: metres per cell.
        pose: map_from_base, (3,).
        scan: scan taken at this pose.
        since: number of the oldest scan that counts; cells last changed by older scans count as unknown.
    """
    points = scan.points
    if len(points) > POINTS:
        points = np.ascontiguousarray(points[(np.arange(POINTS) * len(points)) // POINTS])
    known, through, free = _compare_rays(cells, seen, since, origin, resolution, pose, scan.origin, points)
    return min(1.0, (through + free) / max(known, LEAST_KNOWN))


@dataclass(frozen=True)
class Integrity:
    """Trust in a pose.

    Attributes:
        lost_probability: probability that the robot is somewhere else, 0..1.
        position_bound_m: protection level. The position error is smaller with a probability of 99.9 %, if the
            covariances of scan matching and drift are right.
        heading_bound_rad: the same for the heading, at most π.
    """

    lost_probability: float
    position_bound_m: float
    heading_bound_rad: float

    @property
    def trusted(self) -> bool:
        """True if the pose may be used."""
        return self.lost_probability < TUNING.untrusted


class IntegrityMonitor:
    """Estimator of the probability of being lost, updated by each scan.

    Attributes:
        contradiction: share of the last scan's rays that contradict the map, 0..1.
        after_gap: true if the doubt began with a time without matched scans.
        sign: true if the last scan is evidence, even if weak, of another place.
    """

    def __init__(self) -> None:
        self.contradiction = 0.0
        self.after_gap = self.sign = False
        self._log_odds = self._provisional_log_odds = TUNING.floor
        self._suspicious = False  # by the last scan alone, independent of the time since the previous one
        self._unseen_s = 0.0
        self._moved_m = 0.0
        self._period_s: float | None = None
        self._doubtful_scans = 0
        self._score_level: float | None = None
        # The level, or the previous scan's value if that is worse. A gradual change, as in a turn or in a map that has
        # drifted, is thus no sign of another place.
        self._usual_score = self._usual_contradiction = 0.0
        self._contradiction_level = 0.0

    @property
    def doubts(self) -> bool:
        """True if scans must stay out of the map."""
        return self._suspicious or self._log_odds > TUNING.doubt

    @property
    def lost(self) -> bool:
        """True if the pose must not be used any more and the map must stay unchanged."""
        return max(self._log_odds, self._provisional_log_odds) >= TUNING.lost

    @property
    def lost_probability(self) -> float:
        """Probability of being lost, 0..1."""
        return 1.0 / (1.0 + math.exp(-max(self._log_odds, self._provisional_log_odds)))

    def matched(
        self, contradicted: float, score: float, elapsed_s: float, recovered: bool = False, moved_m: float = 0.0
    ) -> None:
        """Update the probability by a scan with a match.

        Args:
            contradicted: share of the scan's rays that contradict the map before it, 0..1; see `contradiction`.
            score: score of the match, 0..1.
            elapsed_s: seconds since the previous scan.
            recovered: true if only the wide search has matched the scan.
            moved_m: metres driven since the previous scan; a radian counts as half a metre.
        """
        self.contradiction = contradicted
        usual = score if self._score_level is None else self._usual_score
        excess = min(max(contradicted - self._usual_contradiction, 0.0) / TUNING.full_contradiction, 1.0)
        drop = min(max(usual - score, 0.0) / TUNING.full_drop, 1.0)
        self._note_gap(elapsed_s)
        self._unseen(elapsed_s)
        self._unseen_s = 0.0
        long_drop = min(max(usual - score, 0.0) / TUNING.long_drop, 1.0)
        self._moved_m += moved_m
        long_drop *= min(max(2.0 - self._moved_m / TUNING.new_view_m, 0.0), 1.0)
        share = max(math.sqrt(excess * drop), TUNING.long_drop_share * long_drop)
        evidence = TUNING.evidence * (2.0 * share - 1.0)
        if recovered:
            self._weigh(max(evidence, TUNING.recovered), TUNING.evidence_s)
        else:
            self._weigh(evidence, elapsed_s)
        if self._score_level is None or not self.doubts:
            self.after_gap, self._moved_m = False, 0.0
            level = score if self._score_level is None else self._score_level
            self._score_level = level + TUNING.level_share * (score - level)
            self._usual_score = min(self._score_level, score)
            self._contradiction_level += TUNING.level_share * (contradicted - self._contradiction_level)
            self._usual_contradiction = max(self._contradiction_level, contradicted)

    def compared(self, excess: float, moved_m: float) -> None:
        """Update the probability by a scan that was compared with the map before a sign and with the present one.

        Scans of one place agree or disagree together, so evidence counts per distance driven.

        Args:
            excess: share of the rays that contradict the map before the sign, less the share for the present map.
            moved_m: metres driven since the previous scan; a radian counts as half a metre.
        """
        evidence = TUNING.per_m * (excess - TUNING.agrees) * min(moved_m, TUNING.longest_step_m)
        self._provisional_log_odds = _bounded(self._provisional_log_odds + evidence)

    def settled(self) -> None:
        """Forget the comparison, because the provisional scans have become part of the map."""
        self._provisional_log_odds = TUNING.floor

    def unmatched(self, fits_nowhere: bool, elapsed_s: float) -> None:
        """Update the probability by a scan without a match, which fits nowhere near or has too few points."""
        self._note_gap(elapsed_s)
        if fits_nowhere:
            self._weigh(TUNING.evidence, elapsed_s)
        self._unseen(elapsed_s)

    def _note_gap(self, elapsed_s: float) -> None:
        """Record whether a doubt begins with a gap in the matched scans. Call this before the scan raises a doubt."""
        self.after_gap = self.after_gap or (not self.doubts and self._unseen_s + elapsed_s > self._usual_s(elapsed_s))

    def _usual_s(self, elapsed_s: float) -> float:
        """Return the longest time between matched scans that raises no doubt."""
        return max(TUNING.unseen_s, TUNING.unseen_periods * (elapsed_s if self._period_s is None else self._period_s))

    def _unseen(self, elapsed_s: float) -> None:
        """Raise the log-odds for the time without a matched scan."""
        usual_s = self._usual_s(elapsed_s)
        before = max(self._unseen_s - usual_s, 0.0)
        self._unseen_s += elapsed_s
        grown = TUNING.unseen_per_s * (max(self._unseen_s - usual_s, 0.0) - before)
        if self._log_odds < TUNING.unseen_most:
            self._log_odds = min(self._log_odds + grown, TUNING.unseen_most)
        period_s = elapsed_s if self._period_s is None else self._period_s
        self._period_s = period_s + TUNING.level_share * (min(elapsed_s, usual_s) - period_s)

    def integrity(self, covariance: FloatArray, localized: bool) -> Integrity:
        """Return the trust in a pose with ``covariance`` (3, 3). A robot that is not localized counts as lost."""
        lost = self.lost_probability if localized else 1.0
        mixed = mixture(covariance, lost)
        sigma_m = math.sqrt(max(float(np.linalg.eigvalsh(mixed[:2, :2])[-1]), 0.0))
        heading = BOUND_YAW_SIGMAS * math.sqrt(max(float(mixed[2, 2]), 0.0))
        return Integrity(lost, BOUND_SIGMAS * sigma_m, min(heading, math.pi))

    def _weigh(self, evidence: float, elapsed_s: float) -> None:
        self._suspicious, self.sign = evidence >= TUNING.suspicious, evidence > 0.0
        self._log_odds += evidence * min(1.0, max(elapsed_s, 0.0) / TUNING.evidence_s)
        self._log_odds = _bounded(self._log_odds)
        self._doubtful_scans = self._doubtful_scans + 1 if self.doubts else 0
        if self._doubtful_scans > TUNING.longest_doubt and not self.lost:
            self._log_odds, self._doubtful_scans, self._suspicious = TUNING.floor, 0, False


def _bounded(log_odds: float) -> float:
    return min(max(log_odds, TUNING.floor), TUNING.lost + TUNING.evidence)


def mixture(covariance: FloatArray, lost_probability: float) -> FloatArray:
    """Return the covariance (3, 3) of a pose that may be wrong; unchanged up to the monitor's lowest probability."""
    floor = 1.0 / (1.0 + math.exp(-TUNING.floor))
    p = min(max((lost_probability - floor) / (1.0 - floor), 0.0), 1.0)
    lost = np.diag(np.square([TUNING.lost_sigma_m, TUNING.lost_sigma_m, LOST_SIGMA_RAD]))
    mixed: FloatArray = (1.0 - p) * covariance + p * lost
    return mixed
