"""Latch of the emergency stop, shared by every node that obeys it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from instant_ic.control.robot_lease import may_release_estop
from instant_ic.util import estop_state
from instant_ic.util.diagnosis import Diagnosis, Level

FUTURE_NS = 500_000_000
"""A release stamped farther ahead than this is refused: it was published before the clock was set back."""
OLD_NS = 3_000_000_000
"""An older message is no new action, but a latched value that was sent again, for example after a bridge restarted."""


@dataclass
class EstopLatch:
    """An emergency stop that any client sets at once, and that only a newer release ends.

    Each client has a latched value of its own. After a restart these values arrive in any order, and an old release of
    one client must not end the stop of another. So a press always counts; a release counts only if it is newer.

    Attributes:
        pressed: a press has not been released yet.
        publisher: name of the node that pressed last.
        pressed_ns: publication time of that press, nanoseconds since the epoch.
        again: the press was an old latched value sent again. A newer release sent again then ends the stop.
        buttons: names of the nodes that report a pressed button on the robot.
    """

    pressed: bool = False
    publisher: str = ""
    pressed_ns: int = 0
    again: bool = False
    buttons: set[str] = field(default_factory=set)

    @property
    def button(self) -> bool:
        """True if a button on the robot is pressed. Until the button is released, every release is refused."""
        return bool(self.buttons)

    @property
    def stopped(self) -> bool:
        """True if nothing may move."""
        return self.pressed or self.button

    @property
    def diagnosis(self) -> Diagnosis:
        """The state of the latch: who pressed the emergency stop, and how to release it."""
        if not self.stopped:
            return Diagnosis("emergency stop", Level.OK, "Released")
        by = "the robot (its button, or a fault of its motor controller)" if self.button else self.publisher
        return Diagnosis("emergency stop", Level.WARN, f"Latched by {by}. Release it on the operator's page")

    def hear(self, pressed: bool, publisher: str, publish_ns: int, received_ns: int, holder: str | None = None) -> str:
        """Handle a message of ``/operator/estop``.

        Args:
            pressed: value of the message.
            publisher: name of the node that published it.
            publish_ns: time of publication in nanoseconds since the epoch.
            received_ns: time of arrival by this machine's clock, in the same unit.
            holder: holder of the robot's lease, who alone may release; empty: nobody; None: not known here.

        Returns:
            Why a release is refused; empty if the message was obeyed.
        """
        old = received_ns - publish_ns > OLD_NS
        if pressed:
            self.again = old and (self.again or not self.pressed)
            self._press(publisher, publish_ns)
            return ""
        if not self.stopped:
            return ""
        if self.button:
            cause = "the button on the robot is pressed, or its motor controller reports a fault"
            return f"{cause}. Release the button or remove the fault, then release the stop again."
        advice = "If a clock was set, press stop and release again."
        again = old and self.again  # press and release were both judged before this node started
        if holder is not None and not again and (why := may_release_estop(publisher, holder)):
            return why
        if publish_ns > received_ns + FUTURE_NS:
            ahead_s = (publish_ns - received_ns) / 1e9
            return f"the release by {publisher} is stamped {ahead_s:.1f} s ahead. {advice}"
        if publish_ns < self.pressed_ns:
            return f"the release by {publisher} is older than the stop by {self.publisher}. {advice}"
        if old and not again:
            return f"the release by {publisher} is {(received_ns - publish_ns) / 1e9:.1f} s old. Release again."
        self.pressed = False
        return ""

    def hear_button(self, pressed: bool, publisher: str, publish_ns: int) -> None:
        """Handle a message of ``/robot/estop``. A press latches; releasing the button alone does not end the stop."""
        if pressed:
            self.buttons.add(publisher)
            self.again = False
            self._press(publisher, publish_ns)
        else:
            self.buttons.discard(publisher)

    def _press(self, publisher: str, publish_ns: int) -> None:
        # A publisher's newest press replaces its earlier one even if its clock was set back, so that its own release,
        # stamped by the same clock, is newer than the press.
        same = publisher == self.publisher
        self.pressed_ns = publish_ns if same else max(publish_ns, self.pressed_ns)
        self.pressed, self.publisher = True, publisher


class KeptEstop(EstopLatch):
    """A latch that survives a restart of the node, the stack and the machine (``estop_state``).

    Attributes:
        why: text for the operator about a stop that was not pressed in this run; empty otherwise.
    """

    def __init__(self, run_dir: Path | None, now_ns: int) -> None:
        """Start stopped if the emergency stop was pressed when the last run ended, or if that run was cut off."""
        super().__init__()
        self._run_dir = run_dir
        self._kept = None if run_dir is None else estop_state.read(run_dir)
        if self._kept is not None:
            # Only releases from now on count: after a change of the clock, an old release may look newer than the stop.
            self._kept = replace(self._kept, pressed_ns=now_ns)
            self.hear(True, self._kept.publisher, self._kept.pressed_ns, now_ns)

    @property
    def why(self) -> str:
        return "" if self._kept is None else self._kept.why

    def save(self) -> Diagnosis | None:
        """Save a press, or delete a released one; the disk may be slow.

        Returns:
            Result of writing the file; None if there was nothing to write.
        """
        before, now = self._kept, estop_state.KeptStop(self.publisher, self.pressed_ns) if self.pressed else None
        same = before is not None and now is not None and before.pressed_ns == now.pressed_ns
        if self._run_dir is None or same or now == before:
            return None
        try:
            estop_state.write(self._run_dir, now)
        except estop_state.EstopStateError as error:
            return Diagnosis("estop", Level.ERROR, str(error))
        self._kept = now
        return Diagnosis("estop", Level.OK, "")
