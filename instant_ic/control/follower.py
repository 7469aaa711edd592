"""Path follower for a skid-steer robot: regulated pure pursuit, and tracking of a moving goal.

Source: Macenski, Singh, Martin, Gines: Regulated pure pursuit for robot path tracking, Autonomous Robots 47, 2023;
the tracking law is that of Kanayama et al., ICRA 1990.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import Positive, check_ranges
from instant_ic.control.costmap import Costmap
from instant_ic.control.footprint import Footprint
from instant_ic.control.kinematics import MotionLimits
from instant_ic.control.planner import Plan
from instant_ic.geometry.poses import relative2, wrap_angle

_BESIDE_M = 0.3
"""A moving goal nearer than this may be tracked off the path, if the straight way to it is free."""

CARROT_SHARES = (1.0, 0.7, 0.45, 0.25)
"""Shares of the lookahead that are tried in turn while the arc to the carrot would touch something."""


@dataclass(frozen=True)
class FollowerConfig:
    """Parameters, with the names of nav2's regulated pure pursuit where it has them.

    Attributes:
        desired_linear_vel: m/s; above the operator's usual 0.4, so that the r-bot catches up.
        lookahead_dist: m; used if use_velocity_scaled_lookahead_dist is false.
        use_velocity_scaled_lookahead_dist: the carrot is lookahead_time ahead.
        lookahead_time: s.
        min_lookahead_dist: m.
        max_lookahead_dist: m.
        regulated_linear_scaling_min_radius: m; slower in tighter curves.
        regulated_linear_scaling_min_speed: m/s; lower limit of that slowing.
        use_rotate_to_heading: turn on the spot if the carrot is far to the side.
        rotate_to_heading_min_angle: rad; bearing of the carrot above which the robot turns on the spot.
        rotate_to_heading_stop_angle: rad; bearing below which it drives on.
        rotate_to_heading_gain: 1/s.
        approach_decel_m_s2: m/s²; braking towards the end of the path.
        use_collision_detection: a nearer carrot is used if the arc to it would touch something.
        max_allowed_time_to_collision_up_to_carrot: s of that arc that are checked.
        collision_padding_m: m round the footprint in this check.
        xy_goal_tolerance: m; well inside switch.position_m.
        yaw_goal_tolerance: rad; well inside switch.yaw_deg.
        track_distance_m: m; nearer than this to a moving v-bot, its own speed is followed.
        track_min_speed_m_s: m/s (rad/s); below this speed the v-bot counts as standing.
        track_gain_x: 1/s; along the heading.
        track_gain_y: 1/m²; across.
        track_gain_yaw: 1/m.
    """

    desired_linear_vel: Positive = 0.5
    lookahead_dist: Positive = 0.5
    use_velocity_scaled_lookahead_dist: bool = True
    lookahead_time: Positive = 1.0
    min_lookahead_dist: Positive = 0.30
    max_lookahead_dist: Positive = 0.70
    regulated_linear_scaling_min_radius: Positive = 0.60
    regulated_linear_scaling_min_speed: Positive = 0.05
    use_rotate_to_heading: bool = True
    rotate_to_heading_min_angle: Positive = 0.8
    rotate_to_heading_stop_angle: Positive = 0.15
    rotate_to_heading_gain: Positive = 2.0
    approach_decel_m_s2: Positive = 0.4
    use_collision_detection: bool = True
    max_allowed_time_to_collision_up_to_carrot: Positive = 1.0
    collision_padding_m: Positive = 0.01
    xy_goal_tolerance: Positive = 0.05
    yaw_goal_tolerance: Positive = 0.05
    track_distance_m: Positive = 0.6
    track_min_speed_m_s: Positive = 0.05
    track_gain_x: Positive = 1.5
    track_gain_y: Positive = 6.0
    track_gain_yaw: Positive = 3.0

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.min_lookahead_dist > self.max_lookahead_dist:
            raise ValueError(f"min_lookahead_dist must be <= max_lookahead_dist (got {self.min_lookahead_dist})")


@dataclass(frozen=True)
class FollowerCommand:
    """Twist (m/s, rad/s) and the follower's activity."""

    command: tuple[float, float]
    state: str
    """``track``, ``pursue``, ``reverse``, ``rotate``, ``align``, ``arrived``, ``end`` or ``blocked``."""


class PathFollower:
    """Follows a plan; its only state is whether it turns on the spot or stands at the goal.

    Forward and backward stretches of the path are followed one after the other.
    """

    def __init__(self, config: FollowerConfig, limits: MotionLimits, footprint: Footprint | None = None) -> None:
        self.config = config
        self.limits = limits
        self._body = (footprint or Footprint()).points(0.045, config.collision_padding_m)
        self.reset()

    def reset(self) -> None:
        """Forget the last path."""
        self._rotating = False
        self._at_goal = False

    def step(
        self,
        pose: NDArray[np.float64],
        speed_m_s: float,
        plan: Plan,
        goal_velocity: tuple[float, float] = (0.0, 0.0),
        costmap: Costmap | None = None,
    ) -> FollowerCommand:
        """Twist for the robot at ``pose`` (3,) at ``speed_m_s``; the goal is the plan's last pose.

        Args:
            pose: x, y, yaw in the frame of the plan.
            speed_m_s: the robot's speed.
            plan: newest plan; an empty one stops the robot.
            goal_velocity: velocity of the goal (m/s, rad/s) when it is a driving v-bot.
            costmap: checks arcs to the carrot for collisions; None: no check.
        """
        c = self.config
        if len(plan.poses) == 0:
            return FollowerCommand((0.0, 0.0), "end")
        goal = plan.poses[-1]
        ahead, left, turn = (float(value) for value in relative2(pose, goal))
        distance = math.hypot(ahead, left)
        moving = plan.reached and max(abs(goal_velocity[0]), abs(goal_velocity[1])) > c.track_min_speed_m_s
        near = distance < c.track_distance_m and abs(turn) < 1.0
        # Tracking drives straight at the goal: only where the path does so too, not round a corner. A path to a goal
        # that is very near but not ahead is a manoeuvre, which is not worth it for a moving goal.
        if (
            moving
            and near
            and (
                _remaining(pose, plan.poses) <= 1.15 * distance + 0.1
                or (distance < _BESIDE_M and self._straight_is_free(pose, goal, costmap))
            )
        ):
            self.reset()
            return FollowerCommand(self._track(ahead, left, turn, goal_velocity), "track")
        tolerance = c.xy_goal_tolerance * (2.0 if self._at_goal else 1.0)
        self._at_goal = distance <= tolerance
        if self._at_goal:
            if not plan.reached:
                return FollowerCommand((0.0, 0.0), "end")
            if abs(turn) <= c.yaw_goal_tolerance:
                return FollowerCommand((0.0, 0.0), "arrived")
            return FollowerCommand((0.0, self._turn_rate(turn)), "align")
        return self._pursue(pose, speed_m_s, plan, costmap if c.use_collision_detection else None)

    def _track(self, ahead: float, left: float, turn: float, goal_velocity: tuple[float, float]) -> tuple[float, float]:
        """Tracking law of Kanayama et al. (1990): the goal's own twist plus the error in the robot's frame."""
        c = self.config
        linear, angular = goal_velocity
        v = linear * math.cos(turn) + c.track_gain_x * ahead
        w = angular + linear * (c.track_gain_y * left + c.track_gain_yaw * math.sin(turn))
        return self.limits.clip(self._cap(v), w)

    def _pursue(
        self, pose: NDArray[np.float64], speed_m_s: float, plan: Plan, costmap: Costmap | None
    ) -> FollowerCommand:
        c = self.config
        path, back = _piece(pose, plan, c.xy_goal_tolerance)
        lookahead = c.lookahead_dist
        if c.use_velocity_scaled_lookahead_dist:
            lookahead = min(max(abs(speed_m_s) * c.lookahead_time, c.min_lookahead_dist), c.max_lookahead_dist)
        remaining = _remaining(pose, path)
        v = min(c.desired_linear_vel, math.sqrt(2.0 * c.approach_decel_m_s2 * remaining))
        sign = -1.0 if back else 1.0
        for share in CARROT_SHARES:
            x, y, _ = (
                float(value) for value in relative2(pose, np.array([*_carrot(pose, path, share * lookahead), 0]))
            )
            bearing = math.atan2(sign * y, sign * x)
            limit = c.rotate_to_heading_stop_angle if self._rotating else c.rotate_to_heading_min_angle
            if c.use_rotate_to_heading and abs(bearing) > limit:
                if share > CARROT_SHARES[-1] and not self._turn_is_free(pose, bearing, costmap):
                    continue
                return self._rotate(pose, bearing, costmap)
            curvature = 2.0 * y / max(x * x + y * y, 1e-4)
            length = min(math.hypot(x, y), c.max_allowed_time_to_collision_up_to_carrot * v)
            if self._arc_is_free(pose, sign * curvature, sign * length, costmap):
                break
        else:
            return FollowerCommand((0.0, 0.0), "blocked")
        self._rotating = False
        radius = 1.0 / abs(curvature) if curvature != 0.0 else math.inf
        v *= min(1.0, radius / c.regulated_linear_scaling_min_radius)
        v = sign * max(v, c.regulated_linear_scaling_min_speed)
        return FollowerCommand(self.limits.clip(v, v * curvature), "reverse" if back else "pursue")

    def _rotate(self, pose: NDArray[np.float64], bearing: float, costmap: Costmap | None) -> FollowerCommand:
        """Turn on the spot; the other way round if the shorter turn is blocked."""
        if not self._turn_is_free(pose, bearing, costmap):
            bearing -= math.copysign(2.0 * math.pi, bearing)
            if not self._turn_is_free(pose, bearing, costmap):
                return FollowerCommand((0.0, 0.0), "blocked")
        self._rotating = True
        return FollowerCommand((0.0, self._turn_rate(bearing)), "rotate")

    def _turn_is_free(self, pose: NDArray[np.float64], turn: float, costmap: Costmap | None) -> bool:
        if costmap is None:
            return True
        count = max(2, math.ceil(abs(turn) / 0.12))
        poses = np.tile(np.asarray(pose, dtype=np.float64), (count + 1, 1))
        poses[:, 2] += turn * np.arange(count + 1) / count
        return self._is_free(poses, costmap)

    def _arc_is_free(
        self, pose: NDArray[np.float64], curvature: float, length_m: float, costmap: Costmap | None
    ) -> bool:
        if costmap is None:
            return True
        count = max(2, math.ceil(abs(length_m) / 0.05))
        along = length_m * np.arange(count + 1) / count
        turn = curvature * along
        chord, heading = along * np.sinc(turn / (2.0 * math.pi)), pose[2] + 0.5 * turn
        x, y = pose[0] + chord * np.cos(heading), pose[1] + chord * np.sin(heading)
        return self._is_free(np.stack([x, y, pose[2] + turn], axis=1), costmap)

    def _straight_is_free(self, pose: NDArray[np.float64], goal: NDArray[np.float64], costmap: Costmap | None) -> bool:
        if costmap is None:
            return True
        turn = wrap_angle(float(goal[2] - pose[2]))
        share = np.linspace(0.0, 1.0, 6)[:, None]
        return self._is_free(pose + share * np.array([*(goal[:2] - pose[:2]), turn]), costmap)

    def _is_free(self, poses: NDArray[np.float64], costmap: Costmap) -> bool:
        """Whether no pose overlaps more obstacle points than the first one, where the robot stands."""
        overlap = costmap.lethal_overlap(poses, self._body)
        return bool((overlap <= overlap[0]).all())

    def _turn_rate(self, angle: float) -> float:
        rate = max(self.config.rotate_to_heading_gain * abs(angle), 0.1)
        # Never faster than the robot can stop before the angle is reached.
        rate = min(rate, math.sqrt(self.limits.max_angular_accel_rad_s2 * abs(angle)))
        return math.copysign(min(rate, self.limits.max_angular_rad_s), angle)

    def _cap(self, linear: float) -> float:
        return min(max(linear, -self.config.desired_linear_vel), self.config.desired_linear_vel)


def _piece(pose: NDArray[np.float64], plan: Plan, tolerance_m: float) -> tuple[NDArray[np.float64], bool]:
    """The next part of the path with one driving direction, from the robot on; and whether it is driven backwards."""
    if len(plan.reverse) != len(plan.poses) or len(plan.poses) < 2:
        return plan.poses, False
    # A turn on the spot belongs to the piece that follows it.
    moves = np.linalg.norm(np.diff(plan.poses[:, :2], axis=0), axis=1) > 1e-6
    changes = np.flatnonzero(moves)
    if changes.size == 0:
        return plan.poses, False
    directions = plan.reverse[1:][changes]
    breaks = np.flatnonzero(np.diff(directions)) + 1
    first = 0
    for end in [*breaks, len(directions)]:
        piece = plan.poses[(changes[first] if first else 0) : changes[end - 1] + 2]
        if end == len(directions) or float(np.linalg.norm(piece[-1, :2] - pose[:2])) > tolerance_m:
            return piece, bool(directions[first])
        first = end
    raise AssertionError("the last piece is always taken")


def _carrot(pose: NDArray[np.float64], path: NDArray[np.float64], lookahead: float) -> NDArray[np.float64]:
    """Point (2,) of the path at distance ``lookahead`` from the robot, past its nearest point."""
    away = np.linalg.norm(path[:, :2] - np.asarray(pose)[:2], axis=1)
    near = int(np.argmin(away))
    far = np.flatnonzero(away[near:] >= lookahead)
    return path[near + int(far[0]) if far.size else len(path) - 1, :2]


def _remaining(pose: NDArray[np.float64], path: NDArray[np.float64]) -> float:
    """Metres from the robot along the path to its end."""
    away = np.linalg.norm(path[:, :2] - np.asarray(pose)[:2], axis=1)
    near = int(np.argmin(away))
    rest = float(np.linalg.norm(np.diff(path[near:, :2], axis=0), axis=1).sum())
    return max(rest, float(away[-1]))
