"""Driving through the console: commands of one driver, and an emergency stop for everyone.

:class:`DriveGate` decides which command is valid. It knows no sockets, and its caller passes the time.
:class:`DriveService` publishes the commands that the gate passes, on the server's loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import secrets
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated

from instant_ic.config.ranges import Plausible, check_ranges
from instant_ic.console.backend import ConsoleBackend
from instant_ic.control.command_gate import CommandGate, GateLimits
from instant_ic.control.robot_lease import Verdict, sender_name
from instant_ic.util.pace import current, suspended_ns
from instant_ic.util.step_gap import StepGap

RATE_COMMANDS = 200  # number of newest commands that are kept to measure the rate
CONFIRM_S = 1.0  # time in which the robot must confirm a press of the emergency stop; until then the press counts
LOOK_S = 0.1
"""Longest time between two steps of the server while there is a driver."""
logger = logging.getLogger("instant_ic.console")


@dataclass(frozen=True)
class DriveConfig:
    """Speed limits, and the time-outs after which a command expires.

    Attributes:
        max_linear_mps: m/s at full speed limit; commands are clamped to it.
        max_angular_rps: rad/s at full speed limit; commands are clamped to it.
        rate_hz: rate of /operator/cmd_vel while driving.
        watchdog_s: time without a command from the page, while driving, after which zero is published.
        max_command_age_s: largest age of a command on arrival; older commands are dropped.
        stop_repeat_s: time after a stop during which zeros are published at rate_hz; afterwards at keep_alive_hz.
        keep_alive_hz: rate of an idle driver's zeros, which show the arbiter that the operator is present (arbiter:
            timeouts.command).
        beat_timeout_s: time without a message from the driver's page (it pings at 20 Hz) after which the driver is
            reported lost to the arbiter.
        lease_timeout_s: time without a message from the driver's page after which it loses the lease.
        stop_after_s: time for which the console may stand still before the driver must let go of the controls; at most
            the arbiter's timeouts.stop_after_s.
    """

    max_linear_mps: Annotated[float, Plausible(0.02, 3)] = 0.4
    max_angular_rps: Annotated[float, Plausible(0.05, 6)] = 0.8
    rate_hz: Annotated[float, Plausible(5, 200)] = 20.0
    watchdog_s: Annotated[float, Plausible(0.02, 1)] = 0.25
    max_command_age_s: Annotated[float, Plausible(0.02, 1)] = 0.3
    stop_repeat_s: Annotated[float, Plausible(0, 5)] = 0.3
    keep_alive_hz: Annotated[float, Plausible(1, 100)] = 10.0
    beat_timeout_s: Annotated[float, Plausible(0.02, 2)] = 0.25
    lease_timeout_s: Annotated[float, Plausible(0.05, 120)] = 2.0
    stop_after_s: Annotated[float, Plausible(0.1, 10)] = 1.5

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.watchdog_s * self.rate_hz < 2:
            raise ValueError(f"watchdog_s must span two commands of rate_hz (got {self.watchdog_s} s)")


class DriveGate:
    """Lease of one driver, and the newest command that is still valid; zero if in doubt.

    Zeros mean that the operator is present and commands nothing. Silence means that nobody is present. Zeros of an idle
    driver are therefore published only while his page sends messages. After the page's loss one zero is published, then
    nothing. :meth:`driver_alive` reports the loss.
    """

    def __init__(self, config: DriveConfig) -> None:
        self.config = config
        self._gate = CommandGate(GateLimits(max_age_s=config.max_command_age_s, max_ahead_s=config.max_command_age_s))
        self.driver: int | None = None
        self.estop = False
        self._robot_known = False  # True if the robot reports its emergency stop
        self._pressed = -math.inf  # time of a press of the emergency stop that the robot has not confirmed
        self.watchdog_trips = 0
        self.last_age_s: float | None = None
        self._accepted: deque[float] = deque(maxlen=RATE_COMMANDS)
        self._driver_seen = -math.inf
        self._driver_beat = -math.inf
        self._sequence: dict[int, int] = {}
        self._command = (0.0, 0.0)
        self._received = -math.inf
        self._stopped_at = -math.inf
        self._emitted = -math.inf
        self._emitted_command: tuple[float, float] | None = None
        self._gap = StepGap()
        self._held = False  # True after an interruption, until the driver has let go of the controls
        self._let_go_since = -math.inf  # time since which the driver's page is present and commands no motion

    def look(self, now: float, suspended_ns: int = 0) -> None:
        """Record a step of the server: before any message, and at least every ``LOOK_S`` while there is a driver.

        After a gap between steps, the command is zero and the driver counts as lost. After a long gap, or if the
        machine was suspended, the driver must let go of the controls for ``watchdog_s``, because the page may have sent
        a held key all the time.
        """
        gap_s = self._gap.step(round(now * 1e9), suspended_ns)
        if self.driver is None:
            self._gap.pause()
        elif gap_s:
            self.stop(now)
            self._driver_beat, self._let_go_since = -math.inf, now
            self._held |= gap_s > self.config.stop_after_s

    @property
    def command(self) -> tuple[float, float]:
        """Newest valid command, (m/s, rad/s)."""
        return self._command

    @property
    def moving(self) -> bool:
        """True if the command is not zero."""
        return self._command != (0.0, 0.0)

    def request(self, client: int, now: float, *, take: bool = False) -> bool:
        """Give the lease to ``client`` if it is free or ``take`` is set; return whether the client drives."""
        if self.driver == client:
            return True
        if self.driver is not None and not take:
            return False
        self.stop(now)
        self.driver = client
        self._driver_seen = self._driver_beat = self._let_go_since = now
        return True

    def leave(self, client: int, now: float) -> None:
        """Release the lease of ``client`` (hand-over, closed socket), and stop if it drove."""
        if self.driver == client:
            self.stop(now)
            self.driver = None

    def forget(self, client: int, now: float) -> None:
        """Drop the state of a client that has disconnected."""
        self.leave(client, now)
        self._sequence.pop(client, None)

    def touch(self, client: int, now: float, *, away: bool = False) -> bool:
        """Record a message of ``client``; return True if it changes whether the driver is present.

        ``away`` means that the page is hidden or its operator is typing. The page keeps the lease, but its operator
        counts as absent.
        """
        if self.driver != client:
            return False
        was_there = self.driver_alive(now)
        if not was_there:
            self._let_go_since = now
        self._driver_seen = now
        self._driver_beat = -math.inf if away else now  # an away driver is absent at once, without the time-out
        if away:
            self.stop(now)
        return was_there == away

    def driver_alive(self, now: float) -> bool:
        """Return whether there is a driver whose page reported him present within ``beat_timeout_s``."""
        return self.driver is not None and now - self._driver_beat < self.config.beat_timeout_s

    def receive(self, client: int, sequence: int, age_s: float, linear: float, angular: float, now: float) -> Verdict:
        """Handle a drive command (m/s, rad/s; clamped to the limits) and return the result."""
        moves = (linear, angular) != (0.0, 0.0)
        if client == self.driver and moves:
            self._held &= now - self._let_go_since < self.config.watchdog_s
            self._let_go_since = now
        refusal = self._gate.check_twist(linear, angular)
        verdict = self._judge(client, sequence, age_s, moves) if refusal is None else refusal.verdict
        if verdict is not Verdict.ACCEPTED:
            return verdict
        self._sequence[client] = sequence
        self._driver_seen = now
        self.last_age_s = age_s
        self._accepted.append(now)
        limits = self.config
        command = (
            _clamp(linear, limits.max_linear_mps),
            _clamp(angular, limits.max_angular_rps),
        )
        if command == (0.0, 0.0):
            self.stop(now)
        else:
            self._command = command
            self._received = self._driver_beat = now
        return verdict

    def _judge(self, client: int, sequence: int, age_s: float, moves: bool) -> Verdict:
        if client != self.driver:
            return Verdict.NOT_DRIVER
        if sequence <= self._sequence.get(client, -1):
            return Verdict.OUT_OF_ORDER
        if (refusal := self._gate.check_age(age_s)) is not None:
            return refusal.verdict
        if self.estop:
            return Verdict.STOPPED
        return Verdict.HELD if self._held and moves else Verdict.ACCEPTED

    def rate_hz(self, now: float) -> float:
        """Commands accepted within the last second."""
        return float(sum(now - at <= 1.0 for at in self._accepted))

    def stop(self, now: float) -> None:
        """Set the command to zero."""
        if self.moving:
            self._stopped_at = now
        self._command = (0.0, 0.0)

    def set_estop(self, now: float) -> None:
        """Latch the emergency stop."""
        self.estop, self._pressed = True, now
        self.stop(now)

    def release_estop(self, client: int) -> bool:
        """Return whether ``client`` is the driver, who alone may release the emergency stop.

        If a robot reports its state, the stop ends when the robot reports it (:meth:`follow_estop`), otherwise at once.
        """
        if client != self.driver:
            return False
        self.estop = self.estop and self._robot_known
        return True

    def follow_estop(self, pressed: bool | None, now: float) -> bool:
        """Follow the robot's emergency stop (None: no robot reports it). Return whether the state has changed."""
        before, self._robot_known = self.estop, pressed is not None
        if pressed:
            self._pressed = -math.inf
            self.estop = True
            self.stop(now)
        elif pressed is not None and now - self._pressed >= CONFIRM_S:
            self.estop = False
        return self.estop != before

    def take_due(self, now: float) -> tuple[float, float] | None:
        """Return the command to publish now, or None if none is due. Runs the watchdog and the lease time-out."""
        if self.moving and now - self._received >= self.config.watchdog_s:
            self.watchdog_trips += 1
            self.stop(now)
            self._driver_beat = -math.inf  # report a lost driver, so that the base brakes hard
        if self.driver is not None and now - self._driver_seen >= self.config.lease_timeout_s:
            self.leave(self.driver, now)
        # One zero after a stop is published even if the driver has gone.
        if not self.moving and not self.driver_alive(now) and self._emitted_command in (None, (0.0, 0.0)):
            self._emitted_command = None
            return None
        changed = self._command != self._emitted_command
        # With 1 ms of tolerance, a timer that fires slightly early does not skip a period.
        if not changed and now - self._emitted < self._period_s(now) - 0.001:
            return None
        self._emitted = now
        self._emitted_command = self._command
        return self._command

    def next_deadline(self, now: float) -> float | None:
        """Return the time at which to call :meth:`take_due` next; None if nothing is pending."""
        deadlines = []
        if self.moving:
            deadlines += [self._received + self.config.watchdog_s, self._emitted + self._period_s(now)]
        elif self.driver_alive(now) or self._emitted_command is not None:
            deadlines.append(self._emitted + self._period_s(now))
        if self.driver_alive(now):
            deadlines.append(self._driver_beat + self.config.beat_timeout_s)
        if self.driver is not None:
            deadlines.append(self._driver_seen + self.config.lease_timeout_s)
        return max(now, min(deadlines)) if deadlines else None

    def _period_s(self, now: float) -> float:
        """Return the time between two published commands."""
        repeating = now - self._stopped_at <= self.config.stop_repeat_s
        return 1.0 / (self.config.rate_hz if self.moving or repeating else self.config.keep_alive_hz)


class DriveService:
    """The drive gate on the server's loop. It publishes due commands and follows the robot's lease and emergency stop.

    Clients are identified by their number. The gate's time is the steady clock of the pace. After a call that changes
    the gate, :meth:`settle` must be called.

    Args:
        backend: publishes commands and emergency stops.
        config: limits and time-outs.

    Attributes:
        gate: decides which command is valid.
        on_change: called when the driver, the robot's driver or the emergency stop has changed.
    """

    def __init__(self, backend: ConsoleBackend, config: DriveConfig) -> None:
        self.gate = DriveGate(config)
        self.on_change: Callable[[], None] = lambda: None
        self._backend = backend
        self._instance = secrets.token_hex(4)  # other consoles and the next start use the same client numbers
        self._present = False  # True if the backend was notified that a driver is present
        self._commanding: int | None = None  # client in whose name the backend commands
        self._holder: str | None = None  # holder of the robot's lease; empty: nobody; None: unknown
        self._trips = 0
        self._reported = self._state
        self._wake = asyncio.Event()

    @property
    def client(self) -> str:
        """Name of the client in whose name the backend commands, unique among all pages of all consoles."""
        return self._name_of(self._commanding or 0)

    async def run(self) -> None:
        """Publish due commands until cancelled."""
        pace = current()
        while True:
            now = pace.steady_s()
            deadline = self.gate.next_deadline(now)
            if self.gate.driver is not None and deadline is not None:  # the gate checks the time between its steps
                deadline = min(deadline, now + LOOK_S)
            self._wake.clear()
            with contextlib.suppress(TimeoutError):
                delay = None if deadline is None else max(pace.wait_s(deadline - pace.steady_s()), 0.001)
                await asyncio.wait_for(self._wake.wait(), delay)
                continue  # woken, because the deadline may have changed
            try:
                self.settle()
            except Exception:  # the watchdog must outlive an error of the backend
                logger.exception("a drive command could not be published")

    def settle(self) -> None:
        """Publish the due command, and report changes."""
        now = current().steady_s()
        self.look(now)
        command = self.gate.take_due(now)
        if self._commanding is None:
            self._commanding = self.gate.driver
        if command is not None:
            self._backend.on_drive(*command)
        if self._commanding != self.gate.driver:
            self._backend.on_released(self.client)
            self._commanding = self.gate.driver
        if (present := self.gate.driver_alive(now)) != self._present:
            self._present = present
            self._backend.on_operator(present)
        if self.gate.watchdog_trips != self._trips:
            self._trips = self.gate.watchdog_trips
            logger.warning("no drive command for %.2f s; published zero", self.gate.config.watchdog_s)
        if self._state != self._reported:
            self._reported = self._state
            self.on_change()
        self._wake.set()

    @property
    def _state(self) -> tuple[object, ...]:
        return self.gate.driver, self.gate.estop, self._holder

    def look(self, now: float) -> None:
        """Let the gate check whether this process has stood still, before any message is handled."""
        self.gate.look(now, suspended_ns())

    def stop(self) -> None:
        """Command zero at shutdown."""
        self.gate.stop(current().steady_s())
        self.settle()

    def command(self, client: int, sequence: int, age_s: float, linear: float, angular: float, now: float) -> Verdict:
        """Handle a drive command (m/s, rad/s) and return the result."""
        verdict = self.gate.receive(client, sequence, age_s, linear, angular, now)
        self.settle()
        if verdict is Verdict.ACCEPTED and self.role_of(client) == "other":
            return Verdict.NOT_DRIVER  # published anyway: the robot refuses it, but must know that a key is held
        return verdict

    def stop_robot(self, who: str) -> None:
        """Set the emergency stop, which is published before this method returns."""
        self.gate.set_estop(current().steady_s())
        self._backend.on_estop(True)
        self.settle()
        logger.warning("emergency stop from %s", who)

    def release_estop(self, client: int) -> bool:
        """Release the emergency stop; return False if the client is not the driver, who alone may release it."""
        if self.role_of(client) == "other" or not self.gate.release_estop(client):
            return False
        self._backend.on_estop(False)
        self.settle()
        logger.warning("emergency stop released by client %d", client)
        return True

    def follow(self, holder: str | None, estop: bool) -> None:
        """Follow the robot's lease holder (empty: nobody; None: no robot reports) and its emergency stop."""
        changed = self.gate.follow_estop(None if holder is None else estop, current().steady_s())
        if changed or holder != self._holder:
            self._holder = holder
            self.settle()

    def role_of(self, client: int) -> str:
        """Return who drives from a client's view: ``you``, ``other`` or ``none``. A robot that reports decides."""
        driver = self.gate.driver
        if self._holder and not (driver == client and self._holds(client)):
            return "other"
        if driver is None or (driver == client and self._holder == ""):
            return "none"
        return "you" if driver == client else "other"

    def door(self, clients: Iterable[int]) -> str:
        """Return the node and host through which somebody else than the clients drives; empty if nobody does."""
        if not self._holder or any(self._holds(client) for client in clients):
            return ""
        return self._holder.rpartition("/")[0]

    def _name_of(self, client: int) -> str:
        return sender_name(f"page {client} {self._instance}")

    def _holds(self, client: int) -> bool:
        return self._holder is not None and self._holder.endswith(f"/{self._name_of(client)}")


def _clamp(value: float, limit: float) -> float:
    return max(-limit, min(limit, value)) + 0.0  # + 0.0 turns -0.0 into 0.0
