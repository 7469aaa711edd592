"""Parameters of the tracked base."""

import math
from dataclasses import dataclass

from instant_ic.base.protocol import ADDRESSES, BAUD_RATES
from instant_ic.config.ranges import NotNegative, Positive, check_ranges


def _require(ok: bool, key: str, value: object, rule: str) -> None:
    if not ok:
        raise ValueError(f"{key} must be {rule} (got {value!r})")


@dataclass(frozen=True)
class SkidSteerConfig:
    """Geometry of a skid-steered base, by instantaneous centres of rotation (Martinez et al., 2005).

    Attributes:
        track_width: distance between the tracks' centre lines, metres.
        track_width_multiplier: effective over geometric width; tracks slip sideways when they turn, 1.2-2.
        x_icr: how far ahead of base_link the centre of rotation lies, metres; 0 for an even load.
        pulses_per_metre: encoder pulses for a metre of track.
        left_motor: which of the controller's motors drives the left track, 1 or 2.
        invert_left: the left motor's positive direction drives backwards.
        invert_right: the right motor's positive direction drives backwards.
    """

    track_width: float = 0.40
    track_width_multiplier: float = 1.5
    x_icr: float = 0.0
    pulses_per_metre: float = 4000.0
    left_motor: int = 1
    invert_left: bool = False
    invert_right: bool = False

    def __post_init__(self) -> None:
        """Check the values."""
        _require(self.track_width > 0.0, "track_width", self.track_width, "> 0 m")
        _require(
            0.5 <= self.track_width_multiplier <= 5.0,
            "track_width_multiplier",
            self.track_width_multiplier,
            "in 0.5..5",
        )
        _require(math.isfinite(self.x_icr), "x_icr", self.x_icr, "finite, metres")
        _require(self.pulses_per_metre > 0.0, "pulses_per_metre", self.pulses_per_metre, "> 0")
        _require(self.left_motor in (1, 2), "left_motor", self.left_motor, "1 or 2")

    @property
    def effective_width(self) -> float:
        """y_l - y_r of the model: distance between the tracks' instantaneous centres of rotation, metres."""
        return self.track_width * self.track_width_multiplier


@dataclass(frozen=True)
class LimitsConfig:
    """What the base may do at most.

    Attributes:
        max_v: speed along x, m/s.
        max_w: turn rate, rad/s.
        max_v_acceleration: change of the speed, m/s^2.
        max_w_acceleration: change of the turn rate, rad/s^2.
        hard_deceleration: of each track when the command is lost or asks for a hard stop, m/s^2.
    """

    max_v: Positive = 0.5
    max_w: Positive = 1.0
    max_v_acceleration: Positive = 0.8
    max_w_acceleration: Positive = 2.0
    hard_deceleration: Positive = 4.0

    def __post_init__(self) -> None:
        """Check the values."""
        check_ranges(self)
        _require(
            self.hard_deceleration >= self.max_v_acceleration,
            "hard_deceleration",
            self.hard_deceleration,
            "at least max_v_acceleration",
        )


@dataclass(frozen=True)
class OdometryNoiseConfig:
    """How fast the odometry's uncertainty grows.

    Attributes:
        position_per_metre: variance of the position gained with each metre driven, m^2/m.
        yaw_per_metre: variance of the yaw gained with each metre driven, rad^2/m.
        yaw_per_radian: variance of the yaw gained with each radian turned (tracks slip), rad^2/rad.
        v_floor: standard deviation of the speed at rest, m/s.
        w_floor: standard deviation of the turn rate at rest, rad/s.
    """

    position_per_metre: NotNegative = 0.0004
    yaw_per_metre: NotNegative = 0.0004
    yaw_per_radian: NotNegative = 0.01
    v_floor: NotNegative = 0.005
    w_floor: NotNegative = 0.01

    def __post_init__(self) -> None:
        """Check the values."""
        check_ranges(self)


@dataclass(frozen=True)
class RoboclawConfig:
    """The serial line to the motor controller.

    Attributes:
        port: serial device, such as /dev/ttyACM0, or a pseudo-terminal.
        baud: 2400-460800; of no effect over USB.
        address: of the controller, 0x80-0x87 (128-135).
        reply_timeout_s: how long a reply may take; after that the motors are stopped before anything is repeated.
        retries: how often a command is repeated before the link counts as lost.
        watchdog_s: the controller itself stops the motors when no packet came for this long; steps of 0.1 s.
        reconnect_min_s: first wait before the port is opened again.
        reconnect_max_s: longest wait.
    """

    port: str = "/dev/ttyACM0"
    baud: int = 115200
    address: int = 0x80
    reply_timeout_s: float = 0.1
    retries: int = 2
    watchdog_s: float = 0.3
    reconnect_min_s: float = 0.2
    reconnect_max_s: float = 2.0

    def __post_init__(self) -> None:
        """Check the values."""
        _require(self.port != "", "port", self.port, "the path of a serial device")
        _require(self.baud in BAUD_RATES, "baud", self.baud, f"one of {BAUD_RATES}")
        _require(self.address in ADDRESSES, "address", self.address, "in 128..135")
        _require(self.reply_timeout_s > 0.0, "reply_timeout_s", self.reply_timeout_s, "> 0 s")
        _require(self.retries >= 0, "retries", self.retries, ">= 0")
        _require(0.1 <= self.watchdog_s <= 1.0, "watchdog_s", self.watchdog_s, "in 0.1..1 s")
        _require(
            0.0 < self.reconnect_min_s <= self.reconnect_max_s,
            "reconnect_min_s",
            self.reconnect_min_s,
            "> 0 and at most reconnect_max_s",
        )
