"""Grid SLAM: from /scan and wheel odometry to /map, /pose and the transform map→odom."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.bus import ERROR, LATCHED, OK, RELIABLE, SENSOR, WARN, Node, NodeError, QoS, main
from instant_ic.config.ranges import NotNegative, Positive, check_ranges
from instant_ic.geometry.poses import Matrix, matrix_from_pose2, pose2_from_matrix
from instant_ic.geometry.transforms import TransformError
from instant_ic.msg import (
    LaserScan,
    OccupancyGrid,
    OccupancyGridUpdate,
    Odometry,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    String,
    grid_message,
    header,
    pose_matrix,
    pose_message,
    stamp_ns,
)
from instant_ic.slam import (
    FieldConfig,
    KeyframeConfig,
    LoopConfig,
    MapConfig,
    MatchConfig,
    MotionConfig,
    OdometryNoise,
    ParticleConfig,
    Scan,
    SlamConfig,
    SlamResult,
    SlamStatus,
)
from instant_ic.slam import OccupancyGrid as OccupancyGridArray
from instant_ic.slam.backend import Slam, make_slam, warm_up
from instant_ic.slam.motion import MotionState
from instant_ic.slam.odometry import CorrectionLimiter, OdometryBuffer

ODOMETRY_QUEUE = QoS("sensor", depth=100)
"""Deep, because scans are placed between two odometry messages."""


MODES = ("mapping", "localization")


@dataclass(frozen=True)
class GridSlamConfig:
    """Parameters; `config/slam.yaml` explains each."""

    backend: str = "graph"
    mode: str = "mapping"
    map_file: str = ""
    map_frame: str = "map"
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    use_wheel_odom: bool = True
    odom_wait_s: NotNegative = 0.1
    odom_startup_wait_s: NotNegative = 1.0
    odom_extrapolate_s: NotNegative = 0.2
    max_scan_age_s: Positive = 1.0
    reset_on_time_jump_s: Positive = 1.0
    map_period_s: Positive = 1.0
    map_full_period_s: Positive = 1.0
    correction_speed_mps: Positive = 1.0
    correction_yaw_rate_radps: Positive = 1.0
    odometry: OdometryNoise = dataclasses.field(default_factory=OdometryNoise)
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    match: MatchConfig = dataclasses.field(default_factory=MatchConfig)
    keyframe: KeyframeConfig = dataclasses.field(default_factory=KeyframeConfig)
    loop: LoopConfig = dataclasses.field(default_factory=LoopConfig)
    map: MapConfig = dataclasses.field(default_factory=MapConfig)
    motion: MotionConfig = dataclasses.field(default_factory=MotionConfig)
    rbpf: ParticleConfig = dataclasses.field(default_factory=ParticleConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.mode not in MODES:
            raise ValueError(f"mode must be one of {', '.join(MODES)} (got {self.mode!r})")
        if self.mode == "localization" and not self.map_file:
            raise ValueError("mode localization needs map_file, the map to drive in")

    @property
    def slam(self) -> SlamConfig:
        """The library's part of the parameters."""
        return SlamConfig(
            self.backend,
            self.odometry,
            self.field,
            self.match,
            self.keyframe,
            self.loop,
            self.map,
            self.motion,
            self.rbpf,
        )


@dataclass(frozen=True)
class _Pending:
    """A scan that waits for odometry at its stamp."""

    scan: Scan
    base_from_laser: np.ndarray
    arrived_ns: int


_LEVELS = {
    SlamStatus.FIRST: (OK, "map started"),
    SlamStatus.TRACKED: (OK, "tracking"),
    SlamStatus.RECOVERED: (WARN, "odometry was far off; the scan was found again by the wide search"),
    SlamStatus.LOST: (ERROR, "the scan fits nowhere near; going on by odometry"),
    SlamStatus.RESTARTED: (ERROR, "lost for long; a new local map begins where odometry says"),
    SlamStatus.NO_POINTS: (WARN, "the scan has too few points; going on by odometry"),
}


_MOTIONS = {
    MotionState.NORMAL: (OK, "the robot moves as its tracks do"),
    MotionState.SLIPPING: (WARN, "the tracks slip"),
    MotionState.STUCK: (ERROR, "the tracks turn and the robot stands: it is stuck"),
    MotionState.PUSHED: (WARN, "the robot moves and its tracks stand: somebody pushes it"),
    MotionState.CARRIED: (ERROR, "the tracks stand and the place is another one: the robot is being carried"),
}


class GridSlamNode(Node[GridSlamConfig]):
    name = "grid_slam"
    live_parameters = (
        *("max_scan_age_s", "reset_on_time_jump_s", "odom_wait_s", "odom_startup_wait_s", "odom_extrapolate_s"),
        *("correction_speed_mps", "correction_yaw_rate_radps"),
    )

    def setup(self) -> None:
        warm_up(self.config.slam)
        self.worker = self.background(self.work, self.take_over)
        self.wheel = OdometryBuffer()
        self.limiter = CorrectionLimiter(self.config.correction_speed_mps, self.config.correction_yaw_rate_radps)
        self.pending: deque[_Pending] = deque()
        self.last_scan_ns: int | None = None
        self.scan_came_ns = 0
        self.first_wait_ns: int | None = None
        self.dropped = 0
        self.map_out = self.publisher("/map", OccupancyGrid, qos=LATCHED)
        self.update_out = self.publisher("/map_updates", OccupancyGridUpdate, qos=RELIABLE)
        self.saved_out = self.publisher("/slam/saved", String, qos=RELIABLE)
        self.pose_out = self.publisher("/pose", PoseWithCovarianceStamped, qos=SENSOR)
        self._restart()
        self.tf  # noqa: B018 - listens from here on, so that the laser's mount is known when the first scan arrives
        if self.config.use_wheel_odom:
            self.subscribe("/wheel/odom", Odometry, self.on_odometry, qos=ODOMETRY_QUEUE)
            self.timer(0.02, self.place_pending)
        self.subscribe("/scan", LaserScan, self.on_scan, qos=SENSOR)
        self.subscribe("/slam/save", String, self.on_save, qos=RELIABLE)
        self.subscribe("/initialpose", PoseWithCovarianceStamped, self.on_initial_pose, qos=RELIABLE)
        self.timer(self.config.map_period_s, self.publish_map)
        self.timer(1.0, self.watch)

    def reconfigure(self, config: GridSlamConfig) -> None:
        super().reconfigure(config)
        self.limiter.speed_mps = config.correction_speed_mps
        self.limiter.yaw_rate_radps = config.correction_yaw_rate_radps

    def _restart(self) -> None:
        config = self.config
        try:
            map_file = Path(config.map_file).expanduser() if config.map_file else None
            self.slam = make_slam(config.slam, map_file, config.mode == "localization")
        except ValueError as error:  # MapError is one
            raise NodeError(str(error)) from None
        self.published_version = 0
        self.published: OccupancyGridArray | None = None
        self.full_map_ns = 0
        self.partly = False
        self.placed_ns: int | None = None
        self.localized: bool | None = None
        self.last_scan_ns = None
        self.pending.clear()
        self.limiter.reset()

    # -- inputs ----------------------------------------------------------------------------------

    def on_odometry(self, message: Any) -> None:
        stamp = stamp_ns(message)
        newest = self.wheel.newest_ns
        if newest is not None and newest - stamp > self.config.reset_on_time_jump_s * 1e9:
            self.wheel.clear()
        if not self.wheel.add(stamp, pose2_from_matrix(pose_matrix(message))):
            self.diagnose("odometry", WARN, "dropped a message that is not finite, or not newer than the last")
            return
        self.place_pending()

    def on_scan(self, message: Any) -> None:
        stamp = stamp_ns(message)
        age_s = (self.clock.now_ns() - stamp) * 1e-9
        if abs(age_s) > self.config.max_scan_age_s:
            when = f"{age_s:.2f} s old" if age_s > 0 else f"{-age_s:.2f} s in the future"
            self._drop(f"the scan is {when}: check the clocks, or set use_sim_time for a recording")
            return
        if self.last_scan_ns is not None and stamp <= self.last_scan_ns:
            back_s = (self.last_scan_ns - stamp) * 1e-9
            if back_s <= self.config.reset_on_time_jump_s:
                self._drop(f"the scan is not newer than the one before ({back_s:.3f} s back in time)")
                return
            self.diagnose("time", WARN, f"time went back by {back_s:.1f} s: a new map begins")
            self._restart()
        try:
            base_from_laser = self._mount(self.tf.lookup(self.config.base_frame, message.header.frame_id))
            scan = Scan(
                np.asarray(message.ranges),
                float(message.angle_min),
                float(message.angle_increment),
                float(message.range_min),
                float(message.range_max),
                stamp,
            )
        except TransformError as error:
            self._drop(f"where the laser stands is not known yet: {error}")
            return
        except ValueError as error:
            self._drop(f"the scan cannot be used: {error}")
            return
        self.diagnose("scan", OK, "fresh", dropped=self.dropped)
        self.last_scan_ns, self.scan_came_ns = stamp, self.clock.steady_ns()
        self.pending.append(_Pending(scan, base_from_laser, self.clock.now_ns()))
        self.place_pending()

    def _mount(self, base_from_laser: Matrix) -> np.ndarray:
        if base_from_laser[2, 2] < 0.9:
            raise ValueError("the laser's z axis is more than 25° off the vertical: check its mount (mount_rpy_deg)")
        return pose2_from_matrix(base_from_laser)

    def _drop(self, why: str) -> None:
        self.dropped += 1
        self.diagnose("scan", WARN, why, dropped=self.dropped)

    # -- scans and odometry --------------------------------------------------------------------------

    def place_pending(self) -> None:
        """Place the scans whose odometry has arrived or has been waited for long enough."""
        while self.pending:
            entry = self.pending[0]
            odometry = None
            if self.config.use_wheel_odom:
                odometry = self.wheel.at(entry.scan.stamp_ns)
                if odometry is None:
                    if self._worth_waiting(entry):
                        return
                    odometry = self.wheel.at(entry.scan.stamp_ns, self.config.odom_extrapolate_s)
            self.pending.popleft()
            self.place(entry, odometry)

    def _worth_waiting(self, entry: _Pending) -> bool:
        """Whether odometry for this scan may still come."""
        config, now = self.config, self.clock.now_ns()
        newest = self.wheel.newest_ns
        if newest is None:
            self.first_wait_ns = self.first_wait_ns or entry.arrived_ns
            return now - self.first_wait_ns < config.odom_startup_wait_s * 1e9
        if not -0.5e9 < entry.scan.stamp_ns - newest < 0.5e9:
            return False  # the wheels have long been silent, or the scan is older than the stored odometry
        return now - entry.arrived_ns < config.odom_wait_s * 1e9

    def place(self, entry: _Pending, odometry: np.ndarray | None) -> None:
        """Call the library for one scan and publish the result."""
        result = self.slam.process(entry.scan, odometry, entry.base_from_laser)
        if result.status is SlamStatus.TIME_BACKWARDS:  # on_scan lets none through; if one comes, the fault is here
            self._drop("the scan is not newer than the one before")
            return
        self._tell(result, odometry)
        stamp = self.placed_ns = entry.scan.stamp_ns
        if odometry is None:
            self.tf_broadcast(
                self.config.odom_frame, self.config.base_frame, matrix_from_pose2(self.slam.odom_from_base), stamp
            )
        if not result.localized:
            self.limiter.reset()
            self._submit()
            return
        map_from_odom = self.limiter.follow(self.slam.map_from_odom, self.slam.odom_from_base, stamp)
        self.tf_broadcast(self.config.map_frame, self.config.odom_frame, matrix_from_pose2(map_from_odom), stamp)
        self.pose_out.publish(
            PoseWithCovarianceStamped(
                header=header(self.config.map_frame, stamp),
                pose=PoseWithCovariance(
                    pose=pose_message(matrix_from_pose2(result.map_from_base)),
                    covariance=_covariance6(result.covariance),
                ),
            )
        )
        if self.published_version == 0:
            self.publish_map()
        self._submit()

    def _submit(self) -> None:
        job = self.slam.background_job()
        if job is not None:
            self.worker.submit((self.slam, job))

    def work(self, item: tuple[Slam, Callable[[], Any]]) -> tuple[Slam, Any, str]:
        """Loop closure, optimisation, search in a saved map: on the worker's thread."""
        slam, job = item
        try:
            return slam, job(), ""
        except Exception as error:  # noqa: BLE001 - reported on the node's thread; scans go on
            return slam, None, f"{type(error).__name__}: {error}"

    def take_over(self, result: tuple[Slam, Any, str]) -> None:
        """Apply the worker's result, unless its map has been discarded since."""
        slam, outcome, fault = result
        if fault:
            self.diagnose("loops", ERROR, f"loop closure failed and is off until the node restarts: {fault}")
        if slam is self.slam:
            slam.take_over(outcome)

    def on_initial_pose(self, message: Any) -> None:
        """Set the robot's pose in the saved map from outside (RViz's "2D pose estimate")."""
        try:
            if message.header.frame_id not in ("", self.config.map_frame):
                raise ValueError(f"it is in frame {message.header.frame_id!r}, not {self.config.map_frame!r}")
            self.slam.set_pose(pose2_from_matrix(pose_matrix(message)))
            self.limiter.reset()
        except ValueError as error:
            self.log.warning("/initialpose is not used: %s", error)

    def on_save(self, message: Any) -> None:
        """Write the map to the path in the message; the answer goes to /slam/saved."""
        try:
            answer = "saved: " + ", ".join(str(file) for file in self.slam.save(Path(message.data)))
        except ValueError as error:
            answer = f"error: {error}"
        self.log.info("%s", answer)
        self.saved_out.publish(String(data=answer))

    def _tell(self, result: SlamResult, odometry: np.ndarray | None) -> None:
        level, text = _LEVELS[result.status]
        self.diagnose(
            "slam",
            level,
            text,
            score=round(result.score, 3),
            sigma_xy_m=round(float(np.sqrt(max(np.diag(result.covariance)[:2]))), 4),
            **self.slam.figures(),
        )
        if result.localized != self.localized:
            self.localized = result.localized
            if not result.localized:
                self.diagnose(
                    "place",
                    WARN,
                    "the robot's place in the saved map is not known yet: drive on, or set it (/initialpose)",
                )
            elif self.config.map_file:
                self.diagnose("place", OK, "found in the saved map")
        motion = self.slam.motion
        level, text = _MOTIONS[motion.state] if odometry is not None else (OK, "no wheels to compare with")
        self.diagnose(
            "motion",
            level,
            text,
            slip=round(motion.slip, 2),
            turn_factor=round(motion.turn_factor, 3),
            turn_factor_sigma=round(min(motion.turn_factor_sigma, 9.999), 3),
        )
        if odometry is not None:
            correction_m = round(float(np.hypot(*self.slam.map_from_odom[:2])), 3)
            self.diagnose("odometry", OK, "wheel odometry", correction_m=correction_m)
        elif self.config.use_wheel_odom:
            self.diagnose("odometry", WARN, "no wheel odometry on /wheel/odom: LiDAR odometry is used instead")
        else:
            self.diagnose("odometry", OK, "LiDAR odometry (use_wheel_odom is false)")
        if self.slam.map_clipped:
            self.diagnose("map", WARN, "the map has reached max_size_m", points_left_out=self.slam.map_clipped)

    # -- periodic outputs ---------------------------------------------------------------------------

    def publish_map(self) -> None:
        """Publish a changed map: in parts on /map_updates, whole at most every ``map_full_period_s``."""
        version = self.slam.map_version
        if self.placed_ns is None:
            return
        if version == self.published_version:
            due = self.clock.steady_ns() - self.full_map_ns >= self.config.map_full_period_s * 1e9 * 0.99
            if self.partly and due and self.published is not None:
                self._publish_whole(self.published, self.placed_ns)  # for late subscribers
            return
        grid = self.slam.grid()
        stamp, before = self.placed_ns, self.published
        self.published_version, self.published = version, grid
        same = (
            before is not None
            and before.values.shape == grid.values.shape
            and np.array_equal(before.origin, grid.origin)
        )
        if before is not None and same:
            rows, columns = np.nonzero(before.values != grid.values)
            if len(rows) == 0:
                return
            y, x, y1, x1 = int(rows.min()), int(columns.min()), int(rows.max()) + 1, int(columns.max()) + 1
            self.update_out.publish(
                OccupancyGridUpdate(
                    header=header(self.config.map_frame, stamp),
                    x=x,
                    y=y,
                    width=x1 - x,
                    height=y1 - y,
                    data=np.ascontiguousarray(grid.values[y:y1, x:x1]).reshape(-1),
                )
            )
            if self.clock.steady_ns() - self.full_map_ns < self.config.map_full_period_s * 1e9 * 0.99:
                self.partly = True
                return
        self._publish_whole(grid, stamp)

    def _publish_whole(self, grid: OccupancyGridArray, stamp: int) -> None:
        origin = (float(grid.origin[0]), float(grid.origin[1]))
        self.map_out.publish(grid_message(grid.values, grid.resolution, origin, self.config.map_frame, stamp))
        self.full_map_ns, self.partly = self.clock.steady_ns(), False

    def watch(self) -> None:
        """Report missing scans."""
        if self.last_scan_ns is None:
            if self.dropped == 0:
                self.diagnose("scan", WARN, "no scan on /scan yet: is vlp16_driver running?")
            return
        age_s = (self.clock.steady_ns() - self.scan_came_ns) * 1e-9
        if age_s > self.config.max_scan_age_s:
            self.diagnose("scan", ERROR, f"no scan for {age_s:.1f} s", dropped=self.dropped)


def _covariance6(covariance: np.ndarray) -> np.ndarray:
    """Covariance (36,) in the order x y z rx ry rz from a planar one (3, 3) in x y yaw."""
    full = np.zeros((6, 6))
    full[np.ix_([0, 1, 5], [0, 1, 5])] = covariance
    return full.reshape(36)


if __name__ == "__main__":
    main(GridSlamNode)
