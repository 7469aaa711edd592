"""Decides which robot the operator drives; the only publisher of /cmd_vel (paper, III.A)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from instant_ic import estop_state
from instant_ic.bus import ERROR, LATCHED, OK, SENSOR, WARN, Latest, Node, main
from instant_ic.bus.transport import Received
from instant_ic.config.ranges import Positive, check_ranges
from instant_ic.control.arbiter import Arbiter, Decision
from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.costmap import Costmap, CostmapConfig, RollingCostmap, StaticMap, scan_points, scan_rays
from instant_ic.control.estop import EstopLatch
from instant_ic.control.freshness import Rhythm
from instant_ic.control.heights import SortedPoints, sort_points
from instant_ic.control.kinematics import move
from instant_ic.control.snapshot import ArbiterInputs, Vspace
from instant_ic.control.sources import STEP_AFTER_S
from instant_ic.control.states import SOURCES, Mode
from instant_ic.control.walls import WallFinder, WallMap
from instant_ic.control.warmup import warm_up
from instant_ic.geometry.poses import Matrix, matrix_from_pose2, pose2_from_matrix, relative2
from instant_ic.geometry.transforms import TransformError
from instant_ic.msg import (
    HARD_STOP,
    Bool,
    ControlState,
    LaserScan,
    MessageError,
    OccupancyGrid,
    Odometry,
    Path,
    PointCloud2,
    PoseStamped,
    PoseWithCovarianceStamped,
    ShownPictures,
    TwistStamped,
    VspaceStatus,
    cloud_array,
    deserialize,
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

_MOTION_SAMPLES = 9
"""Poses of the sensor over a sweep of points; between them its motion counts as even."""


@dataclass(frozen=True)
class ArbiterNodeConfig(ArbiterConfig):
    """Parameters of the node ``arbiter``: the library's, and the node's own.

    Attributes:
        rate_hz: steps of the state machine and messages on /cmd_vel, per second.
        wall_min_length_m: m; a straight run of occupied map cells this long is a wall, a shorter one is an obstacle.
        wall_period_s: s; walls are searched for in a changed /map at most this often, on a separate thread.
        map_jump_m: m; a correction of map→odom larger than this makes the costmap forget its marks.
        map_jump_deg: degrees; as map_jump_m, for the yaw.
    """

    rate_hz: Positive = 20.0
    wall_min_length_m: Positive = 1.5
    wall_period_s: Positive = 2.0
    map_jump_m: Positive = 0.3
    map_jump_deg: Positive = 5.0
    costmap: CostmapConfig = field(default_factory=CostmapConfig)

    def __post_init__(self) -> None:
        check_ranges(self)


class ArbiterNode(Node[ArbiterNodeConfig]):
    """Connects ``Arbiter`` and ``RollingCostmap`` to topics."""

    name = "arbiter"
    live_parameters = (
        *("limits", "prediction", "collision_monitor", "passage", "planner", "subgoal", "switch", "timeouts"),
        *("map_jump_m", "map_jump_deg"),
    )

    def setup(self) -> None:
        if not self.lockstep:
            warm_up()
        self.arbiter = Arbiter(self.config)
        self.costmaps = RollingCostmap(self.config.costmap, self.config.footprint)
        self.costmap: Costmap | None = None
        self.static: StaticMap | None = None
        self.walls: WallMap | None = None
        self.map_is_new = False
        finder = WallFinder(self.config.wall_min_length_m, self.config.costmap.lethal_cost_threshold)
        self.wall_worker = self.background(finder.find, self.on_walls)
        self.map_from_odom: Matrix | None = None
        self.placed_scan: NDArray[np.float64] | None = None  # (N, 2) hits of the newest scan with a transform, in odom
        self.used: dict[str, tuple[int, int]] = {}  # last scan and points with a known transform: stamp, arrival
        self.sweep: SortedPoints | None = None  # newest 3D points, in odom
        self.points_seen = False
        self.taken: tuple[int, int] = (-1, -1)  # stamps of the scan and the points in the costmap
        self.costmap_sent_ns: int | None = None
        self.camera_ns: int | None = None
        self.rhythms = {source.key: Rhythm() for source in SOURCES if source.steady}
        self.page_rhythm = Rhythm()  # of the camera images at the operator's page
        self.heard: dict[str, int] = {}  # stamp of each source's newest message
        self.lost_told = False  # a step was made for the loss of the driver
        self.page: tuple[int, int] = (-1, 0)  # newest camera image there: stamp, time of the report
        self.view: tuple[int, int] = (-1, 0)  # newest rendered view there: request, time of the report
        self.views_wanted = False  # the newest view was requested to be shown
        self.picture_delay_s: float | None = None  # from camera to operator
        self.latch = EstopLatch()
        self.kept: estop_state.KeptStop | None = None  # the emergency stop as the next start would restore it
        self.restore_estop()
        self.button_ns: int | None = None  # last report of the robot's own emergency stop
        self.ticks = 0

        self.cmd_vel = self.publisher("/cmd_vel", TwistStamped, qos=SENSOR)
        self.state = self.publisher("/ic/state", ControlState, qos=LATCHED)
        self.subgoal = self.publisher("/ic/subgoal", PoseStamped, qos=SENSOR)
        self.trajectory = self.publisher("/ic/trajectory", Path, qos=SENSOR)
        self.costmap_out = self.publisher("/costmap", OccupancyGrid, qos=SENSOR)

        self.operator = self.latest("/operator/cmd_vel", TwistStamped, max_age_s=10.0)
        self.obeyed = (0.0, 0.0)  # operator's command of the last step
        self.early = False  # a step was made ahead of its time since the last timer
        self.subscribe("/operator/cmd_vel", TwistStamped, self.on_command, qos=SENSOR)
        self.scan = self.latest("/scan", LaserScan, max_age_s=10.0)
        self.points = (
            self.latest("/lidar/points", PointCloud2, max_age_s=10.0) if self.config.costmap.points.enabled else None
        )
        self.odometry = self.latest("/wheel/odom", Odometry, max_age_s=10.0)
        self.pose = self.latest("/pose", PoseWithCovarianceStamped, max_age_s=10.0)
        self.vbot = self.latest("/vbot/odom", Odometry, max_age_s=10.0)
        self.nav = self.latest("/nav/cmd_vel", TwistStamped, max_age_s=10.0)
        self.shown = self.latest("/view/shown", ShownPictures, max_age_s=1.0)
        self.subscribe("/view/shown", ShownPictures, self.on_shown, qos=SENSOR)
        self.vspace = self.latest("/vspace/status", VspaceStatus, max_age_s=60.0, qos=LATCHED)
        self.subscribe("/map", OccupancyGrid, self.on_map, qos=LATCHED)
        self.subscribe_received("/operator/estop", self.on_estop, qos=LATCHED, message_class=Bool)
        self.subscribe_received("/robot/estop", self.on_button, qos=LATCHED, message_class=Bool)
        # Only its age matters: the image is never decoded here.
        self.subscribe_raw("/camera/image/compressed", self.on_camera, qos=SENSOR)
        _ = self.tf  # listens from here on
        self.timer(self.config.wall_period_s, self.update_walls)
        self.timer(1.0 / self.config.costmap.update_frequency, self.update_costmap)
        self.cancel_extra: Callable[[], None] = lambda: None  # cancels a step between two timers
        self.timer(1.0 / self.config.rate_hz, self.on_timer)

    def reconfigure(self, config: ArbiterNodeConfig) -> None:
        super().reconfigure(config)
        self.arbiter.reconfigure(config)

    def teardown(self) -> None:
        if hasattr(self, "cmd_vel"):
            self.cmd_vel.publish(twist_stamped(0.0, 0.0, self.clock.now_ns(), HARD_STOP))

    # -- inputs

    def on_map(self, message: OccupancyGrid) -> None:
        grid, resolution, origin = grid_array(message)
        if grid.size == 0:
            return
        self.static = StaticMap(grid, resolution, np.array(origin))
        self.map_is_new = True
        if self.walls is None:
            self.update_walls()  # the first map at once

    def update_walls(self) -> None:
        """Search for walls in the newest map, outside the node's thread."""
        if self.map_is_new:
            self.map_is_new = False
            self.wall_worker.submit(self.static)

    def on_walls(self, walls: WallMap) -> None:
        self.walls = walls

    def restore_estop(self) -> None:
        """Start stopped if the emergency stop was pressed when the last run ended, or that run broke off."""
        if self.run_dir is None:
            return
        kept, now_ns = estop_state.read(self.run_dir), self.clock.now_ns()
        if kept is not None:
            # Clamp to now, in case the clock was set since: any release from here on is newer.
            self.kept = replace(kept, pressed_ns=min(kept.pressed_ns, now_ns))
            self.latch.hear(True, self.kept.publisher, self.kept.pressed_ns, now_ns)
            self.log.warning("emergency stop: %s", kept.why or "still pressed from before this start")

    def keep_estop(self) -> None:
        """Save a press and delete a released one, so that no restart of a node or of the machine ends a stop.

        Runs after the step that obeys a press: the disk may be slow.
        """
        latch, before = self.latch, self.kept
        now = estop_state.KeptStop(latch.publisher, latch.pressed_ns) if latch.pressed else None
        same = before is not None and now is not None and before.pressed_ns == now.pressed_ns
        if self.run_dir is None or same or now == before:
            return
        try:
            estop_state.write(self.run_dir, now)
            self.kept = now
            self.diagnose("estop", OK, "")
        except estop_state.EstopStateError as error:
            self.diagnose("estop", ERROR, str(error))

    def on_estop(self, received: Received) -> None:
        """Obey a press at once; a release only by the rule of :class:`EstopLatch`."""
        pressed = bool(deserialize(received.payload, received.type_name).data)
        now_ns = self.clock.now_ns()
        if refused := self.latch.hear(pressed, received.publisher, received.publish_ns, now_ns):
            self.log.warning("emergency stop: %s", refused)
        self.tick()  # at once, not at the next timer
        self.keep_estop()

    def on_button(self, received: Received) -> None:
        """Obey the robot's own emergency stop; its release ends nothing: the operator must release the stop."""
        pressed = bool(deserialize(received.payload, received.type_name).data)
        self.button_ns = self.clock.steady_ns()
        self.latch.hear_button(pressed, received.publisher, received.publish_ns)
        self.tick()
        self.keep_estop()

    def on_command(self, message: TwistStamped) -> None:
        """Obey a changed command at once: the next timer is half a period away on average."""
        if not self.early and twist_values(message) != self.obeyed:
            self.early = True
            self.tick()

    def on_timer(self) -> None:
        self.early = False
        self.tick()

    def look_again(self, in_s: float) -> None:
        """Schedule one step in ``in_s`` if the next timer may be later: time-outs are exact."""
        self.cancel_extra()
        if in_s < 1.0 / self.config.rate_hz:
            self.cancel_extra = self.timer(in_s + STEP_AFTER_S, self.tick).cancel

    def on_camera(self, topic: str, type_name: str, payload: bytes | memoryview, publish_ns: int) -> None:
        now_ns = self.clock.steady_ns()
        if self.camera_ns is not None:
            self.rhythms["camera"].heard((now_ns - self.camera_ns) / 1e9)
        self.camera_ns = now_ns

    def age(self, key: str, latest: Latest) -> float:
        """Age of the newest message in seconds, by its stamp."""
        message = latest.message
        if message is None:
            return math.inf
        now_ns, stamp = self.clock.now_ns(), stamp_ns(message)
        if key in self.rhythms and self.heard.get(key) != stamp:
            if key in self.heard:
                self.rhythms[key].heard((now_ns - self.heard[key]) / 1e9 - latest.age_s)
            self.heard[key] = stamp
        return latest.stamp_age_s

    def on_shown(self, message: ShownPictures) -> None:
        """Record new images at the operator's page."""
        now_ns, stamp, view = self.clock.steady_ns(), stamp_ns(message.picture_stamp), int(message.view_id)
        new = stamp != self.page[0] or view != self.view[0]
        if stamp not in (0, self.page[0]):
            if self.page[0] > 0:
                self.page_rhythm.heard((now_ns - self.page[1]) / 1e9)
            self.page = stamp, now_ns
            self.picture_delay_s = min(max((self.clock.now_ns() - stamp) / 1e9, 0.0), 1.0)
        if view != self.view[0]:
            # In REAL, views are requested rarely; their distance in time says nothing of their rate.
            wanted = self.arbiter.mode in (Mode.ENTERING, Mode.VIRTUAL, Mode.RETURNING)
            if wanted and self.views_wanted:
                self.rhythms["view"].heard((now_ns - self.view[1]) / 1e9)
            self.view, self.views_wanted = (view, now_ns), wanted
        gone, told = self.operator_gone(), self.lost_told
        self.lost_told = gone
        if (new and self.arbiter.mode in (Mode.ENTERING, Mode.RETURNING)) or (gone and not told):
            # Whether view and image agree holds at present, not at the next timer; a lost driver must not wait either.
            self.tick()

    def ages(self) -> dict[str, float]:
        shown, steady_ns = self.shown.message, self.clock.steady_ns()
        camera_s = math.inf if self.camera_ns is None else (steady_ns - self.camera_ns) / 1e9
        view_s = math.inf
        if shown is not None:  # where there is a page, the images that arrived there count
            camera_s = max(camera_s, float(shown.picture_age_s) + self.shown.age_s)
            view_s = float(shown.view_age_s) + self.shown.age_s
        ages = {
            "scan": self.age("scan", self.scan),
            "odometry": self.age("odometry", self.odometry),
            "pose": self.age("pose", self.pose),
            "camera": camera_s,
            "view": view_s,
            "vbot": self.age("vbot", self.vbot),
            "nav": self.age("nav", self.nav),
            "command": self.age("command", self.operator),
            "vspace": self.vspace.age_s,
        }
        if self.points is not None and self.points_seen:
            ages["points"] = max(self.age("points", self.points), self.used_age_s("points"))
        if self.button_ns is not None and self.config.timeouts.estop_input > 0:
            ages["estop_input"] = (steady_ns - self.button_ns) / 1e9
        return ages

    def usual(self) -> dict[str, float]:
        """Usual age of each source in seconds when its next message arrives."""
        usual = {key: rhythm.usual_s for key, rhythm in self.rhythms.items()}
        if self.shown.message is not None:
            usual["camera"] = max(usual["camera"], self.page_rhythm.usual_s)
        return usual

    # -- what the operator sees

    def shown_pose(self, pose: NDArray[np.float64], velocity: tuple[float, float]) -> NDArray[np.float64] | None:
        """Position of the r-bot when the image now shown was taken, with its present heading (3,).

        A view of this pose is shown when the next images have arrived, so the pose lies ahead by the delay of a view.
        None without a page.
        """
        shown = self.shown.message
        if shown is None or self.picture_delay_s is None:
            return None
        now_ns = self.clock.now_ns()
        newest_ns = self.tf.newest_ns("base_link") or now_ns
        now = move(pose, *velocity, min(max((now_ns - newest_ns) / 1e9, 0.0), 0.1))
        behind_s = self.picture_delay_s - min(float(shown.view_delay_s), 0.5)
        if behind_s <= (now_ns - newest_ns) / 1e9:
            place = move(now, *velocity, -behind_s)
        else:
            try:
                place = pose2_from_matrix(
                    self.tf.lookup("map", "odom") @ self.tf.lookup("odom", "base_link", now_ns - round(behind_s * 1e9))
                )
            except TransformError:
                return None
        return np.array([place[0], place[1], now[2]])

    def picture_position(self) -> NDArray[np.float64] | None:
        """Position (2,) of the camera in the map for the page's newest image."""
        for frame in ("camera", "base_link"):
            try:
                odom_from_camera = self.tf.lookup("odom", frame, self.page[0])
                place: NDArray[np.float64] = (self.tf.lookup("map", "odom") @ odom_from_camera)[:2, 3]
                return place
            except TransformError:
                continue
        return None

    def robot_pose(self) -> NDArray[np.float64] | None:
        try:
            pose = pose2_from_matrix(self.tf.lookup("map", "base_link"))
        except TransformError as error:
            self.diagnose("pose", WARN, str(error))
            return None
        self.diagnose("pose", OK, "known")
        return pose

    def scan_in_base(self) -> NDArray[np.float64] | None:
        """Hits (N, 2) of the newest scan and 3D points in ``base_link`` now, by odometry, which does not jump."""
        self.place_scan()
        if self.placed_scan is None:
            return None
        near = self.placed_scan
        if self.sweep is not None:
            near = np.concatenate([near, self.sweep.nearest])
        try:
            base_from_odom = np.linalg.inv(self.tf.lookup("odom", "base_link"))
        except TransformError as error:
            self.diagnose("scan", WARN, f"scan cannot be placed: {error}")
            return None
        return np.asarray(near @ base_from_odom[:2, :2].T + base_from_odom[:2, 3])

    def place_scan(self) -> None:
        """Transform the newest scan to ``odom``; until its transform arrives, keep the previous scan and its age."""
        scan = self.scan.message
        if scan is None:
            self.placed_scan = None
            return
        if self.placed_scan is not None and self.used["scan"][0] == stamp_ns(scan):
            return
        try:
            odom_from_lidar = self.tf.lookup("odom", scan.header.frame_id, stamp_ns(scan))
        except TransformError as error:
            self.diagnose("scan", WARN, f"scan cannot be placed: {error}")
            return
        points = scan_points(scan.ranges, scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)
        self.diagnose("scan", OK, f"{len(points)} points")
        self.placed_scan = np.asarray(points @ odom_from_lidar[:2, :2].T + odom_from_lidar[:2, 3])
        self.note_used("scan", self.scan)

    def note_used(self, key: str, latest: Latest) -> None:
        """Record that the newest message of a source has a transform: the age of the last such message counts."""
        self.used[key] = stamp_ns(latest.message), self.clock.steady_ns() - round(latest.age_s * 1e9)

    def used_age_s(self, key: str) -> float:
        """Age of the last message with a transform, since its arrival or its stamp, whichever is longer."""
        if key not in self.used:
            return math.inf
        stamp, came_ns = self.used[key]
        return max(self.clock.now_ns() - stamp, self.clock.steady_ns() - came_ns) / 1e9

    # -- 3D points

    def take_points(self) -> int:
        """Sort the newest 3D points by height, in ``odom``; return their stamp, -1 without points."""
        message = None if self.points is None else self.points.message
        if self.points is None:
            self.diagnose("points", OK, "not used (costmap.points.enabled is false)")
        if message is None:
            if self.points is not None and not self.points_seen:
                self.diagnose("points", OK, "no 3D points yet: low and hanging things are not seen")
            return -1
        self.points_seen = True
        if stamp_ns(message) == self.taken[1]:
            return self.taken[1]
        try:
            self.sweep = self.sorted(message)
        except (MessageError, TransformError) as error:
            if isinstance(error, MessageError):
                self.used.pop("points", None)  # no later transform makes them usable
            self.diagnose("points", WARN, f"3D points cannot be used: {error}")
            return -1
        assert self.points is not None  # the message came from this subscription
        self.note_used("points", self.points)
        counts = self.sweep.counts
        self.diagnose("points", OK, f"{counts['obstacle']} obstacle points", **counts)
        return stamp_ns(message)

    def sorted(self, message: PointCloud2) -> SortedPoints:
        cloud = cloud_array(message)
        names = cloud.dtype.names or ()
        if not {"x", "y", "z"} <= set(names):
            raise MessageError(f"/lidar/points has the fields {', '.join(names)}; x, y and z are needed")
        time_s = cloud["time"] if "time" in names else np.zeros(len(cloud), np.float32)
        duration_s = float(min(max(time_s.max(initial=0.0), 0.0), 1.0))
        first_ns = stamp_ns(message)
        instants = [first_ns + round(1e9 * duration_s * k / (_MOTION_SAMPLES - 1)) for k in range(_MOTION_SAMPLES)]
        poses = np.stack([self.tf.lookup("odom", message.header.frame_id, ns) for ns in instants])
        points = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=1)
        return sort_points(points, time_s, poses, duration_s, self.config.costmap.points)

    # -- costmap

    def update_costmap(self) -> None:
        points_ns = self.take_points()
        pose, scan = self.robot_pose(), self.scan.message
        if pose is None or scan is None:
            missing = "no pose" if pose is None else "no LiDAR scan"
            self.diagnose("costmap", WARN if self.costmap is not None else OK, f"costmap is not updated: {missing}")
            return
        if (stamp_ns(scan), points_ns) == self.taken:
            return
        try:
            # SLAM's correction changes slowly and arrives later than the scan: the newest one is good enough.
            map_from_odom = self.tf.lookup("map", "odom")
            map_from_lidar = map_from_odom @ self.tf.lookup("odom", scan.header.frame_id, stamp_ns(scan))
        except TransformError as error:
            self.diagnose("costmap", WARN, f"costmap is not updated: {error}")
            return
        if self.map_from_odom is not None and self.jumped(self.map_from_odom, map_from_odom):
            self.log.info("the map has jumped: the marks of scans are cleared from the costmap")
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
        new_points = self.sweep if points_ns not in (-1, self.taken[1]) else None
        self.costmap = self.costmaps.update(pose, self.static, rays, new_points, pose2_from_matrix(map_from_odom))
        self.taken = (stamp_ns(scan), points_ns)
        self.diagnose("costmap", OK, "up to date", static_map=self.static is not None)
        self.publish_costmap(stamp_ns(scan))

    def publish_costmap(self, scan_ns: int) -> None:
        now_ns, costmap = self.clock.steady_ns(), self.costmap
        # A little early counts: updates come at the scan's rate, not at the publish frequency.
        due_ns = 0.9e9 / self.config.costmap.publish_frequency
        sent_ns = self.costmap_sent_ns  # later than now if the clock went back: a bag player restarted
        if costmap is None or (sent_ns is not None and 0 <= now_ns - sent_ns < due_ns):
            return
        self.costmap_sent_ns = now_ns
        origin = (float(costmap.origin[0]), float(costmap.origin[1]))
        self.costmap_out.publish(grid_message(costmap.occupancy(), costmap.resolution, origin, "map", scan_ns))

    def jumped(self, before: Matrix, after: Matrix) -> bool:
        # Compared once per costmap period, which is shorter than SLAM's: a correction arrives in one piece.
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
        else:
            ages["scan"] = max(ages["scan"], self.used_age_s("scan"))
        pose = self.robot_pose()
        vbot, status, shown, velocity = (
            self.vbot.message,
            self.vspace.message,
            self.shown.message,
            _twist(self.odometry),
        )
        inputs = ArbiterInputs(
            robot_pose=pose,
            robot_velocity=velocity,
            operator_command=_twist(self.operator),
            operator_gone=self.operator_gone(),
            estop=self.latch.pressed,
            estop_button=self.latch.button,
            estop_why="" if self.kept is None else self.kept.why,
            scan_points=points,
            costmap=self.costmap,
            walls=self.walls,
            vspace=Vspace() if status is None else _vspace(status),
            vbot_pose=None if vbot is None else self.carried_on(vbot),
            vbot_velocity=_twist(self.vbot),
            nav_command=_twist(self.nav),
            shown_pose=None if pose is None else self.shown_pose(pose, velocity),
            image_position=None if shown is None else self.picture_position(),
            view_position=None if shown is None else pose_matrix(shown.view_pose)[:2, 3],
            view_after_image_s=0.0 if shown is None else _between_s(shown),
            ages=ages,
            usual=self.usual(),
            images_late_s=max(self.picture_delay_s or 0.0, 0.0 if shown is None else float(shown.view_delay_s)),
        )
        self.obeyed = inputs.operator_command
        # Steady time: setting the clock back must not make a stale source look fresh.
        decision = self.arbiter.step(inputs, self.clock.steady_ns())
        self.cmd_vel.publish(twist_stamped(*decision.command, now_ns, HARD_STOP if decision.hard else "base_link"))
        self.tell(decision, inputs, now_ns)
        self.look_again(self.arbiter.stale_in_s(inputs, self.clock.steady_ns()))

    def operator_gone(self) -> bool:
        """Whether the console has lost its driver since the newest command."""
        shown, command = self.shown.message, self.operator.message
        return shown is not None and command is not None and stamp_ns(command) <= stamp_ns(shown.operator_lost)

    def carried_on(self, odometry: Odometry) -> NDArray[np.float64]:
        """Pose (3,) of the v-bot extrapolated to the present: its message is up to a period old."""
        age_s = (self.clock.now_ns() - stamp_ns(odometry)) / 1e9
        return move(pose2_from_matrix(pose_matrix(odometry)), *twist_values(odometry), min(max(age_s, 0.0), 0.1))

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
                shown=ControlState.SHOWN_VIRTUAL if decision.mode.shows_vbot else ControlState.SHOWN_REAL,
                vbot_action=int(decision.vbot_action),
                vbot_target=pose_message(matrix_from_pose2(decision.vbot_target)),
                robot_twist=twist_message(*inputs.robot_velocity),
                vbot_limit_m_s=decision.vbot_limit_m_s,
            )
        )
        if decision.changed:
            self.log.info("%s: %s", decision.mode.name.lower(), decision.reason)
        level = WARN if decision.mode == Mode.STOPPED or decision.blocked else OK
        self.diagnose("control", level, decision.reason, mode=decision.mode.name)
        self.ticks += 1
        if self.ticks % 2 and not decision.changed:
            return  # 10 Hz is enough for display and planning
        if decision.subgoal is not None:
            self.subgoal.publish(pose_stamped(matrix_from_pose2(decision.subgoal.pose), "map", now_ns))
        if self.trajectory.subscriber_count or self.lockstep:
            self.trajectory.publish(path_message(decision.trajectory[::4], "map", now_ns))


def _twist(latest: Latest) -> tuple[float, float]:
    return (0.0, 0.0) if latest.message is None else twist_values(latest.message)


def _between_s(shown: ShownPictures) -> float:
    """Seconds from the arrival of the page's newest camera image to that of its newest view; 0 while one is missing."""
    between_s = float(shown.picture_age_s) - float(shown.view_age_s)
    return between_s if math.isfinite(between_s) else 0.0


def _vspace(status: VspaceStatus) -> Vspace:
    return Vspace(
        ready=status.state == VspaceStatus.READY,
        training=status.state == VspaceStatus.TRAINING,
        failed=status.state == VspaceStatus.FAILED,
        position=pose_matrix(status.keyframe_pose)[:2, 3],
        ready_radius_m=float(status.ready_radius_m),
        message=status.message,
        expected_psnr_db=float(status.expected_psnr_db),
    )


if __name__ == "__main__":
    main(ArbiterNode)
