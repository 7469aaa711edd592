"""Driving through the console: passes the commands of one driver, and everybody's emergency stop, to the robot."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
from collections.abc import Callable, Iterable

from instant_ic.console.backend import ConsoleBackend
from instant_ic.console.drive import LOOK_S, DriveConfig, DriveGate
from instant_ic.control.robot_lease import Verdict, sender_name
from instant_ic.util.pace import current, suspended_ns

logger = logging.getLogger("instant_ic.console")


class DriveService:
    """Drive gate on the server's loop: publishes what is due, and follows the robot's lease and emergency stop.

    Clients are identified by their number. The gate's time is the steady clock of the pace.

    Args:
        backend: publishes commands and emergency stops.
        config: limits and time-outs.

    Attributes:
        gate: decides which command is valid.
        on_released: called when a client that drove gives its lease back, with its name; see :attr:`client`.
        on_change: called when driver, emergency stop or the number of watchdog trips has changed.
    """

    def __init__(self, backend: ConsoleBackend, config: DriveConfig) -> None:
        self.gate = DriveGate(config)
        self.on_released: Callable[[str], None] = lambda client: None
        self.on_change: Callable[[], None] = lambda: None
        self._backend = backend
        self._instance = secrets.token_hex(4)  # other consoles, and the next start, have clients of the same numbers
        self._present = False  # the backend knows that a driver is present
        self._commanding: int | None = None  # client in whose name the backend commands
        self._holder: str | None = None  # who has the robot's lease; empty: nobody; None: unknown
        self._wake = asyncio.Event()

    @property
    def client(self) -> str:
        """Name of the client in whose name the backend commands, unique among all pages of all consoles."""
        return self._name_of(self._commanding or 0)

    async def run(self) -> None:
        """Publish what is due, until cancelled."""
        pace = current()
        while True:
            driver, trips = self.gate.driver, self.gate.watchdog_trips
            now = pace.steady_s()
            deadline = self.gate.next_deadline(now)
            if driver is not None and deadline is not None:  # the gate looks at the time between its steps
                deadline = min(deadline, now + LOOK_S)
            self._wake.clear()
            with contextlib.suppress(TimeoutError):
                delay = None if deadline is None else max(pace.wait_s(deadline - pace.steady_s()), 0.001)
                await asyncio.wait_for(self._wake.wait(), delay)
                continue  # woken: the deadline may have changed
            self._emit()
            if self.gate.watchdog_trips != trips:
                logger.warning("no drive command for %.2f s: published zero", self.gate.config.watchdog_s)
            if (self.gate.driver, self.gate.watchdog_trips) != (driver, trips):
                self.on_change()

    def look(self, now: float) -> None:
        """Let the gate look whether this process has stood still, before it handles anything."""
        self.gate.look(now, suspended_ns())

    def stop(self) -> None:
        """Command zero at the end."""
        self.gate.stop(current().steady_s())
        self._emit_and_wake()

    def hear(self, client: int, now: float, away: bool) -> None:
        """Note a message of a client; ``away``: its page is hidden."""
        if self.gate.touch(client, now, away=away):
            self._emit_and_wake()

    def command(self, client: int, sequence: int, age_s: float, linear: float, angular: float, now: float) -> Verdict:
        """Handle a drive command (m/s, rad/s) and return the result."""
        verdict = self.gate.receive(client, sequence, age_s, linear, angular, now)
        self._emit_and_wake()
        if verdict is Verdict.ACCEPTED and self.role_of(client) == "other":
            return Verdict.NOT_DRIVER  # published all the same: the robot refuses it, and sees that a key is held
        return verdict

    def request(self, client: int, now: float, take: bool) -> bool:
        """Request the lease for a client; return whether the driver has changed."""
        before = self.gate.driver
        self.gate.request(client, now, take=take)
        self._emit_and_wake()
        return self.gate.driver != before

    def leave(self, client: int, now: float) -> bool:
        """Release a client's lease; return whether the driver has changed."""
        before = self.gate.driver
        self.gate.leave(client, now)
        self._emit_and_wake()
        return self.gate.driver != before

    def forget(self, client: int) -> None:
        """Drop a client that has disconnected."""
        self.gate.forget(client, current().steady_s())
        self._emit_and_wake()

    def stop_robot(self, who: str) -> None:
        """Set the emergency stop; it is published before this returns."""
        news = not self.gate.estop
        self.gate.set_estop(current().steady_s())
        self._backend.on_estop(True)
        self._emit_and_wake()
        if news:
            self.on_change()
        logger.warning("emergency stop from %s", who)

    def release_estop(self, client: int) -> bool:
        """Release the emergency stop; return False if the client is not the driver, who alone may do so."""
        if self.role_of(client) == "other" or not self.gate.release_estop(client):
            return False
        self._backend.on_estop(False)
        self.on_change()
        logger.warning("emergency stop released by client %d", client)
        return True

    def follow(self, holder: str | None, estop: bool) -> None:
        """Take over who has the robot's lease (empty: nobody) and its emergency stop; None: no robot reports."""
        changed = self.gate.follow_estop(None if holder is None else estop, current().steady_s())
        if changed or holder != self._holder:
            self._holder = holder
            self._emit_and_wake()
            self.on_change()

    def role_of(self, client: int) -> str:
        """Return who drives, as a client sees it: ``you``, ``other`` or ``none``. The robot decides, if it reports."""
        driver = self.gate.driver
        if self._holder and not (driver == client and self._holds(client)):
            return "other"
        if driver is None or (driver == client and self._holder == ""):
            return "none"
        return "you" if driver == client else "other"

    def door(self, clients: Iterable[int]) -> str:
        """Return the node, and host, through which somebody drives who is none of the clients; else empty."""
        if not self._holder or any(self._holds(client) for client in clients):
            return ""
        return self._holder.rpartition("/")[0]

    def _name_of(self, client: int) -> str:
        return sender_name(f"page {client} {self._instance}")

    def _holds(self, client: int) -> bool:
        """Return whether a client has the robot's lease."""
        return self._holder is not None and self._holder.endswith(f"/{self._name_of(client)}")

    def _emit_and_wake(self) -> None:
        self._emit()
        self._wake.set()

    def _emit(self) -> None:
        """Publish the command that is due, and report a driver who is present or lost."""
        now = current().steady_s()
        self.look(now)
        command = self.gate.take_due(now)
        if self._commanding is None:
            self._commanding = self.gate.driver
        if command is not None:
            self._backend.on_drive(*command)
        if self._commanding != self.gate.driver:
            self.on_released(self.client)
            self._commanding = self.gate.driver
        if (present := self.gate.driver_alive(now)) != self._present:
            self._present = present
            self._backend.on_operator(present)
