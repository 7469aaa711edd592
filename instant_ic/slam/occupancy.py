"""Occupancy grid by ray casting: log-odds cells that each scan updates. The grid grows with the map.

Log-odds as in Thrun, Burgard, Fox, Probabilistic Robotics, 9.2. A scan changes a cell at most once. A hit outweighs the
rays of the same scan that pass through the cell, so that walls seen at a grazing angle are kept.
"""

from __future__ import annotations

import copy
import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.slam.config import MapConfig
from instant_ic.slam.integrity import contradiction
from instant_ic.slam.scan import FloatArray, ScanPoints

GROW_CELLS = 64


def _log_odds(probability: float) -> float:
    return math.log(probability / (1.0 - probability))


HIT, MISS = _log_odds(0.7), _log_odds(0.4)
"""Log-odds added to a cell in which a beam ended, and to a cell that a beam has passed through."""
LOW, HIGH = _log_odds(0.03), _log_odds(0.97)
"""Limits of a cell's log-odds, so that changes become visible after a few scans."""


class OccupancyGrid(NamedTuple):
    """A map as in nav_msgs/OccupancyGrid.

    Attributes:
        values: probability of being occupied in per cent, −1 if unknown, (H, W) int8; row 0 has the lowest y.
        resolution: metres per cell.
        origin: map coordinates of the lower left corner of cell (0, 0), (2,).
    """

    values: NDArray[np.int8]
    resolution: float
    origin: FloatArray


@njit(cache=True)
def _cast(cells, seen, mark, x0, y0, x1, y1):  # type: ignore[no-untyped-def]
    """Add ``MISS`` to every cell from (x0, y0) up to, but excluding, the cell of (x1, y1) (Amanatides and Woo, 1987).

    Coordinates are in cells; cell i covers i..i + 1.
    """
    height, width = cells.shape
    ix, iy = math.floor(x0), math.floor(y0)
    end_x, end_y = math.floor(x1), math.floor(y1)
    dx, dy = x1 - x0, y1 - y0
    step_x = 1 if dx > 0 else -1
    step_y = 1 if dy > 0 else -1
    delta_x = abs(1.0 / dx) if dx != 0 else 1e30
    delta_y = abs(1.0 / dy) if dy != 0 else 1e30
    next_x = ((ix + 1 - x0) if dx > 0 else (x0 - ix)) * delta_x if dx != 0 else 1e30
    next_y = ((iy + 1 - y0) if dy > 0 else (y0 - iy)) * delta_y if dy != 0 else 1e30
    for _ in range(abs(end_x - ix) + abs(end_y - iy)):
        if 0 <= ix < width and 0 <= iy < height and seen[iy, ix] != mark:
            seen[iy, ix] = mark
            cells[iy, ix] = max(cells[iy, ix] + MISS, LOW)
        if next_x < next_y:
            next_x += delta_x
            ix += step_x
        else:
            next_y += delta_y
            iy += step_y


@njit(cache=True)
def cast_scan(  # type: ignore[no-untyped-def]
    cells, seen, mark, origin, resolution, pose, laser, points, max_range
):
    """Add one scan to a map.

    Args:
        cells: log-odds, (H, W) float32; changed in place.
        seen: number of the scan that last changed a cell, (H, W) int32; changed in place.
        mark: number of this scan, from 1 on.
        origin: corner of cell (0, 0), (2,).
        resolution: metres per cell.
        pose: map_from_base, (3,).
        laser: centre of the laser in the base frame, (2,).
        points: hits in the base frame, (n, 2).
        max_range: longest ray in metres; a hit beyond it only clears cells up to this range.
    """
    height, width = cells.shape
    cos_yaw, sin_yaw = math.cos(pose[2]), math.sin(pose[2])
    laser_x = (pose[0] + cos_yaw * laser[0] - sin_yaw * laser[1] - origin[0]) / resolution
    laser_y = (pose[1] + sin_yaw * laser[0] + cos_yaw * laser[1] - origin[1]) / resolution
    reach = max_range / resolution
    ends = np.empty_like(points)
    for i in range(points.shape[0]):
        x = (pose[0] + cos_yaw * points[i, 0] - sin_yaw * points[i, 1] - origin[0]) / resolution
        y = (pose[1] + sin_yaw * points[i, 0] + cos_yaw * points[i, 1] - origin[1]) / resolution
        length = math.hypot(x - laser_x, y - laser_y)
        if length > reach:
            x = laser_x + (x - laser_x) * reach / length
            y = laser_y + (y - laser_y) * reach / length
        else:
            ix, iy = math.floor(x), math.floor(y)
            if 0 <= ix < width and 0 <= iy < height and seen[iy, ix] != mark:
                seen[iy, ix] = mark
                cells[iy, ix] = min(cells[iy, ix] + HIT, HIGH)
        ends[i, 0] = x
        ends[i, 1] = y
    for i in range(points.shape[0]):
        _cast(cells, seen, mark, laser_x, laser_y, ends[i, 0], ends[i, 1])


@njit(cache=True)
def _percentages(cells, seen):  # type: ignore[no-untyped-def]
    height, width = cells.shape
    values = np.empty((height, width), dtype=np.int8)
    for j in range(height):
        for i in range(width):
            if seen[j, i] == 0:
                values[j, i] = -1
            else:
                values[j, i] = round(100.0 / (1.0 + math.exp(-cells[j, i])))
    return values


class OccupancyMap:
    """A growing occupancy grid.

    Attributes:
        version: counter that grows with every change.
        clipped: number of points dropped because they lie outside ``max_size_m`` around the first pose.
    """

    def __init__(self, config: MapConfig) -> None:
        self.config = config
        self.version = 0
        self.clipped = 0
        self._mark = 0
        self._centre: NDArray[np.int64] | None = None  # cell of the first pose
        self._first = np.zeros(2, dtype=np.int64)  # cell index of the corner; the corner is first·resolution
        self._cells = np.zeros((0, 0), dtype=np.float32)
        self._seen = np.zeros((0, 0), dtype=np.int32)

    @property
    def origin(self) -> FloatArray:
        """Map coordinates (2,) of the lower left corner."""
        corner: FloatArray = self._first.astype(np.float64) * self.config.resolution_m
        return corner

    def insert(self, map_from_base: FloatArray, scan: ScanPoints) -> None:
        """Add a scan at a pose (3,)."""
        self._grow(map_from_base, scan)
        self._mark += 1
        cast_scan(
            self._cells, self._seen, self._mark, self.origin, self.config.resolution_m, map_from_base, scan.origin,
            scan.points, self.config.max_range_m,
        )  # fmt: skip
        self.version += 1

    @classmethod
    def of_grid(cls, grid: OccupancyGrid) -> OccupancyMap:
        """Return a map with the occupied, free and unknown cells of a grid, for comparison with scans."""
        made = cls(MapConfig(resolution_m=grid.resolution))
        made._first = np.round(grid.origin / grid.resolution).astype(np.int64)
        made._cells = np.where(grid.values >= 50, HIGH, LOW).astype(np.float32)
        made._seen = (grid.values >= 0).astype(np.int32)
        return made

    def copy(self) -> OccupancyMap:
        """Return a copy that later scans do not change."""
        made = copy.copy(self)
        made._cells, made._seen = self._cells.copy(), self._seen.copy()
        return made

    def contradiction(self, map_from_base: FloatArray, scan: ScanPoints, newest: int | None = None) -> float:
        """Return the share of rays, 0..1, that contradict the map or only its ``newest`` scans; see `contradiction`."""
        resolution, since = self.config.resolution_m, 1 if newest is None else max(1, self._mark - newest + 1)
        return contradiction(self._cells, self._seen, self.origin, resolution, map_from_base, scan, since)

    def grid(self) -> OccupancyGrid:
        """Return the current map; 0×0 before the first scan."""
        return OccupancyGrid(_percentages(self._cells, self._seen), self.config.resolution_m, self.origin)

    def _grow(self, pose: FloatArray, scan: ScanPoints) -> None:
        """Extend the grid to cover the scan, in steps of GROW_CELLS, up to ``max_size_m`` around the first pose."""
        cos_yaw, sin_yaw = math.cos(pose[2]), math.sin(pose[2])
        rotation = np.array([[cos_yaw, -sin_yaw], [sin_yaw, cos_yaw]])
        rays = np.concatenate([scan.points, scan.origin[None]]) - scan.origin
        length = np.sqrt((rays**2).sum(axis=1, keepdims=True))
        rays *= np.minimum(1.0, self.config.max_range_m / np.maximum(length, 1e-9))
        places = (rays + scan.origin) @ rotation.T + pose[:2]
        resolution = self.config.resolution_m
        limit = int(self.config.max_size_m / 2 / resolution)
        cells = np.floor(places / resolution).astype(np.int64)
        if self._centre is None:
            self._centre = np.floor(pose[:2] / resolution).astype(np.int64)
        inside = (np.abs(cells - self._centre) < limit).all(axis=1)
        self.clipped += int((~inside).sum())
        cells = cells[inside]
        if len(cells) == 0:
            return
        low = (cells.min(axis=0) // GROW_CELLS) * GROW_CELLS
        high = (cells.max(axis=0) // GROW_CELLS + 1) * GROW_CELLS
        if self._cells.size:
            low = np.minimum(low, self._first)
            high = np.maximum(high, self._first + np.array(self._cells.shape[::-1]))
        width, height = (int(v) for v in high - low)
        if (height, width) == self._cells.shape:
            return
        old_height, old_width = self._cells.shape
        column, row = (int(v) for v in self._first - low) if self._cells.size else (0, 0)
        for name in ("_cells", "_seen"):
            old = getattr(self, name)
            new = np.zeros((height, width), dtype=old.dtype)
            new[row : row + old_height, column : column + old_width] = old
            setattr(self, name, new)
        self._first = np.asarray(low, dtype=np.int64)
