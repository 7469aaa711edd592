"""Turn of the sensor's head from packet to packet, and the sector that a limited field of view leaves out.

A sensor with a limited field of view sends no blocks from the other directions. Time and azimuth then jump between two
blocks of one packet, or between two packets, although no packet is missing. `Head` learns the blocked sector from these
jumps, so that lost packets can still be counted.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from instant_ic.lidar.decode import largest_step, turn_to
from instant_ic.lidar.packets import BLOCK_PERIOD_US

TURN_CDEG = 36000
_SAME_EDGE_CDEG = 200
"""Largest difference of a sector's edge from turn to turn: two blocks at 1200 rpm, and a margin."""


@dataclass(frozen=True)
class Sector:
    """Directions from ``start`` clockwise over ``width``, both in hundredths of a degree."""

    start: int
    width: int

    @property
    def end(self) -> int:
        return (self.start + self.width) % TURN_CDEG

    def within(self, start: int, turned: int) -> float:
        """Return the part of a turn that lies inside the sector, 0.01 degrees; the turn begins at ``start``."""
        begin = (start - self.start) % TURN_CDEG
        return self._passed(begin + turned) - self._passed(begin)

    def _passed(self, turned: int) -> int:
        turns, rest = divmod(turned, TURN_CDEG)
        return turns * self.width + min(rest, self.width)

    def resembles(self, other: Sector) -> bool:
        """Return whether both edges agree within the spacing of blocks in different turns."""
        start = (other.start - self.start + _SAME_EDGE_CDEG) % TURN_CDEG
        return start <= 2 * _SAME_EDGE_CDEG and abs(other.width - self.width) <= 2 * _SAME_EDGE_CDEG

    def contains(self, azimuth: int) -> bool:
        """Return whether an azimuth is inside, clear of both edges."""
        inside = (azimuth - self.start) % TURN_CDEG
        return _SAME_EDGE_CDEG < inside < self.width - _SAME_EDGE_CDEG


class Head:
    """Turn of the head, followed through the azimuths of the packets' blocks.

    Attributes:
        blocked: sector without blocks; None if there is none, or not yet known.
        span: turn from the first to the last block of the newest packet, 0.01 degrees.
    """

    def __init__(self, blocked: Sector | None = None) -> None:
        """Start with the blocked sector of the configuration, if it has one."""
        self.blocked = blocked
        self.span = 0
        self._suspect: Sector | None = None
        self._azimuths: Sequence[int] = ()
        self._step = 0.0
        """Turn from one block to the next, 0.01 degrees."""

    def restart(self) -> None:
        """Forget the last packet, because the next one does not continue it."""
        self._azimuths = ()

    def take(self, azimuths: Sequence[int], step_us: float | None) -> tuple[float, int]:
        """Follow the head to a new packet.

        Args:
            azimuths: azimuth of each block, once for a pair of dual returns, 0.01 degrees.
            step_us: time since the last packet; None before the first one.

        Returns:
            Part of ``step_us`` during which the sensor sent packets, in microseconds, and the turn from the last block
            of the last packet to the first block of this one, 0.01 degrees. Both are 0 before the first packet.
        """
        before, self._azimuths = self._azimuths, azimuths
        between, sent_us = 0, 0.0
        if before and step_us is not None:
            turn = turn_to(before[0], azimuths[0])
            turns = (self._step * step_us / BLOCK_PERIOD_US - turn) / TURN_CDEG
            turn += TURN_CDEG * max(0, round(turns))
            between = turn - self.span
            blocked = self.blocked.within(before[0], turn) if self.blocked is not None and turn > 0 else 0.0
            sent_us = step_us * (1.0 - blocked / turn) if turn > 0 else step_us
            self._look_between(before[-1], between)
        self._look_inside(azimuths)
        return sent_us, between

    def _look_inside(self, azimuths: Sequence[int]) -> None:
        steps = [after - before for before, after in itertools.pairwise(azimuths)]
        if min(steps) < 0:
            steps = [turn_to(before, after) for before, after in itertools.pairwise(azimuths)]
        self.span = sum(steps)
        limit = largest_step(min(steps))
        if max(steps) <= limit:
            self._step = self.span / len(steps)
        elif near := [step for step in steps if step <= limit]:
            self._step = sum(near) / len(near)
            for azimuth, step in zip(azimuths, steps, strict=False):
                if step > limit:
                    self.blocked = self._after(azimuth, step)
        if self.blocked is not None and any(self.blocked.contains(azimuth) for azimuth in azimuths):
            self.blocked = None

    def _look_between(self, azimuth: int, turn: int) -> None:
        """Learn a sector between two packets once its gap appears twice; lost packets leave no gap twice."""
        if self._step <= 0.0 or turn <= largest_step(round(self._step)):
            return
        found = self._after(azimuth, turn % TURN_CDEG)
        if self._suspect is not None and self._suspect.resembles(found):
            self.blocked = found
        self._suspect = found

    def _after(self, azimuth: int, turn: int) -> Sector:
        step = round(self._step)
        return Sector((azimuth + step) % TURN_CDEG, max(0, turn - step))
