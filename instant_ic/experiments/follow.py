"""``ic evaluate follow``: the r-bot follows a v-bot in random rooms, in a closed loop with the shipped library code.

Each episode generates a room (``follow_worlds``). A scripted operator drives the v-bot to a goal, around walls and
straight through everything else. Costmap, subgoal, navigator and collision monitor are those of the nodes, at the
nodes' rates. The robot is the simulator's, with slip: its commands are delayed, its pose estimate wanders by
centimetres, and its LiDAR has 1.5 cm of noise. A revolution is measured at one instant; motion during a revolution is
not simulated.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.base.config import LimitsConfig, SkidSteerConfig
from instant_ic.control.costmap import Costmap, CostmapConfig, RollingCostmap, scan_points, scan_rays
from instant_ic.control.follower import FollowerConfig, PathFollower
from instant_ic.control.footprint import Footprint
from instant_ic.control.heights import sort_points
from instant_ic.control.kinematics import MotionLimits, accelerate
from instant_ic.control.moving import MovingPoints, MovingThings
from instant_ic.control.navigator import Navigator
from instant_ic.control.passage import PassageConfig
from instant_ic.control.planner import HybridPlanner, Plan
from instant_ic.control.prediction import PredictionConfig, Predictor
from instant_ic.control.safety import CollisionMonitor, CollisionMonitorConfig, MonitoredCommand
from instant_ic.control.subgoal import choose_subgoal
from instant_ic.control.vbot import VbotConfig, VirtualRobot
from instant_ic.control.walls import StaticMap, WallMap
from instant_ic.control.warmup import warm_up
from instant_ic.experiments import follow_worlds as worlds
from instant_ic.experiments.plots import new_figure, save_figure
from instant_ic.experiments.processes import run_all
from instant_ic.experiments.results import finite
from instant_ic.geometry.poses import matrix_from_pose2, relative2, wrap_angle
from instant_ic.sim.robot import RobotConfig, TrackedRobot

FloatArray = NDArray[np.float64]

DT_S = 0.05
REACHED_M, REACHED_RAD = 0.20, math.radians(12.0)
"""Largest true distance from r-bot to v-bot at the goal: the arbiter's 0.15 m and 10° (switch.*) plus pose errors."""
SPARE_M = 0.05
"""A goal is reachable if the footprint with this margin on every side can get there."""
OPERATOR_M_S = 0.4


@dataclass
class Episode:
    """Result of one drive."""

    index: int
    reachable: bool
    reached: bool = False
    seconds: float = 0.0
    optimum_m: float = math.inf
    driven_m: float = 0.0
    contacts: int = 0
    """Number of contacts of the robot with a wall or an object."""
    clearance_m: float = math.inf
    """Smallest distance of the true footprint from any static object."""
    reason: str = ""
    """The follower's last message if the goal was not reached."""
    planner_ms: list[float] = field(default_factory=list)
    controller_ms: list[float] = field(default_factory=list)
    costmap_ms: list[float] = field(default_factory=list)
    tracks: dict[str, list[list[float]]] = field(default_factory=dict)
    """Tracks of ``robot`` and ``vbot``, for the plot."""

    @property
    def ratio(self) -> float:
        """Distance driven over the length of the shortest path."""
        return self.driven_m / self.optimum_m


class _TimedPlanner(HybridPlanner):
    """Records the CPU time of each plan."""

    def __init__(self) -> None:
        super().__init__(Footprint())
        self.spent_ms: list[float] = []

    def plan(self, costmap: Costmap, start: FloatArray, goal: FloatArray, before: Plan | None = None) -> Plan:
        began = time.thread_time()
        plan = super().plan(costmap, start, goal, before)
        self.spent_ms.append(1e3 * (time.thread_time() - began))
        return plan


class FollowDrive:
    """One running episode."""

    def __init__(self, seed: int, index: int) -> None:
        self.rng = np.random.default_rng([seed, index])
        self.room = worlds.make_room(self.rng, hidden=index % 3 == 0)
        self.mask = self.room.world.occupied(*worlds.IN_THE_WAY_M, 0.01)
        coarse = self.room.world.occupied(*worlds.IN_THE_WAY_M, 0.025)
        goal = np.array([*self.room.goal, 0.0])
        self.optimum = worlds.shortest_way(coarse, self.room.start, goal, SPARE_M)
        self.episode = Episode(index, self.optimum is not None)
        if self.optimum is not None:
            self.episode.optimum_m = float(np.linalg.norm(np.diff(self.optimum[:, :2], axis=0), axis=1).sum())
        start: tuple[float, float, float] = tuple(float(v) for v in self.room.start)  # type: ignore[assignment]
        self.robot = TrackedRobot(RobotConfig(slip=0.05, turn_slip=0.08), self.mask, start, seed=1000 * seed + index)
        self.distance = self.mask.distance_m()
        self.late: deque[MonitoredCommand] = deque(
            [MonitoredCommand((0.0, 0.0), "free", 0.0)] * int(self.rng.integers(1, 4))
        )
        self.velocity = (0.0, 0.0)
        self.pose_error = np.zeros(3)

        limits, footprint = MotionLimits(), Footprint()
        self.config = CostmapConfig()
        self.static = self._map()
        self.walls = WallMap(self.static)
        self.costmaps = RollingCostmap(self.config, footprint)
        self.moving = MovingThings()
        self.costmap: Costmap | None = None
        self.published: Costmap | None = None
        self.planner = _TimedPlanner()
        self.navigator = Navigator(self.planner, PathFollower(FollowerConfig(), limits, footprint))
        self.monitor = CollisionMonitor(CollisionMonitorConfig(), footprint)
        self.predictor = Predictor(PredictionConfig(), limits, footprint)
        self.vbot = VirtualRobot(VbotConfig(), limits, footprint)
        self.vbot.place(self.room.start, (0.0, 0.0))
        self.nav = (0.0, 0.0)
        self.plan_reason = ""

    def _map(self) -> StaticMap:
        """Return the map that SLAM would build of the empty room: walls, free inside, unknown outside."""
        only_walls = worlds.made(self.room.shapes[self.room.kinds == worlds.WALL], self.room.size)
        walls = only_walls.occupied(*worlds.IN_THE_WAY_M, 0.05)
        occupancy = np.full(walls.cells.shape, -1, dtype=np.int8)
        centres = [walls.origin[i] + (np.arange(walls.cells.shape[1 - i]) + 0.5) * 0.05 for i in (0, 1)]
        inside = [(c > 0) & (c < s) for c, s in zip(centres, self.room.size, strict=True)]
        occupancy[np.ix_(inside[1], inside[0])] = 0
        occupancy[walls.cells] = 100
        return StaticMap(occupancy, 0.05, np.asarray(walls.origin, dtype=np.float64))

    def run(self) -> Episode:
        episode = self.episode
        limit_s = 60.0 + 3.0 * episode.optimum_m / OPERATOR_M_S if episode.reachable else 40.0
        tracks: dict[str, list[FloatArray]] = {"robot": [], "vbot": []}
        before = self.robot.pose.copy()
        for k in range(round(limit_s / DT_S)):
            episode.seconds = k * DT_S
            self.step(k)
            pose = self.robot.pose
            episode.driven_m += float(np.linalg.norm(pose[:2] - before[:2]))
            before = pose.copy()
            if k % 4 == 0:
                tracks["robot"].append(pose.copy())
                tracks["vbot"].append(self.vbot.pose.copy())
                episode.clearance_m = min(episode.clearance_m, self._clearance(pose))
            if self._arrived():
                episode.reached = True
                break
        episode.contacts = self.robot.contacts
        episode.reason = "" if episode.reached else self.plan_reason
        episode.planner_ms = self.planner.spent_ms
        episode.tracks = {name: np.round(np.array(track), 3).tolist() for name, track in tracks.items()}
        return episode

    def _arrived(self) -> bool:
        standing = self.vbot.velocity == (0.0, 0.0)
        if not standing or float(np.linalg.norm(self.vbot.pose[:2] - self.room.goal)) > 0.3:
            return False
        gap = self.vbot.pose - self.robot.pose
        return float(np.hypot(gap[0], gap[1])) <= REACHED_M and abs(wrap_angle(float(gap[2]))) <= REACHED_RAD

    def step(self, k: int) -> None:
        """Advance by a twentieth of a second: sensors, the nodes in their order, and the robot."""
        self.pose_error = 0.95 * self.pose_error + self.rng.normal(0.0, [0.005, 0.005, 0.002])
        estimate = self.robot.pose + self.pose_error
        if k % 2 == 0:
            self._see(estimate, k * DT_S, publish=k % 4 == 0)
        assert self.costmap is not None and self.published is not None
        command = self._operator()
        self.vbot.step(command, estimate, DT_S)  # its route avoids the walls
        prediction = self.predictor.predict(self.vbot.pose, self.vbot.velocity, command, self.costmap)
        extend_m = PassageConfig().max_pass_m
        subgoal = choose_subgoal(self.costmap, self.vbot.pose, prediction, command[0] >= 0, self.walls, extend_m)
        wanted = (0.0, 0.0)
        if subgoal is not None:
            velocity = self.vbot.velocity if subgoal.rule == "vbot" else (0.0, 0.0)
            spent, plans = time.thread_time(), len(self.planner.spent_ms)
            step = self.navigator.step(
                estimate, self.nav[0], subgoal.pose, self.published, round(k * DT_S * 1e9), velocity
            )
            spent_ms = 1e3 * (time.thread_time() - spent) - sum(self.planner.spent_ms[plans:])
            self.episode.controller_ms.append(spent_ms)
            wanted = step.command
            self.plan_reason = step.plan.reason or step.state
        else:
            self.plan_reason = "no free place near the v-bot"
        self.nav = wanted
        velocity = (float(self.robot.twist[0]), float(self.robot.twist[2]))
        self.move(
            self.monitor.limit(
                wanted, self._close_points(estimate), velocity=velocity, moving=self._moving_points(estimate, k * DT_S)
            )
        )

    def _operator(self) -> tuple[float, float]:
        """Steer the v-bot along its route: turn towards a point 0.4 m ahead and drive; release at the goal."""
        pose, route = self.vbot.pose, self.room.route
        if float(np.linalg.norm(route[-1] - pose[:2])) < 0.1:
            return 0.0, 0.0
        away = np.linalg.norm(route - pose[:2], axis=1)
        near = int(np.argmin(away))
        far = np.flatnonzero(away[near:] > 0.4)
        target = route[near + int(far[0]) if far.size else -1]
        x, y, _ = relative2(pose, np.array([*target, 0.0]))
        bearing = math.atan2(float(y), float(x))
        return (0.0 if abs(bearing) > 0.6 else OPERATOR_M_S), min(max(1.5 * bearing, -0.8), 0.8)

    def _see(self, estimate: FloatArray, time_s: float, publish: bool) -> None:
        points = worlds.look(self.room.world, self.robot.pose, self.rng)
        ranges = worlds.flat_ranges(points)
        beam = 2 * math.pi / worlds.BEAMS
        scan = (ranges, -math.pi + beam / 2, beam, worlds.RANGE_MIN_M, worlds.RANGE_MAX_M)
        map_from_lidar = matrix_from_pose2(estimate)
        map_from_lidar[2, 3] = worlds.LIDAR_HEIGHT_M
        cloud = points.astype(np.float32)
        began = time.thread_time()
        sweep = sort_points(cloud, np.zeros(len(cloud), np.float32), map_from_lidar[None], 0.0, self.config.points)
        rays = scan_rays(*scan, map_from_lidar, self.config)
        self.moving.update(sweep, time_s)
        self.costmap = self.costmaps.update(estimate, self.static, rays, sweep)
        self.episode.costmap_ms.append(1e3 * (time.thread_time() - began))
        if publish:
            self.published = Costmap.from_occupancy(
                self.costmap.occupancy(), self.costmap.resolution, self.costmap.origin
            )
        hits = scan_points(*scan) @ map_from_lidar[:2, :2].T + map_from_lidar[:2, 3]
        self.seen = np.concatenate([hits, sweep.nearest])

    def _close_points(self, estimate: FloatArray) -> FloatArray:
        """Return the points for the collision monitor, selected as ``Arbiter`` does."""
        assert self.costmap is not None
        c, s = math.cos(estimate[2]), math.sin(estimate[2])
        seen = (self.seen - estimate[:2]) @ np.array([[c, -s], [s, c]])
        config = self.monitor.config
        memory = self.costmap.memory_near(estimate, config.blind_radius_m, config.memory_range_m)
        return np.concatenate([seen, np.repeat(memory, self.monitor.most_points_needed, axis=0)])

    def _moving_points(self, estimate: FloatArray, time_s: float) -> MovingPoints:
        c, s = math.cos(estimate[2]), math.sin(estimate[2])
        turn, found = np.array([[c, -s], [s, c]]), self.moving.moving(time_s)
        return MovingPoints((found.points - estimate[:2]) @ turn, found.velocities @ turn)

    def move(self, command: MonitoredCommand) -> None:
        self.late.append(command)
        asked = self.late.popleft()
        limits = MotionLimits()
        if asked.action == "stop":  # the arbiter publishes a hard stop, which the base executes with its own ramp
            hard = LimitsConfig().hard_decel_m_s2
            turning = 2.0 * hard / SkidSteerConfig().effective_width
            limits = replace(limits, max_linear_accel_m_s2=hard, max_angular_accel_rad_s2=turning)
        steering = self.robot.kinematics
        for _ in range(3):
            self.velocity = accelerate(self.velocity, asked.command, limits, DT_S / 3)
            self.robot.step(steering.motors_from_tracks(steering.tracks_from_twist(*self.velocity)), DT_S / 3)

    def _clearance(self, pose: FloatArray) -> float:
        """Return the distance in metres from the footprint's outline to the nearest static object."""
        outline = Footprint(worlds.LENGTH_M, worlds.WIDTH_M).points(0.05)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        index = self.mask.index(outline @ np.array([[c, s], [-s, c]]) + pose[:2])
        index = index.clip(0, np.array(self.mask.cells.shape) - 1)
        return float(self.distance[index[:, 0], index[:, 1]].min())


def run_episode(seed: int, index: int) -> Episode:
    """Run one drive; the same seed and index give the same result, except for times."""
    return FollowDrive(seed, index).run()


def prepare() -> None:
    """Compile the kernels, so that no episode includes the compile time."""
    warm_up()
    drive = FollowDrive(0, 0)
    for k in range(8):
        drive.step(k)


def evaluate(
    episodes: int,
    seed: int,
    jobs: int,
    on_episode: Callable[[Episode], None] = lambda episode: None,
    timeout_s: float = 3600.0,
) -> list[Episode]:
    """Run all episodes, ``jobs`` in parallel; with more than one job, each in its own process.

    Raises:
        ValueError: no episodes.
        TimeoutError: the episodes took longer than ``timeout_s``.
        RuntimeError: a process died.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1 (got {episodes})")
    tasks = [(seed, index) for index in range(episodes)]
    done: list[Episode] = []
    for episode in run_all(run_episode, tasks, jobs, prepare, timeout_s):
        done.append(episode)
        on_episode(episode)
    return sorted(done, key=lambda episode: episode.index)


def summary(episodes: list[Episode]) -> dict[str, Any]:
    """Return figures over all episodes, and whether the targets are met."""
    reachable = [e for e in episodes if e.reachable]
    reached = [e for e in reachable if e.reached]
    ratios = np.array([e.ratio for e in reached])
    slowness = np.array([e.seconds * OPERATOR_M_S / e.optimum_m for e in reached])
    metres = sum(e.driven_m for e in episodes)
    contacts = sum(e.contacts for e in episodes)
    share = len(reached) / len(reachable) if reachable else math.nan
    figures: dict[str, Any] = {
        "episodes": len(episodes),
        "reachable": len(reachable),
        "reached": len(reached),
        "reached_share": share,
        "contacts": contacts,
        "clearance_min_m": min(e.clearance_m for e in episodes),
        "path_ratio_mean": _reduced(np.mean, ratios),
        "path_ratio_max": _reduced(np.max, ratios),
        "time_ratio_max": _reduced(np.max, slowness),
        "metres": metres,
    }
    for name in ("planner", "controller", "costmap"):
        spent = np.concatenate([np.array(getattr(e, f"{name}_ms")) for e in episodes])
        figures[f"{name}_ms_p50"] = _reduced(np.median, spent)
        figures[f"{name}_ms_p99"] = _reduced(lambda r: np.percentile(r, 99), spent)
    figures["targets"] = {
        "contacts == 0": contacts == 0,
        "reached_share >= 0.97": bool(share >= 0.97),
        "time_ratio_max <= 3": bool(figures["time_ratio_max"] <= 3),
        "path_ratio_mean <= 1.2": bool(figures["path_ratio_mean"] <= 1.2),
        "planner_ms_p99 <= 50": bool(figures["planner_ms_p99"] <= 50),
        "controller_ms_p99 <= 10": bool(figures["controller_ms_p99"] <= 10),
        "costmap_ms_p99 <= 5": bool(figures["costmap_ms_p99"] <= 5),
    }
    return figures


def _reduced(measure: Callable[[FloatArray], Any], values: FloatArray) -> float:
    return float(measure(values)) if len(values) else math.nan


def report(episodes: list[Episode], seed: int) -> dict[str, Any]:
    """Return the summary and each episode without its tracks and times, ready for JSON."""
    left_out = {"tracks", "planner_ms", "controller_ms", "costmap_ms"}
    rows = []
    for episode in episodes:
        row = {key: value for key, value in asdict(episode).items() if key not in left_out}
        row["path_ratio"] = episode.ratio if episode.reached and episode.reachable else None
        rows.append(row)
    figures: dict[str, Any] = finite({"seed": seed, **summary(episodes), "each": rows})
    return figures


def plot(episodes: list[Episode], seed: int, path: Path, most: int = 12) -> None:
    """Write a PNG overview of episodes, the worst first: contacts, goals not reached, long paths."""

    def badness(e: Episode) -> tuple[float, ...]:
        missed = e.reachable and not e.reached
        return (e.contacts, float(missed), e.ratio if e.reachable else 0.0)

    shown = sorted(episodes, key=badness, reverse=True)[:most]
    columns = min(4, len(shown))
    rows = math.ceil(len(shown) / columns)
    figure, grid = new_figure(rows, columns, (4.4 * columns, 4.0 * rows))
    for axes, episode in zip(grid.flat, shown, strict=False):
        _plot_episode(axes, episode, FollowDrive(seed, episode.index))
    for axes in grid.flat[len(shown) :]:
        axes.set_axis_off()
    figure.suptitle("red: robot, blue: v-bot, dashed: shortest way; olive: low things, purple: hanging", fontsize=9)
    save_figure(figure, path)


def _plot_episode(axes: Any, episode: Episode, drive: FollowDrive) -> None:
    from matplotlib.patches import Rectangle

    for shape, kind in zip(drive.room.shapes, drive.room.kinds, strict=True):
        cx, cy, half_x, half_y, yaw = shape[:5]
        corner, size = (cx - half_x, cy - half_y), (2 * half_x, 2 * half_y)
        colour = ("0.25", "0.55", "tab:olive", "tab:purple")[int(kind)]
        axes.add_patch(Rectangle(corner, *size, angle=math.degrees(yaw), rotation_point="center", lw=0, color=colour))
    if drive.optimum is not None:
        axes.plot(*drive.optimum[:, :2].T, "k--", lw=0.8)
    for name, track in episode.tracks.items():
        colour, width = {"robot": ("tab:red", 1.6), "vbot": ("tab:blue", 1.0)}[name]
        axes.plot(*np.array(track).reshape(len(track), -1)[:, :2].T, color=colour, lw=width)
    axes.plot(*drive.room.start[:2], "o", color="tab:orange", ms=6)
    axes.plot(*drive.room.goal, "k*", ms=8)
    verdict = "reached" if episode.reached else ("not reached" if episode.reachable else "unreachable")
    ratio = f", {episode.ratio:.2f} × optimum" if episode.reachable and episode.reached else ""
    touched = f", {episode.contacts} contacts"
    axes.set_title(f"{episode.index}: {verdict}{ratio}{touched}, {episode.seconds:.0f} s", fontsize=8)
    width, height = drive.room.size
    axes.set(aspect="equal", xlim=(-0.3, width + 0.3), ylim=(-0.3, height + 0.3))
    axes.tick_params(labelsize=6)
