"""Collision monitor: the last thing before ``/cmd_vel`` (nav2_collision_monitor's ``approach`` and ``stop``).

It looks at the newest scan and the true footprint; what is too near for the LiDAR to see is the costmap's memory
(``blind_radius_m``), which the caller adds to the points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..ranges import NotNegative, Positive, PositiveInt, check_ranges
from .footprint import Footprint


@dataclass(frozen=True)
class CollisionMonitorConfig:
    """Time to collision at which the robot slows down and stops."""

    time_before_collision: Positive = 1.2
    stop_time_s: NotNegative = 0.1
    simulation_time_step: Positive = 0.05
    padding_m: NotNegative = 0.04
    min_points: PositiveInt = 2
    blind_radius_m: NotNegative = 0.45

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.stop_time_s < self.time_before_collision:
            raise ValueError(f"stop_time_s must be below time_before_collision (got {self.stop_time_s})")


@dataclass(frozen=True)
class MonitoredCommand:
    """A command that may be sent."""

    command: tuple[float, float]
    action: str
    """``free``, ``approach`` (slowed) or ``stop``."""
    time_to_collision_s: float
    """For the command as asked; inf when nothing is met within ``time_before_collision``."""


class CollisionMonitor:
    """Slows a command down in proportion to its time to collision, to zero at the obstacle."""

    def __init__(self, config: CollisionMonitorConfig, footprint: Footprint) -> None:
        self.config = config
        self.footprint = footprint

    def limit(self, command: tuple[float, float], points: NDArray[np.float64]) -> MonitoredCommand:
        """The command (m/s, rad/s) as it may be sent, given scan hits (N, 2) in ``base_link``, now.

        Linear and angular speed are cut by one factor, so that the robot stays on the arc that was looked at. A
        robot that is in contact already may move so that the contact gets less.
        """
        linear, angular = command
        if not (math.isfinite(linear) and math.isfinite(angular)):
            return MonitoredCommand((0.0, 0.0), "stop", 0.0)
        if (linear == 0.0 and angular == 0.0) or len(points) < self.config.min_points:
            return MonitoredCommand(command, "free", math.inf)
        half = np.array([self.footprint.length_m, self.footprint.width_m]) / 2.0 + self.config.padding_m
        reach = math.hypot(*half) + abs(linear) * self.config.time_before_collision + 0.05
        near = np.ascontiguousarray(points[(points**2).sum(axis=1) < reach**2], dtype=np.float64)
        time_s = float(
            _time_to_collision(
                near,
                linear,
                angular,
                float(half[0]),
                float(half[1]),
                self.config.simulation_time_step,
                self.config.time_before_collision,
                self.config.min_points,
            )
        )
        if math.isinf(time_s):
            return MonitoredCommand(command, "free", time_s)
        if time_s <= self.config.stop_time_s:
            return MonitoredCommand((0.0, 0.0), "stop", time_s)
        factor = time_s / self.config.time_before_collision
        return MonitoredCommand((linear * factor, angular * factor), "approach", time_s)


@njit(cache=True)
def _time_to_collision(
    points: NDArray[np.float64],
    linear: float,
    angular: float,
    half_length: float,
    half_width: float,
    step: float,
    horizon: float,
    min_points: int,
) -> float:
    """Start of the first step in which at least ``min_points`` points go (deeper) into the footprint."""
    depth = np.empty(points.shape[0])
    for j in range(points.shape[0]):
        depth[j] = min(half_length - abs(points[j, 0]), half_width - abs(points[j, 1]))
    for k in range(1, math.ceil(horizon / step) + 1):
        turn = angular * step * k
        if abs(turn) > 1e-9:
            radius = linear / angular
            x, y = radius * math.sin(turn), radius * (1.0 - math.cos(turn))
        else:
            x, y = linear * step * k, 0.0
        c, s = math.cos(turn), math.sin(turn)
        inside = 0
        for j in range(points.shape[0]):
            dx, dy = points[j, 0] - x, points[j, 1] - y
            new_depth = min(half_length - abs(c * dx + s * dy), half_width - abs(c * dy - s * dx))
            if new_depth > 0.0 and new_depth > depth[j] + 1e-3:
                inside += 1
        if inside >= min_points:
            return step * (k - 1)
    return np.inf
