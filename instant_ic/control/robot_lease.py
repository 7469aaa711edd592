"""Lease of the right to drive: one sender at a time, who must release a control held from before first."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from instant_ic.util.diagnosis import Diagnosis, Level

RELEASED = " released"
"""Suffix of a sender's name with which it gives the lease back; its command is zero."""

LEASE_S = 2.0
"""Silence in seconds after which the holder of the robot's lease counts as lost."""
_MOST_CHARACTERS = 64


class Verdict(Enum):
    """Result of checking a command; the value is the text for the operator."""

    ACCEPTED = "The command is accepted."
    NOT_FINITE = "The command is not a number."
    TOO_FAST = "The command is faster than allowed."
    NOT_DRIVER = "Another client drives. Take control first."
    MOVING = "The robot still moves. Drive once it stands."
    HELD = "The controls were held for too long. Let go of them, then drive on."
    UNSTAMPED = "The command has no stamp."
    OLD = "The command is too old."
    FUTURE = "The command is stamped ahead of this clock. Set the clocks."
    OUT_OF_ORDER = "The sequence number is not newer."
    STOPPED = "Emergency stop is pressed. Release it first."
    RELEASE = "Only the driver may release the emergency stop. Take control first."
    NO_SENDER = "The sender of the command is unknown."
    UNREADABLE = "The message cannot be read."
    INSECURE = "The link is not secure."


class Refusal(NamedTuple):
    """Reason why a command may not drive: a verdict for decisions and counts, and a text with the details."""

    verdict: Verdict
    text: str


def sender_name(*parts: str) -> str:
    """Return a sender's name from its gateway, host and client. A part from outside cannot imitate two parts."""
    cleaned = ("".join(c if c.isprintable() and c != "/" else "_" for c in part) for part in parts)
    return "/".join(part[:_MOST_CHARACTERS] for part in cleaned)


class Lease:
    """Right of one sender to drive. Another sender gets it after the holder has released it or was silent.

    A sender that takes over must let go of the controls first, by sending zero, or nothing for ``silent_s``. Otherwise
    a key whose commands were refused so far would suddenly drive the robot. Times are nanoseconds of a steady clock.

    Args:
        silent_s: silence in seconds after which the holder counts as lost.

    Attributes:
        holder: the sender that drives; empty: nobody.
    """

    def __init__(self, silent_s: float) -> None:
        self.silent_s = silent_s
        self.holder = ""
        self._heard_ns = 0  # last command of the holder
        self._held: dict[str, int] = {}  # sender -> time of its last motion that was refused

    def refusal(self, sender: str, moves: bool, now_ns: int, stands: bool = True) -> Refusal | None:
        """Record a command, zero unless ``moves``; return why its sender may not drive, or None if it may (`grant`).

        The lease passes to another sender only while the robot ``stands``.
        """
        since_ns = now_ns - round(self.silent_s * 1e9)
        self._held = {other: held_ns for other, held_ns in self._held.items() if held_ns >= since_ns}
        if not moves:
            self._held.pop(sender, None)
        second = self.holder not in ("", sender) and self._heard_ns >= since_ns
        rolls = sender != self.holder and not stands
        if moves and (second or rolls or sender in self._held):
            self._held[sender] = now_ns
        if second:
            return Refusal(Verdict.NOT_DRIVER, f"{sender} may not drive while {self.holder} does")
        if rolls:
            return Refusal(Verdict.MOVING, f"{sender} may drive once the robot stands")
        if sender in self._held:
            return Refusal(Verdict.HELD, f"{sender} must let go of the controls once before it drives")
        return None

    def grant(self, sender: str, now_ns: int) -> None:
        """Give the lease to a sender that was not refused, or prolong it."""
        self.holder, self._heard_ns = sender, now_ns

    def release(self, sender: str) -> bool:
        """End a sender's lease; return whether the sender had it."""
        if not self.holder or sender != self.holder:
            return False
        self.holder = ""
        return True

    def holds(self, sender: str, now_ns: int) -> bool:
        """Return whether a sender has the lease and is not lost."""
        return bool(sender) and sender == self.holder and now_ns - self._heard_ns <= self.silent_s * 1e9

    def held_in_vain(self, now_ns: int) -> bool:
        """Return whether nobody drives because held controls must be released first."""
        return not self.holds(self.holder, now_ns) and any(
            now_ns - held_ns <= self.silent_s * 1e9 for held_ns in self._held.values()
        )

    @property
    def refused(self) -> tuple[str, ...]:
        """Senders whose motion was refused recently."""
        return tuple(self._held)

    @property
    def diagnosis(self) -> Diagnosis:
        """The present driver; a warning while others try to drive."""
        text = f"{self.holder or 'nobody'} drives"
        if self._held:
            return Diagnosis("operator", Level.WARN, f"{text}; refused: {', '.join(sorted(self._held)[:3])}")
        return Diagnosis("operator", Level.OK, text)


def may_release_estop(publisher: str, holder: str) -> str:
    """Return why the node ``publisher`` may not release the emergency stop.

    Empty if it may, because one of its clients is the ``holder`` of the robot's lease (``node/client``; empty: nobody).
    """
    if holder.startswith(f"{publisher}/"):
        return ""
    driver = f"only {holder} may" if holder else "nobody drives: take control of the robot, then release again"
    return f"the release by {publisher or 'an unknown node'} is refused: {driver}"
