"""The static map and its walls: long straight runs of occupied cells. Shorter runs are obstacles."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

OCCUPIED = 65
"""Cells of at least this probability (0..100) are obstacles."""
WALL_LENGTH_M = 1.5
"""A straight run of occupied map cells of at least this length is a wall; a shorter one is an obstacle."""
WALL_PERIOD_S = 2.0
"""Shortest time between two searches for walls in a changing map."""


@dataclass(frozen=True)
class StaticMap:
    """An occupancy grid: -1 unknown, 0..100 probability of being occupied."""

    occupancy: NDArray[np.int8]
    resolution: float
    origin: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.occupancy.ndim != 2 or self.occupancy.size == 0:
            raise ValueError(f"map must be a grid with cells (got shape {self.occupancy.shape})")
        if not self.resolution > 0:
            raise ValueError(f"map resolution must be > 0 (got {self.resolution})")


class WallMap:
    """Distance to the nearest wall of a map.

    Walls and obstacles differ only in length: a straight run of at least ``WALL_LENGTH_M`` is a wall, which the v-bot
    does not pass. A box, a chair or a person is an obstacle, even if it touches a wall. Curved walls are obstacles too.
    """

    def __init__(self, static: StaticMap) -> None:
        import cv2

        self.static = static
        self.occupied: NDArray[np.bool_] = static.occupancy >= OCCUPIED
        """(H, W) mask of the cells that may be part of a wall."""
        occupied = self.occupied.astype(np.uint8)
        length = max(2, math.ceil(WALL_LENGTH_M / static.resolution))
        lines = cv2.HoughLinesP(occupied * 255, 1.0, math.pi / 180.0, length // 2, minLineLength=length, maxLineGap=3)
        drawn = np.zeros_like(occupied)
        for x0, y0, x1, y1 in np.zeros((0, 4), np.int32) if lines is None else np.reshape(lines, (-1, 4)):
            cv2.line(drawn, (int(x0), int(y0)), (int(x1), int(y1)), 1, thickness=3)
        self.mask: NDArray[np.bool_] = (drawn & occupied).astype(bool)
        if self.mask.any():
            distance = cv2.distanceTransform((~self.mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            self._distance = distance.astype(np.float64) * static.resolution
        else:
            self._distance = np.full(self.mask.shape, np.inf)

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance (...) in metres from points (..., 2) to the nearest wall; inf outside the map."""
        index = np.floor((np.asarray(points) - self.static.origin) / self.static.resolution).astype(np.int64)
        height, width = self._distance.shape
        columns, rows = index[..., 0], index[..., 1]
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        found = self._distance[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
        return np.where(inside, found, np.inf)


class WallSearch:
    """The newest map, and the walls found in it.

    Finding walls in a large map takes tens of milliseconds. A map arrives each second, and most bring nothing new.
    """

    def __init__(self) -> None:
        self.map: StaticMap | None = None
        self.found: WallMap | None = None
        self.submit: Callable[[StaticMap], None] = lambda static: None
        """Function that runs :meth:`find` on another thread and passes its result to :meth:`on_found`."""
        self._map_is_new = False

    def find(self, static: StaticMap) -> WallMap:
        """Return the walls of ``static``; the previous result if the map has not changed."""
        before = self.found
        if (
            before is None
            or before.static.resolution != static.resolution
            or not np.array_equal(before.static.origin, static.origin)
            or not np.array_equal(before.occupied, static.occupancy >= OCCUPIED)
        ):
            return WallMap(static)
        return before

    def on_map(self, grid: NDArray[np.int8], resolution: float, origin: tuple[float, float]) -> None:
        """Record a map. The first one is searched at once, later ones by :meth:`update`."""
        if grid.size == 0:
            return
        self.map, self._map_is_new = StaticMap(grid, resolution, np.array(origin)), True
        if self.found is None:
            self.update()

    def update(self) -> None:
        """Search the newest map, if it has not been searched yet."""
        if self._map_is_new and self.map is not None:
            self._map_is_new = False
            self.submit(self.map)

    def on_found(self, walls: WallMap) -> None:
        """Record the result of a search."""
        self.found = walls
