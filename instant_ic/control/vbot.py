"""The v-bot: the robot that the operator drives in the virtual space (paper, III.A)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..ranges import NotNegative, Positive, check_ranges
from .footprint import Footprint
from .kinematics import MotionLimits, accelerate, clip_twist, move
from .walls import WallMap


@dataclass(frozen=True)
class VbotConfig:
    """How far the v-bot may draw ahead, and how near its outline comes to walls.

    The wall clearance leaves room for the r-bot at the same place, or the two could never meet there.
    """

    max_lead_m: Positive = 3.0
    slow_lead_m: NotNegative = 1.0
    wall_clearance_m: NotNegative = 0.12

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.slow_lead_m < self.max_lead_m:
            raise ValueError(f"slow_lead_m must be below max_lead_m = {self.max_lead_m} (got {self.slow_lead_m})")


class VirtualRobot:
    """The r-bot's kinematics and limits, without the r-bot's obstacles."""

    def __init__(self, config: VbotConfig, limits: MotionLimits, footprint: Footprint | None = None) -> None:
        self.config = config
        self.limits = limits
        self._body = (footprint or Footprint()).points(0.1)
        self.pose: NDArray[np.float64] = np.zeros(3)
        self.velocity: tuple[float, float] = (0.0, 0.0)
        self.slowed_by = ""
        """Why the last step was slower than commanded: ``lead``, ``wall`` or empty."""

    def place(self, pose: NDArray[np.float64], velocity: tuple[float, float]) -> None:
        """Puts the v-bot at ``pose`` (x, y, yaw), moving at ``velocity`` (m/s, rad/s)."""
        self.pose = np.asarray(pose, dtype=np.float64).copy()
        self.velocity = clip_twist(*velocity, self.limits)
        self.slowed_by = ""

    def step(
        self,
        command: tuple[float, float],
        robot_pose: NDArray[np.float64],
        dt_s: float,
        walls: WallMap | None = None,
    ) -> NDArray[np.float64]:
        """Moves by ``dt_s`` under the operator's command; returns the new pose (3,) in the map frame."""
        linear, angular = clip_twist(*command, self.limits)
        factor = self.lead_factor(linear, robot_pose)
        self.slowed_by = "lead" if factor < 1.0 else ""
        # Curvature is kept, as far as the v-bot moves: the operator's line stays the same line.
        target = (linear * factor, angular * factor if linear != 0.0 else angular)
        if factor == 0.0:
            target = (0.0, angular)
        self.velocity = accelerate(self.velocity, target, self.limits, dt_s)
        pose = move(self.pose, self.velocity[0], self.velocity[1], dt_s)
        # Turning on the spot is never held: a corner that grazes a wall is less harm than controls that stick.
        if walls is not None and self.velocity[0] != 0.0 and self._into_wall(pose, walls):
            self.slowed_by = "wall"
            self.velocity = (0.0, self.velocity[1])
            pose = move(self.pose, 0.0, self.velocity[1], dt_s)
        self.pose = pose
        return pose

    def lead_factor(self, linear: float, robot_pose: NDArray[np.float64]) -> float:
        """Share of the linear speed that is left: 1 up to ``slow_lead_m``, 0 at ``max_lead_m``.

        Only what draws the two apart is slowed; back towards the r-bot the v-bot drives freely.
        """
        gap = self.pose[:2] - np.asarray(robot_pose)[:2]
        lead = float(math.hypot(gap[0], gap[1]))
        heading = np.array([math.cos(self.pose[2]), math.sin(self.pose[2])])
        if lead <= self.config.slow_lead_m or linear * float(heading @ gap) <= 0.0:
            return 1.0
        left = (self.config.max_lead_m - lead) / (self.config.max_lead_m - self.config.slow_lead_m)
        return max(0.0, left)

    def _into_wall(self, pose: NDArray[np.float64], walls: WallMap) -> bool:
        now = float(walls.distance(_placed(self._body, self.pose)).min())
        then = float(walls.distance(_placed(self._body, pose)).min())
        return then < self.config.wall_clearance_m and then < now


def _placed(body: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    placed: NDArray[np.float64] = body @ np.array([[c, s], [-s, c]]) + pose[:2]
    return placed
