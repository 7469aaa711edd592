"""Prediction of the path under the present command, and of contacts of the footprint with obstacles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.config.ranges import Checked, Plausible
from instant_ic.control.costmap import Costmap
from instant_ic.control.footprint import Footprint
from instant_ic.control.kinematics import MotionLimits
from instant_ic.geometry.motion import along_arc, step_towards

_along_arc = njit(cache=True)(along_arc)
_step_towards = njit(cache=True)(step_towards)

_YAW_MARGIN_RAD = 0.4
"""Margin when turning on the spot, where ``margin_m`` does not apply."""
_MAX_HORIZON_S = 8.0
"""Longest prediction, however slow the robot."""
STEP_S = 0.05
"""Seconds between predicted poses."""


@dataclass(frozen=True)
class PredictionConfig(Checked):
    """Range of the prediction.

    Attributes:
        latency_s: s; delay from a command to the base's response.
        margin_m: m; horizon beyond the stopping distance; a larger one switches to the v-bot earlier.
        padding_m: m round the footprint.
    """

    latency_s: Annotated[float, Plausible(0, 1)] = 0.2
    margin_m: Annotated[float, Plausible(0, 5)] = 0.6
    padding_m: Annotated[float, Plausible(0, 0.5)] = 0.03


@dataclass(frozen=True)
class Prediction:
    """A predicted trajectory and the obstacle it meets."""

    poses: NDArray[np.float64]
    """(N, 3) x, y, yaw in the map frame, now and every ``STEP_S``."""
    hit_index: int | None
    """Index of the first pose whose footprint overlaps more obstacles than at the start; None if the way is free."""
    distance_m: float
    """Distance that the robot's farthest corner travels to that pose; inf if the way is free."""

    @property
    def time_to_obstacle_s(self) -> float:
        """Seconds until the footprint meets the obstacle; inf when the way is free."""
        return math.inf if self.hit_index is None else STEP_S * self.hit_index


def stopping_distance(speed_m_s: float, limits: MotionLimits, latency_s: float) -> float:
    """Return metres from the stop command to standstill."""
    return speed_m_s * latency_s + speed_m_s**2 / (2.0 * limits.max_linear_accel_m_s2)


class Predictor:
    """A prediction of motion under a command, with the base's latency and acceleration limits.

    The horizon is a length, not a time: the stopping distance at the commanded speed (or the measured one, if higher)
    plus a margin. It is measured at the footprint's farthest corner, so it also covers turning on the spot.
    """

    def __init__(self, config: PredictionConfig, limits: MotionLimits, footprint: Footprint) -> None:
        self.config = config
        self.limits = limits
        self.footprint = footprint
        self.reach_m = footprint.circumscribed_radius_m
        self.body = footprint.points(0.045, config.padding_m)

    def horizon(self, linear: float, angular: float) -> float:
        """Return the distance in metres over which the farthest corner is followed at a twist (m/s, rad/s)."""
        speed = abs(linear) + self.reach_m * abs(angular)
        if speed == 0.0:
            return 0.0
        share = abs(linear) / speed
        margin = share * self.config.margin_m + (1.0 - share) * self.reach_m * _YAW_MARGIN_RAD
        return stopping_distance(speed, self.limits, self.config.latency_s) + margin

    def predict(
        self,
        pose: NDArray[np.float64],
        velocity: tuple[float, float],
        command: tuple[float, float],
        costmap: Costmap | None,
        extra_m: float = 0.0,
        side_m: float = 0.0,
    ) -> Prediction:
        """Return the trajectory from ``pose`` (x, y, yaw) at ``velocity`` under ``command`` (m/s, rad/s).

        ``extra_m`` is added to the horizon, ``side_m`` to every side of the footprint. Without a
        costmap the way is free.
        """
        command = self.limits.clip(*command)
        # Delayed encoder readings can give an impossible speed, which would make the horizon metres too long.
        velocity = self.limits.clip(*velocity)
        faster = command if _speed(command, self.reach_m) >= _speed(velocity, self.reach_m) else velocity
        length = self.horizon(*faster)
        length += extra_m if length > 0 else 0.0
        rates = np.array([self.limits.max_linear_accel_m_s2, self.limits.max_angular_accel_rad_s2])
        path, travelled = _roll_out(
            np.array(pose, dtype=np.float64),
            np.array(velocity, dtype=np.float64),
            np.array(command, dtype=np.float64),
            rates * STEP_S,
            math.ceil(self.config.latency_s / STEP_S - 1e-9),
            length,
            self.reach_m,
        )
        hit = None
        if costmap is not None:
            body = self.body
            if side_m > 0:
                body = self.footprint.points(0.045, self.config.padding_m + side_m)
            overlap = costmap.lethal_overlap(path, body)
            # A robot that stands on an obstacle already (after a map jump) must not be blocked forever.
            worse = np.flatnonzero(overlap > overlap[0])
            hit = int(worse[0]) if worse.size else None
        return Prediction(path, hit, math.inf if hit is None else float(travelled[hit]))


def _speed(velocity: tuple[float, float], reach_m: float) -> float:
    return abs(velocity[0]) + reach_m * abs(velocity[1])


@njit(cache=True)
def _roll_out(
    pose: NDArray[np.float64],
    velocity: NDArray[np.float64],
    command: NDArray[np.float64],
    steepest: NDArray[np.float64],
    late_steps: int,
    length_m: float,
    reach_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the poses (N, 3) under a command, and the distance travelled by the farthest corner at each, (N,).

    The steps are those of ``kinematics.accelerate`` and ``move``. The command takes effect after ``late_steps``, and
    changes the velocity by at most ``steepest`` (2,) per step.
    """
    most_steps = math.ceil(_MAX_HORIZON_S / STEP_S)
    poses, travelled = np.empty((most_steps + 1, 3)), np.zeros(most_steps + 1)
    poses[0] = pose
    v = velocity.copy()
    count = 0
    for k in range(most_steps):
        if k >= late_steps:
            for i in range(2):
                v[i] = _step_towards(v[i], command[i], steepest[i])
        stands = v[0] == 0.0 and v[1] == 0.0 and command[0] == 0.0 and command[1] == 0.0
        if travelled[k] >= length_m or stands:
            break
        x, y, yaw = _along_arc(poses[k, 0], poses[k, 1], poses[k, 2], v[0] * STEP_S, v[1] * STEP_S)
        poses[k + 1, 0], poses[k + 1, 1] = x, y
        poses[k + 1, 2] = yaw - 2.0 * math.pi * math.floor(yaw / (2.0 * math.pi) + 0.5)
        travelled[k + 1] = travelled[k] + (abs(v[0]) + reach_m * abs(v[1])) * STEP_S
        count += 1
    return poses[: count + 1], travelled[: count + 1]
