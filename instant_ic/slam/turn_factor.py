"""Estimate of the turn factor, encoder yaw over true yaw, from turns seen by scan matching."""

from __future__ import annotations

import math

MEMORY = 0.95
"""Weight of older turns per block; about the last 20 blocks count."""
BLOCK_RAD = 0.5
"""Turn after which a block of the regression ends."""


class TurnFactor:
    """Regression of encoder yaw on matched yaw.

    Attributes:
        value: encoder yaw over true yaw, weighted towards recent turns. The correct effective track width is the
            configured one times this factor.
        sigma: standard deviation of ``value``; inf before the first turns.
    """

    def __init__(self) -> None:
        self.value = 1.0
        self.sigma = math.inf
        self._block_wheels = self._block_seen = self._block_turned = 0.0
        self._squares = self._products = self._errors = self._weight = 0.0

    def update(self, wheels_rad: float, seen_rad: float) -> None:
        """Add the turn between two matched scans as seen by the wheels and by scan matching."""
        self._block_wheels += wheels_rad
        self._block_seen += seen_rad
        self._block_turned += abs(seen_rad)
        if self._block_turned < BLOCK_RAD:
            return
        wheels, seen = self._block_wheels, self._block_seen
        self._block_wheels = self._block_seen = self._block_turned = 0.0
        if abs(seen) < 0.3 or abs(wheels) > 3 * abs(seen):
            return  # turning back and forth, or a stuck robot, gives no information about the track width
        error = wheels - self.value * seen
        self._squares = MEMORY * self._squares + seen * seen
        self._products = MEMORY * self._products + seen * wheels
        self._errors = MEMORY * self._errors + error * error
        self._weight = MEMORY * self._weight + 1.0
        self.value = self._products / self._squares
        if self._weight > 1.5:
            self.sigma = math.sqrt(self._errors / (self._weight - 1.0) / self._squares)
