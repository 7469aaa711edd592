"""Velocity and acceleration limits of a planar base."""

import math

from instant_ic.base.config import LimitsConfig
from instant_ic.geometry.motion import step_towards


class TwistLimiter:
    """Moves the twist towards a target within speed and acceleration limits, step by step.

    Attributes:
        v: last returned speed along x, m/s.
        w: last returned turn rate, rad/s.
    """

    def __init__(self, config: LimitsConfig) -> None:
        self.config = config
        self.v = 0.0
        self.w = 0.0

    def step(self, v: float, w: float, dt_s: float) -> tuple[float, float]:
        """Return the next twist towards (v, w) after ``dt_s`` seconds.

        A twist above the speed limits is scaled as a whole, which keeps its curvature. Accelerations are limited
        separately.

        Raises:
            ValueError: v or w is not finite, or dt_s is negative.
        """
        if not (math.isfinite(v) and math.isfinite(w)):
            raise ValueError(f"twist must be finite (got v={v}, w={w})")
        if dt_s < 0.0:
            raise ValueError(f"dt_s must be >= 0 (got {dt_s})")
        v, w = self.config.clip(v, w)
        self.v = step_towards(self.v, v, self.config.max_linear_accel_m_s2 * dt_s)
        self.w = step_towards(self.w, w, self.config.max_angular_accel_rad_s2 * dt_s)
        return self.v, self.w

    def brake(self, decel_m_s2: float, decel_rad_s2: float, dt_s: float) -> tuple[float, float]:
        """Return the next twist towards zero after ``dt_s`` seconds."""
        self.v = step_towards(self.v, 0.0, decel_m_s2 * dt_s)
        self.w = step_towards(self.w, 0.0, decel_rad_s2 * dt_s)
        return self.v, self.w

    def reset(self) -> None:
        """Restart from standing, for example after an emergency stop."""
        self.v = self.w = 0.0
