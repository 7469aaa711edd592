"""The v-bot: the robot that the operator drives in the virtual space (paper, III.A)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import Plausible, Range, check_ranges
from instant_ic.control.footprint import Footprint
from instant_ic.control.kinematics import MotionLimits, accelerate, move
from instant_ic.control.walls import WallMap
from instant_ic.geometry.poses import wrap_angle

_TRACK_M = 0.1
_WALL_CLEARANCE_M = 0.12
"""Distance kept between the v-bot's outline and a wall, so that the r-bot has room at the same place."""
_EASE_TIME_S = 0.25
"""Time constant of easing when the error is small."""
_LEAD_BACK_M_S, _LEAD_BACK_RAD_S = 0.2, math.radians(20.0)
"""Largest speed at which a v-bot without a driver goes back to the r-bot."""


@dataclass(frozen=True)
class VbotConfig:
    """Lead of the v-bot, and its easing onto the r-bot.

    Attributes:
        max_lead_m: largest lead over the r-bot, in metres.
        slow_lead_m: lead in metres above which the v-bot is slowed.
        trail_slow: share of its speed that the v-bot loses while the r-bot trails it: too little for the operator to
            notice, but enough to make the two meet metres sooner.
        trail_m: lead in metres at which trail_slow is reached.
        ease_m_s: largest speed in m/s, relative to the r-bot, at which the v-bot is eased onto it at the return.
        ease_deg_s: as ease_m_s, for the heading, in degrees/s.
    """

    max_lead_m: Annotated[float, Plausible(0.2, 30)] = 3.0
    slow_lead_m: Annotated[float, Plausible(0, 30)] = 1.0
    trail_slow: Annotated[float, Range(0, 0.5)] = 0.1
    trail_m: Annotated[float, Plausible(0.01, 5)] = 0.15
    ease_m_s: Annotated[float, Plausible(0.001, 1)] = 0.035
    ease_deg_s: Annotated[float, Plausible(0.1, 90)] = 6.0

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.slow_lead_m < self.max_lead_m:
            raise ValueError(f"slow_lead_m must be below max_lead_m = {self.max_lead_m} (got {self.slow_lead_m})")


class VirtualRobot:
    """A robot with the r-bot's kinematics and limits, which obstacles do not stop."""

    def __init__(self, config: VbotConfig, limits: MotionLimits, footprint: Footprint | None = None) -> None:
        self.config = config
        self.limits = limits
        self._body = (footprint or Footprint()).points(0.1)
        self.pose: NDArray[np.float64] = np.zeros(3)
        self.velocity: tuple[float, float] = (0.0, 0.0)
        self.slowed_by = ""
        """Reason why the last step was slower than commanded: ``lead``, ``wall`` or empty."""
        self._led_m_s = 0.0
        self._track: list[NDArray[np.float64]] = []  # driven places, ``_TRACK_M`` apart: the way back

    def place(self, pose: NDArray[np.float64], velocity: tuple[float, float]) -> None:
        """Place the v-bot at ``pose`` (x, y, yaw), moving at ``velocity`` (m/s, rad/s)."""
        self.pose = np.asarray(pose, dtype=np.float64).copy()
        self.velocity = self.limits.clip(*velocity)
        self.slowed_by = ""
        self._track = []

    def step(
        self,
        command: tuple[float, float],
        robot_pose: NDArray[np.float64],
        dt_s: float,
        walls: WallMap | None = None,
        speed_limit_m_s: float = math.inf,
    ) -> None:
        """Move by ``dt_s`` under the operator's command."""
        linear, angular = self.limits.clip(*command)
        slower = min(1.0, max(0.0, speed_limit_m_s) / max(abs(linear), 1e-9))  # in this order, NaN counts as 0
        linear, angular = linear * slower, angular * slower
        factor = self.lead_factor(linear, robot_pose)
        self.slowed_by = "lead" if factor < 1.0 - self.config.trail_slow else ""
        # A slowed command keeps its curvature, so that the v-bot stays on the operator's line.
        target = (linear * factor, angular * factor if linear != 0.0 else angular)
        if factor == 0.0:
            target = (0.0, angular)
        self.velocity = accelerate(self.velocity, target, self.limits, dt_s)
        pose = move(self.pose, self.velocity[0], self.velocity[1], dt_s)
        # Turning on the spot is never blocked, because a corner in a wall does less harm than controls that stick.
        if walls is not None and self.velocity[0] != 0.0 and self._into_wall(pose, walls):
            self.slowed_by = "wall"
            self.velocity = (0.0, self.velocity[1])
            pose = move(self.pose, 0.0, self.velocity[1], dt_s)
        self.pose = pose
        self._led_m_s = 0.0
        if not self._track or _distance(pose, self._track[-1]) > _TRACK_M:
            self._track.append(pose.copy())

    def ease(self, target: NDArray[np.float64], velocity: tuple[float, float], dt_s: float) -> None:
        """Move for ``dt_s`` at the r-bot's ``velocity`` (m/s, rad/s), and reduce the error to ``target`` (3,)."""
        config = self.config
        self.velocity = self.limits.clip(*velocity)
        moved = move(self.pose, *self.velocity, dt_s)
        share = min(1.0, dt_s / _EASE_TIME_S)
        self.pose = _eased(moved, target, share, config.ease_m_s * dt_s, math.radians(config.ease_deg_s) * dt_s)
        self.slowed_by = ""

    def lead_back(self, robot_pose: NDArray[np.float64], dt_s: float, walls: WallMap | None = None) -> None:
        """Go back towards the r-bot for ``dt_s``: straight, or along the driven track where a wall lies between."""
        while self._track and _distance(self.pose, self._track[-1]) < _TRACK_M:
            self._track.pop()
        straight = not self._track or walls is None or _in_sight(self.pose, robot_pose, walls)
        goal = np.asarray(robot_pose, dtype=np.float64) if straight else self._track[-1]
        self._led_m_s = min(_LEAD_BACK_M_S, self._led_m_s + 0.25 * self.limits.max_linear_accel_m_s2 * dt_s)
        share = min(1.0, dt_s / _EASE_TIME_S)
        self.pose = _eased(self.pose, goal, share, self._led_m_s * dt_s, _LEAD_BACK_RAD_S * dt_s)
        self.velocity = (0.0, 0.0)
        self.slowed_by = ""

    def lead_factor(self, linear: float, robot_pose: NDArray[np.float64]) -> float:
        """Return the factor on the linear speed: a little below 1 with a small lead, 0 at ``max_lead_m``.

        Only motion away from the r-bot is slowed. Motion towards it is free.
        """
        gap = self.pose[:2] - np.asarray(robot_pose)[:2]
        lead = float(math.hypot(gap[0], gap[1]))
        heading = np.array([math.cos(self.pose[2]), math.sin(self.pose[2])])
        if linear * float(heading @ gap) <= 0.0:
            return 1.0
        config = self.config
        left = (config.max_lead_m - lead) / (config.max_lead_m - config.slow_lead_m)
        return min(1.0, max(0.0, left)) * (1.0 - config.trail_slow * min(1.0, lead / config.trail_m))

    def _into_wall(self, pose: NDArray[np.float64], walls: WallMap) -> bool:
        now = float(walls.distance(_placed(self._body, self.pose)).min())
        then = float(walls.distance(_placed(self._body, pose)).min())
        return then < _WALL_CLEARANCE_M and then < now


def _distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(math.hypot(a[0] - b[0], a[1] - b[1]))


def _eased(
    pose: NDArray[np.float64], goal: NDArray[np.float64], share: float, most_m: float, most_rad: float
) -> NDArray[np.float64]:
    """Move ``pose`` (3,) towards ``goal`` by a share of the error, within the given limits."""
    gap, turn = np.asarray(goal)[:2] - pose[:2], wrap_angle(float(goal[2] - pose[2]))
    step = min(share, most_m / max(float(np.linalg.norm(gap)), 1e-9))
    turn = max(-most_rad, min(most_rad, share * turn))
    return np.array([*(pose[:2] + step * gap), wrap_angle(float(pose[2]) + turn)])


def _in_sight(a: NDArray[np.float64], b: NDArray[np.float64], walls: WallMap) -> bool:
    """Return whether no wall lies between two places."""
    steps = np.linspace(0.0, 1.0, max(2, math.ceil(_distance(a, b) / walls.static.resolution)))
    between = np.asarray(a)[:2] + steps[:, None] * (np.asarray(b)[:2] - np.asarray(a)[:2])
    return bool((walls.distance(between) > walls.static.resolution).all())


def _placed(body: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    placed: NDArray[np.float64] = body @ np.array([[c, s], [-s, c]]) + pose[:2]
    return placed
