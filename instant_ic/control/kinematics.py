"""Motion of a skid-steer robot: limits and the exact arc of a constant twist."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.robot import MotionLimits
from instant_ic.geometry.motion import along_arc, step_towards
from instant_ic.geometry.poses import wrap_angle


def accelerate(
    velocity: tuple[float, float], command: tuple[float, float], limits: MotionLimits, dt_s: float
) -> tuple[float, float]:
    """Return the velocity (m/s, rad/s) after accelerating towards ``command`` for ``dt_s`` within the limits."""
    command = limits.clip(*command)
    return (
        step_towards(velocity[0], command[0], limits.max_linear_accel_m_s2 * dt_s),
        step_towards(velocity[1], command[1], limits.max_angular_accel_rad_s2 * dt_s),
    )


def move(pose: NDArray[np.float64], linear: float, angular: float, dt_s: float) -> NDArray[np.float64]:
    """Return the pose (x, y, yaw) after ``dt_s`` of a constant twist (m/s, rad/s)."""
    x, y, yaw = along_arc(float(pose[0]), float(pose[1]), float(pose[2]), linear * dt_s, angular * dt_s)
    return np.array([x, y, wrap_angle(yaw)])


def extrapolate(pose: NDArray[np.float64], velocity: tuple[float, float], age_s: float) -> NDArray[np.float64]:
    """Return the pose (3,) of a message, moved on at ``velocity`` by the message's age, at most 0.1 s."""
    known = math.isfinite(velocity[0]) and math.isfinite(velocity[1])
    return move(pose, *velocity, min(max(0.0, age_s), 0.1)) if known else pose.copy()
