"""Front end: matches each scan against the local map of recent keyframes."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from instant_ic.geometry.poses import compose2, relative2, wrap_angle
from instant_ic.slam.config import SlamConfig
from instant_ic.slam.keyframes import LOCAL_KEYFRAMES, ScanKeyframe, grown_drift, turned
from instant_ic.slam.likelihood_field import FieldSurface, LikelihoodField
from instant_ic.slam.loop_search import find_place
from instant_ic.slam.matcher import Match, SearchWindow, match_scan
from instant_ic.slam.scan import FloatArray, ScanPoints, thin

MIN_POINTS = 20
"""A scan with fewer points is not matched; odometry decides."""
SEARCH_M, SEARCH_RAD = 0.3, 0.3
"""Half width of the search around the predicted pose; it grows with the odometry step."""
RECOVERY_M, RECOVERY_RAD = 1.2, 1.2
"""Half width of the wide search."""
RECOVERY_SCORE, MIN_SCORE = 0.6, 0.35
"""A score below the first starts the wide search. Below the second the scan counts as lost: its pose is odometry's."""
RECOVERY_MARGIN = 0.1
"""Minimum score gain of the wide search over the first search."""
START_KEYFRAMES = 4
"""Maximum number of keyframes taken at the start pose before the robot moves."""
WIDE_GAIN = 0.35
"""Share of the residual that a pose found over all headings must explain, of the local match's and of the second best
place's."""
SCORE_MEMORY, SCORE_DROP = 0.05, 0.15
"""Weight of a scan in the usual score; a score this much below the usual one is in doubt."""
DOUBTFUL_TURN_RAD = 0.15
"""σ of a heading by odometry, that of a turn of 40° in one scan, above which the match is in doubt at any score."""
WIDE_SIGMAS, WIDE_REACH_M = 3.0, 6.0
"""Reach of the search over all headings: standard deviations of the guess since the last match, and its limit."""
WINDOW_PER_M, WINDOW_PER_RAD, TURN_WINDOW_PER_M = 0.4, 0.4, 0.2
"""Growth of the search window with the odometry step: translation per metre, rotation per radian and per metre; twice
the σ of the odometry."""
FLOOR_SIGMA_M, FLOOR_SIGMA_RAD = 0.01, 0.03
"""σ of an odometry step, also while standing."""
SIGMA_M_PER_M, SIGMA_RAD_PER_RAD, SIGMA_RAD_PER_M = 0.2, 0.2, 0.1
"""σ of an odometry step beyond that: tracks slip, and skid steering turns less than the encoders."""
KEYFRAME_M, KEYFRAME_RAD = 0.25, 0.2
"""Motion since the last keyframe after which a scan becomes a keyframe."""
STEP_SIGMA_M, STEP_SIGMA_RAD = 0.005, 0.0015
"""Scan-matching error between keyframes beyond its own covariance."""
KNOWN_MAP_STEP_M = 2.0
"""Distance in metres after which the local map is rebuilt when localising in a known map."""


class SlamStatus(enum.StrEnum):
    """Outcome of processing a scan."""

    FIRST = "first"
    """The first scan: the origin of the map."""
    TRACKED = "tracked"
    """Matched near the predicted pose."""
    RECOVERED = "recovered"
    """Matched by the wide search; the odometry error was large."""
    LOST = "lost"
    """No match; the pose comes from odometry, and its covariance grows."""
    RESTARTED = "restarted"
    """The robot is lost; a new session starts at the odometry pose, apart from the map so far."""
    NO_POINTS = "no points"
    """No points, only infinite ranges, or too few points; the pose comes from odometry."""
    TIME_BACKWARDS = "time backwards"
    """Not newer than the previous scan; the scan is ignored and the last pose returned."""

    @property
    def matched(self) -> bool:
        """True if the pose comes from scan matching."""
        return self in (SlamStatus.FIRST, SlamStatus.TRACKED, SlamStatus.RECOVERED)


@dataclass(frozen=True)
class Guess:
    """Predicted pose of the base, from odometry or constant velocity.

    Attributes:
        pose: (3,).
        sigma: (3,) along, across, rotation.
        window: search window around the pose.
        doubtful: whether odometry reports a turn so large that its tracks may have slipped.
    """

    pose: FloatArray
    sigma: FloatArray
    window: SearchWindow
    doubtful: bool = False


@dataclass(frozen=True)
class Track:
    """Result of the front end for one scan.

    Attributes:
        pose: (3,).
        covariance: (3, 3) of the pose.
        score: 0..1, mean field value over the points.
        status: outcome of the scan.
        keyframe: the keyframe that was added; None if none was.
        scan_covariance: (3, 3) of the pose by the scan alone; None if the pose is not that of a match.
    """

    pose: FloatArray
    covariance: FloatArray
    score: float
    status: SlamStatus
    keyframe: ScanKeyframe | None
    scan_covariance: FloatArray | None = None

    @property
    def scan_sigma(self) -> FloatArray | None:
        """Standard deviations (3,) by the scan alone: along, across, rotation; None without a match."""
        if self.scan_covariance is None:
            return None
        sigma: FloatArray = np.sqrt(np.diag(turned(self.scan_covariance, -float(self.pose[2]))))
        return sigma


class FrontEnd:
    """Scan-to-local-map matching with keyframes.

    Attributes:
        trajectory: all keyframes in time order.
    """

    def __init__(self, config: SlamConfig) -> None:
        self.config = config
        self.trajectory: list[ScanKeyframe] = []
        self._field = LikelihoodField(config.field.resolution_m, config.field.max_range_m + (RECOVERY_M + 0.5))
        self._lost_sigma_m = 0.0
        self._usual_score = 0.0
        self._covariance = np.zeros((3, 3))
        self._known: FloatArray | None = None
        self._built_at = np.zeros(2)

    @property
    def in_known_map(self) -> bool:
        """True if scans are matched against a known map that stays unchanged."""
        return self._known is not None

    def use_known_map(self, points: FloatArray, pose: FloatArray) -> None:
        """Switch to matching against the surfaces (n, 2) of a known map, starting at ``pose`` (3,)."""
        self._known = points
        self._build_known(pose)

    def guess_from_odometry(self, pose: FloatArray, step: FloatArray) -> Guess:
        """Return the guess at ``pose`` after an odometry step (3,) in the base's own frame."""
        distance, turn = math.hypot(step[0], step[1]), abs(step[2])
        translation = FLOOR_SIGMA_M + SIGMA_M_PER_M * distance
        rotation = FLOOR_SIGMA_RAD + SIGMA_RAD_PER_RAD * turn + SIGMA_RAD_PER_M * distance
        window_m = SEARCH_M + WINDOW_PER_M * distance
        window_rad = SEARCH_RAD + WINDOW_PER_RAD * turn + TURN_WINDOW_PER_M * distance
        return self._guess(pose, translation, rotation, window_m, window_rad, rotation > DOUBTFUL_TURN_RAD)

    def guess_from_velocity(self, pose: FloatArray, elapsed_s: float) -> Guess:
        """Return the guess at ``pose`` without odometry: the window covers any motion possible in the elapsed time."""
        match = self.config.match
        translation = 0.5 * match.free_motion_speed_mps * elapsed_s + 0.05
        rotation = 0.5 * match.free_motion_yaw_rate_radps * elapsed_s + 0.05
        return self._guess(pose, translation, rotation, SEARCH_M + translation, SEARCH_RAD + rotation)

    def constant_velocity(self, pose: FloatArray, step: FloatArray, step_s: float, elapsed_s: float) -> FloatArray:
        """Return the pose after ``elapsed_s`` at the velocity of the last ``step`` (3,), which took ``step_s`` seconds.

        The velocity is at most ``match.free_motion_*``: stamps of a few milliseconds would make it arbitrarily large.
        """
        match = self.config.match
        part = elapsed_s / step_s if step_s > 0 else 0.0
        way, turn = math.hypot(step[0], step[1]), abs(wrap_angle(float(step[2])))
        part_m = min(part, match.free_motion_speed_mps * elapsed_s / way) if way > 0 else 0.0
        part_rad = min(part, match.free_motion_yaw_rate_radps * elapsed_s / turn) if turn > 0 else 0.0
        return compose2(pose, np.array([part_m * step[0], part_m * step[1], part_rad * wrap_angle(float(step[2]))]))

    @staticmethod
    def _guess(
        pose: FloatArray, sigma_m: float, sigma_rad: float, window_m: float, window_rad: float, doubtful: bool = False
    ) -> Guess:
        window = SearchWindow(min(window_m, RECOVERY_M), min(window_rad, RECOVERY_RAD))
        return Guess(pose, np.array([sigma_m, sigma_m, sigma_rad]), window, doubtful)

    def track(
        self, scan: ScanPoints, guess: Guess, stamp_ns: int, accept: Callable[[FloatArray, float, bool], bool]
    ) -> Track:
        """Match a scan that has at least `MIN_POINTS` points; it becomes a keyframe only if ``accept`` returns True.

        ``accept`` gets the pose (3,) and the score of the match, and whether only the wide search has found it.
        """
        points = self._match_points(scan)
        if not self.trajectory:
            keyframe = self._add_keyframe(guess.pose, np.zeros((3, 3)), scan, stamp_ns)
            return Track(guess.pose, np.zeros((3, 3)), 1.0, SlamStatus.FIRST, keyframe)

        status = SlamStatus.TRACKED
        match = match_scan(self._field, points, guess.pose, guess.sigma, guess.window)
        if match.score < RECOVERY_SCORE or match.at_border:
            recovered = match_scan(self._field, points, guess.pose, guess.sigma, SearchWindow(RECOVERY_M, RECOVERY_RAD))
            # Unless the first window was too small, the wide search must be clearly better: a window this large always
            # contains a slightly better pose.
            margin = 0.0 if match.at_border else RECOVERY_MARGIN
            if recovered.score >= MIN_SCORE and recovered.score > match.score + margin:
                match, status = recovered, SlamStatus.RECOVERED
        if self._doubtful(match, guess):
            wide = self._search_all_headings(points, guess, match.score)
            if wide is not None:
                match, status = wide, SlamStatus.RECOVERED
        if match.score < MIN_SCORE:
            return Track(guess.pose, self._grown_covariance(guess), match.score, SlamStatus.LOST, None)

        accepted = accept(match.pose, match.score, status is SlamStatus.RECOVERED)
        self._lost_sigma_m = 0.0
        self._usual_score += SCORE_MEMORY * (match.score - self._usual_score)
        self._covariance = match.covariance
        added: ScanKeyframe | None = None
        if self.in_known_map:
            if math.hypot(*(match.pose[:2] - self._built_at)) > KNOWN_MAP_STEP_M:
                self._build_known(match.pose)
        elif accepted and (self._moved(match.pose) or self._first_was_poor(match, status)):
            added = self._add_keyframe(match.pose, match.covariance, scan, stamp_ns)
        return Track(match.pose, match.covariance, match.score, status, added, match.scan_covariance)

    def restart(self, scan: ScanPoints, guess: Guess, stamp_ns: int) -> Track:
        """Start a new local map and trajectory with a scan, at the predicted pose."""
        self._known = None
        self.trajectory = []
        covariance = self._grown_covariance(guess)
        self._lost_sigma_m = 0.0
        keyframe = self._add_keyframe(guess.pose, covariance, scan, stamp_ns)
        return Track(guess.pose, covariance, 0.0, SlamStatus.RESTARTED, keyframe)

    def dead_reckon(self, guess: Guess) -> Track:
        """Use the guess as the pose of a scan with too few points."""
        return Track(guess.pose, self._grown_covariance(guess), 0.0, SlamStatus.NO_POINTS, None)

    def _match_points(self, scan: ScanPoints) -> FloatArray:
        near = (scan.points**2).sum(axis=1) <= self.config.field.max_range_m**2
        return thin(scan.points[near], scan.joined[near], self.config.match.max_points)

    def _doubtful(self, match: Match, guess: Guess) -> bool:
        """Return whether the scan may fit better at a heading that the local search does not reach."""
        usual = max(RECOVERY_SCORE, self._usual_score - SCORE_DROP)
        return match.at_border or match.score < usual or guess.doubtful

    def _search_all_headings(self, points: FloatArray, guess: Guess, score: float) -> Match | None:
        """Return the best pose over all headings near the guess; None unless unique and better than ``score``."""
        found = find_place(self._field, points, guess.pose, self.reach_m(guess), math.pi)
        if found is None or found.score < RECOVERY_SCORE:
            return None
        other = max(score, found.runner_up)
        if found.score - other < WIDE_GAIN * (1.0 - other):
            return None
        return Match(found.pose, found.covariance, found.score, False, found.covariance)

    def reach_m(self, guess: Guess) -> float:
        """Return the distance from the guess within which the robot is, by odometry since the last match."""
        sigma_m = float(guess.sigma[0]) + self._lost_sigma_m
        return min(RECOVERY_M + WIDE_SIGMAS * sigma_m, WIDE_REACH_M)

    def _grown_covariance(self, guess: Guess) -> FloatArray:
        # Odometry errs by its scale: the errors of the steps without a match add up.
        self._lost_sigma_m += float(guess.sigma[0])
        self._covariance = self._covariance + turned(np.diag(guess.sigma**2), float(guess.pose[2]))
        return self._covariance

    def _first_was_poor(self, match: Match, status: SlamStatus) -> bool:
        """Return whether a robot that has not moved since the start sees more than its map holds.

        This happens when the first scan covered half a revolution, before odometry arrived. Without a further keyframe,
        each scan would start a wide search until the robot moves.
        """
        few = len(self.trajectory) < START_KEYFRAMES
        return few and status is SlamStatus.TRACKED and match.score < RECOVERY_SCORE

    def _moved(self, pose: FloatArray) -> bool:
        last = self.trajectory[-1].map_from_base
        step = relative2(last, pose)
        return math.hypot(step[0], step[1]) >= KEYFRAME_M or abs(step[2]) >= KEYFRAME_RAD

    def _add_keyframe(self, pose: FloatArray, covariance: FloatArray, scan: ScanPoints, stamp_ns: int) -> ScanKeyframe:
        step, step_covariance, drift = np.zeros(3), np.zeros((3, 3)), covariance.copy()
        if self.trajectory:
            last = self.trajectory[-1]
            yaw = float(last.map_from_base[2])
            step = relative2(last.map_from_base, pose)
            step_covariance = turned(covariance, -yaw)
            step_covariance += np.diag(np.square([STEP_SIGMA_M, STEP_SIGMA_M, STEP_SIGMA_RAD]))
            drift = grown_drift(last.drift, pose[:2] - last.map_from_base[:2], yaw, step_covariance)
        keyframe = ScanKeyframe(stamp_ns, pose.copy(), scan, step, step_covariance, drift)
        self.trajectory.append(keyframe)
        self.rebuild_field()
        return keyframe

    def rebuild_field(self) -> None:
        """Rebuild the local map from the recent keyframes, for example after their poses were optimised."""
        if self._known is not None:
            self._build_known(self._built_at)
            return
        recent = self.trajectory[-LOCAL_KEYFRAMES:]
        surfaces = [FieldSurface(k.map_from_base, k.scan.points, k.scan.joined) for k in recent]
        self._field.rebuild(recent[-1].map_from_base, surfaces)

    def _build_known(self, centre: FloatArray) -> None:
        assert self._known is not None
        self._built_at = np.array(centre[:2])
        alone = np.zeros(len(self._known), dtype=np.bool_)
        self._field.rebuild(self._built_at, [FieldSurface(np.zeros(3), self._known, alone)])
