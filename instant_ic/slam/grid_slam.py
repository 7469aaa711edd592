"""Grid SLAM: pose, map and map→odom from scans and odometry.

`GridSlam.process` handles a scan:

1. ``scan_points``: convert the scan to points in the base frame.
2. ``frames.predict``: predict the pose from odometry, or with constant velocity.
3. ``_match``: match the scan to the local map (``front_end``). A lost robot starts a new session (``_new_session``)
   with a map of its own, until it is found in the previous map (``relocalization``).
4. ``_insert``: add a keyframe's scan to the map.
5. ``frames.follow``: put the correction of the pose into map→odom.
6. ``_result``: compute the covariance and the probability that the pose is wrong (``integrity``).

Loop closure and the search in a saved map run in the background (`GridSlam.background_job`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from instant_ic.geometry.poses import compose2, relative2
from instant_ic.slam.config import SlamConfig
from instant_ic.slam.contradiction import ContradictionMonitor
from instant_ic.slam.frames import BaseFrames
from instant_ic.slam.front_end import MIN_POINTS, FrontEnd, Guess, SlamStatus, Track
from instant_ic.slam.integrity import Integrity, IntegrityMonitor, mixture
from instant_ic.slam.keyframes import LOCAL_KEYFRAMES, ScanKeyframe
from instant_ic.slam.localization import FoundPlace, SavedMap
from instant_ic.slam.loop_closure import QUERY_KEYFRAMES, LoopClosure, LoopOutcome, correction
from instant_ic.slam.map_files import save_graph, save_grid
from instant_ic.slam.occupancy import OccupancyGrid, OccupancyMap
from instant_ic.slam.pose_graph import Edge
from instant_ic.slam.relocalization import Relocalization
from instant_ic.slam.scan import FloatArray, Scan, ScanPoints, scan_points
from instant_ic.slam.turn_factor import TurnFactor

PROVISIONAL_KEYFRAMES = 8
"""Number of provisional keyframes after a sign of a loss. Over a longer way, even a right pose drifts."""


@dataclass(frozen=True)
class SlamResult:
    """Result of one scan.

    Attributes:
        map_from_base: pose at the scan's stamp, (3,).
        covariance: covariance of x, y, yaw in the map frame, (3, 3): that of the match plus the drift since the last
            loop closure, wider if the pose is less trusted.
        score: mean likelihood field value over the points, 0..1.
        status: outcome of the scan.
        keyframe_added: whether the scan has become a keyframe.
        anchor: newest keyframe; None before the first. Later corrections move it, and with it this scan's pose.
        localized: False while the robot is lost or not yet located in a saved map; the pose is then in a separate
            frame.
        integrity: probability of being lost, and bounds of the error.
    """

    map_from_base: FloatArray
    covariance: FloatArray
    score: float
    status: SlamStatus
    keyframe_added: bool
    anchor: ScanKeyframe | None = None
    localized: bool = True
    integrity: Integrity = field(default_factory=lambda: Integrity(0.0, 0.0, 0.0))

    @property
    def trusted(self) -> bool:
        """True if the scan was matched and its pose may be used."""
        return self.status.matched and self.localized and self.integrity.trusted


@dataclass
class _MapBefore:
    """State of the map before a sign of a loss.

    Attributes:
        map: the map at that time.
        keyframes: number of keyframes in this map.
        since: number of keyframes added since.
    """

    map: OccupancyMap
    keyframes: int
    since: int = 0


class GridSlam:
    """Online SLAM with a planar laser.

    The first scan's pose is the odometry pose, or the origin without odometry.

    Args:
        config: parameters; None uses the defaults.
        saved: map to localise in or to extend. Until the robot is located in it, it maps in a separate frame.

    Attributes:
        map: the map being made.
        in_map_frame: whether poses are in the map's frame; False until the robot is first located in a saved map.
        frames: poses in the map and in odometry.
        front_end: matches scans and makes keyframes.
        loop_closure: finds loops and optimises the keyframes' poses.
        turn_factor: estimates encoder yaw over true yaw.
        contradiction: detects contradictions between wheel odometry and scan matching.
        monitor: estimates the probability of being lost.
    """

    def __init__(self, config: SlamConfig | None = None, saved: SavedMap | None = None) -> None:
        self.config = config or SlamConfig()
        self.front_end = FrontEnd(self.config)
        self.loop_closure = LoopClosure(self.config)
        self.map = OccupancyMap(self.config.map)
        self.frames = BaseFrames()
        self.turn_factor = TurnFactor()
        self.contradiction = ContradictionMonitor()
        self.monitor = IntegrityMonitor()
        self.in_map_frame = saved is None
        self._relocalization = None if saved is None else Relocalization(saved)
        self._before: _MapBefore | None = None  # set while a sign of a loss is examined
        self._covariance: FloatArray = np.zeros((3, 3))
        self._points: ScanPoints | None = None
        # Background work: number of keyframes handed over, whether a job is running, its session, whether one failed.
        self._handed_over = 0
        self._busy = False
        self._job_of = self.front_end.trajectory
        self._broken = False
        self._merged = 0
        self._edges: list[Edge] = []

    def process(
        self, scan: Scan, odom_pose: ArrayLike | None = None, base_from_laser: ArrayLike = (0.0, 0.0, 0.0)
    ) -> SlamResult:
        """Estimate the pose of a scan, and add the scan to the map if it is a keyframe.

        Args:
            scan: scan to process; ignored if it is not newer than the previous one.
            odom_pose: odom_from_base (3,) at the scan's stamp; None without odometry.
            base_from_laser: mounting pose of the laser on the robot, (3,).
        """
        if self.frames.stamp_ns is not None and scan.stamp_ns <= self.frames.stamp_ns:
            return self._unplaced(SlamStatus.TIME_BACKWARDS)
        odometry = None if odom_pose is None else np.asarray(odom_pose, dtype=np.float64)
        if odometry is not None and not np.isfinite(odometry).all():
            raise ValueError(f"odometry at {scan.stamp_ns} ns is not finite: {odometry}")
        points = scan_points(scan, np.asarray(base_from_laser, dtype=np.float64))
        self._points = points
        guess = self.frames.predict(self.front_end, odometry, scan.stamp_ns)
        if len(points.points) >= MIN_POINTS:
            track = self._match(points, guess, scan.stamp_ns)
        elif self.frames.stamp_ns is None:  # there is nothing to match against yet, so a later scan becomes the first
            return self._unplaced(SlamStatus.NO_POINTS)
        else:
            track = self.front_end.dead_reckon(guess)
            self.monitor.unmatched(False, self.frames.elapsed_s(scan.stamp_ns))
        self._insert(track)
        self._follow(track, odometry, scan.stamp_ns)
        return self._result(track)

    def _match(self, points: ScanPoints, guess: Guess, stamp_ns: int) -> Track:
        """Match a scan. While the pose is in doubt, no scan enters the map. A lost robot starts a new session."""
        elapsed_s = self.frames.elapsed_s(stamp_ns)

        def accept(pose: FloatArray, score: float, recovered: bool) -> bool:
            contradicted = self._matched_map().contradiction(pose, points)
            step = relative2(self.map_from_base, pose)
            moved_m = math.hypot(step[0], step[1]) + 0.5 * abs(float(step[2]))
            self.monitor.matched(contradicted, score, elapsed_s, recovered, moved_m)
            if self._before is not None:
                # Compare with recent scans only, because older parts of the map may contradict a pose that has drifted.
                before = self._before.map.contradiction(pose, points, LOCAL_KEYFRAMES)
                self.monitor.compared(before - contradicted, moved_m)
            return not self.monitor.doubts

        track = self.front_end.track(points, guess, stamp_ns, accept)
        if track.status is SlamStatus.LOST:
            self.monitor.unmatched(True, elapsed_s)
        return self._new_session(points, guess, stamp_ns) if self.monitor.lost else track

    def _insert(self, track: Track) -> None:
        """Add a keyframe's scan to the map. At a sign of a loss, keep a copy of the map before it for some metres."""
        keyframe = track.keyframe
        if self._before is None and self.monitor.sign and not self.front_end.in_known_map:
            self._before = _MapBefore(self.map.copy(), len(self.front_end.trajectory) - (keyframe is not None))
        if keyframe is not None:
            self.map.insert(keyframe.map_from_base, keyframe.scan)
        if self._before is not None:
            self._before.since += keyframe is not None
            if self._before.since >= PROVISIONAL_KEYFRAMES and not self.monitor.doubts:
                self._settle()

    def _follow(self, track: Track, odometry: FloatArray | None, stamp_ns: int) -> None:
        """Accept the pose, and compare the motion with the wheels' motion."""
        matched = track.status in (SlamStatus.TRACKED, SlamStatus.RECOVERED)
        step = self.frames.follow(track.pose, matched, odometry, stamp_ns)
        self._covariance = track.covariance
        if step is not None and step.wheels is not None:
            if matched:
                self.turn_factor.update(float(step.wheels[2]), float(step.motion[2]))
            self.contradiction.update(step.wheels, step.motion, step.elapsed_s, track.scan_sigma)

    def _result(self, track: Track) -> SlamResult:
        """Return the result of a scan, with the covariance in the whole map."""
        anchor = self.front_end.trajectory[-1]
        covariance = track.covariance + anchor.drift
        integrity = self.monitor.integrity(covariance, self.localized)
        covariance = mixture(covariance, integrity.lost_probability)
        added = track.keyframe is not None
        return SlamResult(track.pose, covariance, track.score, track.status, added, anchor, self.localized, integrity)

    def _unplaced(self, status: SlamStatus) -> SlamResult:
        """Return the last pose as the result of a scan that changes nothing."""
        return SlamResult(self.map_from_base, self._covariance, 0.0, status, False, localized=self.localized)

    # -- poses and map ----------------------------------------------------------------------------

    @property
    def map_from_base(self) -> FloatArray:
        """Pose of the last scan, (3,)."""
        return self.frames.map_from_base

    @property
    def saved(self) -> SavedMap | None:
        """The map in which the robot is located or searched for; None while it makes its first map."""
        return None if self._relocalization is None else self._relocalization.saved

    @property
    def localized(self) -> bool:
        """True if the robot is located in the saved map, or if there is no saved map."""
        return self.saved is None or self.saved.located

    def grid(self) -> OccupancyGrid:
        """Return the current map."""
        return self.saved.grid if self.saved is not None and self.saved.unchanged else self.map.grid()

    @property
    def map_version(self) -> int:
        """Counter that grows whenever `grid` changes; 0 before there is a map."""
        return 1 if self.saved is not None and self.saved.unchanged else self.map.version

    def figures(self) -> dict[str, object]:
        """Return the numbers of keyframes, closed loops and rejected loops."""
        return {
            "keyframes": len(self.front_end.trajectory) - self._merged,
            "loops": self.loop_closure.closed,
            "loops_refused": self.loop_closure.refused,
        }

    def save(self, stem: Path) -> list[Path]:
        """Write the map as ``stem.yaml``, ``stem.pgm`` and ``stem.graph.npz``; return the files.

        Raises:
            MapError: there is nothing to save, or the files cannot be written.
        """
        files = save_grid(stem, self.grid())
        if self.saved is not None and self.saved.unchanged:
            return files  # the map was loaded and is unchanged, so its graph, if any, exists beside the loaded file
        return [*files, save_graph(stem, *self._graph())]

    def _graph(self, count: int | None = None) -> tuple[list[ScanKeyframe], list[Edge]]:
        """Return the keyframes that have not been removed, of the first ``count`` or of all, and their edges."""
        keyframes = self.front_end.trajectory[:count]
        edges = [edge for edge in self._edges if max(edge.a, edge.b) < len(keyframes)]
        known = max((edge.b for edge in edges), default=0) + 1
        for k in range(known, len(keyframes)):  # keyframes that loop closure has not processed yet
            edges.append(Edge(k - 1, k, keyframes[k].step, keyframes[k].step_covariance))
        kept = [k for k, keyframe in enumerate(keyframes) if keyframe.merged_into is None]
        row = {k: index for index, k in enumerate(kept)}
        edges = [replace(edge, a=row[edge.a], b=row[edge.b]) for edge in edges]
        return [keyframes[k] for k in kept], edges

    def _matched_map(self) -> OccupancyMap:
        """Return the map in which scans are matched."""
        known = self.front_end.in_known_map and self._relocalization is not None
        return self._relocalization.cells if known else self.map  # type: ignore[union-attr]

    def _replace_map(self, rebuilt: OccupancyMap, count: int) -> None:
        """Continue with a map that contains the first ``count`` keyframes."""
        rebuilt.version = self.map.version + 1
        self.map = rebuilt
        for keyframe in self.front_end.trajectory[count:]:
            self.map.insert(keyframe.map_from_base, keyframe.scan)

    # -- loop closure and search in the background --------------------------------------------------

    def background_job(self) -> Callable[[], FoundPlace | LoopOutcome] | None:
        """Return pending work, which may run on another thread. Pass its result to `take_over`.

        The job is loop closure for the keyframes since the last job, or the search in the saved map. None if there is
        no work, or a job is still running.
        """
        if self._busy:
            return None
        job: Callable[[], FoundPlace | LoopOutcome] | None = None
        lost_in, stamp_ns = self._relocalization, self.frames.stamp_ns
        if lost_in is not None and not self.localized:
            recent = self.front_end.trajectory[-QUERY_KEYFRAMES:]
            if self._points is not None and stamp_ns is not None:
                job = lost_in.saved.search_job(recent, self.map_from_base, self._points, stamp_ns, lost_in.reach_m)
        elif not self._broken and not self.front_end.in_known_map:
            new = self.front_end.trajectory[self._handed_over :]
            self._handed_over += len(new)
            job = (lambda: self.loop_closure.update(new)) if new else None
        self._busy = job is not None
        self._job_of = self.front_end.trajectory
        return job

    def take_over(self, outcome: FoundPlace | LoopOutcome | None) -> None:
        """Apply the result of a background job. Corrections change map_from_odom, never odometry.

        Args:
            outcome: result of the job; None if the job failed. Loop closure is then disabled, because its copy of the
                keyframes is incomplete.
        """
        self._busy = False
        if self._job_of is not self.front_end.trajectory:
            return  # the job belongs to the previous session
        if outcome is None:
            self._broken = self.localized
        elif isinstance(outcome, LoopOutcome):
            self._take_over_loops(outcome)
        elif outcome.found is not None and self._relocalization is not None and not self.localized:
            moved = correction(outcome.pose, outcome.found.pose)
            recent = self.front_end.trajectory[-QUERY_KEYFRAMES:]
            if self._relocalization.recognized(recent, moved, outcome.pose):
                self._join(self._relocalization.saved, moved, outcome.found.covariance, outcome.map)

    def finish(self) -> None:
        """Optimise with all loops after the last scan, and rebuild the map from the result."""
        if not self.localized or self._broken or self.front_end.in_known_map:
            return
        self._settle()
        new = self.front_end.trajectory[self._handed_over :]
        if self.front_end.trajectory:
            self._handed_over += len(new)
            self.take_over(self.loop_closure.update(new, last=True))

    def _take_over_loops(self, outcome: LoopOutcome) -> None:
        """Apply optimised poses, the rebuilt map and merged keyframes."""
        keyframes = self.front_end.trajectory
        if self._before is not None:
            first = self._before.keyframes
            if outcome.poses is not None or any(edge.robust and edge.b >= first for edge in outcome.edges):
                self._settle()  # a loop confirms the place
        moved = outcome.apply(keyframes)
        if moved is not None:
            self.front_end.rebuild_field()
            self.frames.move(moved)
        if outcome.map is not None:
            self._replace_map(outcome.map, outcome.count)
        self._edges = outcome.edges
        self._merged += len(outcome.merged)

    # -- sessions -----------------------------------------------------------------------------------

    def set_pose(self, map_from_base: ArrayLike) -> None:
        """Set the robot's pose (3,) in the saved map. Scan matching corrects an error of up to 1 m and 60°.

        Raises:
            ValueError: there is no saved map or no scan yet, or the pose is not finite.
        """
        pose = np.asarray(map_from_base, dtype=np.float64)
        if not np.isfinite(pose).all():
            raise ValueError(f"the pose is not finite: {pose}")
        if self.saved is None:
            raise ValueError("no saved map is loaded: set map_file")
        if self.frames.stamp_ns is None:
            raise ValueError("no scan received yet")
        if not self.saved.located:
            self._join(self.saved, correction(self.map_from_base, pose), np.diag([0.25, 0.25, 0.1]), None)
        elif self.front_end.in_known_map:
            self.frames.move(correction(self.map_from_base, pose))
            self.front_end.use_known_map(self.saved.localizer.points, self.map_from_base)

    def _settle(self) -> None:
        """Accept the provisional scans since the sign of a loss as part of the map."""
        self._before = None
        self.monitor.settled()

    def _new_session(self, points: ScanPoints, guess: Guess, stamp_ns: int) -> Track:
        """Start a separate map, and leave the present one unchanged until the robot is found in it."""
        if self.localized and not self.front_end.in_known_map:
            try:
                before = self._before or _MapBefore(self.map, len(self.front_end.trajectory))
                saved = SavedMap(self.config, before.map.grid(), self._graph(before.keyframes))
                self._relocalization = Relocalization(saved, by_odometry=True)
            except ValueError:
                self._relocalization = None  # the robot cannot be found in a map without walls or free cells
        if self._relocalization is not None:
            # After a gap in the scans, odometry holds within its error. Otherwise the robot may have been carried.
            self._relocalization.lose(self.front_end.reach_m(guess) if self.monitor.after_gap else math.inf)
        self._before = None
        self.loop_closure = LoopClosure(self.config)
        version, self.map = self.map.version, OccupancyMap(self.config.map)
        self.map.version = version + 1
        self._handed_over, self._merged, self._edges = 0, 0, []
        self.monitor = IntegrityMonitor()
        return self.front_end.restart(points, guess, stamp_ns)

    def _join(self, saved: SavedMap, moved: FloatArray, covariance: FloatArray, built: OccupancyMap | None) -> None:
        """Join the current map to the saved one; ``moved`` (3,) transforms all current poses into the saved map."""
        self._settle()
        own = self.front_end.trajectory
        for keyframe in own:
            keyframe.map_from_base = compose2(moved, keyframe.map_from_base)
        self.frames.move(moved)
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
