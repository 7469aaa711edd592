"""Localisation in a saved map, without an initial pose; the map may then be extended."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from instant_ic.geometry.poses import relative2
from instant_ic.slam.config import SlamConfig
from instant_ic.slam.keyframes import Keyframe
from instant_ic.slam.likelihood_field import LikelihoodField, Surface
from instant_ic.slam.loop_closure import LoopClosure, gather
from instant_ic.slam.loop_search import POOL, Found, apart, find_place, pool
from instant_ic.slam.map_files import occupied_points
from instant_ic.slam.occupancy import OccupancyGrid, OccupancyMap
from instant_ic.slam.pose_graph import Edge
from instant_ic.slam.scan import FloatArray

ROTATIONS = 90
COARSE_POINTS = 80
STARTS = 24
MIN_GAIN = 0.2
UNKNOWN_STEP = np.diag([100.0, 100.0, 10.0])
"""Covariance of the motion from the last saved keyframe to the first new one."""


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
        self._field.rebuild(
            np.array([*self._centre, 0.0]),
            [Surface(np.zeros(3), self.points, np.zeros(len(self.points), dtype=np.bool_))],
        )
        coarse = POOL * self._field.resolution
        self._places = np.unique(np.round(free / coarse).astype(np.int64), axis=0) * coarse
        self._pooled = pool(self._field.values, POOL)
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
            near = find_place(self._field, points, start, 2 * coarse, 2 * math.pi / ROTATIONS)
            if near is not None:
                found.append(near)
        if not found:
            return None
        found.sort(key=lambda one: -one.score)
        best = found[0]
        others = [one.score for one in found[1:] if apart(one.pose, best.pose)]
        best = replace(best, runner_up=max(others, default=0.0))
        gain = (best.score - best.runner_up) / max(1.0 - best.runner_up, 1e-6)
        return best if best.score >= self._min_score and gain >= MIN_GAIN else None


@dataclass(frozen=True)
class Place:
    """Result of a search in the saved map.

    Attributes:
        keyframe: the keyframe that was searched for.
        found: its pose; None if not found.
        map: built from the saved keyframes if the map is to be extended; otherwise None.
    """

    keyframe: Keyframe
    found: Found | None
    map: OccupancyMap | None


class SavedMap:
    """A map from disk, in which the robot is located first.

    Args:
        config: parameters.
        grid: the map.
        graph: its keyframes and edges, to extend the map; None: the map stays unchanged.

    Attributes:
        grid: the map as read.
        localizer: finds scans in it.
        keyframes: saved keyframes; empty if the map stays unchanged.
        edges: edges between them.
        located: whether the robot is located in the map.
    """

    def __init__(
        self, config: SlamConfig, grid: OccupancyGrid, graph: tuple[list[Keyframe], list[Edge]] | None = None
    ) -> None:
        self.grid = grid
        self.localizer = Localizer(grid, config)
        self.keyframes, self.edges = graph or ([], [])
        self.located = False
        self._config = config
        self._searched: Keyframe | None = None

    @property
    def extends(self) -> bool:
        """Whether the map is extended once the robot is located."""
        return bool(self.keyframes)

    @property
    def unchanged(self) -> bool:
        """Whether the map is still as it was read."""
        return not (self.extends and self.located)

    def search_job(self, recent: Sequence[Keyframe]) -> Callable[[], Place] | None:
        """Return a job that searches the map for the recent keyframes; None if the newest was searched for already."""
        if not recent or recent[-1] is self._searched:
            return None
        last = self._searched = recent[-1]
        query = gather([k.map_from_base for k in recent], [k.scan for k in recent])

        def search() -> Place:
            found = self.localizer.find(query)
            return Place(last, found, self.build_map() if found is not None and self.extends else None)

        return search

    def build_map(self) -> OccupancyMap:
        """Build the occupancy map from the saved keyframes."""
        built = OccupancyMap(self._config.map)
        for keyframe in self.keyframes:
            built.insert(keyframe.map_from_base, keyframe.scan)
        return built

    def join(self, own: Sequence[Keyframe], covariance: FloatArray) -> LoopClosure:
        """Tie keyframes ``own``, located with ``covariance`` (3, 3), to the saved graph; return its loop closure."""
        first = own[0]
        # The motion from the last saved keyframe is unknown; the first new keyframe is tied by its pose in the map.
        first.step = relative2(self.keyframes[-1].map_from_base, first.map_from_base)
        first.step_covariance = UNKNOWN_STEP
        for keyframe in own:
            keyframe.drift = covariance
        loop_closure = LoopClosure(self._config)
        loop_closure.load(self.keyframes, self.edges)
        loop_closure.tie(len(self.keyframes), first.map_from_base, covariance)
        return loop_closure
