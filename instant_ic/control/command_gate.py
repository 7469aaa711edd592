"""Checks of a drive command, shared by every receiver.

A command passes if

1. its numbers are finite, and within the limits of the gate;
2. its sender has the right to drive (:class:`~instant_ic.control.robot_lease.Lease`), where the gate has a lease;
3. it is recent: neither too old, nor stamped ahead of the receiver's clock, nor without a stamp.

Each receiver adds checks of its own. The console accepts numbered commands of one driver, the page that took control.
The base obeys one node by its name. The arbiter accepts an old command of the driver, because it watches the command's
age itself and stops the robot when the command is stale.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

from instant_ic.control.robot_lease import Lease, Refusal, Verdict


@dataclass(frozen=True)
class GateLimits:
    """Limits of a gate.

    Attributes:
        max_age_s: age in seconds on arrival above which a command is refused.
        max_ahead_s: lead of a stamp over the receiver's clock above which a command is refused, in seconds.
        max_linear_mps: m/s; a faster command is refused.
        max_angular_rps: rad/s; a faster command is refused.
        accept_unstamped: accept a command without a stamp, whose age is unknown.
    """

    max_age_s: float
    max_ahead_s: float
    max_linear_mps: float = math.inf
    max_angular_rps: float = math.inf
    accept_unstamped: bool = False


class CommandGate:
    """The check whether a command may drive; independent of bus and clock.

    Args:
        limits: limits of the commands.
        lease: lease of the right to drive; None: the caller decides by itself who drives.

    Attributes:
        refused: number of refused commands by verdict.
    """

    def __init__(self, limits: GateLimits, lease: Lease | None = None) -> None:
        self.limits = limits
        self.lease = lease
        self.refused: Counter[Verdict] = Counter()

    def refuse(self, verdict: Verdict, text: str) -> Refusal:
        """Count a refusal and return it."""
        self.refused[verdict] += 1
        return Refusal(verdict, text)

    def check_twist(self, v: float, w: float) -> Refusal | None:
        """Check the numbers of a command: speed in m/s and turn rate in rad/s."""
        if not (math.isfinite(v) and math.isfinite(w)):
            return self.refuse(Verdict.NOT_FINITE, f"command is not finite (v={v}, w={w})")
        limits = self.limits
        if abs(v) > limits.max_linear_mps or abs(w) > limits.max_angular_rps:
            most = f"{limits.max_linear_mps:g} m/s, {limits.max_angular_rps:g} rad/s"
            return self.refuse(Verdict.TOO_FAST, f"{v:g} m/s, {w:g} rad/s: beyond {most}")
        return None

    def check_age(self, age_s: float | None) -> Refusal | None:
        """Check the age of a command by its stamp, in seconds; None for a command without a stamp."""
        limits = self.limits
        if age_s is None:
            return None if limits.accept_unstamped else self.refuse(Verdict.UNSTAMPED, "command has no stamp")
        if not math.isfinite(age_s):
            return self.refuse(Verdict.NOT_FINITE, f"age of the command is not finite ({age_s} s)")
        if age_s > limits.max_age_s:
            return self.refuse(Verdict.OLD, f"command is {age_s:.2f} s old, at most {limits.max_age_s:g} s allowed")
        if age_s < -limits.max_ahead_s:  # a stamp in the future does not prove that the command is recent
            return self.refuse(Verdict.FUTURE, f"command's stamp is {-age_s:.2f} s ahead: set the clocks")
        return None

    def admit(
        self,
        v: float,
        w: float,
        age_s: float | None,
        sender: str = "",
        now_ns: int = 0,
        *,
        given_ns: int | None = None,
        stands: bool = True,
    ) -> Refusal | None:
        """Check a command; return why it must not drive, or None. An accepted command prolongs its sender's lease.

        Args:
            v: speed in m/s.
            w: turn rate in rad/s.
            age_s: age in seconds by its stamp; None without a stamp.
            sender: name of the sender.
            now_ns: steady time.
            given_ns: steady time at which the command was given, the start of the lease; ``now_ns`` if None.
            stands: whether the robot stands; the lease passes to another sender only then.
        """
        if (refusal := self.check_twist(v, w)) is not None:
            return refusal
        if self.lease is None:
            return self.check_age(age_s)
        # The lease is checked first, because an old command also shows that a control is held.
        denied = self.lease.refusal(sender, (v, w) != (0.0, 0.0), now_ns, stands)
        if (refusal := self.check_age(age_s)) is not None:
            return refusal
        if denied is not None:
            return self.refuse(*denied)
        self.lease.grant(sender, now_ns if given_ns is None else given_ns)
        return None

    def admit_release(self, sender: str, age_s: float | None, now_ns: int) -> Refusal | None:
        """Check a release of the emergency stop: it must be recent, and its sender must be the present driver."""
        if (refusal := self.check_age(age_s)) is not None:
            return refusal
        if self.lease is None or not self.lease.holds(sender, now_ns):
            text = f"{sender} does not drive; only the driver may release the emergency stop"
            return self.refuse(Verdict.RELEASE, text)
        return None
