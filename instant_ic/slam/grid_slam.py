"""Grid SLAM: takes scans and odometry, returns pose, map and map→odom."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from instant_ic.geometry.poses import Matrix, compose2, inverse2, matrix_from_pose2, relative2
from instant_ic.slam.config import GridSlamConfig, SlamConfig
from instant_ic.slam.contradiction import ContradictionMonitor
from instant_ic.slam.front_end import MIN_POINTS, FrontEnd, Guess, SlamStatus, Track
from instant_ic.slam.integrity import Integrity, IntegrityMonitor, mixture
from instant_ic.slam.keyframes import LOCAL_KEYFRAMES, ScanKeyframe
from instant_ic.slam.localization import FoundPlace, SavedMap
from instant_ic.slam.loop_closure import QUERY_KEYFRAMES, LoopClosure, LoopOutcome, correction
from instant_ic.slam.map_files import load_graph, load_grid, save_graph, save_grid
from instant_ic.slam.motion import MotionMonitor
from instant_ic.slam.occupancy import OccupancyGrid, OccupancyMap
from instant_ic.slam.odometry import CorrectionLimiter
from instant_ic.slam.pose_graph import Edge, optimise
from instant_ic.slam.scan import FloatArray, Scan, ScanPoints, scan_points
from instant_ic.util.diagnosis import Diagnosis, Level
from instant_ic.util.jit import leave_out_blas

MOST_JOIN_CONTRADICTION = 0.1
"""Contradiction of a session with the saved map above which they are not joined; a right place has 0.03."""
NEAR_M, NEAR_RAD = 1.5, 0.4
"""A session found this close to where odometry says needs no second finding."""
AGREE_M, AGREE_RAD, CONFIRM_AFTER = 0.3, 0.1, 1.0
"""Two findings of a session agree within the first two; metres and radians between them, together."""
PROVISIONAL_KEYFRAMES = 8
"""Number of keyframes after a sign of a loss that are provisional. Over a longer way a right pose drifts, too."""
MAX_ODOMETRY_GAP_S = 5.0
"""The encoders keep counting across a shorter gap; after a longer one they may have been reset."""


class Anchor(Protocol):
    """A past pose that later corrections move."""

    def pose(self) -> FloatArray:
        """Current estimate of map_from_base (3,)."""
        ...


@dataclass(frozen=True)
class SlamResult:
    """Result of one scan.

    Attributes:
        map_from_base: (3,) at the scan's stamp.
        covariance: (3, 3) x, y, yaw in the map frame: match covariance plus drift since the last loop closure, wider
            the less the pose is trusted.
        score: 0..1, mean likelihood field value over the points.
        status: outcome of the scan.
        keyframe_added: whether the map has changed.
        anchor: moves with the map, so that this scan's pose can be read after later corrections; None before the first
            keyframe.
        localized: False while the robot is not yet located in a saved map, or is lost; the pose is then in a separate
            frame.
        integrity: probability of being lost, and bounds of the error.
    """

    map_from_base: FloatArray
    covariance: FloatArray
    score: float
    status: SlamStatus
    keyframe_added: bool
    anchor: Anchor | None = None
    localized: bool = True
    integrity: Integrity = field(default_factory=lambda: Integrity(0.0, 0.0, 0.0))

    @property
    def trusted(self) -> bool:
        """True if the scan was matched and its pose may be used."""
        return self.status.matched and self.localized and self.integrity.trusted


@dataclass
class _Before:
    """The state before a sign of a loss.

    Attributes:
        map: as it was.
        keyframes: number of them.
        since: number of keyframes since.
    """

    map: OccupancyMap
    keyframes: int
    since: int = 0


class GridSlam:
    """Online SLAM with a planar laser.

    The first scan's pose is the odometry pose, or the origin without odometry. `map_from_odom` takes up all
    corrections. `odom_from_base` is the given odometry; for scans without odometry it is LiDAR odometry continued from
    there.

    Args:
        config: defaults when None.
        saved: a map to localise in or to extend. Until the robot is located in it, it maps in a separate frame.

    Attributes:
        map_from_base: pose of the last scan (3,).
        in_map_frame: whether the pose continues one in the map's frame; False until the place in a saved map is found.
        front_end: matches scans and makes keyframes.
        loop_closure: finds loops and optimises the keyframes' poses.
        motion: compares wheel odometry with scan matching.
        contradiction: whether the two contradict each other.
        monitor: probability of being lost.
    """

    def __init__(self, config: SlamConfig | None = None, saved: SavedMap | None = None) -> None:
        self.config = config or SlamConfig()
        self.saved = saved
        self.front_end = FrontEnd(self.config)
        self.loop_closure = LoopClosure(self.config)
        self.map = OccupancyMap(self.config.map)
        self.motion = MotionMonitor()
        self.contradiction = ContradictionMonitor()
        self.monitor = IntegrityMonitor()
        self.in_map_frame = saved is None
        self._apart = False  # a session began after the robot was lost in the map being made
        self._reach_m = math.inf  # distance from odometry within which the robot is searched for
        self._found_before: tuple[FloatArray, FloatArray] | None = None
        self._saved_cells: tuple[SavedMap, OccupancyMap] | None = None  # a saved map, to compare scans with
        self._before: _Before | None = None  # until a sign of a loss has been examined
        self.map_from_base: FloatArray = np.zeros(3)
        self.odom_from_base: FloatArray = np.zeros(3)
        self.map_from_odom: FloatArray = np.zeros(3)
        self._covariance: FloatArray = np.zeros((3, 3))
        self._stamp_ns: int | None = None
        self._points: ScanPoints | None = None
        self._step: FloatArray = np.zeros(3)
        self._step_s = 0.0
        # Odometry and map pose at the last scan that came with odometry.
        self._odometry_stamp_ns: int | None = None
        self._odometry_pose: FloatArray = np.zeros(3)
        self._pose_at_odometry: FloatArray = np.zeros(3)
        # Background work: keyframes handed to the loop closure, whether a job is running, whether one has failed.
        self._handed_over = 0
        self._busy = False
        self._job_of = self.front_end.trajectory
        self._broken = False
        self._merged = 0
        self._edges: list[Edge] = []

    def process(
        self, scan: Scan, odom_pose: ArrayLike | None = None, base_from_laser: ArrayLike = (0.0, 0.0, 0.0)
    ) -> SlamResult:
        """Estimate the pose of a scan, and add the scan to the map when it is a keyframe.

        Args:
            scan: newer than the previous one.
            odom_pose: odom_from_base (3,) at the scan's stamp, or None.
            base_from_laser: mounting pose of the laser on the robot, (3,).
        """
        if self._stamp_ns is not None and scan.stamp_ns <= self._stamp_ns:
            return self._unplaced(SlamStatus.TIME_BACKWARDS)
        odometry = None if odom_pose is None else np.asarray(odom_pose, dtype=np.float64)
        if odometry is not None and not np.isfinite(odometry).all():
            raise ValueError(f"odometry at {scan.stamp_ns} ns is not finite: {odometry}")
        mount = np.asarray(base_from_laser, dtype=np.float64)
        points = scan_points(scan, mount, self.config.map.no_return_clear_m)
        self._points = points
        guess = self._guess(odometry, scan.stamp_ns)
        if len(points.points) >= MIN_POINTS:
            track = self._track(points, guess, scan.stamp_ns)
        elif self._stamp_ns is None:  # nothing to match against yet: the next scan becomes the first one
            return self._unplaced(SlamStatus.NO_POINTS)
        else:
            track = self.front_end.dead_reckon(guess)
            self.monitor.unmatched(False, self._elapsed_s(scan.stamp_ns))
        self._extend_map(track)
        self._follow(track, odometry, scan.stamp_ns)
        anchor = self.front_end.trajectory[-1]
        covariance = track.covariance + anchor.drift
        integrity = self.monitor.integrity(covariance, self.localized)
        covariance = mixture(covariance, integrity.lost_probability)
        added = track.keyframe is not None
        return SlamResult(track.pose, covariance, track.score, track.status, added, anchor, self.localized, integrity)

    @property
    def localized(self) -> bool:
        """True if the robot is located in the saved map; True without one."""
        return self.saved is None or self.saved.located

    def grid(self) -> OccupancyGrid:
        """The map: int8 array (H, W) of −1, 0..100, resolution, origin (2,)."""
        return self.saved.grid if self.saved is not None and self.saved.unchanged else self.map.grid()

    @property
    def map_version(self) -> int:
        """Counter that grows when `grid` changes; 0 before there is a map."""
        return 1 if self.saved is not None and self.saved.unchanged else self.map.version

    def save(self, stem: Path) -> list[Path]:
        """Write the map as ``stem.yaml``, ``stem.pgm`` and ``stem.graph.npz``; return the files.

        Raises:
            MapError: there is nothing to save, or the files cannot be written.
        """
        files = save_grid(stem, self.grid())
        if self.saved is not None and self.saved.unchanged:
            return files  # this map was loaded, and its graph, if any, exists where it came from
        return [*files, save_graph(stem, *self._graph())]

    def _graph(self, count: int | None = None) -> tuple[list[ScanKeyframe], list[Edge]]:
        """The first ``count`` keyframes, or all, that have not been removed, and the edges between them."""
        keyframes = self.front_end.trajectory[:count]
        edges = [edge for edge in self._edges if max(edge.a, edge.b) < len(keyframes)]
        known = max((edge.b for edge in edges), default=0) + 1
        for k in range(known, len(keyframes)):  # keyframes that the loop closure has not processed yet
            edges.append(Edge(k - 1, k, keyframes[k].step, keyframes[k].step_covariance))
        kept = [k for k, keyframe in enumerate(keyframes) if keyframe.merged_into is None]
        row = {k: index for index, k in enumerate(kept)}
        edges = [replace(edge, a=row[edge.a], b=row[edge.b]) for edge in edges]
        return [keyframes[k] for k in kept], edges

    def set_pose(self, map_from_base: ArrayLike) -> None:
        """Set the robot's pose in the saved map (3,). An error of 1 m and 60° is acceptable; scan matching refines it.

        Raises:
            ValueError: no saved map, no scan yet, or a pose that is not finite.
        """
        pose = np.asarray(map_from_base, dtype=np.float64)
        if not np.isfinite(pose).all():
            raise ValueError(f"the pose is not finite: {pose}")
        if self.saved is None:
            raise ValueError("no saved map is loaded: set map_file")
        if self._stamp_ns is None:
            raise ValueError("no scan received yet")
        if not self.saved.located:
            self._join(self.saved, correction(self.map_from_base, pose), np.diag([0.25, 0.25, 0.1]), None)
        elif self.front_end.in_known_map:
            self._move(correction(self.map_from_base, pose))
            self.front_end.use_known_map(self.saved.localizer.points, self.map_from_base)

    # -- background work --------------------------------------------------------------------------

    def background_job(self) -> Callable[[], FoundPlace | LoopOutcome] | None:
        """Return pending work, which may run on another thread; pass its result to `take_over`.

        That is the loop closure for the keyframes since the last job, or the search in the saved map. None if there are
        no new keyframes, or a job is still running.
        """
        if self._busy:
            return None
        job: Callable[[], FoundPlace | LoopOutcome] | None = None
        if self.saved is not None and not self.saved.located:
            recent = self.front_end.trajectory[-QUERY_KEYFRAMES:]
            if self._points is not None and self._stamp_ns is not None:
                job = self.saved.search_job(recent, self.map_from_base, self._points, self._stamp_ns, self._reach_m)
        elif self.config.loop.enabled and not self._broken and not self.front_end.in_known_map:
            new = self.front_end.trajectory[self._handed_over :]
            self._handed_over += len(new)
            job = (lambda: self.loop_closure.update(new)) if new else None
        self._busy = job is not None
        self._job_of = self.front_end.trajectory
        return job

    def take_over(self, outcome: FoundPlace | LoopOutcome | None) -> None:
        """Apply the result of a background job: corrected poses change map_from_odom, never odometry.

        Args:
            outcome: result of the job; None if it failed. Then nothing changes, and loop closure is disabled, because
                its copy of the keyframes is incomplete.
        """
        self._busy = False
        if self._job_of is not self.front_end.trajectory:
            return  # of the session before
        if outcome is None:
            self._broken = self.localized
        elif isinstance(outcome, LoopOutcome):
            self._take_over_loops(outcome)
        elif outcome.found is not None and self.saved is not None and not self.saved.located:
            moved = correction(outcome.pose, outcome.found.pose)
            if self._recognized(self.saved, moved, outcome.pose):
                self._join(self.saved, moved, outcome.found.covariance, outcome.map)

    def finish(self) -> None:
        """After the last scan: optimise with all loops, and rebuild the map from the result."""
        if not self.localized or self._broken or self.front_end.in_known_map:
            return
        self._settle()
        new = self.front_end.trajectory[self._handed_over :]
        if self.config.loop.enabled and self.front_end.trajectory:
            self._handed_over += len(new)
            self.take_over(self.loop_closure.update(new, last=True))

    def figures(self) -> dict[str, object]:
        """Counts of keyframes, closed loops and rejected loops."""
        return {
            "keyframes": len(self.front_end.trajectory) - self._merged,
            "loops": self.loop_closure.closed,
            "loops_refused": self.loop_closure.refused,
        }

    def _take_over_loops(self, outcome: LoopOutcome) -> None:
        """Apply optimised poses, the rebuilt map and merged keyframes."""
        keyframes = self.front_end.trajectory
        if self._before is not None:
            first = self._before.keyframes
            if outcome.poses is not None or any(edge.robust and edge.b >= first for edge in outcome.edges):
                self._settle()  # a loop has recognized the place
        moved = outcome.apply(keyframes)
        if moved is not None:
            self.front_end.rebuild_field()
            self._move(moved)
        if outcome.map is not None:
            self._replace_map(outcome.map, outcome.count)
        self._edges = outcome.edges
        self._merged += len(outcome.merged)

    def _join(self, saved: SavedMap, moved: FloatArray, covariance: FloatArray, built: OccupancyMap | None) -> None:
        """Join the current map to the saved one: ``moved`` transforms everything mapped so far into the saved map."""
        self._settle()
        own = self.front_end.trajectory
        for keyframe in own:
            keyframe.map_from_base = compose2(moved, keyframe.map_from_base)
        self._move(moved)
        saved.located = self.in_map_frame = True
        self.monitor = IntegrityMonitor()
        if not saved.extends:
            own[-1].drift = covariance
            self.front_end.use_known_map(saved.localizer.points, self.map_from_base)
            return
        self.loop_closure = saved.join(own, covariance)
        own[:] = [*saved.keyframes, *own]
        self._edges, self._handed_over = list(saved.edges), len(saved.keyframes)
        self._replace_map(built or saved.build_map(), len(saved.keyframes))
        self.front_end.rebuild_field()

    def _replace_map(self, rebuilt: OccupancyMap, count: int) -> None:
        """Continue with a map that contains the first ``count`` keyframes."""
        rebuilt.version = self.map.version + 1
        self.map = rebuilt
        for keyframe in self.front_end.trajectory[count:]:
            self.map.insert(keyframe.map_from_base, keyframe.scan)

    # -- integrity ------------------------------------------------------------------------------

    def _extend_map(self, track: Track) -> None:
        """Add a keyframe's scan to the map. At a sign of a loss the map before it is kept for some metres."""
        keyframe = track.keyframe
        if self._before is None and self.monitor.sign and not self.front_end.in_known_map:
            self._before = _Before(self.map.copy(), len(self.front_end.trajectory) - (keyframe is not None))
        if keyframe is not None:
            self.map.insert(keyframe.map_from_base, keyframe.scan)
        if self._before is not None:
            self._before.since += keyframe is not None
            if self._before.since >= PROVISIONAL_KEYFRAMES and not self.monitor.doubts:
                self._settle()

    def _settle(self) -> None:
        """Make the scans since the sign of a loss part of the map for good."""
        self._before = None
        self.monitor.settled()

    def _track(self, points: ScanPoints, guess: Guess, stamp_ns: int) -> Track:
        """Match a scan. While the pose is in doubt no scan enters the map; a lost robot starts a new session."""
        elapsed_s = self._elapsed_s(stamp_ns)

        def accept(pose: FloatArray, score: float, recovered: bool) -> bool:
            contradicted = self._compared_map().contradiction(pose, points)
            step = relative2(self.map_from_base, pose)
            moved_m = math.hypot(step[0], step[1]) + 0.5 * abs(float(step[2]))
            self.monitor.matched(contradicted, score, elapsed_s, recovered, moved_m)
            if self._before is not None:
                # What is older than the local map may contradict a right pose, which has drifted.
                before = self._before.map.contradiction(pose, points, LOCAL_KEYFRAMES)
                self.monitor.compared(before - contradicted, moved_m)
            return not self.monitor.doubts

        track = self.front_end.track(points, guess, stamp_ns, accept)
        if track.status is SlamStatus.LOST:
            self.monitor.unmatched(True, elapsed_s)
        return self._new_session(points, guess, stamp_ns) if self.monitor.lost else track

    def _elapsed_s(self, stamp_ns: int) -> float:
        return 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9

    def _compared_map(self) -> OccupancyMap:
        """The map that scans are compared with: the one that they are matched in."""
        in_saved = self.saved is not None and self.front_end.in_known_map
        return self._cells_of(self.saved) if in_saved else self.map  # type: ignore[arg-type]

    def _cells_of(self, saved: SavedMap) -> OccupancyMap:
        if self._saved_cells is None or self._saved_cells[0] is not saved:
            self._saved_cells = saved, OccupancyMap.of_grid(saved.grid)
        return self._saved_cells[1]

    def _new_session(self, points: ScanPoints, guess: Guess, stamp_ns: int) -> Track:
        """Leave the map as it is and map apart from it, until the robot is found in it."""
        if self.localized and not self.front_end.in_known_map:
            try:
                before = self._before or _Before(self.map, len(self.front_end.trajectory))
                self.saved = SavedMap(self.config, before.map.grid(), self._graph(before.keyframes))
                self._apart = True
            except ValueError:
                self.saved = None  # a map without a wall or a free cell: nothing to find the robot in
        elif self.saved is not None:
            self.saved.located = False
        self._before = None
        self.loop_closure = LoopClosure(self.config)
        version, self.map = self.map.version, OccupancyMap(self.config.map)
        self.map.version = version + 1
        self._handed_over, self._merged, self._edges = 0, 0, []
        self._found_before = None
        # After a gap the robot is where odometry says, within its error; otherwise it may have been carried anywhere.
        self._reach_m = NEAR_M + self.front_end.reach_m(guess) if self.monitor.after_gap else math.inf
        self.monitor = IntegrityMonitor()
        return self.front_end.restart(points, guess, stamp_ns)

    def _recognized(self, saved: SavedMap, moved: FloatArray, here: FloatArray) -> bool:
        """Return whether ``moved`` (3,) takes the recent keyframes, and a scan at ``here`` (3,), to their true place.

        They must not contradict the map there. The map of a session before is not complete: the true place may be
        missing in it, and another one look like it. A place far from where odometry says must therefore be found
        twice, from two places.
        """
        recent = self.front_end.trajectory[-QUERY_KEYFRAMES:]
        shares = [self._cells_of(saved).contradiction(compose2(moved, k.map_from_base), k.scan) for k in recent]
        if float(np.mean(shares)) > MOST_JOIN_CONTRADICTION:
            return False
        step = relative2(here, compose2(moved, here))
        if not self._apart or (math.hypot(step[0], step[1]) < NEAR_M and abs(step[2]) < NEAR_RAD):
            return True
        before, self._found_before = self._found_before, (here, moved)
        if before is None:
            return False
        apart = relative2(compose2(before[1], here), compose2(moved, here))
        if math.hypot(apart[0], apart[1]) > AGREE_M or abs(apart[2]) > AGREE_RAD:
            return False
        way = relative2(before[0], here)
        if math.hypot(way[0], way[1]) + abs(way[2]) >= CONFIRM_AFTER:
            return True
        self._found_before = before
        return False

    # -- pose -------------------------------------------------------------------------------------

    def _guess(self, odometry: FloatArray | None, stamp_ns: int) -> Guess:
        if self._stamp_ns is None:
            start = np.zeros(3) if odometry is None else odometry
            return self.front_end.guess_from_odometry(start, np.zeros(3))
        elapsed_s = (stamp_ns - self._stamp_ns) * 1e-9
        gap_s = math.inf if self._odometry_stamp_ns is None else (stamp_ns - self._odometry_stamp_ns) * 1e-9
        if odometry is not None and gap_s <= max(MAX_ODOMETRY_GAP_S, 2 * elapsed_s):
            step = relative2(self._odometry_pose, odometry)
            return self.front_end.guess_from_odometry(compose2(self._pose_at_odometry, step), step)
        pose = self.front_end.constant_velocity(self.map_from_base, self._step, self._step_s, elapsed_s)
        return self.front_end.guess_from_velocity(pose, elapsed_s)

    def _follow(self, track: Track, odometry: FloatArray | None, stamp_ns: int) -> None:
        """Accept the pose and move its correction into map_from_odom."""
        step = relative2(self.map_from_base, track.pose)
        if self._stamp_ns is not None:
            matched = track.status in (SlamStatus.TRACKED, SlamStatus.RECOVERED)
            self._step, self._step_s = step, (stamp_ns - self._stamp_ns) * 1e-9
            if odometry is not None and self._odometry_stamp_ns == self._stamp_ns:
                wheels = relative2(self._odometry_pose, odometry)
                self.motion.update(wheels, step, self._step_s, matched)
                self.contradiction.update(wheels, step, self._step_s, track.scan_sigma)
            if not matched:
                # Damp the velocity: without a match, the estimate must not keep moving for ever.
                self._step = 0.5 * self._step
        if odometry is None:
            self.odom_from_base = compose2(self.odom_from_base, step)
        else:
            self.odom_from_base = odometry
            self._odometry_stamp_ns, self._odometry_pose, self._pose_at_odometry = stamp_ns, odometry, track.pose
            self.map_from_odom = compose2(track.pose, inverse2(odometry))
        self.map_from_base, self._covariance, self._stamp_ns = track.pose, track.covariance, stamp_ns

    def _move(self, moved: FloatArray) -> None:
        """Move the current pose in the map; odometry stays."""
        self.map_from_base = compose2(moved, self.map_from_base)
        self.map_from_odom = compose2(moved, self.map_from_odom)
        self._pose_at_odometry = compose2(moved, self._pose_at_odometry)

    def _unplaced(self, status: SlamStatus) -> SlamResult:
        """Result of a scan that changes nothing: the last pose."""
        return SlamResult(self.map_from_base, self._covariance, 0.0, status, False, localized=self.localized)


def make_slam(config: SlamConfig | None = None, map_file: Path | None = None, localize: bool = False) -> GridSlam:
    """Create the SLAM, with a saved map if one is named.

    Args:
        config: defaults when None.
        map_file: a saved map, ``NAME`` or ``NAME.yaml``; None starts a new map.
        localize: True keeps the map unchanged; False extends it, which needs its ``NAME.graph.npz``.

    Raises:
        MapError: the map cannot be read.
        ValueError: the map has no occupied or no free cell, or localisation was requested without a map.
    """
    config = config or SlamConfig()
    if map_file is None:
        if localize:
            raise ValueError("localization needs a saved map: set map_file")
        return GridSlam(config)
    stem = map_file.with_suffix("") if map_file.suffix in (".yaml", ".yml") else map_file
    return GridSlam(config, SavedMap(config, load_grid(map_file), None if localize else load_graph(stem)))


def warm_up(config: SlamConfig | None = None) -> None:
    """Compile the kernels, or load them from their cache, and import the solver.

    Otherwise they would delay the first scan, and the solver (60 MB) the scans of the first loop closure.
    """
    leave_out_blas()
    slam = GridSlam(config)
    angles = np.linspace(-math.pi, math.pi, 181)[:-1]
    ranges = np.minimum(2.0 / np.maximum(np.abs(np.cos(angles)), 1e-6), 3.0 / np.maximum(np.abs(np.sin(angles)), 1e-6))
    for index in range(2):
        slam.process(Scan(ranges, -math.pi, 2 * math.pi / 180, 0.1, 30.0, index + 1))
    slam.grid()
    optimise(np.zeros((2, 3)), [Edge(0, 1, np.ones(3), np.eye(3))], {0: 0, 1: 1})


def save_answer(slam: GridSlam, stem: Path) -> str:
    """Save the map; return which files were written, or the error."""
    try:
        return "saved: " + ", ".join(str(file) for file in slam.save(stem))
    except ValueError as error:
        return f"error: {error}"


def transforms(
    slam: GridSlam, limiter: CorrectionLimiter, config: GridSlamConfig, stamp_ns: int, with_odometry: bool
) -> Iterator[tuple[str, str, Matrix]]:
    """Transforms to broadcast after a scan: parent, child and parent_from_child (4, 4)."""
    if not with_odometry:
        yield config.odom_frame, config.base_frame, matrix_from_pose2(slam.odom_from_base)
    # A robot that is lost keeps the frames that it had: it may drive on, slowly, until its place is recognized.
    if slam.in_map_frame:
        map_from_odom = limiter.follow(slam.map_from_odom, slam.odom_from_base, stamp_ns)
        yield config.map_frame, config.odom_frame, matrix_from_pose2(map_from_odom)
    else:
        limiter.reset()


class JobResult(NamedTuple):
    """Outcome of a background job of one SLAM; None with a diagnosis if it failed."""

    slam: GridSlam
    outcome: FoundPlace | LoopOutcome | None
    diagnosis: Diagnosis | None = None


def run_job(item: tuple[GridSlam, Callable[[], FoundPlace | LoopOutcome]]) -> JobResult:
    """Run a ``background_job``, on any thread."""
    slam, job = item
    try:
        return JobResult(slam, job())
    except Exception as error:  # noqa: BLE001 - scans go on
        text = f"loop closure failed and is off until the node restarts: {type(error).__name__}: {error}"
        return JobResult(slam, None, Diagnosis("loops", Level.ERROR, text))
