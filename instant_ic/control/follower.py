"""Path follower for a skid-steer robot: regulated pure pursuit, with tracking of a goal that moves."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.poses import relative2
from .kinematics import MotionLimits, clip_twist
from .planner import Plan


@dataclass(frozen=True)
class FollowerConfig:
    """Parameters; those that nav2's regulated pure pursuit has carry its names."""

    desired_linear_vel: float = 0.5
    lookahead_time: float = 1.0
    min_lookahead_dist: float = 0.30
    max_lookahead_dist: float = 0.70
    regulated_linear_scaling_min_radius: float = 0.60
    rotate_to_heading_min_angle: float = 0.8
    rotate_to_heading_stop_angle: float = 0.15
    rotate_to_heading_gain: float = 2.0
    approach_decel_m_s2: float = 0.4
    xy_goal_tolerance: float = 0.05
    yaw_goal_tolerance: float = 0.05
    reverse_distance_m: float = 0.6
    track_distance_m: float = 0.6
    track_min_speed_m_s: float = 0.05
    track_gain_x: float = 1.5
    track_gain_y: float = 6.0
    track_gain_yaw: float = 3.0

    def __post_init__(self) -> None:
        for key, value in vars(self).items():
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"follower.{key} must be > 0 (got {value})")
        if self.min_lookahead_dist > self.max_lookahead_dist:
            raise ValueError(
                f"follower.min_lookahead_dist must be <= max_lookahead_dist (got {self.min_lookahead_dist})"
            )


@dataclass(frozen=True)
class FollowerCommand:
    """Twist (m/s, rad/s) and what the follower is doing."""

    command: tuple[float, float]
    state: str
    """``track``, ``pursue``, ``reverse``, ``rotate``, ``align``, ``arrived`` or ``end``."""


class PathFollower:
    """Follows a plan; keeps no time, only whether it is turning on the spot or at the goal."""

    def __init__(self, config: FollowerConfig, limits: MotionLimits) -> None:
        self.config = config
        self.limits = limits
        self.reset()

    def reset(self) -> None:
        """Forgets the last path."""
        self._rotating = False
        self._at_goal = False

    def step(
        self,
        pose: NDArray[np.float64],
        speed_m_s: float,
        plan: Plan,
        goal_velocity: tuple[float, float] = (0.0, 0.0),
    ) -> FollowerCommand:
        """Twist for the robot at ``pose`` (3,) driving ``speed_m_s``; the goal is the plan's last pose.

        Args:
            pose: x, y, yaw in the frame of the plan.
            speed_m_s: the robot's own.
            plan: newest plan; an empty one stops the robot.
            goal_velocity: of the goal itself (m/s, rad/s), when it is the v-bot driving on.
        """
        c = self.config
        if len(plan.poses) == 0:
            return FollowerCommand((0.0, 0.0), "end")
        goal = plan.poses[-1]
        ahead, left, turn = (float(value) for value in relative2(pose, goal))
        distance = math.hypot(ahead, left)
        moving = plan.reached and max(abs(goal_velocity[0]), abs(goal_velocity[1])) > c.track_min_speed_m_s
        near = distance < c.track_distance_m and abs(turn) < 1.0
        # Tracking drives straight at the goal: only where the path does so too, not round a corner.
        if moving and near and _remaining(pose, plan.poses) <= 1.15 * distance + 0.1:
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
        return self._pursue(pose, speed_m_s, plan, distance)

    def _track(self, ahead: float, left: float, turn: float, goal_velocity: tuple[float, float]) -> tuple[float, float]:
        """Tracking law of Kanayama et al. (1990): the goal's own twist plus the error in the robot's frame."""
        c = self.config
        linear, angular = goal_velocity
        v = linear * math.cos(turn) + c.track_gain_x * ahead
        w = angular + linear * (c.track_gain_y * left + c.track_gain_yaw * math.sin(turn))
        return clip_twist(self._cap(v), w, self.limits)

    def _pursue(self, pose: NDArray[np.float64], speed_m_s: float, plan: Plan, distance: float) -> FollowerCommand:
        c = self.config
        lookahead = min(max(abs(speed_m_s) * c.lookahead_time, c.min_lookahead_dist), c.max_lookahead_dist)
        carrot, remaining = _carrot(pose, plan.poses, lookahead)
        x, y, _ = (float(value) for value in relative2(pose, np.array([*carrot, 0.0])))
        bearing = math.atan2(y, x)
        back = plan.reached and distance < c.reverse_distance_m and abs(bearing) > 2.0 and not self._rotating
        off = math.remainder(bearing - math.pi, 2 * math.pi) if back else bearing
        if abs(off) > (c.rotate_to_heading_stop_angle if self._rotating else c.rotate_to_heading_min_angle):
            self._rotating = True
            return FollowerCommand((0.0, self._turn_rate(off)), "rotate")
        self._rotating = False
        curvature = 2.0 * y / max(x * x + y * y, 1e-4)
        v = min(c.desired_linear_vel, math.sqrt(2.0 * c.approach_decel_m_s2 * remaining))
        radius = 1.0 / abs(curvature) if curvature != 0.0 else math.inf
        v *= min(1.0, radius / c.regulated_linear_scaling_min_radius)
        v = max(v, 0.05) * (-1.0 if back else 1.0)
        return FollowerCommand(clip_twist(v, v * curvature, self.limits), "reverse" if back else "pursue")

    def _turn_rate(self, angle: float) -> float:
        rate = max(self.config.rotate_to_heading_gain * abs(angle), 0.1)
        # Never faster than it can be stopped again before the angle is reached.
        rate = min(rate, math.sqrt(self.limits.max_angular_accel_rad_s2 * abs(angle)))
        return math.copysign(min(rate, self.limits.max_angular_rad_s), angle)

    def _cap(self, linear: float) -> float:
        return min(max(linear, -self.config.desired_linear_vel), self.config.desired_linear_vel)


def _carrot(
    pose: NDArray[np.float64], path: NDArray[np.float64], lookahead: float
) -> tuple[NDArray[np.float64], float]:
    """Point (2,) of the path ``lookahead`` from the robot, past its nearest point; and metres left to the end."""
    away = np.linalg.norm(path[:, :2] - np.asarray(pose)[:2], axis=1)
    near = int(np.argmin(away))
    far = np.flatnonzero(away[near:] >= lookahead)
    index = near + int(far[0]) if far.size else len(path) - 1
    return path[index, :2], _remaining(pose, path)


def _remaining(pose: NDArray[np.float64], path: NDArray[np.float64]) -> float:
    """Metres from the robot along the path to its end."""
    away = np.linalg.norm(path[:, :2] - np.asarray(pose)[:2], axis=1)
    near = int(np.argmin(away))
    rest = float(np.linalg.norm(np.diff(path[near:, :2], axis=0), axis=1).sum())
    return max(rest, float(away[-1]))
