"""Parameters that several nodes share: the robot's outline, its limits and its sensor mounts.

Their values are in the ``/**`` section of `config/robot.yaml`. Every node that uses one declares it by the same name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from instant_ic.config.ranges import Checked, Plausible, Range, check_ranges
from instant_ic.geometry.twists import clip_twist

MOST_STOPPING_M = 3.0
"""Longest stopping distance of a robot, because low obstacles farther away are not seen."""
MOST_STOPPING_RAD = math.pi
"""Largest angle within which a robot that turns on the spot must stop."""
Metres = Annotated[float, Plausible(-5, 5)]
Degrees = Annotated[float, Range(-360, 360)]


@dataclass(frozen=True)
class Rectangle(Checked):
    """The robot's outline, centred on base_link.

    Attributes:
        length_m: m; extent along x.
        width_m: m; extent along y.
    """

    length_m: Annotated[float, Plausible(0.1, 3)] = 0.60
    width_m: Annotated[float, Plausible(0.1, 3)] = 0.50


@dataclass(frozen=True)
class MotionLimits(Checked):
    """Speed and acceleration limits of the robot.

    Attributes:
        max_linear_m_s: m/s; largest speed.
        max_angular_rad_s: rad/s; largest turn rate.
        max_linear_accel_m_s2: m/s²; largest change of the speed, including braking. It determines how far ahead the
            prediction looks.
        max_angular_accel_rad_s2: rad/s²; largest change of the turn rate.
    """

    max_linear_m_s: Annotated[float, Plausible(0.02, 3)] = 0.5
    max_angular_rad_s: Annotated[float, Plausible(0.05, 6)] = 1.0
    max_linear_accel_m_s2: Annotated[float, Plausible(0.05, 10)] = 0.8
    max_angular_accel_rad_s2: Annotated[float, Plausible(0.1, 30)] = 2.0

    def __post_init__(self) -> None:
        check_ranges(self)
        distance = self.max_linear_m_s**2 / (2 * self.max_linear_accel_m_s2)
        if distance > MOST_STOPPING_M:
            raise ValueError(
                f"max_linear_accel_m_s2 must stop the robot from max_linear_m_s within {MOST_STOPPING_M:g} m "
                f"(got {self.max_linear_accel_m_s2}: {distance:.1f} m from {self.max_linear_m_s} m/s)"
            )
        turn = self.max_angular_rad_s**2 / (2 * self.max_angular_accel_rad_s2)
        if turn > MOST_STOPPING_RAD:
            raise ValueError(
                f"max_angular_accel_rad_s2 must stop the robot from max_angular_rad_s within half a turn "
                f"(got {self.max_angular_accel_rad_s2}: {math.degrees(turn):.0f} degrees from "
                f"{self.max_angular_rad_s} rad/s)"
            )

    def clip(self, linear: float, angular: float) -> tuple[float, float]:
        """Return the twist within the speed limits, with the same curvature; zero if it is not finite."""
        return clip_twist(linear, angular, self.max_linear_m_s, self.max_angular_rad_s)


@dataclass(frozen=True)
class Mount(Checked):
    """Pose of a sensor in base_link, whose origin is on the ground.

    Attributes:
        xyz: m; position.
        rpy_deg: degrees; roll, pitch, yaw about fixed axes.
    """

    xyz: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    rpy_deg: tuple[Degrees, Degrees, Degrees] = (0.0, 0.0, 0.0)

    @property
    def pose(self) -> tuple[float, float, float, float, float, float]:
        """x, y, z in metres and roll, pitch, yaw in radians: the arguments of ``pose_matrix``."""
        (x, y, z), (roll, pitch, yaw) = self.xyz, (math.radians(angle) for angle in self.rpy_deg)
        return x, y, z, roll, pitch, yaw


CAMERA_MOUNT = Mount(xyz=(0.0, 0.0, 1.2))
LIDAR_MOUNT = Mount(xyz=(0.0, 0.0, 0.6))
