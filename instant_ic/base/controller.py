"""Drives the base at a fixed rate: newest command in, odometry and health out, stop when in doubt."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

from instant_ic.base.config import LimitsConfig, OdometryNoiseConfig, RoboclawConfig, SkidSteerConfig
from instant_ic.base.limits import TwistLimiter
from instant_ic.base.odometry import OdometryEstimate, WheelOdometry
from instant_ic.base.roboclaw import LinkError, Roboclaw, SerialPort, Status, open_serial

from ..pace import current
from ..ranges import Positive, Range, check_ranges


@dataclass(frozen=True)
class ControllerConfig:
    """The tracked base as a whole.

    Attributes:
        roboclaw: serial line.
        geometry: tracks and encoders.
        limits: speeds and accelerations.
        odometry: growth of the uncertainty.
        command_timeout_s: a command older than this counts no more: the base slows down to a stand.
        health_period_s: battery and status are asked for this often.
    """

    roboclaw: RoboclawConfig = field(default_factory=RoboclawConfig)
    geometry: SkidSteerConfig = field(default_factory=SkidSteerConfig)
    limits: LimitsConfig = field(default_factory=LimitsConfig)
    odometry: OdometryNoiseConfig = field(default_factory=OdometryNoiseConfig)
    command_timeout_s: Annotated[float, Range(above=0, high=2)] = 0.3
    health_period_s: Positive = 1.0

    def __post_init__(self) -> None:
        """Check the values."""
        check_ranges(self)


@dataclass(frozen=True)
class Health:
    """What the controller told of itself at one instant."""

    stamp_ns: int
    battery_v: float
    status: Status


@dataclass(frozen=True)
class BaseState:
    """Result of one step.

    Attributes:
        connected: the controller answers.
        link: what happened on the line in this step, in words; empty when nothing did.
        odometry: new estimate, if there is one.
        health: newest battery and status, when they were asked for in this step.
        command_fresh: there was a command that was young enough.
        v: speed sent to the motors, m/s.
        w: turn rate sent to the motors, rad/s.
    """

    connected: bool
    link: str = ""
    odometry: OdometryEstimate | None = None
    health: Health | None = None
    command_fresh: bool = False
    v: float = 0.0
    w: float = 0.0


class BaseController:
    """Steps the base; `command` may be called from any thread, everything else from one."""

    def __init__(
        self,
        config: ControllerConfig,
        now_ns: Callable[[], int],
        open_port: Callable[[RoboclawConfig], SerialPort] = open_serial,
    ) -> None:
        """Nothing is opened yet: the first `step` connects.

        Args:
            config: parameters.
            now_ns: the clock that command stamps come from.
            open_port: how the serial port is opened.
        """
        self.config = config
        self.roboclaw = Roboclaw(config.roboclaw, open_port)
        self.odometry = WheelOdometry(config.geometry, config.odometry)
        self.limiter = TwistLimiter(config.limits)
        self._now_ns = now_ns
        self._command: tuple[float, float, int] = (0.0, 0.0, 0)
        self._last_step_ns: int | None = None
        self._next_health_ns = 0
        self._next_connect_ns = 0
        self._backoff_s = config.roboclaw.reconnect_min_s
        limits, geometry = config.limits, config.geometry
        # The limiter shapes the twist; the controller's ramp is what one track needs for both parts at once.
        self._ramp_pps2 = geometry.pulses_per_metre * (
            limits.max_v_acceleration + 0.5 * geometry.effective_width * limits.max_w_acceleration
        )

    def command(self, v: float, w: float, stamp_ns: int) -> None:
        """Set what the base shall do from now on: m/s, rad/s, and the time that the command was given."""
        self._command = (v, w, stamp_ns)

    def step(self) -> BaseState:
        """Send the speeds that are due, read the encoders and, from time to time, the health."""
        now_ns = self._now_ns()
        # The clock may be set back: a wait that was planned by the old time must not last until then.
        config = self.config
        self._next_connect_ns = min(self._next_connect_ns, now_ns + int(config.roboclaw.reconnect_max_s * 1e9))
        self._next_health_ns = min(self._next_health_ns, now_ns + int(config.health_period_s * 1e9))
        if not self.roboclaw.connected:
            return self._connect(now_ns)
        dt_s = 0.0 if self._last_step_ns is None else max(0.0, (now_ns - self._last_step_ns) * 1e-9)
        self._last_step_ns = now_ns

        v, w, stamp_ns = self._command
        # A stamp from the future means that the clock was set back: such a command would never grow old.
        fresh = stamp_ns > 0 and abs(now_ns - stamp_ns) * 1e-9 <= self.config.command_timeout_s
        v, w = self.limiter.step(v, w, dt_s) if fresh else self.limiter.step(0.0, 0.0, dt_s)
        kinematics = self.odometry.kinematics
        health = None
        try:
            tracks = kinematics.tracks_from_twist(v, w)
            self.roboclaw.drive(kinematics.motors_from_tracks(tracks).tolist(), self._ramp_pps2)
            encoders = self.roboclaw.encoders()
            encoders_ns = self._now_ns()
            if now_ns >= self._next_health_ns:
                health = Health(now_ns, self.roboclaw.battery_v(), self.roboclaw.status())
                self._next_health_ns = now_ns + int(self.config.health_period_s * 1e9)
        except LinkError as error:
            self._lost(now_ns)
            return BaseState(connected=False, link=str(error))
        return BaseState(
            connected=True,
            odometry=self.odometry.update(encoders, encoders_ns),
            health=health,
            command_fresh=fresh,
            v=v,
            w=w,
        )

    def close(self) -> str:
        """Stop the motors at once and release the port.

        Returns:
            Why the motors could not be told to stop (then the controller's watchdog does it); empty if they
            were, or if there was no connection.
        """
        if not self.roboclaw.connected:
            return ""
        try:
            self.roboclaw.stop()
        except LinkError as error:
            return str(error)
        finally:
            self.roboclaw.close()
            self.limiter.reset()
        return ""

    def _connect(self, now_ns: int) -> BaseState:
        if now_ns < self._next_connect_ns:
            return BaseState(connected=False)
        try:
            version = self.roboclaw.connect()
            # From a stand: whatever the motors still do from before is over now.
            self.roboclaw.stop()
        except LinkError as error:
            self._lost(now_ns)
            return BaseState(connected=False, link=str(error))
        self._backoff_s = self.config.roboclaw.reconnect_min_s
        self._last_step_ns = now_ns
        return BaseState(connected=True, link=f"connected to {version} at {self.config.roboclaw.port}")

    def _lost(self, now_ns: int) -> None:
        self.roboclaw.close()
        self.limiter.reset()
        self._next_connect_ns = now_ns + int(self._backoff_s * 1e9)
        self._backoff_s = min(2.0 * self._backoff_s, self.config.roboclaw.reconnect_max_s)


class ControllerThread(threading.Thread):
    """Steps a controller at a rate on its own thread, so that nothing else delays the motors' commands."""

    def __init__(
        self,
        controller: BaseController,
        rate_hz: float,
        on_state: Callable[[BaseState], None],
        on_end: Callable[[BaseException | None, str], None],
    ) -> None:
        """Not started yet.

        Args:
            controller: used by this thread only, apart from `BaseController.command`.
            rate_hz: steps a second.
            on_state: called on this thread after each step.
            on_end: called on this thread when it ends: the exception that ended it, and what
                `BaseController.close` said.
        """
        super().__init__(name="crawler_base serial", daemon=True)
        self._controller = controller
        self._period_s = 1.0 / rate_hz
        self._on_state = on_state
        self._on_end = on_end
        self._end = threading.Event()

    def run(self) -> None:
        """Step until `end`; the motors are stopped however it ends."""
        fault: BaseException | None = None
        pace = current()
        due_s = pace.steady_s()
        try:
            # By a grid of times, so that what a step takes does not slow the rate; steps missed are left out.
            while not self._end.wait(pace.wait_s(max(0.0, due_s - pace.steady_s()))):
                self._on_state(self._controller.step())
                due_s = max(due_s + self._period_s, pace.steady_s())
        except BaseException as error:  # noqa: BLE001 - handed to on_end; the motors must stop first
            fault = error
        self._on_end(fault, self._controller.close())

    def end(self, timeout_s: float = 2.0) -> bool:
        """Stop the motors and the thread; False when it does not end in time."""
        self._end.set()
        if self.is_alive():
            self.join(timeout_s)
        return not self.is_alive()
