"""Global localisation: finds scans anywhere in a known map, without an initial pose."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numba import njit

from instant_ic.slam.config import SlamConfig
from instant_ic.slam.likelihood_field import LikelihoodField, Surface
from instant_ic.slam.loop_search import POOL, Found, LoopSearch, pool
from instant_ic.slam.map_files import occupied_points
from instant_ic.slam.occupancy import OccupancyGrid
from instant_ic.slam.scan import FloatArray

ROTATIONS = 90
COARSE_POINTS = 80
STARTS = 24
MIN_GAIN = 0.2


@njit(cache=True)
def score_places(field, origin, resolution, points, places, rotations):  # type: ignore[no-untyped-def]
    """Best mean field value of the points at each place, over all headings.

    Args:
        field: float32 (H, W).
        origin: (2,) centre of cell (0, 0).
        resolution: metres per cell.
        points: (n, 2) in the base frame, n > 0.
        places: (k, 2) metres.
        rotations: number of headings tried at each place, evenly spaced around the circle.

    Returns:
        value (k,) float32 and heading (k,).
    """
    height, width = field.shape
    n = points.shape[0]
    best = np.zeros(places.shape[0], dtype=np.float32)
    heading = np.zeros(places.shape[0])
    for r in range(rotations):
        yaw = -math.pi + 2 * math.pi * r / rotations
        cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
        dx = (cos_yaw * points[:, 0] - sin_yaw * points[:, 1] - origin[0]) / resolution + 0.5
        dy = (sin_yaw * points[:, 0] + cos_yaw * points[:, 1] - origin[1]) / resolution + 0.5
        for k in range(places.shape[0]):
            px, py = places[k, 0] / resolution, places[k, 1] / resolution
            total = np.float32(0.0)
            for i in range(n):
                # Stop once the remaining points cannot reach the best value.
                if total + (n - i) <= best[k] * n:
                    break
                ix, iy = int(px + dx[i]), int(py + dy[i])
                if 0 <= ix < width and 0 <= iy < height:
                    total += field[iy, ix]
            if total > best[k] * n:
                best[k] = total / n
                heading[k] = yaw
    return best, heading


class Localizer:
    """Finds scans in a saved map.

    Attributes:
        points: the map's occupied cells (n, 2).

    Raises:
        ValueError: the map has no occupied or no free cell.
    """

    def __init__(self, grid: OccupancyGrid, config: SlamConfig) -> None:
        self.points = occupied_points(grid)
        free_rows, free_columns = np.nonzero((grid.values >= 0) & (grid.values < 50))
        if len(self.points) == 0 or len(free_rows) == 0:
            raise ValueError("the map has no occupied or no free cell: localisation needs both")
        free = grid.origin + grid.resolution * (np.column_stack([free_columns, free_rows]) + 0.5)
        low = np.minimum(self.points.min(axis=0), free.min(axis=0))
        high = np.maximum(self.points.max(axis=0), free.max(axis=0))
        self._centre = (low + high) / 2
        field = replace(config.field, max_range_m=float((high - low).max() / 2 + 1.0))
        self._field = LikelihoodField(field, 0.5)
        self._field.draw(
            np.array([*self._centre, 0.0]),
            [Surface(np.zeros(3), self.points, np.zeros(len(self.points), dtype=np.bool_))],
        )
        coarse = POOL * self._field.resolution
        self._places = np.unique(np.round(free / coarse).astype(np.int64), axis=0) * coarse
        self._pooled = pool(self._field.values, POOL)
        self._search = LoopSearch(config.match.residual_sigma)
        self._min_score = config.loop.min_score

    def find(self, points: FloatArray) -> Found | None:
        """Return the only pose where the points (n, 2), in the base frame, fit; None if none or several fit."""
        if len(points) < 10:
            return None
        few = points[(np.arange(min(len(points), COARSE_POINTS)) * len(points)) // min(len(points), COARSE_POINTS)]
        coarse = POOL * self._field.resolution
        value, heading = score_places(self._pooled, self._field.origin, coarse, few, self._places, ROTATIONS)
        found: list[Found] = []
        taken: list[FloatArray] = []
        for k in np.argsort(-value, kind="stable"):
            if len(found) >= STARTS or value[k] < self._min_score:
                break
            place = self._places[k]
            if any(math.hypot(*(place - other)) < 2 * coarse for other in taken):
                continue
            taken.append(place)
            start = np.array([*place, heading[k]])
            near = self._search.find(self._field, points, start, 2 * coarse, 2 * math.pi / ROTATIONS)
            if near is not None:
                found.append(near)
        if not found:
            return None
        found.sort(key=lambda one: -one.score)
        best = found[0]
        others = [one.score for one in found[1:] if self._search.apart(one.pose, best.pose)]
        best = replace(best, runner_up=max(others, default=0.0))
        gain = (best.score - best.runner_up) / max(1.0 - best.runner_up, 1e-6)
        return best if best.score >= self._min_score and gain >= MIN_GAIN else None
