"""Skid-steer kinematics by instantaneous centres of rotation.

Source: Martinez, Mandow, Morales, Pedraza, Garcia-Cerezo: Approximating kinematics for tracked mobile robots,
IJRR 24(10), 2005.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from instant_ic.base.config import SkidSteerConfig


class SkidSteer:
    """Converts between body twist, track speeds and motor speeds."""

    def __init__(self, config: SkidSteerConfig) -> None:
        self.config = config
        left = config.left_motor - 1
        self._order = [left, 1 - left]
        self._sign = np.array([-1.0 if config.invert_left else 1.0, -1.0 if config.invert_right else 1.0])

    def tracks_from_twist(self, v: float, w: float) -> NDArray[np.float64]:
        """Return the track speeds (left, right), m/s, for a speed along x and a turn rate."""
        half = 0.5 * self.config.effective_width
        return np.array([v - w * half, v + w * half])

    def twist_from_tracks(self, tracks: ArrayLike) -> NDArray[np.float64]:
        """Return the body twist (v_x, v_y, w) for track speeds (left, right), or displacement for track distances."""
        left, right = np.asarray(tracks, float)
        w = (right - left) / self.config.effective_width
        return np.array([0.5 * (left + right), -w * self.config.x_icr, w])

    def motors_from_tracks(self, tracks: ArrayLike) -> NDArray[np.float64]:
        """Return the pulses (or pulses/s) of motors M1, M2 from track metres (or m/s), (left, right)."""
        motors = np.zeros(2)
        motors[self._order] = np.asarray(tracks, float) * self._sign * self.config.pulses_per_metre
        return motors

    def tracks_from_motors(self, motors: ArrayLike) -> NDArray[np.float64]:
        """Return the track metres (or m/s), (left, right), from pulses (or pulses/s) of motors M1, M2."""
        return np.asarray(motors, float)[self._order] * self._sign / self.config.pulses_per_metre
