"""The operator's commands over time: last motion, release, and controls held from before an interruption."""

from __future__ import annotations

from instant_ic.control.kinematics import MotionLimits
from instant_ic.control.reasons import Notice
from instant_ic.control.snapshot import NO_MOTION, ArbiterInputs
from instant_ic.control.states import Reason

LET_GO_S = 0.1
"""Seconds of zeros that show that no control is held. A single zero is no proof: the console sends one just before it
reports a lost page, and a page that reconnects sends one before the command of a held key."""
_MOST_SENDERS = 64
"""Largest number of remembered senders: a page has a new name after each start."""


class OperatorCommands:
    """The operator's commands, followed from step to step.

    A control that was held while its commands were refused, or when they ended, must be released before it drives
    again. The rule binds its sender even after a reconnect; if commands ended, it binds the next operator too. Commands
    end when none is fresh for too long, or when their sender gives up the lease or restarts. The rule applies only to
    senders that send zeros while their operator commands nothing, as the console does: silence of any other sender may
    be a release.

    Attributes:
        command: m/s, rad/s, within the limits; zero when stale.
        fresh: the command is not stale, and its client is still connected.
        last: the last command that was not zero.
        held_by: sender of the last motion, until it has let go; empty if that sender sends no zeros.
    """

    def __init__(self) -> None:
        self.command = self.last = NO_MOTION
        self.fresh = False
        self.held_by = ""
        self._fresh_ns: int | None = None  # time of the last fresh command
        self._driven_ns: int | None = None  # time of the last motion
        self._let_go_ns: int | None = None  # start of the present sender's zeros
        self._holder = ""  # holder of the lease in the previous step
        # Sender that must release a control first -> whether it is known to send zeros.
        self._must_release: dict[str, bool] = {}
        self._ended = False  # commands ended while a control was held, and no operator has let go since

    def step(
        self, inputs: ArbiterInputs, fresh: bool, limits: MotionLimits, longest_s: float, now_ns: int
    ) -> Notice | None:
        """Record the command of a step if it is ``fresh``; return why the controls must be released first, or None.

        After a silence of ``longest_s``, a held control must be released.
        """
        self.fresh, self.command = fresh, limits.clip(*inputs.operator_command) if fresh else NO_MOTION
        if self._driven_ns is None:
            self._driven_ns = now_ns
        if fresh or self._fresh_ns is None:
            self._fresh_ns = now_ns
        holder, before = inputs.holder, self._holder
        self._holder = holder
        # If every command arrives late, its age stays small although none is fresh.
        silent_s = 0.0 if fresh else max(inputs.age("command"), (now_ns - self._fresh_ns) / 1e9)
        if self.held_by and (holder != self.held_by or silent_s > longest_s):
            self._ended = True
            self._note(self.held_by, sends_zeros=True)
        for sender in inputs.refused:
            self._note(sender, sends_zeros=self._must_release.get(sender, False))
        if self.command != NO_MOTION:
            self.last, self._driven_ns, self._let_go_ns = self.command, now_ns, None
            self.held_by = holder if inputs.holder_sends_zeros or self._must_release.get(holder) else ""
            ended = self.held_by and (self._ended or holder in self._must_release)
            return Notice(Reason.OPERATOR_LOST, "The operator's link was lost.") if ended else None
        if not fresh:
            self._let_go_ns = None
        elif self._let_go_ns is None or holder != before:
            self._let_go_ns = now_ns
        if fresh and holder and self.let_go_s(now_ns) >= LET_GO_S:
            self.held_by, self._ended = "", False
            self._must_release.pop(holder, None)
        return None

    def _note(self, sender: str, *, sends_zeros: bool) -> None:
        self._must_release[sender] = sends_zeros
        if len(self._must_release) > _MOST_SENDERS:
            del self._must_release[next(iter(self._must_release))]

    def idle_s(self, now_ns: int) -> float:
        """Return seconds since the last motion was commanded."""
        return 0.0 if self._driven_ns is None else (now_ns - self._driven_ns) / 1e9

    def let_go_s(self, now_ns: int) -> float:
        """Return the seconds for which fresh commands have been zero; -1 while they are stale or not zero."""
        return -1.0 if self._let_go_ns is None else (now_ns - self._let_go_ns) / 1e9

    def forget_zeros(self) -> None:
        """Restart the count of zeros at the next step, because the time before it was not watched."""
        self._let_go_ns = None

    def hand_back(self, now_ns: int) -> None:
        """Take the present command as the last one, because the operator drives the r-bot from now on."""
        self.last, self._driven_ns = self.command, now_ns
