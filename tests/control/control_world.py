"""A flat world for the tests of the control part: analytic scans, exact contact, a base with latency.

Nothing here uses the code under test, but for the closed loop that drives it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np

from instant_ic.control.arbiter import Arbiter, Decision
from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.costmap import CostmapConfig, RollingCostmap, scan_points, scan_rays
from instant_ic.control.follower import FollowerConfig, PathFollower
from instant_ic.control.footprint import Footprint
from instant_ic.control.kinematics import MotionLimits
from instant_ic.control.navigator import Navigator, meeting_pose
from instant_ic.control.planner import HybridPlanner
from instant_ic.control.snapshot import ArbiterInputs, Vspace
from instant_ic.control.states import Mode, VbotAction
from instant_ic.control.vbot import VbotConfig, VirtualRobot
from instant_ic.control.walls import StaticMap, WallMap
from instant_ic.msg import VspaceStatus, header, pose_message, to_time
from instant_ic.util.contradiction import Contradiction

LENGTH_M, WIDTH_M = 0.60, 0.50
BEAMS = 720
LIDAR_MIN_M, LIDAR_MAX_M = 0.40, 20.0


def rectangle(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    """Four segments (4, 2, 2)."""
    p = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return np.stack([p, np.roll(p, -1, axis=0)], axis=1)


@dataclass
class World:
    """Segments (N, 2, 2) in metres."""

    segments: np.ndarray

    def cast(self, x: float, y: float, yaw: float) -> np.ndarray:
        """Ranges (BEAMS,), the first beam at -pi from the heading; +inf for nothing, and for too near, as a VLP-16."""
        angle = yaw - math.pi + 2 * math.pi * np.arange(BEAMS) / BEAMS
        d = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
        a, e = self.segments[:, 0][None], (self.segments[:, 1] - self.segments[:, 0])[None]
        to_a = a - np.array([x, y])
        cross = d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (to_a[..., 0] * e[..., 1] - to_a[..., 1] * e[..., 0]) / cross
            u = (to_a[..., 0] * d[..., 1] - to_a[..., 1] * d[..., 0]) / cross
            t = np.where((np.abs(cross) > 1e-12) & (t > 0) & (u >= 0) & (u <= 1), t, np.inf)
        r = t.min(axis=1)
        return np.where((r < LIDAR_MIN_M) | (r > LIDAR_MAX_M), np.inf, r)

    def contact(self, pose: np.ndarray) -> bool:
        """Whether the true footprint touches a segment (sampled each centimetre)."""
        c, s = math.cos(pose[2]), math.sin(pose[2])
        x, y = (self.points - pose[:2]).T
        inside = (np.abs(c * x + s * y) < LENGTH_M / 2) & (np.abs(-s * x + c * y) < WIDTH_M / 2)
        return bool(inside.any())

    @cached_property
    def points(self) -> np.ndarray:
        """Points (N, 2) on the segments, a centimetre apart."""
        counts = [max(2, math.ceil(float(np.linalg.norm(b - a)) / 0.01)) for a, b in self.segments]
        pairs = zip(self.segments, counts, strict=True)
        return np.concatenate([a + (b - a) * np.linspace(0, 1, n)[:, None] for (a, b), n in pairs])


def corridor(length: float = 16.0, width: float = 2.4, start: float = -2.0) -> np.ndarray:
    return rectangle(start, -width / 2, start + length, width / 2)


def draw_map(segments: np.ndarray, inside: tuple[float, float, float, float], resolution: float = 0.05) -> StaticMap:
    """Occupancy grid with the given segments drawn, free inside the rectangle, unknown outside."""
    x0, y0, x1, y1 = inside
    origin = np.array([x0 - 1.0, y0 - 1.0])
    shape = (round((y1 - y0 + 2.0) / resolution), round((x1 - x0 + 2.0) / resolution))
    grid = np.full(shape, -1, dtype=np.int8)
    centre_x = origin[0] + (np.arange(shape[1]) + 0.5) * resolution
    centre_y = origin[1] + (np.arange(shape[0]) + 0.5) * resolution
    grid[np.ix_((centre_y > y0) & (centre_y < y1), (centre_x > x0) & (centre_x < x1))] = 0
    for a, b in segments:
        n = math.ceil(float(np.linalg.norm(b - a)) / (resolution / 4)) + 1
        index = np.floor((a + (b - a) * np.linspace(0, 1, n)[:, None] - origin) / resolution).astype(int)
        grid[index[:, 1], index[:, 0]] = 100
    return StaticMap(grid, resolution, origin)


def ready_vspace(now_ns: int) -> VspaceStatus:
    """The status of a virtual space that is ready everywhere."""
    numbers = {field.name: 0 for field in fields(VspaceStatus) if field.name != "__msgtype__"}
    floats = ("psnr_db", "expected_psnr_db", "unseen_share", "train_seconds", "ready_seconds")
    numbers |= dict.fromkeys((*floats, "ms_per_iteration", "render_ms", "render_fps"), 0.0)
    given = {
        "header": header("map", now_ns),
        "state": VspaceStatus.READY,
        "keyframe_pose": pose_message(np.eye(4)),
        "keyframe_stamp": to_time(now_ns),
        "ready_radius_m": 100.0,
        "device": "cpu",
        "message": "",
    }
    return VspaceStatus(**numbers | given)


def matrix(pose: np.ndarray) -> np.ndarray:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    m = np.eye(4)
    m[:2, :2], m[:2, 3] = [[c, -s], [s, c]], pose[:2]
    return m


def _clip(value: float, bound: float) -> float:
    return max(-bound, min(bound, value))


@dataclass
class Base:
    """Tracked base: command latency, speed and acceleration limits, small Euler steps."""

    pose: np.ndarray = field(default_factory=lambda: np.zeros(3))
    v: float = 0.0
    w: float = 0.0
    latency_steps: int = 2
    queue: deque = field(default_factory=deque)

    def step(self, command: tuple[float, float], dt: float) -> None:
        self.queue.append(command)
        now = self.queue.popleft() if len(self.queue) > self.latency_steps else (0.0, 0.0)
        for _ in range(10):
            h = dt / 10
            self.v += _clip(_clip(now[0], 0.5) - self.v, 0.8 * h)
            self.w += _clip(_clip(now[1], 1.0) - self.w, 2.0 * h)
            x, y, yaw = self.pose
            self.pose = np.array([x + self.v * math.cos(yaw) * h, y + self.v * math.sin(yaw) * h, yaw + self.w * h])
        self.pose[2] = math.atan2(math.sin(self.pose[2]), math.cos(self.pose[2]))


@dataclass
class Frame:
    """One step of the closed loop."""

    t: float
    decision: Decision
    robot: np.ndarray
    vbot: np.ndarray
    command: tuple[float, float]
    speed: float
    state: str
    picture: np.ndarray
    view: np.ndarray | None


class Loop:
    """The whole control part against the world at 20 Hz: scan at 10 Hz, costmap at 5 Hz, SLAM is the truth.

    The operator sees camera pictures and rendered views at 10 Hz, each some steps old.
    """

    dt = 0.05
    camera_delay, view_delay, picture_period = 5, 2, 2  # steps

    def __init__(
        self,
        world: World,
        static: StaticMap | None,
        config: ArbiterConfig | None = None,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
        noise: np.random.Generator | None = None,
    ) -> None:
        self.noise, self.error = noise, np.zeros(3)
        self.world, self.static = world, static
        self.walls = WallMap(static) if static is not None else None
        self.costmaps = RollingCostmap(CostmapConfig(), Footprint())
        self.costmap_config = CostmapConfig()
        self.arbiter = Arbiter(config)
        limits = MotionLimits()
        self.navigator = Navigator(HybridPlanner(), PathFollower(FollowerConfig(), limits))
        self.vbot = VirtualRobot(VbotConfig(), limits)
        self.base = Base(np.array(start))
        self.pose_lost = 0.0
        self.blind = (False, False)
        self.contradiction, self.contradictions = Contradiction.NONE, 0
        self.vspace = Vspace(ready=True, position=np.zeros(2), ready_radius_m=100.0)
        self.k = 0
        self.frames: list[Frame] = []
        self.ages = dict.fromkeys(
            ["scan", "odometry", "pose", "camera", "view", "vbot", "nav", "command", "vspace"], 0.0
        )
        self.estop = False
        self.decision: Decision | None = None
        self.nav: tuple[float, float] = (0.0, 0.0)
        self.nav_state = ""
        self.costmap = None
        self.cameras: list[np.ndarray] = []  # pose of the r-bot, as known, at each step
        self.views: list[np.ndarray] = []  # pose of the v-bot at each step
        self.views_stop_at = math.inf  # s; no view comes any more

    def step(self, operator: tuple[float, float]) -> Frame:
        now_ns = round(self.k * self.dt * 1e9)
        truth = self.base.pose.copy()
        robot = self.measured(truth)
        if self.k % 2 == 0:
            self.ranges, self.scan_pose = self.world.cast(*truth), robot
            if self.noise is not None:
                self.ranges = self.ranges + self.noise.normal(0.0, 0.015, len(self.ranges))
        scan = (self.ranges, -math.pi, 2 * math.pi / BEAMS, LIDAR_MIN_M, LIDAR_MAX_M)
        if self.k % 4 == 0:
            rays = scan_rays(*scan, matrix(self.scan_pose), self.costmap_config)
            self.costmap = self.costmaps.update(robot, self.static, rays)
        hits = scan_points(*scan)
        points = np.column_stack([hits, np.zeros(len(hits))])
        base_from_scan = np.linalg.inv(matrix(robot)) @ matrix(self.scan_pose)
        in_base = points @ base_from_scan[:3, :3].T + base_from_scan[:3, 3]
        self.cameras.append(robot)
        self.move_vbot(operator, robot)
        self.views.append(self.vbot.pose.copy())
        picture, view = self.pictures()
        inputs = ArbiterInputs(
            robot_pose=robot,
            pose_lost_probability=self.pose_lost,
            blind=self.blind,
            contradiction=self.contradiction,
            contradictions=self.contradictions,
            robot_velocity=(self.base.v, self.base.w),
            operator_command=operator,
            estop=self.estop,
            scan_points=in_base[:, :2],
            costmap=self.costmap,
            walls=self.walls,
            vspace=self.vspace,
            vbot_pose=self.vbot.pose,
            vbot_velocity=self.vbot.velocity,
            nav_command=self.nav,
            shown_pose=self.shown_pose(robot),
            image_position=picture[:2],
            view_position=None if view is None else view[:2],
            view_after_image_s=self.view_after_picture_s(),
            ages=dict(self.ages),
        )
        self.decision = self.arbiter.step(inputs, now_ns)
        self.nav = (0.0, 0.0)
        if self.decision.mode != Mode.VIRTUAL:
            self.navigator.reset()
        if self.decision.mode == Mode.VIRTUAL and self.decision.subgoal is not None:
            subgoal = self.decision.subgoal
            goal, velocity = subgoal.pose, (0.0, 0.0)
            if subgoal.rule == "vbot":
                goal, velocity = meeting_pose(goal, self.decision.vbot_target, robot), self.vbot.velocity
            step = self.navigator.step(robot, self.base.v, goal, self.costmap, now_ns, velocity)
            self.nav, self.nav_state = step.command, step.state
        self.base.step(self.decision.command, self.dt)
        frame = Frame(
            self.k * self.dt,
            self.decision,
            truth,
            self.vbot.pose.copy(),
            self.decision.command,
            self.base.v,
            self.nav_state,
            picture,
            view,
        )
        self.frames.append(frame)
        self.k += 1
        return frame

    def move_vbot(self, operator: tuple[float, float], robot: np.ndarray) -> None:
        """What the node does by the arbiter's last word."""
        said = self.decision
        twist = (self.base.v, self.base.w)
        if said is None or said.vbot_action == VbotAction.WITH_ROBOT:
            self.vbot.place(self.shown_pose(robot), twist)
        elif said.vbot_action == VbotAction.EASED:
            self.vbot.ease(self.shown_pose(robot), twist, self.dt)
        elif said.vbot_action == VbotAction.LED_BACK:
            self.vbot.lead_back(robot, self.dt, self.walls)
        else:
            free = said.vbot_action == VbotAction.DRIVEN and self.ages["command"] <= 0.3
            self.vbot.step(operator if free else (0.0, 0.0), robot, self.dt, self.walls)

    def shown_pose(self, robot: np.ndarray) -> np.ndarray:
        """Where the r-bot was when the picture was taken that a view asked for now should look like."""
        place = self.cameras[max(0, self.k - self.camera_delay + self.view_delay)]
        return np.array([place[0], place[1], robot[2]])

    def pictures(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Poses of the newest camera picture and the newest view that the operator has."""
        taken = max(0, self.k - self.camera_delay) // self.picture_period * self.picture_period
        asked = max(0, self.k - self.view_delay) // self.picture_period * self.picture_period
        if asked * self.dt > self.views_stop_at:
            return self.cameras[taken], None
        return self.cameras[taken], self.views[asked]

    def view_after_picture_s(self) -> float:
        """From when the newest camera picture came to when the newest view did."""
        came = [
            (self.k - late) // self.picture_period * self.picture_period + late
            for late in (self.camera_delay, self.view_delay)
        ]
        return (came[1] - came[0]) * self.dt

    def measured(self, truth: np.ndarray) -> np.ndarray:
        """What SLAM says: the truth, or with noise an error that wanders by centimetres."""
        if self.noise is None:
            return truth
        self.error = 0.95 * self.error + self.noise.normal(0.0, [0.005, 0.005, 0.002])
        return truth + self.error

    def start(self) -> None:
        """Hands off until the arbiter lets the operator drive."""
        for _ in range(40):
            if self.step((0.0, 0.0)).decision.mode == Mode.REAL:
                return
        raise AssertionError(f"never left STOPPED: {self.decision.reason}")

    def modes(self) -> list[str]:
        """Modes in order, without repeats."""
        names = [frame.decision.mode.name for frame in self.frames]
        return [name for i, name in enumerate(names) if i == 0 or names[i - 1] != name]
