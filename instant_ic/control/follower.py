"""Path follower for a skid-steer robot: regulated pure pursuit, and tracking of a moving goal.

Source: Macenski, Singh, Martin, Gines: Regulated pure pursuit for robot path tracking, Autonomous Robots 47, 2023;
the tracking law is that of Kanayama et al., ICRA 1990.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import Plausible, check_ranges
from instant_ic.control.costmap import Costmap
from instant_ic.control.footprint import Footprint
from instant_ic.control.kinematics import MotionLimits
from instant_ic.control.planner import Plan
from instant_ic.geometry.motion import along_arc
from instant_ic.geometry.poses import relative2, wrap_angle

LOOKAHEAD_TIME_S = 1.0
"""Distance of the carrot, in seconds at the present speed."""
SCALING_MIN_RADIUS_M, SCALING_MIN_SPEED_M_S = 0.60, 0.05
"""The robot slows down in curves tighter than this radius, down to this speed."""
ROTATE_MIN_RAD, ROTATE_STOP_RAD = 0.8, 0.15
"""Bearings of the carrot above which the robot turns on the spot, and below which it drives on."""
ROTATE_GAIN = 2.0
"""Turn rate per radian of bearing, 1/s."""
APPROACH_DECEL_M_S2 = 0.4
"""Deceleration towards the end of the path."""
CHECKED_S = 1.0
"""Seconds of the arc to the carrot that are checked for collisions."""
PADDING_M = 0.01
"""Padding of the footprint in this check."""
GOAL_M, GOAL_RAD = 0.05, 0.05
"""Tolerance at the goal: well inside ``switch.position_m`` and ``switch.yaw_deg``."""
TRACK_DISTANCE_M = 0.6
"""Nearer to a moving v-bot than this, the r-bot follows the v-bot's own speed."""
BESIDE_M = 0.3
"""A moving goal nearer than this may be tracked off the path if the straight way to it is free."""
STANDS_BELOW = 0.05
"""m/s or rad/s; below this speed the v-bot counts as standing."""
TRACK_GAIN_X, TRACK_GAIN_Y, TRACK_GAIN_YAW = 1.5, 6.0, 3.0
"""Gains along the heading (1/s), across it (1/m²), and of the heading error (1/m)."""
CARROT_SHARES = (1.0, 0.7, 0.45, 0.25)
"""Shares of the lookahead that are tried in turn until the arc to the carrot is free."""


@dataclass(frozen=True)
class FollowerConfig:
    """Parameters, with the names of nav2's regulated pure pursuit where it has them.

    Attributes:
        desired_linear_vel: m/s; higher than the operator's usual 0.4, so that the r-bot catches up.
        min_lookahead_dist: m; shortest distance of the carrot.
        max_lookahead_dist: m; longest distance of the carrot.
    """

    desired_linear_vel: Annotated[float, Plausible(0.02, 3)] = 0.5
    min_lookahead_dist: Annotated[float, Plausible(0.05, 5)] = 0.30
    max_lookahead_dist: Annotated[float, Plausible(0.05, 5)] = 0.70

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
    """A follower of plans. Its only state is whether the robot turns on the spot, or is at the goal.

    Forward and backward stretches of the path are followed one after the other.
    """

    def __init__(self, config: FollowerConfig, limits: MotionLimits, footprint: Footprint | None = None) -> None:
        self.config = config
        self.limits = limits
        self._body = (footprint or Footprint()).points(0.045, PADDING_M)
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
        """Return the twist for the robot at ``pose`` (3,) at ``speed_m_s``; the goal is the plan's last pose.

        Args:
            pose: x, y, yaw in the frame of the plan.
            speed_m_s: the robot's speed.
            plan: newest plan; the robot stops if it is empty, or if any input is not finite.
            goal_velocity: velocity of the goal (m/s, rad/s) when it is a driving v-bot.
            costmap: costs by which arcs to the carrot are checked for collisions; None: no check.
        """
        if len(plan.poses) == 0 or not np.isfinite([*pose, speed_m_s, *goal_velocity]).all():
            return FollowerCommand((0.0, 0.0), "end")
        goal = plan.poses[-1]
        ahead, left, turn = (float(value) for value in relative2(pose, goal))
        distance = math.hypot(ahead, left)
        moving = plan.reached and max(abs(goal_velocity[0]), abs(goal_velocity[1])) > STANDS_BELOW
        near = distance < TRACK_DISTANCE_M and abs(turn) < 1.0
        # Tracking drives straight to the goal, so the path must be straight too. A goal close beside the robot is
        # tracked as well, because a manoeuvre does not pay for a moving goal.
        if (
            moving
            and near
            and (
                _remaining(pose, plan.poses) <= 1.15 * distance + 0.1
                or (distance < BESIDE_M and self._straight_is_free(pose, goal, costmap))
            )
        ):
            self.reset()
            return FollowerCommand(self._track(ahead, left, turn, goal_velocity), "track")
        self._at_goal = distance <= GOAL_M * (2.0 if self._at_goal else 1.0)
        if self._at_goal:
            if not plan.reached:
                return FollowerCommand((0.0, 0.0), "end")
            if abs(turn) <= GOAL_RAD:
                return FollowerCommand((0.0, 0.0), "arrived")
            return FollowerCommand((0.0, self._turn_rate(turn)), "align")
        return self._pursue(pose, speed_m_s, plan, costmap)

    def _track(self, ahead: float, left: float, turn: float, goal_velocity: tuple[float, float]) -> tuple[float, float]:
        """Apply the tracking law of Kanayama et al. (1990): the goal's twist, corrected by the robot's pose error."""
        linear, angular = goal_velocity
        v = linear * math.cos(turn) + TRACK_GAIN_X * ahead
        # abs, because the law is made for forward motion: backwards, the heading term would turn the robot away.
        w = angular + linear * TRACK_GAIN_Y * left + abs(linear) * TRACK_GAIN_YAW * math.sin(turn)
        most = self.config.desired_linear_vel
        return self.limits.clip(min(max(v, -most), most), w)

    def _pursue(
        self, pose: NDArray[np.float64], speed_m_s: float, plan: Plan, costmap: Costmap | None
    ) -> FollowerCommand:
        c = self.config
        path, back = _piece(pose, plan, GOAL_M)
        lookahead = min(max(abs(speed_m_s) * LOOKAHEAD_TIME_S, c.min_lookahead_dist), c.max_lookahead_dist)
        remaining = _remaining(pose, path)
        v = min(c.desired_linear_vel, math.sqrt(2.0 * APPROACH_DECEL_M_S2 * remaining))
        sign = -1.0 if back else 1.0
        for share in CARROT_SHARES:
            x, y, _ = (
                float(value) for value in relative2(pose, np.array([*_carrot(pose, path, share * lookahead), 0]))
            )
            bearing = math.atan2(sign * y, sign * x)
            if abs(bearing) > (ROTATE_STOP_RAD if self._rotating else ROTATE_MIN_RAD):
                if share > CARROT_SHARES[-1] and not self._turn_is_free(pose, bearing, costmap):
                    continue
                return self._rotate(pose, bearing, costmap)
            curvature = 2.0 * y / max(x * x + y * y, 1e-4)
            length = min(math.hypot(x, y), CHECKED_S * v)
            if self._arc_is_free(pose, sign * curvature, sign * length, costmap):
                break
        else:
            return FollowerCommand((0.0, 0.0), "blocked")
        self._rotating = False
        radius = 1.0 / abs(curvature) if curvature != 0.0 else math.inf
        v *= min(1.0, radius / SCALING_MIN_RADIUS_M)
        v = sign * max(v, SCALING_MIN_SPEED_M_S)
        return FollowerCommand(self.limits.clip(v, v * curvature), "reverse" if back else "pursue")

    def _rotate(self, pose: NDArray[np.float64], bearing: float, costmap: Costmap | None) -> FollowerCommand:
        """Turn on the spot, in the other direction if the shorter turn is blocked."""
        if not self._turn_is_free(pose, bearing, costmap):
            bearing -= math.copysign(2.0 * math.pi, bearing)
            if not self._turn_is_free(pose, bearing, costmap):
                return FollowerCommand((0.0, 0.0), "blocked")
        self._rotating = True
        return FollowerCommand((0.0, self._turn_rate(bearing)), "rotate")

    def _turn_is_free(self, pose: NDArray[np.float64], turn: float, costmap: Costmap | None) -> bool:
        count = max(2, math.ceil(abs(turn) / 0.12))
        poses = np.tile(np.asarray(pose, dtype=np.float64), (count + 1, 1))
        poses[:, 2] += turn * np.arange(count + 1) / count
        return self._is_free(poses, costmap)

    def _arc_is_free(
        self, pose: NDArray[np.float64], curvature: float, length_m: float, costmap: Costmap | None
    ) -> bool:
        count = max(2, math.ceil(abs(length_m) / 0.05))
        along = [length_m * k / count for k in range(count + 1)]
        x, y, yaw = pose.tolist()
        return self._is_free(np.array([along_arc(x, y, yaw, way, curvature * way) for way in along]), costmap)

    def _straight_is_free(self, pose: NDArray[np.float64], goal: NDArray[np.float64], costmap: Costmap | None) -> bool:
        turn = wrap_angle(float(goal[2] - pose[2]))
        share = np.linspace(0.0, 1.0, 6)[:, None]
        return self._is_free(pose + share * np.array([*(goal[:2] - pose[:2]), turn]), costmap)

    def _is_free(self, poses: NDArray[np.float64], costmap: Costmap | None) -> bool:
        """Return whether no pose overlaps more obstacles than the first pose, where the robot stands."""
        if costmap is None:
            return True
        overlap = costmap.lethal_overlap(poses, self._body)
        return bool((overlap <= overlap[0]).all())

    def _turn_rate(self, angle: float) -> float:
        rate = max(ROTATE_GAIN * abs(angle), 0.1)
        # The robot must be able to stop before it has turned by the whole angle.
        rate = min(rate, math.sqrt(self.limits.max_angular_accel_rad_s2 * abs(angle)))
        return math.copysign(min(rate, self.limits.max_angular_rad_s), angle)


def _piece(pose: NDArray[np.float64], plan: Plan, tolerance_m: float) -> tuple[NDArray[np.float64], bool]:
    """Return the next stretch of the path in one driving direction, and whether it is driven backwards."""
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
    """Return the first point (2,) of the path at least ``lookahead`` from the robot, after the point nearest to it."""
    away = np.linalg.norm(path[:, :2] - np.asarray(pose)[:2], axis=1)
    near = int(np.argmin(away))
    far = np.flatnonzero(away[near:] >= lookahead)
    return path[near + int(far[0]) if far.size else len(path) - 1, :2]


def _remaining(pose: NDArray[np.float64], path: NDArray[np.float64]) -> float:
    """Return metres from the robot along the path to its end."""
    away = np.linalg.norm(path[:, :2] - np.asarray(pose)[:2], axis=1)
    near = int(np.argmin(away))
    rest = float(np.linalg.norm(np.diff(path[near:, :2], axis=0), axis=1).sum())
    return max(rest, float(away[-1]))
