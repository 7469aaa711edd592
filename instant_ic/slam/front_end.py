"""Front end, which matches each scan against the local map of recent keyframes.

1. ``guess_from_odometry``, ``guess_from_velocity``: predict the pose, its uncertainty and the search window.
2. ``track``: match the scan in this window. If the score is poor, match it in a wide window. If the match is still in
   doubt, search all headings (``_search_all_headings``).
3. ``_add_keyframe``: make a keyframe of a scan that is far enough from the last one, and rebuild the local map.
"""

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
"""Smallest number of points with which a scan is matched; with fewer, its pose is odometry's."""


@dataclass(frozen=True)
class FrontEndConfig:
    """Tuning of the front end.

    Attributes:
        search_m: half width of the search around the predicted pose, in metres; it grows with the odometry step.
        search_rad: the same for the heading, in radians.
        recovery_m: half width of the wide search, in metres.
        recovery_rad: the same for the heading, in radians.
        recovery_score: score below which the wide search starts.
        min_score: score below which the scan counts as lost and gets odometry's pose.
        recovery_margin: smallest gain of the wide search's score over the first search's.
        start_keyframes: largest number of keyframes at the start pose before the robot moves.
        wide_gain: smallest share of the residual, of the local match and of the second best place, that a pose found
            over all headings must explain.
        score_memory: weight of a new scan in the usual score.
        score_drop: drop below the usual score at which a match is in doubt.
        doubtful_turn_rad: standard deviation of odometry's heading above which a match is in doubt at any score;
            reached by a turn of 40° in one scan.
        wide_sigmas: reach of the search over all headings, in standard deviations of odometry since the last match.
        wide_reach_m: limit of this reach, in metres.
        window_per_m: growth of the search window per metre of the odometry step. This and the next two are twice the
            standard deviation of odometry.
        window_per_rad: growth of the window's rotation per radian.
        turn_window_per_m: growth of the window's rotation per metre.
        floor_sigma_m: smallest standard deviation of an odometry step, in metres; also while standing.
        floor_sigma_rad: the same for the heading, in radians.
        sigma_m_per_m: growth of the position's standard deviation per metre, because tracks slip.
        sigma_rad_per_rad: growth of the heading's standard deviation per radian, because skid steering slips in turns.
        sigma_rad_per_m: growth of the heading's standard deviation per metre.
        keyframe_m: motion since the last keyframe after which a scan becomes a keyframe, in metres.
        keyframe_rad: the same for the heading, in radians.
        step_sigma_m: scan-matching error between keyframes beyond its own covariance, in metres.
        step_sigma_rad: the same for the heading, in radians.
        known_map_step_m: motion after which the local map of a known map is rebuilt, in metres.
    """

    search_m: float = 0.3
    search_rad: float = 0.3
    recovery_m: float = 1.2
    recovery_rad: float = 1.2
    recovery_score: float = 0.6
    min_score: float = 0.35
    recovery_margin: float = 0.1
    start_keyframes: int = 4
    wide_gain: float = 0.35
    score_memory: float = 0.05
    score_drop: float = 0.15
    doubtful_turn_rad: float = 0.15
    wide_sigmas: float = 3.0
    wide_reach_m: float = 6.0
    window_per_m: float = 0.4
    window_per_rad: float = 0.4
    turn_window_per_m: float = 0.2
    floor_sigma_m: float = 0.01
    floor_sigma_rad: float = 0.03
    sigma_m_per_m: float = 0.2
    sigma_rad_per_rad: float = 0.2
    sigma_rad_per_m: float = 0.1
    keyframe_m: float = 0.25
    keyframe_rad: float = 0.2
    step_sigma_m: float = 0.005
    step_sigma_rad: float = 0.0015
    known_map_step_m: float = 2.0


TUNING = FrontEndConfig()


class SlamStatus(enum.StrEnum):
    """Outcome of processing a scan."""

    FIRST = "first"
    """First scan, which is the origin of the map."""
    TRACKED = "tracked"
    """Match near the predicted pose."""
    RECOVERED = "recovered"
    """Match by the wide search, because the odometry error was large."""
    LOST = "lost"
    """No match. The pose comes from odometry, and its covariance grows."""
    RESTARTED = "restarted"
    """Lost robot. A new session starts at the odometry pose, with a map of its own."""
    NO_POINTS = "no points"
    """Too few points. The pose comes from odometry."""
    TIME_BACKWARDS = "time backwards"
    """Scan that is not newer than the previous one. It is ignored, and the last pose is returned."""

    @property
    def matched(self) -> bool:
        """True if the pose comes from scan matching."""
        return self in (SlamStatus.FIRST, SlamStatus.TRACKED, SlamStatus.RECOVERED)


@dataclass(frozen=True)
class Guess:
    """Predicted pose of the base, from odometry or constant velocity.

    Attributes:
        pose: map_from_base, (3,).
        sigma: standard deviations along, across and in rotation, (3,).
        window: search window around the pose.
        doubtful: true if odometry reports a turn so large that the tracks may have slipped.
    """

    pose: FloatArray
    sigma: FloatArray
    window: SearchWindow
    doubtful: bool = False


@dataclass(frozen=True)
class Track:
    """Result of the front end for one scan.

    Attributes:
        pose: map_from_base, (3,).
        covariance: covariance of the pose, (3, 3).
        score: mean field value over the points, 0..1.
        status: outcome of the scan.
        keyframe: keyframe that was added, or None.
        scan_covariance: covariance of the match without odometry, (3, 3); None without a match.
    """

    pose: FloatArray
    covariance: FloatArray
    score: float
    status: SlamStatus
    keyframe: ScanKeyframe | None
    scan_covariance: FloatArray | None = None

    @property
    def scan_sigma(self) -> FloatArray | None:
        """Standard deviations of the match without odometry (3,): along, across, rotation; None without a match."""
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
        self._field = LikelihoodField(config.field.resolution_m, config.field.max_range_m + (TUNING.recovery_m + 0.5))
        self._lost_sigma_m = 0.0
        self._usual_score = 0.0
        self._covariance = np.zeros((3, 3))
        self._known: FloatArray | None = None
        self._built_at = np.zeros(2)

    @property
    def in_known_map(self) -> bool:
        """True if scans are matched against a known map, which stays unchanged."""
        return self._known is not None

    def use_known_map(self, points: FloatArray, pose: FloatArray) -> None:
        """Match against the surface points (n, 2) of a known map from now on, starting at ``pose`` (3,)."""
        self._known = points
        self._build_known(pose)

    def guess_from_odometry(self, pose: FloatArray, step: FloatArray) -> Guess:
        """Return the guess at ``pose``, which an odometry step (3,) in the base's own frame has led to."""
        distance, turn = math.hypot(step[0], step[1]), abs(step[2])
        translation = TUNING.floor_sigma_m + TUNING.sigma_m_per_m * distance
        rotation = TUNING.floor_sigma_rad + TUNING.sigma_rad_per_rad * turn + TUNING.sigma_rad_per_m * distance
        window_m = TUNING.search_m + TUNING.window_per_m * distance
        window_rad = TUNING.search_rad + TUNING.window_per_rad * turn + TUNING.turn_window_per_m * distance
        return self._guess(pose, translation, rotation, window_m, window_rad, rotation > TUNING.doubtful_turn_rad)

    def guess_from_velocity(self, pose: FloatArray, elapsed_s: float) -> Guess:
        """Return the guess at ``pose`` without odometry. Its window covers any motion possible in the elapsed time."""
        match = self.config.match
        translation = 0.5 * match.free_motion_speed_mps * elapsed_s + 0.05
        rotation = 0.5 * match.free_motion_yaw_rate_radps * elapsed_s + 0.05
        return self._guess(pose, translation, rotation, TUNING.search_m + translation, TUNING.search_rad + rotation)

    def constant_velocity(self, pose: FloatArray, step: FloatArray, step_s: float, elapsed_s: float) -> FloatArray:
        """Return the pose after ``elapsed_s`` at the velocity of the last ``step`` (3,), which took ``step_s`` seconds.

        The velocity is limited to ``match.free_motion_*``, because stamps a few milliseconds apart could make it huge.
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
        window = SearchWindow(min(window_m, TUNING.recovery_m), min(window_rad, TUNING.recovery_rad))
        return Guess(pose, np.array([sigma_m, sigma_m, sigma_rad]), window, doubtful)

    def track(
        self, scan: ScanPoints, guess: Guess, stamp_ns: int, accept: Callable[[FloatArray, float, bool], bool]
    ) -> Track:
        """Match a scan of at least `MIN_POINTS` points. It can become a keyframe only if ``accept`` returns True.

        ``accept`` gets the pose (3,) and the score of the match, and whether only a wide search has found it.
        """
        points = self._match_points(scan)
        if not self.trajectory:
            keyframe = self._add_keyframe(guess.pose, np.zeros((3, 3)), scan, stamp_ns)
            return Track(guess.pose, np.zeros((3, 3)), 1.0, SlamStatus.FIRST, keyframe)

        status = SlamStatus.TRACKED
        match = match_scan(self._field, points, guess.pose, guess.sigma, guess.window)
        if match.score < TUNING.recovery_score or match.at_border:
            recovered = match_scan(
                self._field, points, guess.pose, guess.sigma, SearchWindow(TUNING.recovery_m, TUNING.recovery_rad)
            )
            # A window this large always contains a slightly better pose. The wide search must therefore be clearly
            # better, unless the first window was too small.
            margin = 0.0 if match.at_border else TUNING.recovery_margin
            if recovered.score >= TUNING.min_score and recovered.score > match.score + margin:
                match, status = recovered, SlamStatus.RECOVERED
        if self._doubtful(match, guess):
            wide = self._search_all_headings(points, guess, match.score)
            if wide is not None:
                match, status = wide, SlamStatus.RECOVERED
        if match.score < TUNING.min_score:
            return Track(guess.pose, self._grown_covariance(guess), match.score, SlamStatus.LOST, None)

        accepted = accept(match.pose, match.score, status is SlamStatus.RECOVERED)
        self._lost_sigma_m = 0.0
        self._usual_score += TUNING.score_memory * (match.score - self._usual_score)
        self._covariance = match.covariance
        added: ScanKeyframe | None = None
        if self.in_known_map:
            if math.hypot(*(match.pose[:2] - self._built_at)) > TUNING.known_map_step_m:
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
        """Return whether the scan may fit better at a heading outside the local search."""
        usual = max(TUNING.recovery_score, self._usual_score - TUNING.score_drop)
        return match.at_border or match.score < usual or guess.doubtful

    def _search_all_headings(self, points: FloatArray, guess: Guess, score: float) -> Match | None:
        """Return the best pose over all headings near the guess, or None unless it is unique and beats ``score``."""
        found = find_place(self._field, points, guess.pose, self.reach_m(guess), math.pi)
        if found is None or found.score < TUNING.recovery_score:
            return None
        other = max(score, found.runner_up)
        if found.score - other < TUNING.wide_gain * (1.0 - other):
            return None
        return Match(found.pose, found.covariance, found.score, False, found.covariance)

    def reach_m(self, guess: Guess) -> float:
        """Return the distance from the guess within which the robot must be, by odometry since the last match."""
        sigma_m = float(guess.sigma[0]) + self._lost_sigma_m
        return min(TUNING.recovery_m + TUNING.wide_sigmas * sigma_m, TUNING.wide_reach_m)

    def _grown_covariance(self, guess: Guess) -> FloatArray:
        # Odometry has a scale error, so the standard deviations of steps without a match add up.
        self._lost_sigma_m += float(guess.sigma[0])
        self._covariance = self._covariance + turned(np.diag(guess.sigma**2), float(guess.pose[2]))
        return self._covariance

    def _first_was_poor(self, match: Match, status: SlamStatus) -> bool:
        """Return whether the first keyframes hold too little of what the robot sees at its start.

        This happens if the first scan covered only half a revolution. Without a further keyframe, each scan would start
        a wide search until the robot moves.
        """
        few = len(self.trajectory) < TUNING.start_keyframes
        return few and status is SlamStatus.TRACKED and match.score < TUNING.recovery_score

    def _moved(self, pose: FloatArray) -> bool:
        last = self.trajectory[-1].map_from_base
        step = relative2(last, pose)
        return math.hypot(step[0], step[1]) >= TUNING.keyframe_m or abs(step[2]) >= TUNING.keyframe_rad

    def _add_keyframe(self, pose: FloatArray, covariance: FloatArray, scan: ScanPoints, stamp_ns: int) -> ScanKeyframe:
        step, step_covariance, drift = np.zeros(3), np.zeros((3, 3)), covariance.copy()
        if self.trajectory:
            last = self.trajectory[-1]
            yaw = float(last.map_from_base[2])
            step = relative2(last.map_from_base, pose)
            step_covariance = turned(covariance, -yaw)
            step_covariance += np.diag(np.square([TUNING.step_sigma_m, TUNING.step_sigma_m, TUNING.step_sigma_rad]))
            drift = grown_drift(last.drift, pose[:2] - last.map_from_base[:2], yaw, step_covariance)
        keyframe = ScanKeyframe(stamp_ns, pose.copy(), scan, step, step_covariance, drift)
        self.trajectory.append(keyframe)
        self.rebuild_field()
        return keyframe

    def rebuild_field(self) -> None:
        """Rebuild the local map from the recent keyframes, for example after the optimisation of their poses."""
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
