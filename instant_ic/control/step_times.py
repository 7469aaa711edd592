"""Timing of a controller: additional steps between two timers, and timers skipped while the robot rests."""

from __future__ import annotations

REST_COSTMAP_S = 0.5
"""Period of the costmap while the robot rests; the command that ends the rest updates it at once."""
REST_STEP_S = 0.1
"""Longest time between two steps while the robot rests: well below every receiver's time-out."""


class StepTimes:
    """Times of the last step and costmap, by a steady clock. The robot rests while it stands with no command to move.

    Attributes:
        obeyed: the operator's command of the last step.
        shown: whether the last step is published for display and planning; every second step is enough.
    """

    def __init__(self) -> None:
        self.obeyed = (0.0, 0.0)
        self.shown = True
        self._early = False  # a step was made early since the last timer
        self._rests = False  # the robot rested at the last step
        self._stepped_ns = self._costmap_ns = 0

    def timer_steps(self, now_ns: int, rests: bool = False) -> bool:
        """Return whether this timer steps."""
        self._early = False
        since_s = (now_ns - self._stepped_ns) / 1e9
        # 0.9, because timers jitter: at 20 Hz every second one must step.
        return not 0.0 <= since_s < 0.9 * REST_STEP_S or not rests

    def command_steps(self, command: tuple[float, float]) -> bool:
        """Return whether to step at once for a command, because a changed one must not wait for the timer."""
        if self._early or command == self.obeyed:
            return False
        self._early = True
        return True

    def costmap_due(self, now_ns: int, rests: bool) -> bool:
        """Return whether to update the costmap; it then counts as updated."""
        if rests and 0.0 <= (now_ns - self._costmap_ns) / 1e9 < REST_COSTMAP_S:
            return False
        self._costmap_ns = now_ns
        return True

    def begin_step(self, now_ns: int, rests: bool) -> bool:
        """Record a step; return whether it ends a rest."""
        before, self._rests, self._stepped_ns = self._rests, rests, now_ns
        self.shown = not self.shown
        return before and not rests
