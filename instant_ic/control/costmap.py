"""Costmap in the map frame: static map, live scan with ray clearing, heights of 3D points, inflation.

Costs, layers and parameters carry nav2's names (costmap_2d): 0 free, 1..252 inflated, 253 inscribed,
254 lethal, 255 unknown. Arrays are (H, W), row 0 at the lowest y, as in ``nav_msgs/OccupancyGrid``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.config.ranges import Plausible, Range, check_ranges
from instant_ic.control.footprint import Footprint
from instant_ic.control.heights import HeightConfig, HeightLayer, SortedPoints, shifted
from instant_ic.control.walls import OCCUPIED, StaticMap

FREE = 0
INSCRIBED = 253
LETHAL = 254
UNKNOWN = 255

_LOOKED = 1
"""Mark of a cell that a beam of the scan passed through."""
SLACK_M = 1e-6
"""Tolerance when distances are compared: five cells of 0.05 m are not quite 0.25 m in floating point."""


@dataclass(frozen=True)
class CostmapConfig:
    """Parameters of the rolling window, with nav2's names.

    Attributes:
        width: m; side of the window that moves with the robot.
        resolution: m per cell.
        update_frequency: largest number of updates per second; an update needs a new scan or new points.
        publish_frequency: messages on /costmap, per second.
        inflation_radius: m; costs reach this far from an obstacle.
        cost_scaling_factor: 1/m; higher: costs fall off faster, paths come closer to obstacles.
        obstacle_max_range: m; farther hits are not marked.
        raytrace_max_range: m; beams clear no farther than this.
        footprint_clearing_enabled: clear the cells under the robot.
        static_seen_through: number of consecutive scans that must look through a cell before it counts as free although
            the map holds it as occupied; 0: never.
        points: obstacles from /lidar/points, such as low and hanging things.
    """

    width: Annotated[float, Plausible(2, 100)] = 12.0
    resolution: Annotated[float, Plausible(0.01, 0.25)] = 0.05
    update_frequency: Annotated[float, Plausible(2, 100)] = 20.0
    publish_frequency: Annotated[float, Plausible(0.1, 100)] = 5.0
    inflation_radius: Annotated[float, Plausible(0, 5)] = 0.70
    cost_scaling_factor: Annotated[float, Plausible(0.1, 100)] = 3.0
    obstacle_max_range: Annotated[float, Plausible(1, 100)] = 8.0
    raytrace_max_range: Annotated[float, Plausible(1, 100)] = 8.5
    footprint_clearing_enabled: bool = True
    static_seen_through: Annotated[int, Range(0, 255)] = 40
    points: HeightConfig = field(default_factory=HeightConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.width < 10 * self.resolution:
            raise ValueError(f"width must be at least ten cells (got {self.width})")


@dataclass(frozen=True)
class Costmap:
    """Costs and their place in the map frame."""

    costs: NDArray[np.uint8]
    """(H, W), row 0 at the lowest y."""
    resolution: float
    origin: NDArray[np.float64]
    """(2,) metres: outer corner of cell (0, 0)."""
    remembered: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    """(N, 2) centres of the cells that 3D points marked: low and hanging things that the flat scan does not see."""

    def cells(self, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows and columns of points (..., 2), which may lie outside the window."""
        index = np.floor((np.asarray(points, dtype=np.float64) - self.origin) / self.resolution).astype(np.int64)
        return index[..., 1], index[..., 0]

    def centres(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the centres (..., 2) of cells in metres."""
        return self.origin + (np.stack([columns, rows], axis=-1) + 0.5) * self.resolution

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether points (..., 2) lie in the window."""
        rows, columns = self.cells(points)
        height, width = self.costs.shape
        return (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)

    def cost_at(self, points: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the cost (...) at points (..., 2); UNKNOWN outside the window."""
        rows, columns = self.cells(points)
        height, width = self.costs.shape
        found = self.costs[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
        return np.where(self.contains(points), found, UNKNOWN).astype(np.uint8)

    def lethal_overlap(self, poses: NDArray[np.float64], body: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the number of ``body`` points (M, 2) in a lethal cell, for each pose (N, 3)."""
        poses = np.ascontiguousarray(poses, dtype=np.float64).reshape(-1, 3)
        body = np.ascontiguousarray(body, dtype=np.float64)
        ox, oy = float(self.origin[0]), float(self.origin[1])
        overlap: NDArray[np.int64] = _lethal_overlap(self.costs, ox, oy, self.resolution, poses, body)
        return overlap

    def lethal_near(self, pose: NDArray[np.float64], radius_m: float) -> NDArray[np.float64]:
        """Return the centres (N, 2) of lethal cells within ``radius_m`` of ``pose`` (x, y, yaw), in its frame."""
        row, column = (int(i) for i in self.cells(np.asarray(pose)[:2]))
        reach = math.ceil(radius_m / self.resolution) + 1
        top, left = max(0, row - reach), max(0, column - reach)
        window = self.costs[top : max(0, row + reach + 1), left : max(0, column + reach + 1)]
        rows, columns = np.nonzero(window == LETHAL)
        away = self.centres(rows + top, columns + left) - np.asarray(pose)[:2]
        away = away[(away**2).sum(axis=-1) <= radius_m**2]
        c, s = math.cos(pose[2]), math.sin(pose[2])
        seen: NDArray[np.float64] = away @ np.array([[c, -s], [s, c]])
        return seen

    def memory_near(
        self, pose: NDArray[np.float64], blind_radius_m: float, remembered_radius_m: float
    ) -> NDArray[np.float64]:
        """Return the marks that the sensors may not see at present, (N, 2) in the frame of ``pose``.

        These are the lethal cells in the blind zone round the LiDAR, and the marks of 3D points farther out.
        """
        away = self.remembered - np.asarray(pose)[:2]
        away = away[(away**2).sum(axis=-1) <= remembered_radius_m**2]
        c, s = math.cos(pose[2]), math.sin(pose[2])
        return np.concatenate([self.lethal_near(pose, blind_radius_m), away @ np.array([[c, -s], [s, c]])])

    def occupancy(self) -> NDArray[np.int8]:
        """Return the costs in the range -1..100 of ``nav_msgs/OccupancyGrid``, as nav2 publishes them."""
        return _TO_OCCUPANCY[self.costs]

    @staticmethod
    def from_occupancy(occupancy: NDArray[np.int8], resolution: float, origin: NDArray[np.float64]) -> Costmap:
        """Return the costmap of a published grid, the inverse of ``occupancy``; inflated costs are exact to 1.3."""
        costs = _FROM_OCCUPANCY[np.asarray(occupancy, dtype=np.int8).view(np.uint8)]
        return Costmap(costs, float(resolution), np.asarray(origin, dtype=np.float64)[:2])


def _occupancy_tables() -> tuple[NDArray[np.int8], NDArray[np.uint8]]:
    to = np.zeros(256, dtype=np.int8)
    to[1:INSCRIBED] = 1 + (97 * (np.arange(1, INSCRIBED) - 1)) // 251
    to[INSCRIBED], to[LETHAL], to[UNKNOWN] = 99, 100, -1
    back = np.full(256, UNKNOWN, dtype=np.uint8)
    back[0] = FREE
    for value in range(1, 99):  # the middle of the costs that map to each published value
        costs = np.flatnonzero(to == value)
        back[value] = costs[costs.size // 2]
    back[99], back[100] = INSCRIBED, LETHAL
    return to, back


_TO_OCCUPANCY, _FROM_OCCUPANCY = _occupancy_tables()


@dataclass(frozen=True)
class ScanRays:
    """One scan in the map frame, ready for marking and clearing."""

    origin: NDArray[np.float64]
    """(2,) position of the sensor."""
    ends: NDArray[np.float64]
    """(N, 2) end of each beam."""
    hits: NDArray[np.bool_]
    """(N,) true where the beam ended on something near enough to be marked."""


def scan_points(
    ranges: NDArray[np.floating], angle_min: float, angle_increment: float, range_min: float, range_max: float
) -> NDArray[np.float64]:
    """Return the hits (N, 2) in the sensor's plane, metres, without invalid ranges (REP-117)."""
    r = np.asarray(ranges, dtype=np.float64)
    valid = np.isfinite(r) & (r >= range_min) & (r <= range_max)
    angle = angle_min + angle_increment * np.flatnonzero(valid)
    return np.stack([r[valid] * np.cos(angle), r[valid] * np.sin(angle)], axis=-1)


def scan_rays(
    ranges: NDArray[np.floating],
    angle_min: float,
    angle_increment: float,
    range_min: float,
    range_max: float,
    map_from_lidar: NDArray[np.float64],
    config: CostmapConfig,
) -> ScanRays:
    """Return the measured beams of a scan in the map frame (REP-117).

    A beam without a return neither marks nor clears, because a VLP-16 also returns nothing from nearer than 0.4 m.
    ``ranges`` is (N,) in metres, angles are radians; ``map_from_lidar`` is (4, 4) at the stamp of the scan.
    """
    r = np.asarray(ranges, dtype=np.float64)
    angle = angle_min + angle_increment * np.arange(r.size)
    measured = np.isfinite(r) & (r >= range_min) & (r <= range_max)
    hits = r[measured] <= config.obstacle_max_range
    reach = np.minimum(r[measured], config.raytrace_max_range)
    ends_lidar = np.stack([reach * np.cos(angle[measured]), reach * np.sin(angle[measured])], axis=-1)
    ends = ends_lidar @ map_from_lidar[:2, :2].T + map_from_lidar[:2, 3]
    return ScanRays(map_from_lidar[:2, 3].copy(), ends, hits)


class RollingCostmap:
    """A window that moves with the robot and remembers what scans and 3D points saw in it."""

    def __init__(self, config: CostmapConfig, footprint: Footprint) -> None:
        self.config = config
        self.footprint = footprint
        self.size = round(config.width / config.resolution)
        self.heights = HeightLayer(config.points, self.size, config.resolution)
        self._observed = np.full((self.size, self.size), UNKNOWN, dtype=np.uint8)
        # Number of consecutive scans that looked through a cell, at most 255; a hit in or beside it resets the count.
        self._through = np.zeros((self.size, self.size), dtype=np.uint8)
        self._corner: tuple[int, int] | None = None  # first column and row of the window in the endless grid
        self._body = footprint.points(0.5 * config.resolution)
        # From near, the sensors may never see these marks again: a pose that is a cell off must not erase them.
        self._under = footprint.points(0.5 * config.resolution, -config.resolution)
        # Squared distances between cells are whole numbers, so the costs up to the inflation radius fit a table.
        reach = (max(config.inflation_radius, footprint.inscribed_radius_m) + SLACK_M) / config.resolution
        metres = np.sqrt(np.arange(math.floor(reach**2) + 1)) * config.resolution
        self._cost_of_square = np.array([inflated_cost(d, config, footprint) for d in metres], dtype=np.uint8)

    def reset(self) -> None:
        """Forget all observations, for example after a jump of the map."""
        self._observed.fill(UNKNOWN)
        self._through.fill(0)
        self.heights.reset()

    def carry(self, moved: NDArray[np.float64]) -> None:
        """Move all observations by ``moved`` (x, y, yaw), for example after a correction of the map."""
        if self._corner is None:
            return
        corner, c, s = np.array(self._corner), math.cos(moved[2]), math.sin(moved[2])

        def carried(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
            """Return the rows and columns (2, N) of the cells in ``mask``, and of the cells that they move to."""
            cells = np.argwhere(mask)
            places = (cells[:, ::-1] + corner + 0.5) @ np.array([[c, s], [-s, c]]) + moved[:2] / self.config.resolution
            goals = np.floor(places).astype(np.intp)[:, ::-1] - corner[::-1]
            inside = ((goals >= 0) & (goals < self.size)).all(axis=1)
            return cells[inside].T, goals[inside].T

        free, lethal = (carried(self._observed == value)[1] for value in (FREE, LETHAL))
        self._observed.fill(UNKNOWN)
        self._observed[free[0], free[1]] = FREE
        self._observed[lethal[0], lethal[1]] = LETHAL
        self._through.fill(0)
        self.heights.carry(*carried(self.heights.hits > 0))

    def update(
        self,
        robot_pose: NDArray[np.float64],
        static: StaticMap | None,
        scan: ScanRays | None,
        points: SortedPoints | None = None,
        map_from_points: NDArray[np.float64] | None = None,
    ) -> Costmap:
        """Move the window over the robot (x, y, yaw), add a scan and a sweep of points, and return the costs.

        ``map_from_points`` (x, y, yaw) is the pose of the points' frame in the map; None: they are in the map frame.
        """
        resolution = self.config.resolution
        self._move_to(float(robot_pose[0]), float(robot_pose[1]))
        assert self._corner is not None
        origin = np.array(self._corner, dtype=np.float64) * resolution
        if scan is not None and len(scan.ends):
            start = (scan.origin - origin) / resolution
            ends = np.ascontiguousarray((scan.ends - origin) / resolution)
            looked = np.zeros_like(self._observed)
            _clear_and_mark(self._observed, looked, float(start[0]), float(start[1]), ends, scan.hits)
            self._count_through(looked)
        if points is not None:
            self.heights.update(points, np.zeros(3) if map_from_points is None else map_from_points, origin)
        if self.config.footprint_clearing_enabled:
            self._clear_footprint(robot_pose, origin)
        master = self._master(static, origin)
        rows, columns = np.nonzero(self.heights.occupied())
        remembered = origin + (np.stack([columns, rows], axis=-1) + 0.5) * resolution
        return Costmap(self._inflate(master), resolution, origin, remembered)

    def _count_through(self, looked: NDArray[np.uint8]) -> None:
        import cv2

        beside = cv2.dilate((looked == LETHAL).astype(np.uint8), np.ones((3, 3), np.uint8))
        free = (looked == _LOOKED) & (beside == 0)
        self._through[free] += self._through[free] < 255
        self._through[beside > 0] = 0

    def _move_to(self, x: float, y: float) -> None:
        half = self.size // 2
        corner = (
            math.floor(x / self.config.resolution) - half,
            math.floor(y / self.config.resolution) - half,
        )
        if corner == self._corner:
            return
        if self._corner is not None:
            dx, dy = corner[0] - self._corner[0], corner[1] - self._corner[1]
            self._observed = shifted(self._observed, dx, dy, UNKNOWN)
            self._through = shifted(self._through, dx, dy, 0)
            self.heights.shift(dx, dy)
        self._corner = corner

    def _clear_footprint(self, pose: NDArray[np.float64], origin: NDArray[np.float64]) -> None:
        c, s = math.cos(pose[2]), math.sin(pose[2])
        turn = np.array([[c, s], [-s, c]])
        for body, layer, value in ((self._body, self._observed, FREE), (self._under, self.heights.hits, 0)):
            index = np.floor((body @ turn + np.asarray(pose)[:2] - origin) / self.config.resolution).astype(np.int64)
            index = index[((index >= 0) & (index < self.size)).all(axis=1)]
            layer[index[:, 1], index[:, 0]] = value

    def _master(self, static: StaticMap | None, origin: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Join the layers like nav2's ``combination_method`` max: a cell is occupied if any layer marks it.

        Exception: a cell that only the map marks is free once ``static_seen_through`` consecutive scans have looked
        through it. It stems from a misplaced scan, or from a thing that has been removed.
        """
        occupancy, shift = np.full((1, 1), -1, dtype=np.int8), np.zeros(2)
        resolution = self.config.resolution
        if static is not None:
            occupancy, resolution, shift = static.occupancy.view(), static.resolution, origin - static.origin
        occupancy.flags.writeable = False  # one array type: numba compiles the kernel once
        return _join(
            self._observed,
            self.heights.occupied(),
            self.heights.dismissed(),
            occupancy,
            float(shift[0]),
            float(shift[1]),
            self.config.resolution,
            resolution,
            self._through,
            self.config.static_seen_through or 256,
        )

    def _inflate(self, master: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Inflate as nav2: 252·exp(-cost_scaling_factor·(d - inscribed_radius)); 253 within the inscribed radius."""
        import cv2

        free = (master != LETHAL).astype(np.uint8)
        if free.all():
            return master
        _inflate(master, cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), self._cost_of_square)
        return master


def inflated_cost(distance_m: float, config: CostmapConfig, footprint: Footprint) -> int:
    """Return the cost of a place ``distance_m`` from the nearest obstacle."""
    if distance_m <= 0:
        return LETHAL
    if distance_m <= footprint.inscribed_radius_m + SLACK_M:
        return INSCRIBED
    if distance_m > config.inflation_radius + SLACK_M:
        return FREE
    return int(252.0 * math.exp(-config.cost_scaling_factor * (distance_m - footprint.inscribed_radius_m)))


@njit(cache=True)
def _join(
    observed: NDArray[np.uint8],
    occupied: NDArray[np.bool_],
    dismissed: NDArray[np.bool_],
    occupancy: NDArray[np.int8],
    shift_x: float,
    shift_y: float,
    resolution: float,
    map_resolution: float,
    through: NDArray[np.uint8],
    seen_through: int,
) -> NDArray[np.uint8]:
    """Return the master grid of observations and map; the map's origin lies ``shift`` metres before the window's."""
    size_y, size_x = observed.shape
    height, width = occupancy.shape
    master = np.empty_like(observed)
    columns = np.empty(size_x, dtype=np.int64)
    for c in range(size_x):
        columns[c] = math.floor((shift_x + (c + 0.5) * resolution) / map_resolution)
    for r in range(size_y):
        row = math.floor((shift_y + (r + 0.5) * resolution) / map_resolution)
        for c in range(size_x):
            known = -1
            if 0 <= row < height and 0 <= columns[c] < width:
                known = occupancy[row, columns[c]]
            seen = observed[r, c]
            held = known >= OCCUPIED and through[r, c] < seen_through
            if seen == 254 and dismissed[r, c]:
                seen = 0
            if held or seen == 254 or occupied[r, c]:
                master[r, c] = 254
            else:
                master[r, c] = seen if known < 0 else 0
    return master


@njit(cache=True)
def _inflate(master: NDArray[np.uint8], distance: NDArray[np.float32], cost_of_square: NDArray[np.uint8]) -> None:
    """Write each cell's cost by its distance to the nearest lethal one, in cells; unknown cells only if inscribed."""
    most = math.sqrt(len(cost_of_square) - 0.5)
    for r in range(master.shape[0]):
        for c in range(master.shape[1]):
            if distance[r, c] > most or master[r, c] == 254:
                continue
            cost = cost_of_square[int(distance[r, c] * distance[r, c] + 0.5)]
            if cost >= 253 or master[r, c] != 255:
                master[r, c] = cost


@njit(cache=True)
def _clear_and_mark(
    observed: NDArray[np.uint8],
    looked: NDArray[np.uint8],
    start_x: float,
    start_y: float,
    ends: NDArray[np.float64],
    hits: NDArray[np.bool_],
) -> None:
    """Clear along every beam up to its last cell, then mark the hits, so that no grazing beam clears a hit.

    ``looked`` receives the cells of this scan: ``_LOOKED`` where a beam passed, 254 for a hit. Coordinates are in cells
    of ``observed``. The loop visits the cells that a beam touches (Amanatides & Woo 1987).
    """
    height, width = observed.shape
    for i in range(ends.shape[0]):
        dx, dy = ends[i, 0] - start_x, ends[i, 1] - start_y
        column, row = math.floor(start_x), math.floor(start_y)
        last_column, last_row = math.floor(ends[i, 0]), math.floor(ends[i, 1])
        step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        per_x = abs(1.0 / dx) if dx != 0.0 else np.inf
        per_y = abs(1.0 / dy) if dy != 0.0 else np.inf
        next_x = ((column + 1 - start_x) if dx > 0 else (start_x - column)) * per_x if dx != 0.0 else np.inf
        next_y = ((row + 1 - start_y) if dy > 0 else (start_y - row)) * per_y if dy != 0.0 else np.inf
        for _ in range(abs(last_column - column) + abs(last_row - row)):
            if column < 0 or row < 0 or column >= width or row >= height:
                break
            observed[row, column] = 0
            looked[row, column] = _LOOKED
            if next_x < next_y:
                next_x += per_x
                column += step_x
            else:
                next_y += per_y
                row += step_y
        if not hits[i] and 0 <= last_column < width and 0 <= last_row < height:
            observed[last_row, last_column] = 0
    for i in range(ends.shape[0]):
        if hits[i]:
            column, row = math.floor(ends[i, 0]), math.floor(ends[i, 1])
            if 0 <= column < width and 0 <= row < height:
                observed[row, column] = 254
                looked[row, column] = 254


@njit(cache=True)
def _lethal_overlap(
    costs: NDArray[np.uint8],
    origin_x: float,
    origin_y: float,
    resolution: float,
    poses: NDArray[np.float64],
    body: NDArray[np.float64],
) -> NDArray[np.int64]:
    height, width = costs.shape
    overlap = np.zeros(poses.shape[0], dtype=np.int64)
    for i in range(poses.shape[0]):
        c, s = math.cos(poses[i, 2]), math.sin(poses[i, 2])
        for j in range(body.shape[0]):
            column = math.floor((poses[i, 0] + c * body[j, 0] - s * body[j, 1] - origin_x) / resolution)
            row = math.floor((poses[i, 1] + s * body[j, 0] + c * body[j, 1] - origin_y) / resolution)
            if 0 <= row < height and 0 <= column < width and costs[row, column] == 254:
                overlap[i] += 1
    return overlap
