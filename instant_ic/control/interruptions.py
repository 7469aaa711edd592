"""Interruptions after which the operator must release the controls, even if every source is fresh again."""

from __future__ import annotations

import math
from collections.abc import Mapping

from instant_ic.control.reasons import Notice
from instant_ic.control.states import Reason
from instant_ic.util.step_gap import StepGap

WATCHED = {"odometry": "base driver", "nav": "navigator", "vbot": "virtual robot", "command": "operator's console"}
"""Sources whose restart stops the robot, with the names of their nodes for the operator."""


class Interruptions:
    """Detector of events after which a held key must not drive on: a long gap, a suspension, a restarted node."""

    def __init__(self) -> None:
        self.gap = StepGap()
        self.gap_s = 0.0
        """Seconds since the previous step if that was too long, else 0."""
        self._instances: dict[tuple[str, str], bytes] = {}

    def step(
        self, steady_ns: int, suspended_ns: int, instances: Mapping[tuple[str, str], bytes], longest_s: float
    ) -> Notice | None:
        """Record a step of the arbiter; return the interruption since the previous step, or None.

        ``suspended_ns`` and ``instances`` are as in ``ArbiterInputs``; a gap above ``longest_s`` is an interruption.
        """
        self.gap_s = self.gap.step(steady_ns, suspended_ns)
        new = [key for key, instance in instances.items() if self._instances.get(key, instance) != instance]
        self._instances |= instances
        if math.isinf(self.gap_s):
            return Notice(Reason.INTERRUPTED, "This computer was suspended.")
        if self.gap_s > longest_s:
            return Notice(Reason.INTERRUPTED, f"The robot's controller paused for {self.gap_s:.1f} s.")
        if new:
            names = ", ".join(sorted({f"{WATCHED[key]} ({publisher})" for key, publisher in new}))
            return Notice(Reason.INTERRUPTED, f"The {names} was restarted.")
        return None
