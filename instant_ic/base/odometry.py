"""Dead reckoning from track encoders."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from instant_ic.base.config import SkidSteerConfig
from instant_ic.base.kinematics import SkidSteer
from instant_ic.geometry.motion import along_arc
from instant_ic.geometry.poses import planar_covariance

_MAX_TRACK_SPEED = 3.0  # m/s; a reading that implies more is rejected
_JITTER_M = 0.05
"""Largest step, in metres, that is never rejected as a jump. On a busy machine, a late reading may be followed soon by
the next one, so the speed between the two means nothing.
"""
UNMEASURED_VARIANCE = 1e6
"""Variance of z, roll and pitch, which encoders do not measure."""

# Growth of the uncertainty: variance added per metre driven or per radian turned (tracks slip), and the standard
# deviations at rest.
_POSITION_PER_METRE = 0.0004  # m^2/m
_YAW_PER_METRE = 0.0004  # rad^2/m
_YAW_PER_RADIAN = 0.01  # rad^2/rad
_V_FLOOR = 0.005  # m/s
_W_FLOOR = 0.01  # rad/s


@dataclass(frozen=True)
class OdometryEstimate:
    """Pose and twist from the encoders at one instant.

    Attributes:
        stamp_ns: time of measurement.
        pose: base_link in odom, (x, y, yaw), metres and radians, (3,).
        twist: (v_x, v_y, w) in base_link, m/s and rad/s, (3,).
        pose_covariance: covariance of x y z rx ry rz in odom, (6, 6).
        twist_covariance: covariance in the same order, in base_link, (6, 6).
    """

    stamp_ns: int
    pose: NDArray[np.float64]
    twist: NDArray[np.float64]
    pose_covariance: NDArray[np.float64]
    twist_covariance: NDArray[np.float64]


class WheelOdometry:
    """Integrates encoder counts into a pose with covariance.

    Attributes:
        rejected: number of readings that were implausibly far from the previous one, because the controller lost its
            counts. The pose is kept, and integration continues from the new reading.
    """

    def __init__(self, geometry: SkidSteerConfig) -> None:
        """Start at the origin of odom."""
        self.kinematics = SkidSteer(geometry)
        self.rejected = 0
        self._pose = np.zeros(3)
        self._covariance = np.zeros((3, 3))
        self._last: tuple[NDArray[np.int64], int] | None = None

    def forget_counts(self) -> None:
        """Keep the pose and integrate from the next reading on, because the controller has lost its counts."""
        self._last = None

    def update(self, encoders: ArrayLike, stamp_ns: int) -> OdometryEstimate | None:
        """Integrate one reading.

        Args:
            encoders: counts of M1 and M2 modulo 2^32, (2,).
            stamp_ns: time of the reading.

        Returns:
            The new estimate; None if the reading is the first, is not newer, comes too soon or is rejected.
        """
        counts = np.asarray(encoders, np.int64)
        last, self._last = self._last, (counts, stamp_ns)
        if last is None:
            return None
        dt_s = (stamp_ns - last[1]) * 1e-9
        tracks = self.kinematics.tracks_from_motors(unwrap_counts(last[0], counts))
        furthest = np.abs(tracks).max()
        too_fast = furthest > _MAX_TRACK_SPEED * dt_s
        if dt_s <= 0.0 or (too_fast and furthest < _JITTER_M):
            self._last = last
            return None
        if too_fast:
            self.rejected += 1
            return None
        step = self.kinematics.twist_from_tracks(tracks)
        self._integrate(step)
        return OdometryEstimate(
            stamp_ns=stamp_ns,
            pose=self._pose.copy(),
            twist=step / dt_s,
            pose_covariance=planar_covariance(self._covariance, UNMEASURED_VARIANCE),
            twist_covariance=self._twist_covariance(step, dt_s),
        )

    def _integrate(self, step: NDArray[np.float64]) -> None:
        """Move the pose by a body displacement (x, y, yaw) along its arc, and grow the covariance."""
        dx, dy, dyaw = step.tolist()
        x, y, yaw = self._pose.tolist()
        x, y, yaw = along_arc(x, y, yaw, dx, dyaw, dy)
        moved = np.array([x, y]) - self._pose[:2]

        jacobian = np.eye(3)
        jacobian[:2, 2] = (-moved[1], moved[0])
        gained = np.zeros((3, 3))
        distance = float(np.hypot(dx, dy))
        gained[:2, :2] = np.eye(2) * _POSITION_PER_METRE * distance
        gained[2, 2] = _YAW_PER_METRE * distance + _YAW_PER_RADIAN * abs(dyaw)
        self._covariance = jacobian @ self._covariance @ jacobian.T + gained

        self._pose = np.array([x, y, (yaw + np.pi) % (2.0 * np.pi) - np.pi])

    def _twist_covariance(self, step: NDArray[np.float64], dt_s: float) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of the mean twist: growth of the pose's variance per second, plus a floor."""
        distance, turn = abs(float(step[0])), abs(float(step[2]))
        v_variance = _V_FLOOR**2 + _POSITION_PER_METRE * distance / dt_s
        w_variance = _W_FLOOR**2 + (_YAW_PER_METRE * distance + _YAW_PER_RADIAN * turn) / dt_s
        return planar_covariance(np.diag([v_variance, v_variance, w_variance]), UNMEASURED_VARIANCE)


def unwrap_counts(before: NDArray[np.int64], now: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the signed pulses from one unsigned 32-bit count to the next, in the shorter direction."""
    return (now - before + 2**31) % 2**32 - 2**31
