"""Who drives, and which command holds: the lease, the watchdog and the emergency stop, without a socket.

Times are seconds of one monotonic clock, given by the caller, so that tests need not wait.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum

RATE_COMMANDS = 200  # of which the rate is counted


@dataclass(frozen=True)
class DriveConfig:
    """What may be driven, and when a command no longer holds."""

    max_linear_mps: float = 0.4
    max_angular_rps: float = 0.8
    rate_hz: float = 20.0  # commands given on while driving
    watchdog_s: float = 0.25  # no command from the driver for this long: stop
    max_command_age_s: float = 0.3  # older commands (by the client's stamp) are dropped
    stop_repeat_s: float = 0.3  # zeros are given on at rate_hz for this long after a stop
    keep_alive_hz: float = 10.0  # zeros of an idle driver whose page lives: the operator is there
    beat_timeout_s: float = 0.25  # nothing heard from the driver's page for this long: he is lost, and the arbiter told
    lease_timeout_s: float = 2.0  # a driver who is silent for this long loses the lease

    def __post_init__(self) -> None:
        for key in ("max_linear_mps", "max_angular_rps", "rate_hz", "watchdog_s", "max_command_age_s"):
            _positive(key, getattr(self, key))
        for key in ("keep_alive_hz", "beat_timeout_s", "lease_timeout_s"):
            _positive(key, getattr(self, key))
        if not self.stop_repeat_s >= 0 or not math.isfinite(self.stop_repeat_s):
            raise ValueError(f"stop_repeat_s must be >= 0 (got {self.stop_repeat_s})")
        if self.watchdog_s * self.rate_hz < 2:
            raise ValueError(f"watchdog_s must span two commands of rate_hz (got {self.watchdog_s} s)")


class Verdict(Enum):
    """What became of a drive command."""

    ACCEPTED = "accepted"
    NOT_DRIVER = "another client drives"
    OUT_OF_ORDER = "sequence number not newer"
    OLD = "command too old"
    STOPPED = "emergency stop is set"


class DriveGate:
    """One driver by lease; the newest command that still holds; zero whenever in doubt.

    Zeros mean "the operator is there and wants nothing"; silence means that nobody is there. So an idle driver's zeros
    are given on only while the page is heard, and after its loss one zero goes out, then nothing. :meth:`driver_alive`
    tells of the loss itself.
    """

    def __init__(self, config: DriveConfig) -> None:
        self.config = config
        self.driver: int | None = None
        self.estop = False
        self.counts: dict[Verdict, int] = dict.fromkeys(Verdict, 0)
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

    @property
    def command(self) -> tuple[float, float]:
        """Newest command that holds, (m/s, rad/s)."""
        return self._command

    @property
    def moving(self) -> bool:
        """Whether the command is other than zero."""
        return self._command != (0.0, 0.0)

    def request(self, client: int, now: float, *, take: bool = False) -> bool:
        """Gives the lease to ``client`` if it is free or ``take`` is set; True when it drives."""
        if self.driver == client:
            return True
        if self.driver is not None and not take:
            return False
        self.stop(now)
        self.driver = client
        self._driver_seen = self._driver_beat = now
        return True

    def leave(self, client: int, now: float) -> None:
        """Gives the lease back (hand-over, closed socket); stops if ``client`` drove."""
        if self.driver == client:
            self.stop(now)
            self.driver = None

    def forget(self, client: int, now: float) -> None:
        """Drops what is known of a client that has gone."""
        self.leave(client, now)
        self._sequence.pop(client, None)

    def touch(self, client: int, now: float, *, away: bool = False) -> bool:
        """Any sign of life of ``client``; True when by it the driver has come back, or gone.

        ``away``: its page is not looked at. It keeps the lease, but the operator does not count as there.
        """
        if self.driver != client:
            return False
        was_there = self.driver_alive(now)
        self._driver_seen = now
        self._driver_beat = -math.inf if away else now  # a page that says so need not be missed first
        return was_there == away

    def driver_alive(self, now: float) -> bool:
        """Whether somebody drives whose page was heard, and looked at, within ``beat_timeout_s``."""
        return self.driver is not None and now - self._driver_beat < self.config.beat_timeout_s

    def receive(self, client: int, sequence: int, age_s: float, linear: float, angular: float, now: float) -> Verdict:
        """Takes a drive command (m/s, rad/s; clamped to the limits) and says what became of it."""
        verdict = self._judge(client, sequence, age_s)
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

    def _judge(self, client: int, sequence: int, age_s: float) -> Verdict:
        if client != self.driver:
            return Verdict.NOT_DRIVER
        if sequence <= self._sequence.get(client, -1):
            return Verdict.OUT_OF_ORDER
        # A stamp from the future tells as little about freshness as an old one.
        if abs(age_s) > self.config.max_command_age_s:
            return Verdict.OLD
        return Verdict.STOPPED if self.estop else Verdict.ACCEPTED

    def rate_hz(self, now: float) -> float:
        """Commands accepted a second, over the last second; 0 while none come."""
        return float(sum(now - at <= 1.0 for at in self._accepted))

    def stop(self, now: float) -> None:
        """Command zero from now on."""
        if self.moving:
            self._stopped_at = now
        self._command = (0.0, 0.0)

    def set_estop(self, now: float) -> None:
        """Latches the emergency stop."""
        self.estop = True
        self.stop(now)

    def release_estop(self, client: int) -> bool:
        """Releases the emergency stop; only the driver may. True when released."""
        if client != self.driver:
            return False
        self.estop = False
        return True

    def take_due(self, now: float) -> tuple[float, float] | None:
        """Command to give on now, or None when none is due. Runs the watchdog and the lease time-out."""
        if self.moving and now - self._received >= self.config.watchdog_s:
            self.watchdog_trips += 1
            self.stop(now)
            self._driver_beat = -math.inf  # a loss, no wish to stop: the arbiter is informed, and the base brakes hard
        if self.driver is not None and now - self._driver_seen >= self.config.lease_timeout_s:
            self.leave(self.driver, now)
        # The one zero after a stop goes out even when nobody is there any more.
        if not self.moving and not self.driver_alive(now) and self._emitted_command in (None, (0.0, 0.0)):
            self._emitted_command = None
            return None
        changed = self._command != self._emitted_command
        # 1 ms of slack: a timer that wakes a little early must not skip a whole period.
        if not changed and now - self._emitted < self._period_s(now) - 0.001:
            return None
        self._emitted = now
        self._emitted_command = self._command
        return self._command

    def next_deadline(self, now: float) -> float | None:
        """When :meth:`take_due` should be called next; None when nothing is going on."""
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
        """Time between two commands given on."""
        repeating = now - self._stopped_at <= self.config.stop_repeat_s
        return 1.0 / (self.config.rate_hz if self.moving or repeating else self.config.keep_alive_hz)


def _clamp(value: float, limit: float) -> float:
    return max(-limit, min(limit, value)) + 0.0  # + 0.0 makes -0.0 a plain zero


def _positive(key: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{key} must be > 0 (got {value})")
