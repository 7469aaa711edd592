"""Surroundings of the robot: the newest scan and 3D points in its own frame, and the costmap."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.costmap import Costmap, CostmapConfig, RollingCostmap, scan_points, scan_rays
from instant_ic.control.footprint import Footprint
from instant_ic.control.heights import SortedPoints, sort_points
from instant_ic.control.moving import NOTHING_MOVES, MovingPoints, MovingThings
from instant_ic.control.walls import StaticMap
from instant_ic.geometry.poses import Matrix, inverse, pose2_from_matrix, relative2
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.util.diagnosis import Diagnosis, Level

log = logging.getLogger(__name__)

_MOTION_SAMPLES = 9
"""Number of sensor poses over a sweep of points; motion between them is taken as uniform."""
_CORRECTED_M, _CORRECTED_RAD = 0.05, math.radians(2.0)
"""The map counts as corrected if, between two updates, the robot moves this much more in the map than by odometry. The
costmap's marks then move with the robot, since no sensor may see them again from near. A smaller difference is slip."""
_JUMP_M, _JUMP_RAD = 0.5, 0.5
"""After a larger correction the robot counts as carried off, and the costmap forgets its marks. By then the arbiter has
stopped the robot (``pose_trust``)."""


@dataclass(frozen=True)
class ArrivedScan:
    """A flat scan as it arrived (LaserScan)."""

    frame: str
    stamp_ns: int
    arrived_ns: int
    """Steady clock."""
    ranges: NDArray[np.floating]
    """(N,) metres."""
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float

    @property
    def beams(self) -> tuple[NDArray[np.floating], float, float, float, float]:
        """Arguments of ``scan_points`` and ``scan_rays``."""
        return self.ranges, self.angle_min, self.angle_increment, self.range_min, self.range_max

    @property
    def usable(self) -> bool:
        """True if the scan's geometry is known, and any beam has a range or reports that nothing is within range."""
        known = math.isfinite(self.angle_min + self.angle_increment) and self.range_min < self.range_max
        return known and bool((np.asarray(self.ranges) >= self.range_min).any())


@dataclass(frozen=True)
class ArrivedCloud:
    """A sweep of 3D points as it arrived (PointCloud2)."""

    frame: str
    stamp_ns: int
    arrived_ns: int
    """Steady clock."""
    points: NDArray[Any]
    """(N,) structured: x, y, z in metres; optionally time in seconds since the first point."""


_BLIND_RAD, _LANE_M = math.radians(10.0), 1.0
"""Width of a run of missing beams that counts as covered, and length of the lanes ahead and behind that are checked."""


class Surroundings:
    """The newest scan and 3D points, placed by the transforms, and the costmap that they update.

    A scan whose transform has not arrived yet is not used; the previous scan and its age are kept.
    """

    def __init__(self, config: CostmapConfig, footprint: Footprint, tf: TransformBuffer) -> None:
        self.config = config
        self.costmap: Costmap | None = None
        self.points_seen = False
        self.blind = (False, False)
        """Flags (ahead, behind) of a covered LiDAR, which measures nothing in a sector where it did before."""
        self.findings: dict[str, Diagnosis] = {}
        """Diagnoses by input: scan, points, costmap, pose."""
        if not config.points.enabled:
            self._find("points", True, "3D points are not used (costmap.points.enabled is false)")
        else:
            self._find("points", True, "No 3D points yet. Low and hanging things are not seen")
        self._tf = tf
        self._footprint = footprint
        # Beams that have ever measured, and beams that did not measure in the newest scan.
        self._measured = self._unmeasured = np.zeros(0, np.bool_)
        self._rolling = RollingCostmap(config, footprint)
        self._map_from_odom: Matrix | None = None
        self._scan_hits: NDArray[np.float64] | None = None  # (N, 2) of the newest scan with a transform, in odom
        self._sweep: SortedPoints | None = None  # newest 3D points, in odom
        self._moving = MovingThings()
        self._used: dict[str, tuple[int, int]] = {}  # last scan and points with a transform: stamp, arrival
        self._published_ns: int | None = None
        self._in_costmap: tuple[int, int] = (-1, -1)  # stamps of the scan and the points in the costmap

    def robot_pose(self) -> NDArray[np.float64] | None:
        """Return the pose (3,) of the robot in the map; None while unknown."""
        try:
            pose = pose2_from_matrix(self._tf.lookup("map", "base_link"))
        except TransformError as error:
            self._find("pose", False, str(error))
            return None
        self._find("pose", True, "known")
        return pose

    def near_points(self, scan: ArrivedScan | None) -> NDArray[np.float64] | None:
        """Return the hits (N, 2) of the newest scan and points in ``base_link`` now, by odometry, which never jumps.

        None while there is no scan, or while its pose is unknown.
        """
        if scan is None:
            self._scan_hits = None
        elif self._scan_hits is None or self._used["scan"][0] != scan.stamp_ns:
            self._place(scan)
        if self._scan_hits is None:
            return None
        near = self._scan_hits
        if self._sweep is not None:
            near = np.concatenate([near, self._sweep.nearest])
        try:
            base_from_odom = self._tf.lookup("base_link", "odom")
        except TransformError as error:
            self._find("scan", False, f"The scan cannot be placed: {error}")
            return None
        return np.asarray(near @ base_from_odom[:2, :2].T + base_from_odom[:2, 3])

    def moving_points(self, now_ns: int) -> MovingPoints:
        """Return the points and velocities of people and other moving things, in ``base_link`` now; needs 3D points."""
        found = self._moving.moving(now_ns / 1e9)
        if len(found.points) == 0:
            return NOTHING_MOVES
        try:
            base_from_odom = self._tf.lookup("base_link", "odom")
        except TransformError:
            return NOTHING_MOVES  # near_points has reported it
        turn = base_from_odom[:2, :2].T
        return MovingPoints(found.points @ turn + base_from_odom[:2, 3], found.velocities @ turn)

    def used_age_s(self, key: str, now_ns: int, steady_ns: int) -> float:
        """Return the age in seconds of the last ``scan`` or ``points`` with a transform; inf without one.

        The age is the longer of those by arrival and by stamp.
        """
        if key not in self._used:
            return math.inf
        stamp_ns, arrived_ns = self._used[key]
        return max(now_ns - stamp_ns, steady_ns - arrived_ns) / 1e9

    def refuse_points(self, reason: str) -> None:
        """Report 3D points that cannot be used, even with a later transform."""
        self.points_seen = True
        self._used.pop("points", None)
        self._find("points", False, f"3D points cannot be used: {reason}")

    def update_costmap(
        self, scan: ArrivedScan | None, cloud: ArrivedCloud | None, static: StaticMap | None
    ) -> Costmap | None:
        """Add the newest scan and 3D points to the costmap and return it; None if nothing is new or known."""
        points_ns = -1 if cloud is None else self._take(cloud)
        pose = self.robot_pose()
        if pose is None or scan is None or not scan.usable:
            missing = "there is no pose" if pose is None else "there is no LiDAR scan"
            self._find("costmap", self.costmap is None, f"The costmap is not updated: {missing}")
            return None
        if (scan.stamp_ns, points_ns) == self._in_costmap:
            return None
        try:
            # SLAM's correction changes slowly and arrives later than the scan, so the newest one is good enough.
            map_from_odom = self._tf.lookup("map", "odom")
            map_from_lidar = map_from_odom @ self._tf.lookup("odom", scan.frame, scan.stamp_ns)
        except TransformError as error:
            self._find("costmap", False, f"The costmap is not updated: {error}")
            return None
        self._correct(map_from_odom)
        rays = scan_rays(*scan.beams, map_from_lidar, self.config)
        new_points = self._sweep if points_ns not in (-1, self._in_costmap[1]) else None
        self.costmap = self._rolling.update(pose, static, rays, new_points, pose2_from_matrix(map_from_odom))
        self._in_costmap = (scan.stamp_ns, points_ns)
        self._find("costmap", True, "up to date", static_map=static is not None)
        return self.costmap

    def publish_due(self, steady_ns: int) -> bool:
        """Return whether the costmap is to be published now, by ``publish_frequency``; it then counts as published."""
        # 0.9, because updates come at the scan's rate, not at the publish frequency.
        due_ns = 0.9e9 / self.config.publish_frequency
        sent_ns = self._published_ns  # later than now if the clock went back: a bag player restarted
        if sent_ns is not None and 0 <= steady_ns - sent_ns < due_ns:
            return False
        self._published_ns = steady_ns
        return True

    def _correct(self, map_from_odom: Matrix) -> None:
        """Let the costmap's marks follow a correction of the map."""
        before, self._map_from_odom = self._map_from_odom, map_from_odom
        if before is None:
            return
        # The costmap's period is shorter than SLAM's, so a correction arrives in one piece. Compare at the robot: far
        # from the origin of odom, a turn by a degree moves that origin by decimetres.
        odom_from_base = self._tf.lookup("odom", "base_link")
        x, y, yaw = relative2(
            pose2_from_matrix(before @ odom_from_base), pose2_from_matrix(map_from_odom @ odom_from_base)
        )
        moved_m, turned_rad = math.hypot(x, y), abs(yaw)
        if moved_m > _JUMP_M or turned_rad > _JUMP_RAD:
            log.info("the map has jumped; the costmap has forgotten its marks")
            self._rolling.reset()
        elif moved_m > _CORRECTED_M or turned_rad > _CORRECTED_RAD:
            self._rolling.carry(pose2_from_matrix(map_from_odom @ inverse(before)))

    def _find(self, name: str, ok: bool, text: str, **values: Any) -> None:
        self.findings[name] = Diagnosis(name, Level.OK if ok else Level.WARN, text, values)

    def _place(self, scan: ArrivedScan) -> None:
        if not scan.usable:
            self._find("scan", False, "The scan cannot be used: no beam has measured anything. Uncover the LiDAR")
            return
        try:
            odom_from_lidar = self._tf.lookup("odom", scan.frame, scan.stamp_ns)
        except TransformError as error:
            self._find("scan", False, f"The scan cannot be placed: {error}")
            return
        self.blind = self._blind(scan)
        points = scan_points(*scan.beams)
        self._find("scan", True, f"{len(points)} points")
        self._scan_hits = np.asarray(points @ odom_from_lidar[:2, :2].T + odom_from_lidar[:2, 3])
        self._used["scan"] = scan.stamp_ns, scan.arrived_ns

    def _blind(self, scan: ArrivedScan) -> tuple[bool, bool]:
        """Return whether the lanes ahead and behind lack beams in the last two scans that have measured before."""
        unmeasured = np.isnan(scan.ranges)
        if len(unmeasured) != len(self._measured):
            self._measured = self._unmeasured = np.zeros(len(unmeasured), np.bool_)
        beams = unmeasured & self._unmeasured & self._measured
        self._measured, self._unmeasured = self._measured | ~unmeasured, unmeasured
        width = max(1, math.ceil(_BLIND_RAD / max(abs(scan.angle_increment), 1e-3)))
        runs = np.all([np.roll(beams, -k) for k in range(width)], axis=0)
        if not runs.any():
            return False, False
        beams = np.any([np.roll(runs, k) for k in range(width)], axis=0)
        angle = scan.angle_min + scan.angle_increment * np.flatnonzero(beams)
        base_from_lidar = self._tf.lookup("base_link", scan.frame)
        reach = np.arange(0.05, self._footprint.circumscribed_radius_m + _LANE_M, 0.05)[:, None, None]
        rays = reach * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        x, y = np.moveaxis(rays @ base_from_lidar[:2, :2].T + base_from_lidar[:2, 3], -1, 0)
        front = 0.5 * self._footprint.length_m
        lane = (np.abs(y) < 0.5 * self._footprint.width_m) & (np.abs(x) > front) & (np.abs(x) < front + _LANE_M)
        return bool((lane & (x > 0)).any()), bool((lane & (x < 0)).any())

    def _take(self, cloud: ArrivedCloud) -> int:
        """Sort new 3D points by height, in ``odom``; return their stamp, -1 if they cannot be used."""
        self.points_seen = True
        if cloud.stamp_ns == self._in_costmap[1]:
            return cloud.stamp_ns
        names = cloud.points.dtype.names or ()
        if not {"x", "y", "z"} <= set(names):
            self.refuse_points(f"/lidar/points has the fields {', '.join(names)}; x, y and z are needed")
            return -1
        try:
            self._sweep = self._sorted(cloud)
            self._moving.update(self._sweep, cloud.stamp_ns / 1e9)
        except TransformError as error:
            self._find("points", False, f"3D points cannot be used: {error}")
            return -1
        self._used["points"] = cloud.stamp_ns, cloud.arrived_ns
        counts = self._sweep.counts
        self._find("points", True, f"{counts['obstacle']} obstacle points", **counts)
        return cloud.stamp_ns

    def _sorted(self, cloud: ArrivedCloud) -> SortedPoints:
        points = cloud.points
        time_s = points["time"] if "time" in (points.dtype.names or ()) else np.zeros(len(points), np.float32)
        duration_s = float(min(max(time_s.max(initial=0.0), 0.0), 1.0))
        instants = [
            cloud.stamp_ns + round(1e9 * duration_s * k / (_MOTION_SAMPLES - 1)) for k in range(_MOTION_SAMPLES)
        ]
        poses = np.stack([self._tf.lookup("odom", cloud.frame, ns) for ns in instants])
        xyz = np.stack([points["x"], points["y"], points["z"]], axis=1)
        return sort_points(xyz, time_s, poses, duration_s, self.config.points)
