"""Arbitration of drive commands without a socket: lease, watchdog and emergency stop.

The caller passes the time, in seconds of one monotonic clock, so that tests need not wait.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass
from typing import Annotated

from instant_ic.config.ranges import Plausible, check_ranges
from instant_ic.control.command_gate import CommandGate, GateLimits
from instant_ic.control.robot_lease import Verdict
from instant_ic.util.step_gap import StepGap

RATE_COMMANDS = 200  # newest commands kept to measure the rate
CONFIRM_S = 1.0  # time in which the robot confirms a press of the emergency stop; until then the press counts
LOOK_S = 0.1
"""Longest time between two steps of the server while there is a driver."""


@dataclass(frozen=True)
class DriveConfig:
    """Speed limits, and the time-outs after which a command expires.

    Attributes:
        max_linear_mps: m/s at full speed limit; commands are clamped to it.
        max_angular_rps: rad/s at full speed limit; commands are clamped to it.
        rate_hz: rate of /operator/cmd_vel while driving.
        watchdog_s: time without a command from the page, while driving, after which zero is published.
        max_command_age_s: commands older than this on arrival are dropped.
        stop_repeat_s: time after a stop in which zeros are published at rate_hz; afterwards at keep_alive_hz.
        keep_alive_hz: zeros of an idle driver; they show the arbiter that the operator is present (arbiter:
            timeouts.command).
        beat_timeout_s: silence of the driver's page (pings at 20 Hz) after which the driver is reported lost to the
            arbiter.
        lease_timeout_s: silence of the driver's page after which it loses the lease.
        stop_after_s: standstill of the console after which the driver must let go of the controls; at most the
            arbiter's timeouts.stop_after_s.
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
    """Lease of one driver, and the newest command that is still valid; zero whenever in doubt.

    Zeros mean that the operator is present and commands nothing; silence means that nobody is present. An idle driver's
    zeros are therefore published only while his page is heard. After its loss one zero is published, then nothing.
    :meth:`driver_alive` reports the loss itself.
    """

    def __init__(self, config: DriveConfig) -> None:
        self.config = config
        self._gate = CommandGate(GateLimits(max_age_s=config.max_command_age_s, max_ahead_s=config.max_command_age_s))
        self.driver: int | None = None
        self.estop = False
        self._robot_known = False  # the robot reports its emergency stop
        self._pressed = -math.inf  # emergency stop pressed here and not confirmed by the robot
        self.counts: Counter[Verdict] = Counter()
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
        self._held = False  # an interrupted drive: the controls must be released first
        self._let_go_since = -math.inf  # the driver's page is present and commands no motion

    def look(self, now: float, suspended_ns: int = 0) -> None:
        """Note a step of the server, at least every ``LOOK_S`` while there is a driver; before any message is handled.

        After a gap the command is zero and the driver lost. After a long one, or if the machine was suspended, the
        driver must first let go of the controls for ``watchdog_s``: the page has sent the held key all the time.
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
        """Note a message of ``client``; return True if it changes whether the driver is present.

        ``away``: the page is hidden or its operator types. It keeps the lease, but the operator counts as absent.
        """
        if self.driver != client:
            return False
        was_there = self.driver_alive(now)
        if not was_there:
            self._let_go_since = now
        self._driver_seen = now
        self._driver_beat = -math.inf if away else now  # absent at once, without the time-out
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
        self.counts[verdict] += 1
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

        Where a robot reports its state, the stop ends when it says so (:meth:`follow_estop`), else at once.
        """
        if client != self.driver:
            return False
        self.estop = self.estop and self._robot_known
        return True

    def follow_estop(self, pressed: bool | None, now: float) -> bool:
        """Take over the robot's emergency stop; None: it reports none. Return whether the state has changed."""
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
            self._driver_beat = -math.inf  # a lost driver, not a commanded stop: report it, and the base brakes hard
        if self.driver is not None and now - self._driver_seen >= self.config.lease_timeout_s:
            self.leave(self.driver, now)
        # The one zero after a stop is published even if the driver has gone.
        if not self.moving and not self.driver_alive(now) and self._emitted_command in (None, (0.0, 0.0)):
            self._emitted_command = None
            return None
        changed = self._command != self._emitted_command
        # 1 ms of slack, so that a timer that fires slightly early does not skip a period.
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
        """Time between two published commands."""
        repeating = now - self._stopped_at <= self.config.stop_repeat_s
        return 1.0 / (self.config.rate_hz if self.moving or repeating else self.config.keep_alive_hz)


def _clamp(value: float, limit: float) -> float:
    return max(-limit, min(limit, value)) + 0.0  # + 0.0 turns -0.0 into 0.0
