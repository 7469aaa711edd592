"""Dynamics of the tracked robot: motors, slipping tracks, encoders, contact with the world."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from instant_ic.base.config import SkidSteerConfig
from instant_ic.base.kinematics import SkidSteer
from instant_ic.config.ranges import Checked, NotNegative, Positive, Range
from instant_ic.config.robot import Rectangle
from instant_ic.geometry.motion import along_arc
from instant_ic.sim.contact import OccupancyMask
from instant_ic.sim.motors import TrackMotors

FloatArray = npt.NDArray[np.float64]

#: Distance from the pose at contact at which the contact ends, metres and radians.
_LET_GO = 0.015
#: Time constant of the slip.
_SLIP_TIME_S = 1.0


@dataclass(frozen=True)
class RobotConfig(Checked):
    """Parameters of the simulated robot.

    Attributes:
        track_acceleration: largest acceleration that the motor gives a track, m/s².
        motor_lag_s: time constant with which a track follows its set point.
        rolling_resistance: deceleration of a track by friction, m/s². The speed controller compensates for friction,
            except at set point zero, where friction ends the motion.
        slip: standard deviation of the share of a track's motion that is lost; 0 disables slip.
        turn_slip: relative standard deviation of the effective track width; 0 disables this slip.
        encoder_noise_pulses: standard deviation of the encoder counts while a track moves.
    """

    track_acceleration: Positive = 2.0
    motor_lag_s: Positive = 0.06
    rolling_resistance: NotNegative = 0.5
    slip: Annotated[float, Range(0, below=0.5)] = 0.02
    turn_slip: Annotated[float, Range(0, below=0.5)] = 0.05
    encoder_noise_pulses: NotNegative = 2.0


class TrackedRobot:
    """The robot on the floor plan.

    Args:
        mask: floor plan of the objects that stop the robot.
        pose: x, y, yaw at the start.
        seed: seed of slip and noise.
        footprint: outline.
        geometry: tracks and encoders.

    Attributes:
        pose: (3,) x, y, yaw (unwrapped) in the world's frame.
        twist: (3,) true v_x, v_y, yaw rate in the robot's frame.
        motors: motors of the tracks.
        contact: True while the robot pushes against something.
        contacts: number of contacts so far.
    """

    def __init__(
        self,
        config: RobotConfig,
        mask: OccupancyMask,
        pose: tuple[float, float, float],
        seed: int = 0,
        footprint: Rectangle = Rectangle(),  # noqa: B008 - frozen
        geometry: SkidSteerConfig = SkidSteerConfig(),  # noqa: B008 - frozen
    ) -> None:
        self.config = config
        self.kinematics = SkidSteer(geometry)
        self.pose: FloatArray = np.asarray(pose, float)
        self.twist: FloatArray = np.zeros(3)
        self.motors = TrackMotors(config.track_acceleration, config.motor_lag_s, config.rolling_resistance, seed)
        self.contact = False
        self.contacts = 0
        self._mask = mask
        self._rng = np.random.default_rng([31, seed])
        self._slip: FloatArray = np.zeros(3)
        self._jitter: FloatArray = np.zeros(2)
        self._held_at: FloatArray = self.pose
        self._outline = _outline(footprint.length_m, footprint.width_m, mask.cell_m)
        if self.touches(self.pose):
            raise ValueError(f"the start pose x={pose[0]:.2f}, y={pose[1]:.2f} collides with the world")

    @property
    def tracks(self) -> FloatArray:
        """(2,) speeds of the left and right track at the sprockets, m/s."""
        return self.motors.speeds

    @property
    def encoder_pulses(self) -> FloatArray:
        """(2,) encoder counts of the motors M1 and M2 since the start, not rounded."""
        return self.kinematics.motors_from_tracks(self.motors.counted) + self._jitter

    @property
    def motor_speed_pps(self) -> FloatArray:
        """(2,) speeds of the motors M1 and M2 as their encoders measure them, pulses/s."""
        return self.kinematics.motors_from_tracks(self.motors.encoders * self.motors.speeds)

    def touches(self, pose: npt.ArrayLike) -> bool:
        """Return whether the footprint's outline at a pose (x, y, yaw) touches something."""
        x, y, yaw = np.asarray(pose, float)
        c, s = math.cos(yaw), math.sin(yaw)
        points = self._outline @ np.asarray([[c, s], [-s, c]]) + (x, y)
        return bool(self._mask.at(points).any())

    def put_down(self, pose: tuple[float, float, float]) -> None:
        """Place the robot at another pose (x, y, yaw).

        Raises:
            ValueError: the pose is not finite, or an object is in the way.
        """
        if not np.isfinite(pose).all() or self.touches(pose):
            raise ValueError(f"the pose x={pose[0]:.2f}, y={pose[1]:.2f} collides with the world")
        self.pose, self.contact = np.asarray(pose, float), False

    def step(self, setpoint_pps: npt.ArrayLike, dt_s: float, closed_loop: bool = True) -> None:
        """Advance the robot by ``dt_s`` (at most about 20 ms).

        Args:
            setpoint_pps: set points of the motors (2,), pulses/s.
            dt_s: seconds.
            closed_loop: True while the speed loops regulate; otherwise the set points are power.
        """
        config = self.config
        mean = self.motors.step(self.kinematics.tracks_from_motors(setpoint_pps), dt_s, closed_loop)
        moving = np.abs(mean) > 1e-4
        if config.encoder_noise_pulses > 0:
            noise = self._rng.normal(0, config.encoder_noise_pulses, 2)
            self._jitter = np.where(moving, noise, self._jitter)

        keep = math.exp(-dt_s / _SLIP_TIME_S)
        spread = np.asarray([config.slip, config.slip, config.turn_slip]) * math.sqrt(1 - keep * keep)
        self._slip = keep * self._slip + spread * self._rng.standard_normal(3)
        twist = self.kinematics.twist_from_tracks(mean * (1 - self._slip[:2]))
        twist[1:] /= 1 + self._slip[2]
        self._move(twist, dt_s)

    def _move(self, twist: FloatArray, dt_s: float) -> None:
        forward, sideways, turn = (twist * dt_s).tolist()
        x, y, yaw = self.pose.tolist()
        target = np.array(along_arc(x, y, yaw, forward, turn, sideways))
        if bool(np.any(twist != 0)) and self.touches(target):
            if not self.contact:
                self.contacts += 1
            self.contact = True
            self._held_at = self.pose
            self.twist = np.zeros(3)
            return
        self.pose, self.twist = target, twist
        # Creeping by less than a cell during a contact does not start a new contact.
        if self.contact and float(np.abs(self.pose - self._held_at).max()) > _LET_GO:
            self.contact = False


def _outline(length: float, width: float, step: float) -> FloatArray:
    """Return points (N, 2) on the border of a rectangle, at most ``step`` apart."""
    along = np.linspace(-0.5, 0.5, int(length / step) + 2) * length
    across = np.linspace(-0.5, 0.5, int(width / step) + 2) * width
    half = np.full_like
    return np.concatenate(
        [
            np.column_stack([along, half(along, width / 2)]),
            np.column_stack([along, half(along, -width / 2)]),
            np.column_stack([half(across, length / 2), across]),
            np.column_stack([half(across, -length / 2), across]),
        ]
    )
