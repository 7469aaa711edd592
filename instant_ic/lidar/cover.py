"""Sectors of the sensor that something covers: they had returns a moment ago and have none now.

1. Compute the share of rays with a return per sector of a revolution. Ground and ceiling count too.
2. Remember the largest share seen in each direction of the world, by odometry. The memory fades with time and distance.
3. Mark a sector with hardly any returns as covered if many are remembered there and beside it. New returns end this.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from instant_ic.lidar.packets import LASERS
from instant_ic.lidar.stream import Revolution
from instant_ic.util.diagnosis import Diagnosis, Level

SECTORS = 72
HELD, GONE, BACK = 0.25, 0.02, 0.1
"""Shares of rays with a return: least in a sector that held returns, most in one that lost them, least when back."""
FADES_S, FADES_M = 2.0, 0.5
"""Time and distance after which the memory has faded to a third."""
_LEAST_FIRINGS = 4
"""A sector with fewer firings than this, of about twelve, was not measured."""
_WIDTH_RAD = 2.0 * math.pi / SECTORS


class CoverWatch:
    """The covered sectors, updated with each revolution.

    Attributes:
        covered: True for a covered sector; sector i begins at azimuth i * 5 degrees, clockwise, (72,).
    """

    def __init__(self) -> None:
        self.covered: NDArray[np.bool_] = np.zeros(SECTORS, np.bool_)
        self._held = np.zeros(SECTORS)  # by direction in the world
        self._before: tuple[int, NDArray[np.float64]] | None = None

    def update(self, revolution: Revolution, odom_from_base: NDArray[np.float64]) -> None:
        """Take a revolution and the pose (3,) of the base at its end."""
        if self._before is not None:
            elapsed_s = max(0.0, (revolution.end_ns - self._before[0]) * 1e-9)
            moved_m = math.dist(odom_from_base[:2], self._before[1][:2])
            self._held *= math.exp(-elapsed_s / FADES_S - moved_m / FADES_M)
        self._before = revolution.end_ns, odom_from_base
        points = revolution.points
        firings = np.bincount(_sector(revolution.firing_azimuth), minlength=SECTORS)
        returns = np.bincount(_sector(np.arctan2(-points["y"], points["x"])), minlength=SECTORS)
        measured = firings >= _LEAST_FIRINGS
        share = returns / np.maximum(firings * LASERS, 1)
        world = (np.arange(SECTORS) - round(float(odom_from_base[2]) / _WIDTH_RAD)) % SECTORS
        held = self._held[world]
        expected = np.minimum(held, np.minimum(np.roll(held, 1), np.roll(held, -1)))
        self.covered |= measured & (share <= GONE) & (expected >= HELD)
        self.covered &= ~(measured & (share >= BACK))
        self._held[world] = np.maximum(held, np.where(measured, share, 0.0))

    def withhold(self, ranges: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the ranges of a flat scan, (beams,), with NaN for infinite ones in covered sectors."""
        direction = -math.pi + 2.0 * math.pi / len(ranges) * np.arange(len(ranges))
        return np.where(self.covered[_sector(-direction)] & np.isinf(ranges), np.float32(np.nan), ranges)

    @property
    def diagnosis(self) -> Diagnosis:
        """Diagnosis of the covered directions, in degrees clockwise from ahead."""
        if not self.covered.any():
            return Diagnosis("cover", Level.OK, "no sector is covered")
        width, starts = 360 // SECTORS, np.flatnonzero(self.covered & ~np.roll(self.covered, 1))
        first = int(starts[0]) if len(starts) else 0
        text = (
            f"LiDAR covered: no more returns from {int(self.covered.sum()) * width}° of the circle, from "
            f"{first * width}° on (clockwise from ahead). The robot does not drive that way. Uncover the sensor, or "
            "drive away from objects that are too near for it."
        )
        return Diagnosis("cover", Level.ERROR, text)


def _sector(azimuth: NDArray[np.floating]) -> NDArray[np.int64]:
    return np.floor(np.asarray(azimuth, np.float64) / _WIDTH_RAD + 1e-6).astype(np.int64) % SECTORS
