"""Collision monitor: the last step before ``/cmd_vel`` (after nav2_collision_monitor).

It checks the newest scan and 3D points against the true footprint, on the path of the robot from its present speed to
the commanded one. The caller adds things that are too near or too low to be seen, from the costmap's memory
(``blind_radius_m``, ``memory_range_m``), and people with their velocity (``moving.py``).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.config.ranges import Checked, Plausible, check_ranges
from instant_ic.control.footprint import Footprint
from instant_ic.control.kinematics import MotionLimits
from instant_ic.control.moving import MOST_SPEED_M_S, NOTHING_MOVES, MovingPoints
from instant_ic.geometry.motion import along_arc, step_towards

_along_arc = njit(cache=True)(along_arc)
_step_towards = njit(cache=True)(step_towards)

STEP_S = 0.05
"""Seconds between the simulated poses."""


@dataclass(frozen=True)
class PolygonConfig(Checked):
    """A padded footprint that is checked for points inside.

    Attributes:
        enabled: check the polygon.
        padding_m: m round the footprint.
        min_points: smallest number of points inside at which the polygon counts as occupied.
    """

    enabled: bool = True
    padding_m: Annotated[float, Plausible(0, 2)] = 0.02
    min_points: Annotated[int, Plausible(1, 10)] = 2


@dataclass(frozen=True)
class SlowdownConfig(PolygonConfig):
    """The polygon in which the robot is slower.

    Attributes:
        slowdown_ratio: share of the command that remains.
    """

    padding_m: Annotated[float, Plausible(0, 2)] = 0.10
    slowdown_ratio: Annotated[float, Plausible(0.05, 1)] = 0.6


@dataclass(frozen=True)
class ApproachConfig(PolygonConfig):
    """The polygon whose contact with obstacles is predicted.

    Attributes:
        time_before_collision: seconds to contact below which the command is slowed in proportion.
        stop_time_s: seconds to contact at which the command becomes zero.
        moving_stop_time_s: as stop_time_s, for a person or another moving thing; the robot has stopped by the contact.
    """

    padding_m: Annotated[float, Plausible(0, 2)] = 0.04
    time_before_collision: Annotated[float, Plausible(0.2, 10)] = 1.2
    stop_time_s: Annotated[float, Plausible(0, 5)] = 0.1
    moving_stop_time_s: Annotated[float, Plausible(0, 5)] = 0.6

    def __post_init__(self) -> None:
        check_ranges(self)
        for name in ("stop_time_s", "moving_stop_time_s"):
            if not getattr(self, name) < self.time_before_collision:
                raise ValueError(f"{name} must be below time_before_collision (got {getattr(self, name)})")


@dataclass(frozen=True)
class CollisionMonitorConfig(Checked):
    """Polygons, of which the most restrictive wins, and the largest age of their points.

    Attributes:
        source_timeout: s; older scans or points stop the robot.
        blind_radius_m: m; nearer than this the LiDAR sees nothing, and the costmap's lethal cells count; 0: off.
        memory_range_m: m; marks of 3D points count within this range, even if no sensor sees them now; 0: off.
        stop: command zero while something is inside and the command leads deeper.
        slowdown: slower command while something is inside.
        approach: command slowed in proportion before a contact within time_before_collision.
    """

    source_timeout: Annotated[float, Plausible(0.05, 2)] = 0.5
    blind_radius_m: Annotated[float, Plausible(0, 2)] = 0.45
    memory_range_m: Annotated[float, Plausible(0, 10)] = 2.5
    stop: PolygonConfig = field(default_factory=PolygonConfig)
    slowdown: SlowdownConfig = field(default_factory=SlowdownConfig)
    approach: ApproachConfig = field(default_factory=ApproachConfig)

    def polygons(self) -> dict[str, PolygonConfig]:
        """Return the enabled polygons, by name."""
        named: dict[str, PolygonConfig] = {"stop": self.stop, "slowdown": self.slowdown, "approach": self.approach}
        return {name: polygon for name, polygon in named.items() if polygon.enabled}


@dataclass(frozen=True)
class MonitoredCommand:
    """A command that may be sent."""

    command: tuple[float, float]
    action: str
    """``free``, ``slowdown``, ``approach`` (slowed in proportion to the time to collision) or ``stop``."""
    time_to_collision_s: float
    """Time to collision of the requested command; inf without contact within ``time_before_collision``."""
    polygon: str = ""
    """Name of the deciding polygon; ``source_timeout`` when the points are too old."""


@dataclass(frozen=True)
class _Polygon:
    name: str
    config: PolygonConfig
    normals: NDArray[np.float64]
    """(E, 2) outward normals of the edges."""
    offsets: NDArray[np.float64]
    """(E,) distances of the edges from the origin; a point is inside if normals @ point < offsets."""
    reach: float


class CollisionMonitor:
    """The check that reduces a command to the share that every polygon allows.

    Linear and angular speed are reduced by one factor, so that the robot stays on the checked arc. A robot in contact
    may move so that the contact gets smaller: ``stop`` and ``approach`` block only motion that goes deeper.
    """

    def __init__(
        self, config: CollisionMonitorConfig, footprint: Footprint, limits: MotionLimits | None = None
    ) -> None:
        self.config = config
        self.footprint = footprint
        self.limits = limits or MotionLimits()
        self._polygons = [_polygon(name, polygon, footprint) for name, polygon in config.polygons().items()]
        self.most_points_needed = max((p.config.min_points for p in self._polygons), default=1)
        """Number of points by which a cell of memory must be represented for every polygon to notice it."""

    def limit(
        self,
        command: tuple[float, float],
        points: NDArray[np.float64],
        source_age_s: float = 0.0,
        velocity: tuple[float, float] | None = None,
        moving: MovingPoints = NOTHING_MOVES,
    ) -> MonitoredCommand:
        """Return the part of the command (m/s, rad/s) that may be sent.

        Args:
            command: the requested command.
            points: (N, 2) points seen, in ``base_link`` at the robot's present pose.
            source_age_s: age of the oldest required source of the points.
            velocity: present twist of the robot; None: it already moves as commanded.
            moving: points of people and other moving things, in ``base_link`` at the robot's present pose.
        """
        linear, angular = command
        if not all(map(math.isfinite, (linear, angular, *(velocity or ())))):
            return MonitoredCommand((0.0, 0.0), "stop", 0.0)
        if linear == 0.0 and angular == 0.0:
            return MonitoredCommand(command, "free", math.inf)
        if not source_age_s <= self.config.source_timeout:
            return MonitoredCommand((0.0, 0.0), "stop", 0.0, "source_timeout")
        # Check from the commanded twist and from the present one, because slowing down or turning away takes time.
        starts = {command, command if velocity is None else velocity}
        standing = MovingPoints(points, np.zeros_like(points))
        factor, action, decided, soonest = 1.0, "free", "", math.inf
        for polygon in self._polygons:
            for start, seen in itertools.product(starts, (standing, moving)):
                share, time_s = self._allowed(polygon, command, start, seen, seen is moving)
                soonest = min(soonest, time_s)
                if share < factor:
                    factor, decided = share, polygon.name
                    action = "stop" if share == 0.0 else polygon.name
        return MonitoredCommand((linear * factor, angular * factor), action, soonest, decided)

    def _allowed(
        self,
        polygon: _Polygon,
        command: tuple[float, float],
        start: tuple[float, float],
        seen: MovingPoints,
        moving: bool,
    ) -> tuple[float, float]:
        """Return the share of the command that a polygon allows from the twist ``start``, and the time to collision.

        The time is inf if the polygon does not need it.
        """
        config = polygon.config
        looks_ahead = not isinstance(config, SlowdownConfig)
        horizon = config.time_before_collision if isinstance(config, ApproachConfig) else 3 * STEP_S
        speed = max(abs(command[0]), abs(start[0])) + (MOST_SPEED_M_S if moving else 0.0)
        reach = polygon.reach + 0.05 + (speed * horizon if looks_ahead else 0.0)
        close = (seen.points**2).sum(axis=1) < reach**2
        near = np.ascontiguousarray(seen.points[close], dtype=np.float64)
        if len(near) < config.min_points:
            return 1.0, math.inf
        if not isinstance(config, ApproachConfig):
            inside = int((near @ polygon.normals.T < polygon.offsets).all(axis=1).sum())
            if inside < config.min_points:
                return 1.0, math.inf
        if isinstance(config, SlowdownConfig):
            return config.slowdown_ratio, math.inf
        time_s = float(
            _time_to_collision(
                near,
                np.ascontiguousarray(seen.velocities[close], dtype=np.float64),
                np.array([start, command], dtype=np.float64),
                np.array([self.limits.max_linear_accel_m_s2, self.limits.max_angular_accel_rad_s2]),
                polygon.normals,
                polygon.offsets,
                horizon,
                config.min_points,
            )
        )
        if math.isinf(time_s):
            return 1.0, time_s
        if not isinstance(config, ApproachConfig):
            return 0.0, time_s
        if time_s <= (config.moving_stop_time_s if moving else config.stop_time_s):
            return 0.0, time_s
        return time_s / config.time_before_collision, time_s


def _polygon(name: str, config: PolygonConfig, footprint: Footprint) -> _Polygon:
    corners = footprint.corners(config.padding_m)
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=-1) / np.linalg.norm(edges, axis=1)[:, None]
    offsets = (normals * corners).sum(axis=1)
    return _Polygon(name, config, normals, offsets, float(np.linalg.norm(corners, axis=1).max()))


@njit(cache=True)
def _depth(x: float, y: float, normals: NDArray[np.float64], offsets: NDArray[np.float64]) -> float:
    depth = np.inf
    for e in range(offsets.shape[0]):
        depth = min(depth, offsets[e] - normals[e, 0] * x - normals[e, 1] * y)
    return depth


@njit(cache=True)
def _time_to_collision(
    points: NDArray[np.float64],
    velocities: NDArray[np.float64],
    twists: NDArray[np.float64],
    accelerations: NDArray[np.float64],
    normals: NDArray[np.float64],
    offsets: NDArray[np.float64],
    horizon: float,
    min_points: int,
) -> float:
    """Return the start in seconds of the first step in which ``min_points`` points enter the polygon or go deeper.

    The robot accelerates from ``twists[0]`` to ``twists[1]``; the points (N, 2) move at ``velocities``.
    """
    depth = np.empty(points.shape[0])
    for j in range(points.shape[0]):
        depth[j] = _depth(points[j, 0], points[j, 1], normals, offsets)
    x, y, yaw = 0.0, 0.0, 0.0
    now = twists[0].copy()
    for k in range(1, math.ceil(horizon / STEP_S) + 1):
        for i in range(2):
            now[i] = _step_towards(now[i], twists[1, i], accelerations[i] * STEP_S)
        x, y, yaw = _along_arc(x, y, yaw, now[0] * STEP_S, now[1] * STEP_S)
        c, s = math.cos(yaw), math.sin(yaw)
        inside = 0
        for j in range(points.shape[0]):
            dx = points[j, 0] + velocities[j, 0] * STEP_S * k - x
            dy = points[j, 1] + velocities[j, 1] * STEP_S * k - y
            new_depth = _depth(c * dx + s * dy, c * dy - s * dx, normals, offsets)
            if new_depth > 0.0 and new_depth > depth[j] + 1e-3:
                inside += 1
        if inside >= min_points:
            return STEP_S * (k - 1)
    return np.inf
