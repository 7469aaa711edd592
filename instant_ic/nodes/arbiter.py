"""Decides who is driven, and is the only one to write /cmd_vel (paper, III.A)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from instant_ic.bus import LATCHED, OK, SENSOR, WARN, Latest, Node, main
from instant_ic.control.arbiter import Arbiter, ArbiterConfig, ArbiterInputs, Decision, Mode, Vspace
from instant_ic.control.costmap import Costmap, CostmapConfig, RollingCostmap, StaticMap, scan_points, scan_rays
from instant_ic.control.walls import WallFinder, WallMap
from instant_ic.control.warmup import warm_up
from instant_ic.geometry.poses import Matrix, matrix_from_pose2, pose2_from_matrix, relative2
from instant_ic.geometry.transforms import TransformError
from instant_ic.msg import (
    Bool,
    ControlState,
    LaserScan,
    OccupancyGrid,
    Odometry,
    Path,
    PoseStamped,
    PoseWithCovarianceStamped,
    TwistStamped,
    VspaceStatus,
    grid_array,
    grid_message,
    header,
    path_message,
    pose_matrix,
    pose_message,
    pose_stamped,
    stamp_ns,
    twist_message,
    twist_stamped,
    twist_values,
)


@dataclass(frozen=True)
class ArbiterNodeConfig(ArbiterConfig):
    """Parameters of the node ``arbiter``: the library's, and what only the node needs."""

    rate_hz: float = 20.0
    costmap_rate_hz: float = 5.0
    wall_min_length_m: float = 1.5
    wall_period_s: float = 2.0
    map_jump_m: float = 0.3
    map_jump_deg: float = 5.0
    costmap: CostmapConfig = field(default_factory=CostmapConfig)

    def __post_init__(self) -> None:
        for key in ("rate_hz", "costmap_rate_hz", "wall_min_length_m", "wall_period_s", "map_jump_m", "map_jump_deg"):
            if not getattr(self, key) > 0:
                raise ValueError(f"{key} must be > 0 (got {getattr(self, key)})")


class ArbiterNode(Node[ArbiterNodeConfig]):
    """Topics in and out of ``Arbiter`` and ``RollingCostmap``."""

    name = "arbiter"

    def setup(self) -> None:
        if not self.lockstep:
            warm_up()
        self.arbiter = Arbiter(self.config)
        self.costmaps = RollingCostmap(self.config.costmap, self.config.footprint)
        self.costmap: Costmap | None = None
        self.static: StaticMap | None = None
        self.walls: WallMap | None = None
        self.map_is_new = False
        finder = WallFinder(self.config.wall_min_length_m, self.config.costmap.occupied_threshold)
        self.wall_worker = self.background(finder.find, self.on_walls)
        self.map_from_odom: Matrix | None = None
        self.camera_ns: int | None = None
        self.estop = False
        self.ticks = 0

        self.cmd_vel = self.publisher("/cmd_vel", TwistStamped, qos=SENSOR)
        self.state = self.publisher("/ic/state", ControlState, qos=LATCHED)
        self.subgoal = self.publisher("/ic/subgoal", PoseStamped, qos=SENSOR)
        self.trajectory = self.publisher("/ic/trajectory", Path, qos=SENSOR)
        self.costmap_out = self.publisher("/costmap", OccupancyGrid, qos=SENSOR)

        self.operator = self.latest("/operator/cmd_vel", TwistStamped, max_age_s=10.0)
        self.scan = self.latest("/scan", LaserScan, max_age_s=10.0)
        self.odometry = self.latest("/wheel/odom", Odometry, max_age_s=10.0)
        self.pose = self.latest("/pose", PoseWithCovarianceStamped, max_age_s=10.0)
        self.vbot = self.latest("/vbot/odom", Odometry, max_age_s=10.0)
        self.nav = self.latest("/nav/cmd_vel", TwistStamped, max_age_s=10.0)
        self.vspace = self.latest("/vspace/status", VspaceStatus, max_age_s=60.0, qos=LATCHED)
        self.subscribe("/map", OccupancyGrid, self.on_map, qos=LATCHED)
        self.subscribe("/operator/estop", Bool, self.on_estop, qos=LATCHED)
        # Only its age matters: the picture is never decoded here.
        self.subscribe_raw("/camera/image/compressed", self.on_camera, qos=SENSOR)
        _ = self.tf  # listens from now on
        self.timer(self.config.wall_period_s, self.update_walls)
        self.timer(1.0 / self.config.costmap_rate_hz, self.update_costmap)
        self.timer(1.0 / self.config.rate_hz, self.tick)

    def teardown(self) -> None:
        if hasattr(self, "cmd_vel"):
            self.cmd_vel.publish(twist_stamped(0.0, 0.0, self.clock.now_ns()))

    # -- inputs

    def on_map(self, message: OccupancyGrid) -> None:
        grid, resolution, origin = grid_array(message)
        if grid.size == 0:
            return
        self.static = StaticMap(grid, resolution, np.array(origin))
        self.map_is_new = True
        if self.walls is None:
            self.update_walls()  # the first at once

    def update_walls(self) -> None:
        """Has walls looked for in the newest map, beside the node's thread."""
        if self.map_is_new:
            self.map_is_new = False
            self.wall_worker.submit(self.static)

    def on_walls(self, walls: WallMap) -> None:
        self.walls = walls

    def on_estop(self, message: Bool) -> None:
        self.estop = bool(message.data)
        self.tick()  # not at the next timer: now

    def on_camera(self, topic: str, type_name: str, payload: bytes | memoryview, publish_ns: int) -> None:
        self.camera_ns = self.clock.now_ns()

    def age(self, latest: Latest) -> float:
        """Seconds since the newest message came, or since it was measured where that is longer."""
        message = latest.message
        if message is None:
            return math.inf
        return max(latest.age_s, (self.clock.now_ns() - stamp_ns(message)) / 1e9)

    def ages(self) -> dict[str, float]:
        camera = math.inf if self.camera_ns is None else (self.clock.now_ns() - self.camera_ns) / 1e9
        return {
            "scan": self.age(self.scan),
            "odometry": self.age(self.odometry),
            "pose": self.age(self.pose),
            "camera": camera,
            "vbot": self.age(self.vbot),
            "nav": self.age(self.nav),
            "command": self.age(self.operator),
            "vspace": self.vspace.age_s,
        }

    def robot_pose(self) -> NDArray[np.float64] | None:
        try:
            pose = pose2_from_matrix(self.tf.lookup("map", "base_link"))
        except TransformError as error:
            self.diagnose("pose", WARN, str(error))
            return None
        self.diagnose("pose", OK, "known")
        return pose

    def scan_in_base(self) -> NDArray[np.float64] | None:
        """Hits (N, 2) of the newest scan in ``base_link`` now; by odometry, which does not jump."""
        scan = self.scan.message
        if scan is None:
            return None
        try:
            odom_from_lidar = self.tf.lookup("odom", scan.header.frame_id, stamp_ns(scan))
            base_from_lidar = np.linalg.inv(self.tf.lookup("odom", "base_link")) @ odom_from_lidar
        except TransformError as error:
            self.diagnose("scan", WARN, f"scan cannot be placed: {error}")
            return None
        points = scan_points(scan.ranges, scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)
        self.diagnose("scan", OK, f"{len(points)} points")
        placed: NDArray[np.float64] = points @ base_from_lidar[:2, :2].T + base_from_lidar[:2, 3]
        return placed

    # -- costmap

    def update_costmap(self) -> None:
        pose, scan = self.robot_pose(), self.scan.message
        if pose is None or scan is None:
            missing = "no pose" if pose is None else "no LiDAR scan"
            self.diagnose("costmap", WARN if self.costmap is not None else OK, f"costmap stands still: {missing}")
            return
        try:
            map_from_lidar = self.tf.lookup("map", scan.header.frame_id, stamp_ns(scan))
            map_from_odom = self.tf.lookup("map", "odom")
        except TransformError as error:
            self.diagnose("costmap", WARN, f"costmap stands still: {error}")
            return
        if self.map_from_odom is not None and self.jumped(self.map_from_odom, map_from_odom):
            self.log.info("the map has been corrected: the costmap forgets what the scans marked")
            self.costmaps.reset()
        self.map_from_odom = map_from_odom
        rays = scan_rays(
            scan.ranges,
            scan.angle_min,
            scan.angle_increment,
            scan.range_min,
            scan.range_max,
            map_from_lidar,
            self.config.costmap,
        )
        self.costmap = self.costmaps.update(pose, self.static, rays)
        self.diagnose("costmap", OK, "up to date", static_map=self.static is not None)
        self.costmap_out.publish(
            grid_message(
                self.costmap.occupancy(),
                self.costmap.resolution,
                (float(self.costmap.origin[0]), float(self.costmap.origin[1])),
                "map",
                stamp_ns(scan),
            )
        )

    def jumped(self, before: Matrix, after: Matrix) -> bool:
        # Per costmap period, which is shorter than that of SLAM: a correction comes in one piece.
        moved = relative2(pose2_from_matrix(before), pose2_from_matrix(after))
        far = math.hypot(float(moved[0]), float(moved[1])) > self.config.map_jump_m
        return far or abs(float(moved[2])) > math.radians(self.config.map_jump_deg)

    # -- the step

    def tick(self) -> None:
        now_ns = self.clock.now_ns()
        ages = self.ages()
        points = self.scan_in_base()
        if points is None:
            points, ages["scan"] = np.zeros((0, 2)), math.inf
        pose = self.robot_pose()
        vbot, status = self.vbot.message, self.vspace.message
        inputs = ArbiterInputs(
            robot_pose=pose,
            robot_velocity=_twist(self.odometry),
            operator_command=_twist(self.operator),
            estop=self.estop,
            scan_points=points,
            costmap=self.costmap,
            walls=self.walls,
            vspace=Vspace() if status is None else _vspace(status),
            vbot_pose=None if vbot is None else pose2_from_matrix(pose_matrix(vbot)),
            vbot_velocity=_twist(self.vbot),
            nav_command=_twist(self.nav),
            ages=ages,
        )
        decision = self.arbiter.step(inputs, now_ns)
        self.cmd_vel.publish(twist_stamped(*decision.command, now_ns))
        self.tell(decision, inputs, now_ns)

    def tell(self, decision: Decision, inputs: ArbiterInputs, now_ns: int) -> None:
        pose = inputs.robot_pose if inputs.robot_pose is not None else np.zeros(3)
        self.state.publish(
            ControlState(
                header=header("map", now_ns),
                mode=int(decision.mode),
                reason=decision.reason,
                estop=decision.estop,
                blocked=decision.blocked,
                transitions=decision.transitions,
                robot_pose=pose_message(matrix_from_pose2(pose)),
                vbot_start=pose_message(matrix_from_pose2(decision.vbot_start)),
                vbot_pose=pose_message(matrix_from_pose2(decision.vbot_pose)),
                operator_command=twist_message(*decision.operator_command),
                applied_command=twist_message(*decision.command),
                pose_gap_m=decision.pose_gap_m,
                yaw_gap_rad=decision.yaw_gap_rad,
                time_to_obstacle_s=decision.time_to_obstacle_s,
            )
        )
        if decision.changed:
            self.log.info("%s: %s", decision.mode.name.lower(), decision.reason)
        level = WARN if decision.mode == Mode.STOPPED or decision.blocked else OK
        self.diagnose("control", level, decision.reason, mode=decision.mode.name)
        self.ticks += 1
        if self.ticks % 2 and not decision.changed:
            return  # 10 Hz is enough for what is looked at and planned to
        if decision.subgoal is not None:
            self.subgoal.publish(pose_stamped(matrix_from_pose2(decision.subgoal.pose), "map", now_ns))
        if self.trajectory.subscriber_count or self.lockstep:
            self.trajectory.publish(path_message(decision.trajectory[::4], "map", now_ns))


def _twist(latest: Latest) -> tuple[float, float]:
    return (0.0, 0.0) if latest.message is None else twist_values(latest.message)


def _vspace(status: VspaceStatus) -> Vspace:
    return Vspace(
        ready=status.state == VspaceStatus.READY,
        training=status.state == VspaceStatus.TRAINING,
        failed=status.state == VspaceStatus.FAILED,
        position=pose_matrix(status.keyframe_pose)[:2, 3],
        ready_radius_m=float(status.ready_radius_m),
        message=status.message,
    )


if __name__ == "__main__":
    main(ArbiterNode)
