"""Checks commands from outside the run directory: they must be recent, plausible and from one sender at a time."""

from __future__ import annotations

import math
from dataclasses import dataclass

from instant_ic.config.ranges import Checked, Positive
from instant_ic.control.robot_lease import Lease

DRIVE, STOP = "/operator/cmd_vel", "/operator/estop"
COMMANDS = {DRIVE: "geometry_msgs/msg/TwistStamped", STOP: "std_msgs/msg/Bool"}
"""Topics that a remote operator may send, with their types."""


class CommandRefused(ValueError):
    """A command that must not reach the robot; the message says why."""


@dataclass(frozen=True)
class CommandLimits(Checked):
    """Limits for commands from outside.

    Attributes:
        max_age_s: s; an older command is refused. The clocks of both machines must agree better than this.
        lease_s: s; while one sender drives, commands of others are refused until it has been silent for this long.
        max_linear_mps: m/s; a faster command is refused. The arbiter limits the commands that pass.
        max_angular_rps: rad/s; a faster command is refused.
    """

    max_age_s: Positive = 0.3
    lease_s: Positive = 2.0
    max_linear_mps: Positive = 2.0
    max_angular_rps: Positive = 4.0


class CommandGate:
    """Accepts or refuses each command; independent of bus and clock. Each check raises :class:`CommandRefused`.

    Attributes:
        refused: reason → number of refused commands.
    """

    def __init__(self, limits: CommandLimits) -> None:
        self.limits = limits
        self.refused: dict[str, int] = {}
        self._lease = Lease(limits.lease_s)

    def check_age(self, source_ns: int, now_ns: int) -> None:
        """Refuse an old command, or one from the future, whose age is unknown."""
        age_s = (now_ns - source_ns) / 1e9
        if age_s > self.limits.max_age_s:
            raise self.refuse("old", f"{age_s:.2f} s old, at most {self.limits.max_age_s:g} s allowed")
        if age_s < -self.limits.max_age_s:
            raise self.refuse("future", f"stamped {-age_s:.2f} s ahead of this machine's clock: set both by NTP")

    def check_drive(self, sender: str, v: float, w: float, steady_ns: int, sent: tuple[int, int] | None = None) -> None:
        """Refuse implausible values (m/s, rad/s), a second driver, and by ``sent`` an old command (:meth:`check_age`).

        ``steady_ns`` comes from a clock that is never set, since it measures the lease (:class:`Lease`).
        """
        if not (math.isfinite(v) and math.isfinite(w)):
            raise self.refuse("not finite", f"v {v}, w {w}: not finite")
        if abs(v) > self.limits.max_linear_mps or abs(w) > self.limits.max_angular_rps:
            limits = f"{self.limits.max_linear_mps:g} m/s, {self.limits.max_angular_rps:g} rad/s"
            raise self.refuse("too fast", f"{v:g} m/s, {w:g} rad/s: beyond {limits}")
        refusal = self._lease.refusal(sender, (v, w) != (0.0, 0.0), steady_ns)
        if sent is not None:  # only now: an old command too shows that a key is held
            self.check_age(*sent)
        if refusal is not None:
            raise self.refuse(*refusal)
        self._lease.grant(sender, steady_ns)

    def check_release(self, sender: str, steady_ns: int) -> None:
        """Refuse to release the emergency stop unless the sender is the driver and its commands are current."""
        if not self._lease.holds(sender, steady_ns):
            raise self.refuse("release", f"{sender} does not drive; only the driver may release the emergency stop")

    def release(self, sender: str) -> bool:
        """End a sender's lease; return True if it was the driver."""
        return self._lease.release(sender)

    def refuse(self, reason: str, words: str) -> CommandRefused:
        """Count a refusal by its reason and return the error to raise."""
        self.refused[reason] = self.refused.get(reason, 0) + 1
        return CommandRefused(words)
