"""Localisation in a saved map without an initial pose."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.geometry.poses import compose2, relative2, wrap_angle
from instant_ic.slam.config import SlamConfig
from instant_ic.slam.keyframes import ScanKeyframe
from instant_ic.slam.likelihood_field import FieldSurface, LikelihoodField
from instant_ic.slam.loop_closure import LoopClosure, gather
from instant_ic.slam.loop_search import MIN_PLACE_SCORE, POOL, ROTATION_STEP_RAD, Found, apart, pool, refined
from instant_ic.slam.map_files import occupied_points
from instant_ic.slam.occupancy import OccupancyGrid, OccupancyMap
from instant_ic.slam.pose_graph import Edge
from instant_ic.slam.scan import FloatArray, ScanPoints

POINTS = 120
"""Number of query points in the search. The refinement uses all points."""
LEVELS = 4
"""Number of pooled fields. The first has cells of `POOL` field cells, each further one cells twice as wide."""
FIRST_FLOOR, FLOOR_STEP = 0.9, 0.1
"""Score above which poses are examined first, and its decrement. A good place makes lower scores needless."""
MIN_GAIN = 0.2
"""Share of every other place's residual that the found place must explain."""
MAX_STARTS, MAX_NODES = 150, 1_200_000
"""Maximum numbers of refined poses and of bounds in a search. A search that needs more cannot show that its place is
the only one, so the place counts as ambiguous."""
SEARCH_PERIOD_S = 0.5
"""Smallest time between the scans of two searches, which limits the load of a lost robot."""
SAME_M, SAME_RAD = 0.3, 0.1
"""Largest difference between the places of two scans that confirm each other."""
UNKNOWN_STEP = np.diag([100.0, 100.0, 10.0])
"""Covariance of the motion from the last saved keyframe to the first new one."""


@njit(cache=True)
def bound_nodes(field, origin, resolution, points, nodes, sums, counts, floor, rotation_step):  # type: ignore[no-untyped-def]
    """Compute upper bounds of the points' score over nodes, each a cell of translations at one heading.

    A node's sum stops once its bound ``(sums + n - counts) / n`` falls below ``floor``. A later call with a lower floor
    continues it.

    Args:
        field: pooled field, (H, W) float32; a cell holds the best value within it and its next neighbours.
        origin: centre of the first cell of the field that was pooled, (2,).
        resolution: metres per pooled cell.
        points: points in the base frame, (n, 2), n > 0.
        nodes: rotation, row and column of each node, (k, 3) int32; a node covers the translations of a pooled cell.
        sums: sum of the field over the first ``counts`` points, (k,) float32; changed in place.
        counts: number of points in each sum, (k,) int32; changed in place.
        floor: lowest bound of interest, 0..1.
        rotation_step: heading step in radians.
    """
    height, width = field.shape
    n = points.shape[0]
    columns, rows = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    rotation = -1
    for k in range(nodes.shape[0]):
        total, first = sums[k], counts[k]
        if first == n or total + (n - first) < floor * n:
            continue
        if nodes[k, 0] != rotation:
            rotation = nodes[k, 0]
            cos_yaw, sin_yaw = math.cos(rotation * rotation_step), math.sin(rotation * rotation_step)
            # A pooled cell holds the values around its lower corner. Values beyond it are in the next cell.
            for i in range(n):
                columns[i] = math.floor((cos_yaw * points[i, 0] - sin_yaw * points[i, 1]) / resolution) + 1
                rows[i] = math.floor((sin_yaw * points[i, 0] + cos_yaw * points[i, 1]) / resolution) + 1
        last = n
        for i in range(first, n):
            ix, iy = columns[i] + nodes[k, 2], rows[i] + nodes[k, 1]
            if 0 <= ix < width and 0 <= iy < height:
                total += field[iy, ix]
            if total + (n - 1 - i) < floor * n:
                last = i + 1
                break
        sums[k], counts[k] = total, last


@dataclass
class _SearchLevel:
    """Undivided nodes (k, 3) of one level of a search, with their sums and counts (k,)."""

    nodes: NDArray[np.int32]
    sums: NDArray[np.float32]
    counts: NDArray[np.int32]

    @classmethod
    def of(cls, nodes: NDArray[np.int32]) -> _SearchLevel:
        return cls(nodes, np.zeros(len(nodes), dtype=np.float32), np.zeros(len(nodes), dtype=np.int32))

    def add(self, nodes: NDArray[np.int32]) -> None:
        new = _SearchLevel.of(nodes)
        self.nodes = np.concatenate([self.nodes, new.nodes])
        self.sums = np.concatenate([self.sums, new.sums])
        self.counts = np.concatenate([self.counts, new.counts])

    def take(self, good: NDArray[np.bool_]) -> NDArray[np.int32]:
        """Remove and return the nodes that are ``good`` (k,)."""
        taken = self.nodes[good]
        self.nodes, self.sums, self.counts = self.nodes[~good], self.sums[~good], self.counts[~good]
        return taken


class Localizer:
    """Finds scans in a saved map, by branch and bound over all positions and headings.

    A pooled field bounds the score of all poses in a cell of translations (Hess et al., Real-time loop closure in 2D
    LIDAR SLAM, ICRA 2016). All cells that may hold a pose above a score are visited. A place is therefore reported as
    the only one because the search was complete, not because the number of candidates is limited.

    Attributes:
        points: centres of the map's occupied cells, (n, 2).

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
        centre = (low + high) / 2
        self._field = LikelihoodField(config.field.resolution_m, float((high - low).max() / 2 + 1.0) + 0.5)
        self._field.rebuild(
            np.array([*centre, 0.0]),
            [FieldSurface(np.zeros(3), self.points, np.zeros(len(self.points), dtype=np.bool_))],
        )
        self._pooled = [pool(self._field.values, POOL << level) for level in range(LEVELS)]
        cells = np.floor((free - self._field.origin) / (POOL * self._field.resolution)).astype(np.int64)
        self._free: list[NDArray[np.bool_]] = [np.zeros(pooled.shape, dtype=np.bool_) for pooled in self._pooled]
        for level, mask in enumerate(self._free):
            mask[tuple((cells[:, ::-1] >> level).T)] = True
        self._rotations = math.ceil(2 * math.pi / ROTATION_STEP_RAD)

    def find(
        self, points: FloatArray, centre: FloatArray | None = None, reach_m: float = math.inf
    ) -> tuple[Found | None, bool]:
        """Return the only pose at which the points (n, 2) in the base frame fit, and whether several places fit.

        If ``centre`` (2,) is given, only positions within ``reach_m`` of it are searched.
        """
        if len(points) < 10:
            return None, False
        # In random order, the sums of the bounds fall below the floor soonest.
        few = points[np.random.default_rng(0).permutation(len(points))[:POINTS]]
        nodes = np.argwhere(self._free[-1])
        if centre is not None:
            side = self._field.resolution * (POOL << (LEVELS - 1))
            off = self._field.origin + side * (nodes[:, ::-1] + 0.5) - centre
            nodes = nodes[np.hypot(off[:, 0], off[:, 1]) <= reach_m + side]
        levels = self._levels(nodes)
        floor, left = FIRST_FLOOR, MAX_NODES - len(levels[-1].nodes)
        found: list[Found] = []
        examined = 0
        while True:
            left = self._bound(levels, few, floor, left)
            starts = self._starts(levels[0], len(few), floor) if left >= 0 else None
            if starts is None or len(starts) > MAX_STARTS:
                return None, True
            # With a lower floor, new starts follow those of the higher floor.
            found += self._refined(points, starts[examined:])
            found.sort(key=lambda one: -one.score)
            examined = len(starts)
            # Every pose that scores at least the floor has been examined. Lower ones may matter if the best is poor.
            rival = self._rival(found[0].score) if found else 0.0
            if rival >= floor or floor <= MIN_PLACE_SCORE:
                break
            floor = max(MIN_PLACE_SCORE, floor - FLOOR_STEP, rival)
        if not found or found[0].score < MIN_PLACE_SCORE:
            return None, False
        best = found[0]
        runner_up = max((one.score for one in found[1:] if apart(one.pose, best.pose)), default=0.0)
        if runner_up > self._rival(best.score):
            return None, True
        return replace(best, runner_up=runner_up), False

    @staticmethod
    def _rival(score: float) -> float:
        """Return the score that another place must have to make a place with ``score`` ambiguous."""
        return (score - MIN_GAIN) / (1.0 - MIN_GAIN)

    def _levels(self, nodes: NDArray[np.intp]) -> list[_SearchLevel]:
        """Return the levels of a search that starts with ``nodes`` (n, 2) of the last level at all headings."""
        rotations = np.repeat(np.arange(self._rotations), len(nodes))
        first = np.column_stack([rotations, np.tile(nodes, (self._rotations, 1))]).astype(np.int32)
        return [*(_SearchLevel.of(np.zeros((0, 3), dtype=np.int32)) for _ in range(LEVELS - 1)), _SearchLevel.of(first)]

    def _bound(self, levels: list[_SearchLevel], points: FloatArray, floor: float, left: int) -> int:
        """Divide the nodes whose bound is at least ``floor``, down to the first level.

        ``left`` is the number of bounds that may still be computed. Return the rest of it; the search has stopped early
        if this is negative.
        """
        for k in range(LEVELS - 1, -1, -1):
            level, resolution = levels[k], self._field.resolution * (POOL << k)
            bound_nodes(
                self._pooled[k], self._field.origin, resolution, points, level.nodes, level.sums, level.counts, floor,
                2 * math.pi / self._rotations,
            )  # fmt: skip
            if k == 0:
                break
            good = (level.counts == len(points)) & (level.sums >= floor * len(points))
            corners = np.array([[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 1]], dtype=np.int32)
            divided = level.take(good)[:, None] * np.array([1, 2, 2], dtype=np.int32) + corners
            nodes = divided.reshape(-1, 3)
            rows, columns = self._free[k - 1].shape
            nodes = nodes[(nodes[:, 1] < rows) & (nodes[:, 2] < columns)]
            nodes = nodes[self._free[k - 1][nodes[:, 1], nodes[:, 2]]]
            left -= len(nodes)
            if left < 0:
                break
            levels[k - 1].add(nodes)
        return left

    def _starts(self, level: _SearchLevel, count: int, floor: float) -> FloatArray:
        """Return the poses (k, 3), best bound first, around which all scores of at least ``floor`` lie."""
        good = (level.counts == count) & (level.sums >= floor * count)
        order = np.flatnonzero(good)[np.argsort(-level.sums[good], kind="stable")]
        nodes = level.nodes[order]
        kept = nodes[keep_peaks(nodes, self._rotations, MAX_STARTS + 1)].astype(np.float64)
        coarse = POOL * self._field.resolution
        places = self._field.origin + coarse * (kept[:, [2, 1]] + 0.5)
        return np.column_stack([places, kept[:, 0] * (2 * math.pi / self._rotations)])

    def _refined(self, points: FloatArray, starts: FloatArray) -> list[Found]:
        """Return the best poses near ``starts`` (k, 3)."""
        found = [refined(self._field, points, start) for start in starts]
        return [one for one in found if one is not None]


@njit(cache=True)
def keep_peaks(nodes, rotations, count):  # type: ignore[no-untyped-def]
    """Return the indices of at most ``count`` nodes (k, 3), leaving out neighbours of earlier ones."""
    kept = np.zeros(count, dtype=np.int64)
    taken = 0
    for k in range(nodes.shape[0]):
        near = False
        for j in range(taken):
            other = nodes[kept[j]]
            turn = abs(nodes[k, 0] - other[0])
            turn = min(turn, rotations - turn)
            if turn <= 1 and abs(nodes[k, 1] - other[1]) <= 1 and abs(nodes[k, 2] - other[2]) <= 1:
                near = True
                break
        if not near:
            kept[taken] = k
            taken += 1
            if taken == count:
                break
    return kept[:taken]


@dataclass(frozen=True)
class FoundPlace:
    """Result of a search in the saved map.

    Attributes:
        pose: pose of the scan in its own map, (3,).
        found: pose of the scan in the saved map; None if it was not found or not yet confirmed by a second scan.
        map: map built from the saved keyframes; None unless the map is to be extended.
    """

    pose: FloatArray
    found: Found | None
    map: OccupancyMap | None


class SavedMap:
    """A map in which the robot is to be located, from disk or from an earlier session.

    Args:
        config: parameters.
        grid: the map.
        graph: keyframes and edges of the map, with which it is extended; None keeps the map unchanged.

    Attributes:
        grid: the map as given.
        localizer: finds scans in the map.
        keyframes: saved keyframes; empty if the map stays unchanged.
        edges: edges between the saved keyframes.
        located: true if the robot is located in the map.
        ambiguous: true if the last search found several places that fit.
    """

    def __init__(
        self, config: SlamConfig, grid: OccupancyGrid, graph: tuple[list[ScanKeyframe], list[Edge]] | None = None
    ) -> None:
        self.grid = grid
        self.localizer = Localizer(grid, config)
        self.keyframes, self.edges = graph or ([], [])
        self.located = False
        self.ambiguous = False
        self._config = config
        self._searched: ScanKeyframe | None = None
        self._searched_ns = 0
        self._unconfirmed: FloatArray | None = None

    @property
    def extends(self) -> bool:
        """True if the map is extended once the robot is located."""
        return bool(self.keyframes)

    @property
    def unchanged(self) -> bool:
        """True if the map has not been changed."""
        return not (self.extends and self.located)

    def search_job(
        self,
        recent: Sequence[ScanKeyframe],
        pose: FloatArray,
        scan: ScanPoints,
        stamp_ns: int,
        reach_m: float = math.inf,
    ) -> Callable[[], FoundPlace] | None:
        """Return a job that searches the map for the recent keyframes and the newest scan, whose pose is ``pose`` (3,).

        A finite ``reach_m`` limits the search to the surroundings of ``pose``. Return None if the newest keyframe was
        searched for already and no place waits for confirmation, or if the previous search was less than
        `SEARCH_PERIOD_S` ago.
        """
        if not recent or (recent[-1] is self._searched and self._unconfirmed is None):
            return None
        if self._searched is not None and stamp_ns - self._searched_ns < SEARCH_PERIOD_S * 1e9:
            return None
        self._searched, self._searched_ns = recent[-1], stamp_ns
        query = gather([*(k.map_from_base for k in recent), pose], [*(k.scan for k in recent), scan])

        def search() -> FoundPlace:
            near = pose[:2] if math.isfinite(reach_m) else None
            found, self.ambiguous = self.localizer.find(query, near, reach_m)
            if not self._confirmed(found, pose):
                found = None
            return FoundPlace(pose, found, self.build_map() if found is not None and self.extends else None)

        return search

    def _confirmed(self, found: Found | None, pose: FloatArray) -> bool:
        """Return whether the place agrees with the unconfirmed place of the previous search, and update the latter."""
        before = self._unconfirmed
        # Store the pose of the other map's origin in the saved map, which is the same for every scan.
        self._unconfirmed = None if found is None else compose2(found.pose, relative2(pose, np.zeros(3)))
        if found is None or before is None:
            return False
        rest = relative2(compose2(before, pose), found.pose)
        if math.hypot(rest[0], rest[1]) > SAME_M or abs(wrap_angle(float(rest[2]))) > SAME_RAD:
            return False
        self._unconfirmed = None
        return True

    def build_map(self) -> OccupancyMap:
        """Build the occupancy map from the saved keyframes."""
        built = OccupancyMap(self._config.map)
        for keyframe in self.keyframes:
            built.insert(keyframe.map_from_base, keyframe.scan)
        return built

    def join(self, own: Sequence[ScanKeyframe], covariance: FloatArray) -> LoopClosure:
        """Tie keyframes ``own``, located with ``covariance`` (3, 3), to the saved graph. Return its loop closure."""
        first = own[0]
        # The motion from the last saved keyframe is unknown, so the first new keyframe is tied by its pose in the map.
        first.step = relative2(self.keyframes[-1].map_from_base, first.map_from_base)
        first.step_covariance = UNKNOWN_STEP
        for keyframe in own:
            keyframe.drift = covariance
        loop_closure = LoopClosure(self._config)
        loop_closure.load(self.keyframes, self.edges)
        loop_closure.tie(len(self.keyframes), first.map_from_base, covariance)
        return loop_closure
