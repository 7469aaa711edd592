"""Updates of a growing map: the part that changed, and the whole map at a lower rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.slam.occupancy import OccupancyGrid

EARLY = 0.99
"""A timer may fire this much before its period has passed."""


@dataclass(frozen=True)
class MapPart:
    """Changed rectangle of a map: int8 cells (h, w) from column ``x`` and row ``y`` on."""

    x: int
    y: int
    values: NDArray[np.int8]


class MapUpdates:
    """Compares the map with the last published one.

    Attributes:
        grid: the last published map; None before the first.

    Args:
        full_period_s: minimum period of whole maps.
    """

    def __init__(self, full_period_s: float) -> None:
        self.grid: OccupancyGrid | None = None
        self._period_ns = EARLY * 1e9 * full_period_s
        self._version = 0
        self._full_ns = 0
        self._partly = False

    def update(
        self, version: int, build: Callable[[], OccupancyGrid], now_ns: int
    ) -> tuple[MapPart | None, OccupancyGrid | None]:
        """Return the changed part and the whole map, each None when it is not to be published now.

        Args:
            version: version of the map; ``build`` is called only if it has changed.
            build: returns the map.
            now_ns: steady time.
        """
        due = now_ns - self._full_ns >= self._period_ns
        if version == self._version:
            # For late subscribers of a latched topic, whose value lacks the parts since.
            return None, self._whole(self.grid, now_ns) if self._partly and due and self.grid is not None else None
        before, grid = self.grid, build()
        self._version, self.grid = version, grid
        if before is None or before.values.shape != grid.values.shape or not np.array_equal(before.origin, grid.origin):
            return None, self._whole(grid, now_ns)
        rows, columns = np.nonzero(before.values != grid.values)
        if len(rows) == 0:
            return None, None
        y, x = int(rows.min()), int(columns.min())
        part = MapPart(x, y, grid.values[y : int(rows.max()) + 1, x : int(columns.max()) + 1])
        if due:
            return part, self._whole(grid, now_ns)
        self._partly = True
        return part, None

    def _whole(self, grid: OccupancyGrid, now_ns: int) -> OccupancyGrid:
        self._full_ns, self._partly = now_ns, False
        return grid
