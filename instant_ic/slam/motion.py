"""Compares wheel odometry with scans: detects slip, a stuck, pushed or carried robot; estimates the turn factor."""

from __future__ import annotations

import enum
import math
from collections import deque
from dataclasses import dataclass

from instant_ic.slam.scan import FloatArray

WINDOW_S = 2.0
"""Time window of the comparison: long enough for a slow robot to move clearly."""
STILL_M, STILL_RAD = 0.02, 0.03
"""Tracks below both in the window are standing."""
MOVED_M, MOVED_RAD = 0.1, 0.15
"""A robot above either in the window is moving: several times the error of scan matching."""
CARRIED_JUMP_M = 0.4
"""Jump between two scans, with standing tracks, above which the robot was carried."""
SLIP_SHARE, STUCK_SHARE = 0.4, 0.85
"""Shares of the track distance lost above which the robot is slipping, or stuck."""
TURN_MEMORY = 0.95
"""Weight of older turns in the estimate of the effective track width: about the last 20 blocks count."""


class MotionState(enum.StrEnum):
    """Motion state of the robot."""

    NORMAL = "normal"
    SLIPPING = "slipping"
    """The tracks turn clearly farther than the robot moves."""
    STUCK = "stuck"
    """The tracks turn, but the robot does not move."""
    PUSHED = "pushed"
    """The robot moves, but the tracks do not."""
    CARRIED = "carried"
    """The tracks do not turn, and the scan shows another place or an unknown one."""


@dataclass(frozen=True)
class _MotionStep:
    seconds: float
    wheels_m: float
    wheels_rad: float
    seen_m: float
    seen_rad: float
    seen: bool


class MotionMonitor:
    """Compares odometry steps with matched steps over the last `WINDOW_S`.

    Attributes:
        state: see `MotionState`.
        slip: share of the track distance lost over the window, 0..1; negative if the robot moved farther than the
            tracks.
        turn_factor: encoder yaw over true yaw, from all turns so far, weighted towards recent ones. The correct
            effective track width is the one in use times this factor.
        turn_factor_sigma: its standard deviation (1σ); inf before the first turn.
    """

    def __init__(self) -> None:
        self.state = MotionState.NORMAL
        self.slip = 0.0
        self.turn_factor = 1.0
        self.turn_factor_sigma = math.inf
        self._steps: deque[_MotionStep] = deque()
        self._span_s = 0.0
        # Sums of the regression of encoder yaw on matched yaw, in blocks of about half a radian.
        self._block_wheels = self._block_seen = 0.0
        self._block_turned = 0.0
        self._squares = self._products = self._errors = self._weight = 0.0

    def update(self, wheels: FloatArray, seen: FloatArray, elapsed_s: float, matched: bool) -> MotionState:
        """Add a step and return the motion state.

        Args:
            wheels: odometry step (3,), in the base's frame.
            seen: matched step (3,).
            elapsed_s: duration of the step.
            matched: whether the scan was matched.
        """
        wheels_m = math.copysign(math.hypot(wheels[0], wheels[1]), wheels[0])
        seen_m = math.copysign(math.hypot(seen[0], seen[1]), seen[0])
        self._steps.append(_MotionStep(elapsed_s, wheels_m, float(wheels[2]), seen_m, float(seen[2]), matched))
        self._span_s += elapsed_s
        while len(self._steps) > 1 and self._span_s - self._steps[0].seconds >= WINDOW_S:
            self._span_s -= self._steps.popleft().seconds
        if matched:
            self._learn_turn(float(wheels[2]), float(seen[2]))
        self.state = self._judge()
        return self.state

    def _judge(self) -> MotionState:
        steps = self._steps
        wheels_way = sum(abs(s.wheels_m) for s in steps)
        wheels_turn = sum(abs(s.wheels_rad) for s in steps)
        seen = [s for s in steps if s.seen]
        seen_way = abs(sum(s.seen_m for s in seen))
        seen_turn = abs(sum(s.seen_rad for s in seen))
        stands = wheels_way < STILL_M and wheels_turn < STILL_RAD
        if stands:
            self.slip = 0.0
            if len(seen) < 0.5 * len(steps):
                return MotionState.CARRIED
            jump = max((abs(s.seen_m) for s in seen), default=0.0)
            if jump > CARRIED_JUMP_M:
                return MotionState.CARRIED
            return MotionState.PUSHED if seen_way > MOVED_M or seen_turn > MOVED_RAD else MotionState.NORMAL
        net = abs(sum(s.wheels_m for s in seen))
        self.slip = 1.0 - seen_way / net if net > MOVED_M else 0.0
        turned = abs(sum(s.wheels_rad for s in seen))
        lost_turn = 1.0 - seen_turn * self.turn_factor / turned if turned > MOVED_RAD else 0.0
        if max(self.slip, lost_turn) > STUCK_SHARE and max(seen_way, 0.3 * seen_turn) < STILL_M * 2:
            return MotionState.STUCK
        return MotionState.SLIPPING if max(self.slip, lost_turn) > SLIP_SHARE else MotionState.NORMAL

    def _learn_turn(self, wheels_rad: float, seen_rad: float) -> None:
        self._block_wheels += wheels_rad
        self._block_seen += seen_rad
        self._block_turned += abs(seen_rad)
        if self._block_turned < 0.5:
            return
        wheels, seen = self._block_wheels, self._block_seen
        self._block_wheels = self._block_seen = self._block_turned = 0.0
        if abs(seen) < 0.3 or abs(wheels) > 3 * abs(seen):
            return  # turning back and forth, or a stuck robot: no information about the track width
        keep = TURN_MEMORY
        error = wheels - self.turn_factor * seen
        self._squares = keep * self._squares + seen * seen
        self._products = keep * self._products + seen * wheels
        self._errors = keep * self._errors + error * error
        self._weight = keep * self._weight + 1.0
        self.turn_factor = self._products / self._squares
        if self._weight > 1.5:
            self.turn_factor_sigma = math.sqrt(self._errors / (self._weight - 1.0) / self._squares)
