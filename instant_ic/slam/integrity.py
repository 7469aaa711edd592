"""Integrity of the pose: distinguishes a right pose from a plausible one, and bounds the error.

A wrong pose may still fit the local map by its score. What gives it away is the scan's rays: they pass through walls of
the map, or end in space that the map shows as free. Neither happens where the robot only sees something new. The
contradiction counts together with a drop of the match score, both against the scans before: a map that has drifted
contradicts new scans too, but gradually, and at a good score.

`IntegrityMonitor` is a Bayes filter on one bit, lost or not. The log-likelihood ratio of a scan was chosen on the Intel
log and a generated office, with robots put down elsewhere; docs/benchmarks.md has the figures on other logs. While the
monitor doubts, the map must not grow: otherwise the scan agrees with its own copy.

A robot that is put down in a place that looks the same fits at a good score, and each scan contradicts little. After a
weak sign (`IntegrityMonitor.sign`) scans are therefore provisional for some metres, and the map before them is kept. If
the next ones contradict it and agree with the map that has the provisional ones, metre after metre, the robot is lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.slam.scan import FloatArray, ScanPoints

POINTS = 120
"""Number of rays compared with the map, evenly chosen."""
RECOVERED = 1.6
"""Evidence of a scan that only the wide search matches, at least: it stays out of the map."""
RANGE_M, SLACK_M = 12.0, 0.25
"""Farther hits are not compared; a wall and a hit this close together agree."""
OCCUPIED_LOG_ODDS = 1.0
"""A cell above is a wall: two hits more than rays through it."""
LEAST_KNOWN = 20
"""Fewer comparable rays count as so many: five of five are little evidence."""
FULL_CONTRADICTION, FULL_DROP = 0.25, 0.2
"""Share of contradicted rays, and drop of the score, above their levels, which are full evidence together."""
LONG_DROP, LONG_DROP_SHARE = 0.4, 0.6
"""A drop of the score this large is neutral to weak evidence without a contradiction: the place may be new."""
EVIDENCE = 2.0
"""Limit of a scan's log-likelihood ratio: no single scan decides."""
EVIDENCE_S = 0.1
"""Scans closer in time see the same scene: their evidence counts in proportion to the time between them."""
PER_M, AGREES = 100.0, 0.1
"""Evidence of a metre in which all rays contradict the map before the sign and none the map since, and the difference
of the two shares that is no evidence. 0.3 m at a difference of 0.3 make a sign a loss."""
LONGEST_STEP_M = 0.25
"""Way between two scans that counts at most."""
LEVEL_SHARE = 0.1
"""Weight of a new scan in the levels."""
FLOOR = -6.0
"""Least log-odds of being lost. Higher makes false alarms, lower delays detection."""
DOUBT, SUSPICIOUS = -5.5, 0.5
"""Log-odds, or evidence of the last scan, above which scans are kept out of the map: a quarter of a scan's evidence is
enough, also at a high rate."""
LOST = 0.0
"""Log-odds from which the robot is lost. Scans of one place agree or disagree with the map together, so later ones that
fit do not restore the trust; only recognition does."""
UNSEEN_S, UNSEEN_PERIODS, UNSEEN_PER_S, UNSEEN_MOST = 1.0, 2.0, 0.6, -1.0
"""After a second without a matched scan, and this many times the usual period of the scans, the log-odds grow by this
much a second, up to a limit."""
NEW_VIEW_M = 0.5
"""From this motion since the last scan without a doubt on a lower score is less evidence, from twice of it on none: the
view is new, and doubtful scans are not in the map."""
LONGEST_DOUBT = 30
"""Scans after which a doubt that is less likely than not is dropped: the robot has driven on, and its map must grow."""
UNTRUSTED = 0.5
"""Probability of being lost from which a pose must not be used."""
BOUND_SIGMAS, BOUND_YAW_SIGMAS = 3.717, 3.291
"""99.9 % of a Gaussian in the plane, and on a line, lie within so many σ."""
LOST_SIGMA_M, LOST_SIGMA_RAD = 10.0, math.pi / math.sqrt(3.0)
"""σ of the pose of a lost robot: a building, and any heading."""


@njit(cache=True)
def _compare_rays(cells, seen, since, origin, resolution, pose, laser, points):  # type: ignore[no-untyped-def]
    """Count the rays that the map knows something about, that pass through a wall, and that end in free space.

    Arguments as of `contradiction`; the laser's centre ``laser`` (2,) and the hits ``points`` (n, 2) are in the base
    frame.
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
    """Return the share of a scan's rays, 0..1, that contradict a map: through its walls, or ending in its free space.

    Args:
        cells: log-odds (H, W).
        seen: (H, W), number of the scan that last changed a cell; 0 where the map is unknown.
        origin: (2,) corner of cell (0, 0).
        resolution: metres per cell.
        pose: map_from_base (3,).
        scan: of the robot at that pose.
        since: cells that only scans before this one have changed count as unknown.
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
        lost_probability: 0..1, that the robot is somewhere else.
        position_bound_m: protection level: the position error is below it with a probability of 99.9 %, if scan
            matching and drift err as their covariance says.
        heading_bound_rad: the same for the heading, at most π.
    """

    lost_probability: float
    position_bound_m: float
    heading_bound_rad: float

    @property
    def trusted(self) -> bool:
        """True if the pose may be used."""
        return self.lost_probability < UNTRUSTED


class IntegrityMonitor:
    """Probability of being lost, from scan to scan.

    Attributes:
        contradiction: of the last scan.
        after_gap: whether the doubt began with a time without matched scans.
        sign: whether the last scan is evidence, however weak, of another place.
    """

    def __init__(self) -> None:
        self.contradiction = 0.0
        self.after_gap = self.sign = False
        self._log_odds = self._provisional_log_odds = FLOOR
        self._suspicious = False  # the last scan, whatever the time since the one before
        self._unseen_s = 0.0
        self._moved_m = 0.0
        self._period_s: float | None = None
        self._doubtful_scans = 0
        self._score_level: float | None = None
        # Level, or value of the scan before, if worse: what changes gradually, as in a turn or in a map that has
        # drifted, is no sign of another place.
        self._usual_score = self._usual_contradiction = 0.0
        self._contradiction_level = 0.0

    @property
    def doubts(self) -> bool:
        """True if scans must stay out of the map."""
        return self._suspicious or self._log_odds > DOUBT

    @property
    def lost(self) -> bool:
        """True if the pose must no longer be used, and the map be left as it is."""
        return max(self._log_odds, self._provisional_log_odds) >= LOST

    @property
    def lost_probability(self) -> float:
        """Probability of being lost, 0..1."""
        return 1.0 / (1.0 + math.exp(-max(self._log_odds, self._provisional_log_odds)))

    def matched(
        self, contradicted: float, score: float, elapsed_s: float, recovered: bool = False, moved_m: float = 0.0
    ) -> None:
        """Take in a scan that fits somewhere.

        Args:
            contradicted: share of its rays that contradict the map as it was before, 0..1; see `contradiction`.
            score: of the match, 0..1.
            elapsed_s: since the scan before.
            recovered: only the wide search has matched it.
            moved_m: since the scan before; a radian counts as half a metre.
        """
        self.contradiction = contradicted
        usual = score if self._score_level is None else self._usual_score
        excess = min(max(contradicted - self._usual_contradiction, 0.0) / FULL_CONTRADICTION, 1.0)
        drop = min(max(usual - score, 0.0) / FULL_DROP, 1.0)
        self._note_gap(elapsed_s)
        self._unseen(elapsed_s)
        self._unseen_s = 0.0
        long_drop = min(max(usual - score, 0.0) / LONG_DROP, 1.0)
        self._moved_m += moved_m
        long_drop *= min(max(2.0 - self._moved_m / NEW_VIEW_M, 0.0), 1.0)
        share = max(math.sqrt(excess * drop), LONG_DROP_SHARE * long_drop)
        evidence = EVIDENCE * (2.0 * share - 1.0)
        if recovered:
            self._weigh(max(evidence, RECOVERED), EVIDENCE_S)
        else:
            self._weigh(evidence, elapsed_s)
        if self._score_level is None or not self.doubts:
            self.after_gap, self._moved_m = False, 0.0
            level = score if self._score_level is None else self._score_level
            self._score_level = level + LEVEL_SHARE * (score - level)
            self._usual_score = min(self._score_level, score)
            self._contradiction_level += LEVEL_SHARE * (contradicted - self._contradiction_level)
            self._usual_contradiction = max(self._contradiction_level, contradicted)

    def compared(self, excess: float, moved_m: float) -> None:
        """Take in a scan that was compared with the map before a sign and with the map since.

        Scans of one place agree or disagree together, so evidence counts by the way driven.

        Args:
            excess: share of its rays that contradict the map before, less the share that contradicts the map since.
            moved_m: since the scan before; a radian counts as half a metre.
        """
        evidence = PER_M * (excess - AGREES) * min(moved_m, LONGEST_STEP_M)
        self._provisional_log_odds = min(max(self._provisional_log_odds + evidence, FLOOR), LOST + EVIDENCE)

    def settled(self) -> None:
        """Forget the comparison: the provisional scans have become part of the map."""
        self._provisional_log_odds = FLOOR

    def unmatched(self, fits_nowhere: bool, elapsed_s: float) -> None:
        """Take in a scan without a match: one that fits nowhere near, or one without points."""
        self._note_gap(elapsed_s)
        if fits_nowhere:
            self._weigh(EVIDENCE, elapsed_s)
        self._unseen(elapsed_s)

    def _note_gap(self, elapsed_s: float) -> None:
        """Note before any doubt by the scan itself that a doubt begins with a time without matched scans."""
        self.after_gap = self.after_gap or (not self.doubts and self._unseen_s + elapsed_s > self._usual_s(elapsed_s))

    def _usual_s(self, elapsed_s: float) -> float:
        """Return the time between matched scans that raises no doubt."""
        return max(UNSEEN_S, UNSEEN_PERIODS * (elapsed_s if self._period_s is None else self._period_s))

    def _unseen(self, elapsed_s: float) -> None:
        """Let the doubt grow with the time without a matched scan."""
        usual_s = self._usual_s(elapsed_s)
        before = max(self._unseen_s - usual_s, 0.0)
        self._unseen_s += elapsed_s
        grown = UNSEEN_PER_S * (max(self._unseen_s - usual_s, 0.0) - before)
        if self._log_odds < UNSEEN_MOST:
            self._log_odds = min(self._log_odds + grown, UNSEEN_MOST)
        period_s = elapsed_s if self._period_s is None else self._period_s
        self._period_s = period_s + LEVEL_SHARE * (min(elapsed_s, usual_s) - period_s)

    def integrity(self, covariance: FloatArray, localized: bool) -> Integrity:
        """Return the trust in a pose of ``covariance`` (3, 3); a robot without a place in its saved map is lost."""
        lost = self.lost_probability if localized else 1.0
        mixed = mixture(covariance, lost)
        sigma_m = math.sqrt(max(float(np.linalg.eigvalsh(mixed[:2, :2])[-1]), 0.0))
        heading = BOUND_YAW_SIGMAS * math.sqrt(max(float(mixed[2, 2]), 0.0))
        return Integrity(lost, BOUND_SIGMAS * sigma_m, min(heading, math.pi))

    def _weigh(self, evidence: float, elapsed_s: float) -> None:
        self._suspicious, self.sign = evidence >= SUSPICIOUS, evidence > 0.0
        self._log_odds += evidence * min(1.0, max(elapsed_s, 0.0) / EVIDENCE_S)
        self._log_odds = min(max(self._log_odds, FLOOR), LOST + EVIDENCE)
        self._doubtful_scans = self._doubtful_scans + 1 if self.doubts else 0
        if self._doubtful_scans > LONGEST_DOUBT and not self.lost:
            self._log_odds, self._doubtful_scans, self._suspicious = FLOOR, 0, False


def mixture(covariance: FloatArray, lost_probability: float) -> FloatArray:
    """Return the covariance (3, 3) of a pose that is wrong with a probability; its own below the monitor's floor."""
    floor = 1.0 / (1.0 + math.exp(-FLOOR))
    p = min(max((lost_probability - floor) / (1.0 - floor), 0.0), 1.0)
    lost = np.diag(np.square([LOST_SIGMA_M, LOST_SIGMA_M, LOST_SIGMA_RAD]))
    mixed: FloatArray = (1.0 - p) * covariance + p * lost
    return mixed
