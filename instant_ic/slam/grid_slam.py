"""Grid SLAM: takes scans and odometry, returns pose, map and map→odom."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from instant_ic.geometry.poses import compose2, inverse2, relative2
from instant_ic.slam.config import SlamConfig
from instant_ic.slam.front_end import FrontEnd, Guess, Track, TrackStatus, constant_velocity
from instant_ic.slam.keyframes import NO_SCAN, Keyframe, grown_drift
from instant_ic.slam.localization import Localizer
from instant_ic.slam.loop_closure import BackEnd, correction, gather
from instant_ic.slam.loop_search import Found
from instant_ic.slam.map_files import save_graph, save_grid
from instant_ic.slam.motion import MotionMonitor
from instant_ic.slam.occupancy import OccupancyGrid, OccupancyMap
from instant_ic.slam.pose_graph import Edge
from instant_ic.slam.scan import FloatArray, Scan, scan_points

MAX_ODOMETRY_GAP_S = 5.0


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
    """Lost for several scans; a new local map starts at the odometry pose."""
    NO_POINTS = "no points"
    """No points, only infinite ranges, or too few points; the pose comes from odometry."""
    TIME_BACKWARDS = "time backwards"
    """Not newer than the previous scan; the scan is ignored and the last pose returned."""

    @property
    def matched(self) -> bool:
        """Whether the pose comes from scan matching."""
        return self in (SlamStatus.FIRST, SlamStatus.TRACKED, SlamStatus.RECOVERED)


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
        covariance: (3, 3) x, y, yaw in the map frame: match covariance plus drift since the last loop closure.
        score: 0..1, mean likelihood field value over the points.
        status: outcome of the scan.
        keyframe_added: whether the map has changed.
        localized: False while the robot is not yet located in a saved map; the pose is then in a separate frame.
        anchor: moves with the map, so that this scan's pose can be read after later corrections; None before the first
            keyframe.
    """

    map_from_base: FloatArray
    covariance: FloatArray
    score: float
    status: SlamStatus
    keyframe_added: bool
    anchor: Anchor | None = None
    localized: bool = True


@dataclass(frozen=True)
class _Place:
    """Result of a search in the saved map.

    Attributes:
        keyframe: the keyframe that was searched for.
        found: its pose; None if not found.
        map: map built from the saved keyframes, if there are any.
    """

    keyframe: Keyframe
    found: Found | None
    map: OccupancyMap | None


class GridSlam:
    """Online SLAM with a planar laser.

    The first scan's pose is the odometry pose, or the origin without odometry. `map_from_odom` takes up all
    corrections. `odom_from_base` is the given odometry; for scans without odometry it is LiDAR odometry continued from
    there.

    Args:
        config: defaults when None.
        known: a saved map to localise in or to extend.
        graph: keyframes and edges of the saved map, which is then extended. None: the map stays unchanged, and the
            robot only localises in it. Until it is located, the robot maps in a separate frame.

    Attributes:
        localized: whether the robot is located in the saved map; True without one.
        motion: compares wheel odometry with scan matching.
    """

    def __init__(
        self,
        config: SlamConfig | None = None,
        known: OccupancyGrid | None = None,
        graph: tuple[list[Keyframe], list[Edge]] | None = None,
    ) -> None:
        self.config = config or SlamConfig()
        self._known = known
        self._graph = graph
        self._localizer = None if known is None else Localizer(known, self.config)
        self.localized = known is None
        self._tried_keyframe: Keyframe | None = None
        self.front_end = FrontEnd(self.config)
        self.back_end = BackEnd(self.config)
        self.map = OccupancyMap(self.config.map)
        self.motion = MotionMonitor(self.config.motion)
        self._handed_over = 0
        self._busy = False
        self._broken = False
        self._merged = 0
        self._edges: list[Edge] = []
        self.map_from_base: FloatArray = np.zeros(3)
        self.odom_from_base: FloatArray = np.zeros(3)
        self.map_from_odom: FloatArray = np.zeros(3)
        self._covariance: FloatArray = np.zeros((3, 3))
        self._stamp_ns: int | None = None
        self._step: FloatArray = np.zeros(3)
        self._step_s = 0.0
        # Odometry and map pose at the last scan that came with odometry.
        self._odometry_stamp_ns: int | None = None
        self._odometry_pose: FloatArray = np.zeros(3)
        self._pose_at_odometry: FloatArray = np.zeros(3)

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
            return SlamResult(self.map_from_base, self._covariance, 0.0, SlamStatus.TIME_BACKWARDS, False)
        odometry = None if odom_pose is None else np.asarray(odom_pose, dtype=np.float64)
        if odometry is not None and not np.isfinite(odometry).all():
            raise ValueError(f"odometry at {scan.stamp_ns} ns is not finite: {odometry}")
        mount = np.asarray(base_from_laser, dtype=np.float64)
        points = scan_points(scan, mount, self.config.field.join_gap_m, self.config.map.no_return_clear_m)
        guess = self._guess(odometry, scan.stamp_ns)
        if len(points.points) < self.config.match.min_points:
            if self._stamp_ns is None:
                # Nothing to match against yet: the next scan becomes the first one.
                return SlamResult(self.map_from_base, self._covariance, 0.0, SlamStatus.NO_POINTS, False)
            track, status = self.front_end.dead_reckon(guess), SlamStatus.NO_POINTS
        else:
            track = self.front_end.track(points, guess, scan.stamp_ns)
            status = _STATUS[track.status]
        if track.keyframe is not None:
            self.map.insert(track.keyframe.map_from_base, track.keyframe.scan)
        self._follow(track, odometry, scan.stamp_ns)
        anchor = self.front_end.trajectory.keyframes[-1]
        if status is SlamStatus.RESTARTED and self._localizer is not None and self._graph is None:
            self.localized = False
        covariance = track.covariance + anchor.drift
        added = track.keyframe is not None
        return SlamResult(track.pose, covariance, track.score, status, added, anchor, self.localized)

    def grid(self) -> OccupancyGrid:
        """The map: int8 array (H, W) of −1, 0..100, resolution, origin (2,)."""
        if self._known is not None and (self._graph is None or not self.localized):
            return self._known
        return self.map.grid()

    @property
    def map_version(self) -> int:
        """Counter that grows when `grid` changes; 0 before there is a map."""
        if self._known is not None and (self._graph is None or not self.localized):
            return 1
        return self.map.version

    @property
    def map_clipped(self) -> int:
        """Number of points outside ``map.max_size_m``."""
        return self.map.clipped

    def save(self, stem: Path) -> list[Path]:
        """Write the map as ``stem.yaml``, ``stem.pgm`` and ``stem.graph.npz``; return the files.

        Raises:
            MapError: there is nothing to save, or the files cannot be written.
        """
        files = save_grid(stem, self.grid())
        if self._known is not None and not (self._graph is not None and self.localized):
            return files  # localisation only: this map was loaded, and its graph, if any, exists where it came from
        keyframes = self.front_end.trajectory.keyframes
        known = max((edge.b for edge in self._edges), default=0) + 1
        edges = list(self._edges)
        for k in range(known, len(keyframes)):  # keyframes that the loop closure has not processed yet
            edges.append(Edge(k - 1, k, keyframes[k].step, keyframes[k].step_covariance))
        kept = [k for k, keyframe in enumerate(keyframes) if keyframe.merged_into is None]
        row = {k: index for index, k in enumerate(kept)}
        edges = [replace(edge, a=row[edge.a], b=row[edge.b]) for edge in edges]
        return [*files, save_graph(stem, [keyframes[k] for k in kept], edges)]

    def set_pose(self, map_from_base: ArrayLike) -> None:
        """Set the robot's pose in the saved map (3,). An error of 1 m and 60° is acceptable; scan matching refines it.

        Raises:
            ValueError: no saved map, no scan yet, or a pose that is not finite.
        """
        pose = np.asarray(map_from_base, dtype=np.float64)
        if not np.isfinite(pose).all():
            raise ValueError(f"the pose is not finite: {pose}")
        if self._localizer is None:
            raise ValueError("no saved map is loaded: set map_file")
        if self._stamp_ns is None:
            raise ValueError("no scan received yet")
        if not self.localized:
            self._settle_in(correction(self.map_from_base, pose), np.diag([0.25, 0.25, 0.1]), None)
        elif self.front_end.in_known_map:
            self._move(correction(self.map_from_base, pose))
            self.front_end.use_known_map(self._localizer.points, self.map_from_base)

    def background_job(self) -> Callable[[], Any] | None:
        """Return the loop closure and optimisation job for the keyframes since the last job.

        None if there are no new keyframes, or a job is still running.
        """
        if not self.localized:
            return self._search_job()
        new = self.front_end.trajectory.keyframes[self._handed_over :]
        off = self._broken or not self.config.loop.enabled or self.front_end.in_known_map
        if self._busy or not new or off:
            return None
        self._busy, self._handed_over = True, self._handed_over + len(new)
        return lambda: self.back_end.update(new)

    def take_over(self, outcome: Any) -> None:
        """Apply the result of a background job: corrected poses change map_from_odom, never odometry.

        Args:
            outcome: result of the job; None if it failed. Then nothing changes, and loop closure is disabled, because
                its copy of the keyframes is incomplete.
        """
        self._busy = False
        if outcome is None:
            self._broken = self.localized
            return
        if isinstance(outcome, _Place):
            if outcome.found is not None and not self.localized:
                moved = correction(outcome.keyframe.map_from_base, outcome.found.pose)
                self._settle_in(moved, outcome.found.covariance, outcome.map)
            return
        keyframes = self.front_end.trajectory.keyframes
        if outcome.poses is not None:
            moved = correction(keyframes[outcome.count - 1].map_from_base, outcome.poses[-1])
            for k in outcome.alive:
                keyframes[k].map_from_base = outcome.poses[k]
            for keyframe in keyframes[outcome.count :]:
                keyframe.map_from_base = compose2(moved, keyframe.map_from_base)
            self.front_end.redraw()
            self._move(moved)
        if outcome.map is not None:
            outcome.map.version = self.map.version + 1
            self.map = outcome.map
            for keyframe in keyframes[outcome.count :]:
                self.map.insert(keyframe.map_from_base, keyframe.scan)
        self._edges = outcome.edges
        for gone, heir, heir_from_gone in outcome.merged:
            keyframes[gone].merged_into = (keyframes[heir], heir_from_gone)
            keyframes[gone].scan = NO_SCAN
            self._merged += 1
        drift = outcome.drift
        for before, keyframe in zip(keyframes[outcome.count - 1 :], keyframes[outcome.count :], strict=False):
            way = keyframe.map_from_base[:2] - before.map_from_base[:2]
            drift = grown_drift(drift, way, float(before.map_from_base[2]), keyframe.step_covariance)
        keyframes[-1].drift = drift

    def _move(self, moved: FloatArray) -> None:
        """Move the current pose in the map; odometry stays."""
        self.map_from_base = compose2(moved, self.map_from_base)
        self.map_from_odom = compose2(moved, self.map_from_odom)
        self._pose_at_odometry = compose2(moved, self._pose_at_odometry)

    def _search_job(self) -> Callable[[], Any] | None:
        """Return a job that searches the saved map for the last keyframes, once for each new keyframe."""
        keyframes = self.front_end.trajectory.recent(self.config.loop.query_keyframes)
        localizer, graph = self._localizer, self._graph
        if self._busy or localizer is None or not keyframes or keyframes[-1] is self._tried_keyframe:
            return None
        self._busy, last = True, keyframes[-1]
        self._tried_keyframe = last
        query = gather([k.map_from_base for k in keyframes], [k.scan for k in keyframes], self.config.loop)

        def search() -> _Place:
            found = localizer.find(query)
            drawn = None
            if found is not None and graph is not None:
                drawn = OccupancyMap(self.config.map)
                for keyframe in graph[0]:
                    drawn.insert(keyframe.map_from_base, keyframe.scan)
            return _Place(last, found, drawn)

        return search

    def _settle_in(self, moved: FloatArray, covariance: FloatArray, drawn: OccupancyMap | None) -> None:
        """Join the current map to the saved one: ``moved`` transforms everything mapped so far into the saved map."""
        assert self._localizer is not None
        own = self.front_end.trajectory.keyframes
        for keyframe in own:
            keyframe.map_from_base = compose2(moved, keyframe.map_from_base)
        self._move(moved)
        self.localized = True
        if self._graph is None:
            own[-1].drift = covariance
            self.front_end.use_known_map(self._localizer.points, self.map_from_base)
            return
        saved, edges = self._graph
        first = own[0]
        # The motion from the last saved keyframe is unknown; the first new keyframe is tied by its pose in the map.
        first.step = relative2(saved[-1].map_from_base, first.map_from_base)
        first.step_covariance = np.diag([100.0, 100.0, 10.0])
        self.front_end.trajectory.keyframes = [*saved, *own]
        self.back_end = BackEnd(self.config)
        self.back_end.load(saved, edges)
        self._edges = list(edges)
        self.back_end.tie(len(saved), first.map_from_base, covariance)
        self._handed_over = len(saved)
        if drawn is None:
            drawn = OccupancyMap(self.config.map)
            for keyframe in saved:
                drawn.insert(keyframe.map_from_base, keyframe.scan)
        drawn.version = self.map.version + 1
        self.map = drawn
        for keyframe in own:
            keyframe.drift = covariance
            self.map.insert(keyframe.map_from_base, keyframe.scan)
        self.front_end.redraw()

    def finish(self) -> None:
        """After the last scan: optimise with all loops, and rebuild the map from the result."""
        if not self.localized or self._broken or self.front_end.in_known_map:
            return
        new = self.front_end.trajectory.keyframes[self._handed_over :]
        if self.config.loop.enabled and self.front_end.trajectory.keyframes:
            self._handed_over += len(new)
            self.take_over(self.back_end.update(new, last=True))

    def figures(self) -> dict[str, object]:
        """Counts of keyframes, closed loops and rejected loops."""
        return {
            "keyframes": len(self.front_end.trajectory) - self._merged,
            "loops": self.back_end.closed,
            "loops_refused": self.back_end.refused,
        }

    def _guess(self, odometry: FloatArray | None, stamp_ns: int) -> Guess:
        if self._stamp_ns is None:
            start = np.zeros(3) if odometry is None else odometry
            return self.front_end.guess_from_odometry(start, np.zeros(3))
        elapsed_s = (stamp_ns - self._stamp_ns) * 1e-9
        # The encoders keep counting across a short gap; after a long gap they may have been reset.
        gap_s = math.inf if self._odometry_stamp_ns is None else (stamp_ns - self._odometry_stamp_ns) * 1e-9
        if odometry is not None and gap_s <= max(MAX_ODOMETRY_GAP_S, 2 * elapsed_s):
            step = relative2(self._odometry_pose, odometry)
            return self.front_end.guess_from_odometry(compose2(self._pose_at_odometry, step), step)
        pose = constant_velocity(self.map_from_base, self._step, self._step_s, elapsed_s)
        return self.front_end.guess_from_velocity(pose, elapsed_s)

    def _follow(self, track: Track, odometry: FloatArray | None, stamp_ns: int) -> None:
        """Accept the pose and move its correction into map_from_odom."""
        step = relative2(self.map_from_base, track.pose)
        if self._stamp_ns is not None:
            self._step, self._step_s = step, (stamp_ns - self._stamp_ns) * 1e-9
            if odometry is not None and self._odometry_stamp_ns == self._stamp_ns:
                matched = track.status in (TrackStatus.TRACKED, TrackStatus.RECOVERED)
                self.motion.update(relative2(self._odometry_pose, odometry), step, self._step_s, matched)
            if track.status not in (TrackStatus.TRACKED, TrackStatus.RECOVERED):
                # Damp the velocity: without a match, the estimate must not keep moving for ever.
                self._step = 0.5 * self._step
        if odometry is None:
            self.odom_from_base = compose2(self.odom_from_base, step)
        else:
            self.odom_from_base = odometry
            self._odometry_stamp_ns, self._odometry_pose, self._pose_at_odometry = stamp_ns, odometry, track.pose
            self.map_from_odom = compose2(track.pose, inverse2(odometry))
        self.map_from_base, self._covariance, self._stamp_ns = track.pose, track.covariance, stamp_ns


_STATUS = {
    TrackStatus.FIRST: SlamStatus.FIRST,
    TrackStatus.TRACKED: SlamStatus.TRACKED,
    TrackStatus.RECOVERED: SlamStatus.RECOVERED,
    TrackStatus.LOST: SlamStatus.LOST,
    TrackStatus.RESTARTED: SlamStatus.RESTARTED,
}
