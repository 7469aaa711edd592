"""Control loop of the base: sends the newest command at a fixed rate, returns odometry and health, stops on faults."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from instant_ic.base.config import ControllerConfig, RoboclawConfig
from instant_ic.base.following import TrackWatch
from instant_ic.base.limits import TwistLimiter
from instant_ic.base.odometry import OdometryEstimate, WheelOdometry, unwrap_counts
from instant_ic.base.roboclaw import ControllerRestarted, ControllerStatus, LinkError, Roboclaw, SerialPort, open_serial
from instant_ic.util.pace import current, suspended_ns
from instant_ic.util.reconnect import Backoff
from instant_ic.util.step_gap import StepGap

_COUNTED_SINCE_M = 0.2
"""Largest track distance, in metres, that a restarted controller can have counted by the next reading."""
_RUNAWAY = 1.2
"""Speed error of a track, as a share of its fastest commanded speed, at which the controller itself stops the motor."""
_RECONNECT_MIN_S, RECONNECT_MAX_S = 0.2, 2.0
"""Shortest and longest wait before the port is reopened; see :class:`Backoff`."""
_SURE_WITHIN_S = 0.025
"""Longest exchange whose reading has a certain time. In a longer one, the process may have waited for a CPU."""
_UNSURE_AFTER_S = 0.2
"""Time without a certain reading after which an uncertain one is used."""


@dataclass(frozen=True)
class Health:
    """Battery of the controller at one instant."""

    stamp_ns: int
    battery_v: float


@dataclass(frozen=True)
class BaseState:
    """Result of one step.

    Attributes:
        connected: whether the controller answers.
        link: text of a link event in this step; empty if there was none.
        fault: text about a track that does not follow, because of which the base has stopped; empty if both follow.
        restarted: true if the controller had lost its settings; the base has then stopped.
        odometry: new estimate; None if there is none.
        status: faults and warnings of the controller; None if they were not read. On a fault the base has stopped.
        health: battery; None if it was not read in this step.
        command_fresh: whether a command within the time-out was available.
        v: speed sent to the motors, m/s.
        w: turn rate sent to the motors, rad/s.
    """

    connected: bool
    link: str = ""
    fault: str = ""
    restarted: bool = False
    odometry: OdometryEstimate | None = None
    status: ControllerStatus | None = None
    health: Health | None = None
    command_fresh: bool = False
    v: float = 0.0
    w: float = 0.0


@dataclass(frozen=True)
class _Command:
    v: float
    w: float
    hard: bool
    given_ns: int
    """Time of the command on the steady clock."""


class BaseController:
    """Runs the control loop, one cycle per `step`.

    `command` and `emergency_stop` may be called from any thread, everything else from one thread only.
    """

    def __init__(
        self,
        config: ControllerConfig,
        now_ns: Callable[[], int],
        steady_ns: Callable[[], int],
        open_port: Callable[[RoboclawConfig], SerialPort] = open_serial,
        suspended_ns: Callable[[], int] = suspended_ns,
    ) -> None:
        """Create the controller without opening the port: the first `step` connects.

        Args:
            config: parameters.
            now_ns: clock for stamps, nanoseconds since the epoch; the system may set this clock at any time.
            steady_ns: monotonic clock for ages, periods and time-outs.
            open_port: function that opens the serial port.
            suspended_ns: clock that counts the time for which the machine was suspended.
        """
        self.config = config
        self.roboclaw = Roboclaw(config.roboclaw, open_port)
        self.odometry = WheelOdometry(config.geometry)
        self.limiter = TwistLimiter(config.limits)
        self._now_ns = now_ns
        self._steady_ns = steady_ns
        self._suspended_ns = suspended_ns
        self._gap = StepGap()
        self._awake_ns = 0  # end of the last gap between steps; commands from before it do not count
        self._lock = threading.Lock()
        self._command: _Command | None = None
        self._stopped = False
        self._encoders: NDArray[np.int64] | None = None
        limits = config.limits
        self._fastest_m_s = limits.max_linear_m_s + 0.5 * config.geometry.effective_width * limits.max_angular_rad_s
        pulse_m = 1.0 / config.geometry.pulses_per_metre
        self._watch = TrackWatch(self._fastest_m_s, pulse_m, simulated=not current().real)
        self._watched: tuple[NDArray[np.int64], int] | None = None  # last counts judged by the watch, and their time
        self._sent: tuple[NDArray[np.float64], int] | None = None  # track speeds, and the end of their last report
        self._last_step_ns: int | None = None
        self._placed_ns: int | None = None  # time of the last reading used for odometry
        self._next_health_ns = 0
        self._next_connect_ns = 0
        self._backoff = Backoff(_RECONNECT_MIN_S, RECONNECT_MAX_S)

    def command(self, v: float, w: float, given_ns: int, hard: bool = False) -> None:
        """Set the command that the base follows from now on.

        Args:
            v: speed along x, m/s.
            w: turn rate, rad/s.
            given_ns: time of the command on the steady clock.
            hard: ignore the speeds and stop at the hard deceleration.
        """
        with self._lock:
            self._command = _Command(v, w, hard, given_ns)

    def emergency_stop(self, stopped: bool) -> None:
        """Take the power off the motors while ``stopped``, which brakes them.

        The current command is discarded, so after the release the base stands until a new command arrives.
        """
        with self._lock:
            if stopped or self._stopped:
                self._command = None
            self._stopped = stopped

    def step(self) -> BaseState:
        """Send motor speeds, then read encoders, power, currents, status and, every ``health_period_s``, the health.

        The base makes an emergency stop when a track does not follow or the controller reports a fault.
        """
        now_ns = self._steady_ns()
        gap_s = self._gap.step(now_ns, self._suspended_ns())
        if gap_s:
            self._awake_ns = now_ns
        if not self.roboclaw.connected:
            return self._connect(now_ns)
        dt_s = 0.0 if self._last_step_ns is None else max(0.0, (now_ns - self._last_step_ns) * 1e-9)
        self._last_step_ns = now_ns
        if gap_s or dt_s > self.config.roboclaw.watchdog_s:
            # The controller's watchdog has stopped the motors during the gap.
            self._forget_motion()
            dt_s = 0.0
        command = self._fresh_command()
        stops = self.roboclaw.counters.stops
        try:
            v, w = self._drive(command, dt_s)
            asked_ns = self._steady_ns()
            encoders = self.roboclaw.encoders()
            encoders_ns, stamp_ns = self._steady_ns(), self._now_ns()
            self._note_speeds(v, w, asked_ns, encoders_ns)
            self._check_counts(encoders)
            power, current_a = self.roboclaw.pwm(), self.roboclaw.currents_a()
            status = self.roboclaw.status()
            self._watch.exchanged((self._steady_ns() - now_ns) * 1e-9)
            health = self._read_health(now_ns)
            rejected, estimate = self.odometry.rejected, None
            if self._sure(asked_ns, encoders_ns):
                estimate = self.odometry.update(encoders, encoders_ns)
            fault = self._check_tracks(encoders, power, current_a, asked_ns, encoders_ns)
            if (fault or status.faults) and not self._stopped:
                self.emergency_stop(True)
                self.roboclaw.stop()
            if self.odometry.rejected != rejected and self._near_zero(encoders):
                raise ControllerRestarted(f"{self.config.roboclaw.port}: the encoder counts jumped to {encoders}")
        except LinkError as error:
            restarted = isinstance(error, ControllerRestarted)
            if restarted:
                self.odometry.forget_counts()
            wait_s = self._backoff.fail(now_ns * 1e-9)
            self._lost(now_ns, 0.0 if restarted else wait_s)
            return BaseState(connected=False, link=str(error))
        if self.roboclaw.counters.stops != stops:
            self._forget_motion()  # a reply was missing, so the motors were stopped
        return BaseState(
            connected=True,
            fault=fault,
            # Speeds use the steady clock, the stamp uses the system clock.
            odometry=None if estimate is None else replace(estimate, stamp_ns=stamp_ns),
            status=status,
            health=health,
            command_fresh=command is not None,
            v=v,
            w=w,
        )

    def _read_health(self, now_ns: int) -> Health | None:
        """Check the watchdog and read the battery if ``health_period_s`` has passed, else return None."""
        if now_ns < self._next_health_ns:
            return None
        self.roboclaw.check_watchdog()
        health = Health(self._now_ns(), self.roboclaw.battery_v())
        self._next_health_ns = now_ns + int(self.config.health_period_s * 1e9)
        return health

    def _sure(self, asked_ns: int, read_ns: int) -> bool:
        """Return whether the time of a reading is certain enough. The next reading contains a dropped one's motion."""
        before_ns = self._placed_ns
        late = read_ns - asked_ns > _SURE_WITHIN_S * 1e9
        if late and before_ns is not None and read_ns - before_ns < _UNSURE_AFTER_S * 1e9:
            return False
        self._placed_ns = read_ns
        return True

    def _fresh_command(self) -> _Command | None:
        """Return the current command if it is fresh. Discard a stale command, so that it never becomes fresh again."""
        with self._lock:
            command = self._command
            if command is not None:
                age_s = (self._steady_ns() - command.given_ns) * 1e-9
                fresh = command.given_ns >= self._awake_ns and 0.0 <= age_s <= self.config.command_timeout_s
                if not fresh:
                    command = self._command = None
            return command

    def _drive(self, command: _Command | None, dt_s: float) -> tuple[float, float]:
        limits, geometry, kinematics = self.config.limits, self.config.geometry, self.odometry.kinematics
        if self._stopped:
            self._forget_motion()
            self.roboclaw.stop()
            return 0.0, 0.0
        half_width = 0.5 * geometry.effective_width
        stands = not (self.limiter.v or self.limiter.w)
        if command is None or command.hard:
            v, w = self.limiter.brake(limits.hard_decel_m_s2, limits.hard_decel_m_s2 / half_width, dt_s)
            # The controller ramps down to zero even if no further packet arrives; the limiter follows the same ramp.
            speeds, ramp = np.zeros(2), limits.hard_decel_m_s2
        else:
            v, w = self.limiter.step(command.v, command.w, dt_s)
            speeds = kinematics.motors_from_tracks(kinematics.tracks_from_twist(v, w))
            # The limiter already limits both accelerations; one track may need the sum of the two.
            ramp = limits.max_linear_accel_m_s2 + half_width * limits.max_angular_accel_rad_s2
        if stands and not (v or w):
            # A speed loop at zero could still drive a track whose encoder is dead or reversed.
            self._forget_motion()
            self.roboclaw.stop()
        else:
            self.roboclaw.drive(speeds, geometry.pulses_per_metre * ramp)
        return v, w

    def _forget_motion(self) -> None:
        """Assume that the robot stands, because the motors were stopped by other means than the limiter."""
        self.limiter.reset()
        self._watch.reset()
        self._watched = self._sent = None

    def _note_speeds(self, v: float, w: float, sent_ns: int, now_ns: int) -> None:
        """Report the commanded speeds to the watch: the previous ones until ``sent_ns``, then ``v`` and ``w``."""
        speeds = self.odometry.kinematics.tracks_from_twist(v, w)
        if self._sent is not None:
            before, since_ns = self._sent
            self._watch.commanded(before, (sent_ns - since_ns) * 1e-9)
            self._watch.commanded(speeds, (now_ns - sent_ns) * 1e-9)
        self._sent = speeds, now_ns

    def _check_tracks(
        self,
        encoders: NDArray[np.int64],
        power: NDArray[np.float64],
        current_a: NDArray[np.float64],
        asked_ns: int,
        read_ns: int,
    ) -> str:
        """Return why a track does not follow its power, as text; empty if both follow."""
        last, self._watched = self._watched, (encoders, read_ns)
        if last is None or self._sent is None:
            return ""
        kinematics = self.odometry.kinematics
        moved = kinematics.tracks_from_motors(unwrap_counts(last[0], encoders))
        per_metre = self.config.geometry.pulses_per_metre
        powers = kinematics.tracks_from_motors(power * per_metre)
        currents = kinematics.tracks_from_motors(current_a * per_metre)
        # Counts are taken between request and reply, so at least this time has passed since the previous ones.
        return self._watch.judge(moved, powers, currents, max(0, asked_ns - last[1]) * 1e-9)

    def _check_counts(self, encoders: NDArray[np.int64]) -> None:
        """Check the watchdog if both counts jumped to zero, because the controller may have restarted."""
        last, self._encoders = self._encoders, encoders
        if last is not None and last.any() and not encoders.any():
            self.roboclaw.check_watchdog()

    def _near_zero(self, encoders: NDArray[np.int64]) -> bool:
        """Return whether both counts are small enough for a controller that has just restarted."""
        metres = unwrap_counts(np.zeros(2, np.int64), encoders) / self.config.geometry.pulses_per_metre
        return bool(np.abs(metres).max() < _COUNTED_SINCE_M)

    def close(self) -> str:
        """Stop the motors at once and release the port.

        Returns:
            Why the stop command failed; the controller's watchdog then stops the motors. Empty if the command succeeded
            or there was no connection.
        """
        if not self.roboclaw.connected:
            return ""
        try:
            self.roboclaw.stop()
        except LinkError as error:
            return str(error)
        finally:
            self.roboclaw.close()
            self._forget_motion()
        return ""

    def _connect(self, now_ns: int) -> BaseState:
        """Connect if the wait is over. Make an emergency stop if the controller has restarted in the meantime."""
        if now_ns < self._next_connect_ns:
            return BaseState(connected=False)
        failure, version, limited = "", "", False
        try:
            version = self.roboclaw.connect()
            per_metre = self.config.geometry.pulses_per_metre
            limited = self.roboclaw.limit_speed_error(_RUNAWAY * self._fastest_m_s * per_metre)
        except LinkError as error:
            self._lost(now_ns, self._backoff.fail(now_ns * 1e-9))
            failure = str(error)
        restarted = self.roboclaw.restarted
        if restarted:
            self.odometry.forget_counts()
            self.emergency_stop(True)
        if failure:
            return BaseState(connected=False, link=failure, restarted=restarted)
        self._encoders = None
        self._backoff.succeed()
        self._last_step_ns = now_ns
        without = "" if limited else ", whose firmware has no speed error limit"
        link = f"connected to {version} at {self.config.roboclaw.port}{without}"
        return BaseState(connected=True, link=link, restarted=restarted)

    def _lost(self, now_ns: int, wait_s: float) -> None:
        self.roboclaw.close()
        self._forget_motion()
        self._next_connect_ns = now_ns + int(wait_s * 1e9)


class ControllerThread(threading.Thread):
    """Steps a controller at a fixed rate on a thread of its own, so that other work does not delay motor commands."""

    def __init__(
        self,
        controller: BaseController,
        rate_hz: float,
        on_state: Callable[[BaseState], None],
        on_end: Callable[[BaseException | None, str], None],
    ) -> None:
        """Create the thread without starting it.

        Args:
            controller: controller to step. Other threads may call only its `command` and `emergency_stop`.
            rate_hz: steps per second.
            on_state: called on this thread after each step.
            on_end: called on this thread when it ends, with the exception that ended it and the result of
                `BaseController.close`.
        """
        super().__init__(name="crawler_base serial", daemon=True)
        self._controller = controller
        self._period_s = 1.0 / rate_hz
        self._on_state = on_state
        self._on_end = on_end
        self._end = threading.Event()
        self._wake = threading.Event()

    def run(self) -> None:
        """Step until `end`, then stop the motors, also after an exception."""
        fault: BaseException | None = None
        pace = current()
        due_s = pace.steady_s()
        try:
            # The due times are fixed, so the duration of a step does not lower the rate. Missed steps are skipped.
            while not self._end.is_set():
                self._wake.wait(pace.wait_s(max(0.0, due_s - pace.steady_s())))
                if self._end.is_set():
                    break
                self._wake.clear()
                due = pace.steady_s() >= due_s
                self._on_state(self._controller.step())
                if due:
                    due_s = max(due_s + self._period_s, pace.steady_s())
        except BaseException as error:  # noqa: BLE001 - handed to on_end; the motors must stop first
            fault = error
        self._on_end(fault, self._controller.close())

    def hurry(self) -> None:
        """Run an extra step now, so that a stop does not wait for the next period."""
        self._wake.set()

    def end(self, timeout_s: float = 2.0) -> bool:
        """Stop the motors and the thread; return whether the thread ended in time."""
        self._end.set()
        self._wake.set()
        if self.is_alive():
            self.join(timeout_s)
        return not self.is_alive()


class SteppedController(ControllerThread):
    """Controller for lockstep: each :meth:`hurry` runs one step on the caller's thread."""

    def start(self) -> None:
        """Start no thread."""

    def hurry(self) -> None:
        self._on_state(self._controller.step())

    def end(self, timeout_s: float = 0.0) -> bool:
        self._on_end(None, self._controller.close())
        return True
