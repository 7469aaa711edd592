"""Parameters of the tracked base."""

from dataclasses import dataclass, field
from typing import Annotated

from instant_ic.base.following import SLOW_CYCLE_S
from instant_ic.base.protocol import BAUD_RATES, CYCLE_BYTES, PINS
from instant_ic.config.ranges import Checked, Plausible, Range, check_ranges, require, require_protection
from instant_ic.config.robot import MotionLimits


@dataclass(frozen=True)
class SkidSteerConfig(Checked):
    """Geometry of a skid-steer base, modelled by instantaneous centres of rotation (Martinez et al., 2005).

    Attributes:
        track_width: distance between the tracks' centre lines, metres.
        track_width_multiplier: effective width divided by geometric width, 1.2-2; above 1 because tracks slip
            sideways in turns.
        x_icr: distance of the centre of rotation ahead of base_link, metres; 0 for an even load.
        pulses_per_metre: encoder pulses per metre of track.
        left_motor: controller motor that drives the left track, 1 or 2.
        invert_left: whether the left motor's positive direction drives backwards.
        invert_right: whether the right motor's positive direction drives backwards.
    """

    track_width: Annotated[float, Plausible(0.05, 3)] = 0.40
    track_width_multiplier: Annotated[float, Range(0.5, 5)] = 1.5
    x_icr: Annotated[float, Range(-10, 10)] = 0.0
    pulses_per_metre: Annotated[float, Plausible(50, 1000000)] = 4000.0
    left_motor: Annotated[int, Range(1, 2)] = 1
    invert_left: bool = False
    invert_right: bool = False

    @property
    def effective_width(self) -> float:
        """Distance between the tracks' instantaneous centres of rotation (y_l - y_r in the model), metres."""
        return self.track_width * self.track_width_multiplier


@dataclass(frozen=True)
class LimitsConfig(MotionLimits):
    """Speed and acceleration limits of the base.

    Attributes:
        hard_decel_m_s2: m/s²; deceleration of each track when no command is fresh or a command asks for a hard stop.
    """

    hard_decel_m_s2: Annotated[float, Plausible(0.5, 20)] = 4.0

    def __post_init__(self) -> None:
        super().__post_init__()
        soft = self.max_linear_accel_m_s2
        require(self, "hard_decel_m_s2", self.hard_decel_m_s2 >= soft, "at least max_linear_accel_m_s2")


@dataclass(frozen=True)
class RoboclawConfig:
    """Serial link to the motor controller.

    Attributes:
        port: path of the serial device, such as /dev/ttyACM0, or of a pseudo-terminal.
        baud: baud rate, 2400-460800; no effect over USB.
        address: packet serial address of the controller, 0x80-0x87 (128-135).
        reply_timeout_s: longest wait for a reply. After it, the motors are stopped before the command is repeated.
        retries: number of repeats of a command before the link counts as lost.
        watchdog_s: time without a packet after which the controller itself stops the motors; steps of 0.1 s.
        estop_pin: controller pin to which the robot's stop button is wired: S3, S4 or S5. The pin must be set to
            E-Stop (latching). Empty if the robot has no stop button.
    """

    port: str = "/dev/ttyACM0"
    baud: Annotated[int, Range(2400, 460800)] = 115200
    address: Annotated[int, Range(128, 135)] = 0x80
    reply_timeout_s: Annotated[float, Plausible(0.005, 2)] = 0.1
    retries: Annotated[int, Plausible(0, 5)] = 2
    watchdog_s: Annotated[float, Range(0.1, 1)] = 0.3
    estop_pin: str = "S3"

    def __post_init__(self) -> None:
        check_ranges(self)
        require(self, "port", self.port != "", "the path of a serial device")
        require(self, "baud", self.baud in BAUD_RATES, f"one of {BAUD_RATES}")
        require(self, "estop_pin", self.estop_pin in ("", *PINS), f"one of {PINS}, or empty without a button")


@dataclass(frozen=True)
class ControllerConfig(Checked):
    """Parameters of the whole tracked base.

    Attributes:
        roboclaw: serial link.
        geometry: tracks and encoders.
        limits: speeds and accelerations.
        command_timeout_s: largest age of a command; older commands are dropped, and without a newer one the base
            stops hard.
        health_period_s: time between two readings of the battery and of the controller's watchdog setting.
    """

    roboclaw: RoboclawConfig = field(default_factory=RoboclawConfig)
    geometry: SkidSteerConfig = field(default_factory=SkidSteerConfig)
    limits: LimitsConfig = field(default_factory=LimitsConfig)
    command_timeout_s: Annotated[float, Plausible(0.05, 1)] = 0.25
    health_period_s: Annotated[float, Plausible(0.02, 1)] = 0.25


_LEAST_PERIODS = 3
"""Fewest command periods that the controller's watchdog must span."""
_BITS = 10
"""Bits per byte on the serial line, including start and stop bits."""


@dataclass(frozen=True)
class CrawlerBaseConfig(ControllerConfig):
    """Parameters of the node ``crawler_base``, in addition to those of the controller.

    Attributes:
        rate_hz: commands and odometry messages per second.
        battery_full_v: voltage of the full main battery, volts.
        battery_empty_v: voltage below which the main battery must be charged, volts; a lower voltage is a warning.
        recent_s: time for which repeated and dropped commands and impossible readings remain a warning, seconds.
        command_source: name of the only node whose commands are obeyed; empty obeys every node.
        accept_unstamped: also obey commands without a stamp; their time of arrival is used instead.
        unprotected: permit an empty command_source and accept_unstamped, with a permanent warning.
    """

    rate_hz: Annotated[float, Range(5, 200)] = 30.0
    battery_full_v: Annotated[float, Plausible(3, 100)] = 25.2
    battery_empty_v: Annotated[float, Plausible(3, 100)] = 21.0
    recent_s: Annotated[float, Plausible(1, 600)] = 10.0
    command_source: str = "arbiter"
    accept_unstamped: bool = False
    unprotected: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        rule = f"at most roboclaw.watchdog_s = {self.roboclaw.watchdog_s:g} s, after which the controller stops"
        require(self, "command_timeout_s", self.command_timeout_s <= self.roboclaw.watchdog_s, rule)
        if self.roboclaw.reply_timeout_s > self.roboclaw.watchdog_s:
            raise ValueError(f"roboclaw.reply_timeout_s must be {rule} (got {self.roboclaw.reply_timeout_s})")
        require_protection(self.unprotected, self.unprotected_by, "commands of any node or of any age move the robot")
        if not 0.0 < self.battery_empty_v < self.battery_full_v:
            raise ValueError(
                "battery_empty_v must be > 0 and below battery_full_v "
                f"(got {self.battery_empty_v}, {self.battery_full_v})"
            )
        line_s = CYCLE_BYTES * _BITS / self.roboclaw.baud
        cycle = f"a cycle takes {line_s:.3f} s on the line at roboclaw.baud {self.roboclaw.baud}: raise it"
        if line_s > SLOW_CYCLE_S:
            raise ValueError(f"{cycle}; above {SLOW_CYCLE_S} s the tracks cannot be watched")
        if line_s > 1.0 / self.rate_hz:
            raise ValueError(f"{cycle}, or lower rate_hz to {int(1.0 / line_s)} (got {self.rate_hz})")
        if self.roboclaw.watchdog_s < _LEAST_PERIODS / self.rate_hz:
            raise ValueError(
                f"roboclaw.watchdog_s must span {_LEAST_PERIODS} periods of rate_hz "
                f"(got {self.roboclaw.watchdog_s} s at {self.rate_hz} Hz)"
            )

    @property
    def unprotected_by(self) -> list[str]:
        """Names of the parameters that switch a protection off."""
        off = {"command_source": not self.command_source, "accept_unstamped": self.accept_unstamped}
        return [name for name, is_off in off.items() if is_off]
