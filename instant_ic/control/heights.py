"""Obstacles by height, from 3D points: low and hanging things, except those that the robot can drive over or under.

1. ``sort_points``: place the points of a sweep in a level frame, each from the sensor's pose at its measurement, and
   sort them by height. Record where the beams of each elevation and azimuth end.
2. ``_clear``: remove the marks that a beam passes through at their own heights. For each other mark, weigh the beams
   that end in it against those that end just behind it.
3. ``_mark``: mark the cells of the obstacle points with their lowest and highest point.

A scanner with few rings sees a low or a hanging thing only from afar: 0.6 m above the ground, the lowest beam (-15°)
meets a thing 0.1 m high no nearer than 1.9 m. A mark therefore stays until a beam passes through the heights at which
it was made. A beam of the flat scan that passes over it proves nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.config.ranges import Plausible, check_ranges

Cell = TypeVar("Cell", bound=np.generic)

AZIMUTHS = 720
"""Number of azimuth bins."""
ROW_RAD, ROWS = math.radians(2.0), 90
"""Size of an elevation bin, the angle between the sensor's rings, and number of bins from straight down to straight up.
"""
CLEAR_MARGIN_M = 0.15
"""Distance behind a mark at which a beam must end to clear it."""
INSIDE_WEIGHT, MOST_EVIDENCE = 4, 200
"""Weight of a beam that ends in a mark, where one that ends just behind it weighs 1; bound of the sum."""
FAST = {"contract", "arcp", "afn"}
"""Fast-math flags that keep nan and inf."""
UNSEEN_EDGE_M, FAR_BEHIND_M = 0.1, 0.4
"""A thing that only the lowest ring meets may begin nearer than the point where that ring meets its top. The first
distance in front of the point is marked too, if the next ring ends at least the second distance behind it."""
SCATTER_M = 0.01
"""Scatter of the heights of one surface, in metres: noise of the ranges, pitch of the robot."""
INSTANTS = 65
"""Sensor poses per sweep: accurate to 1 mrad at 1 rad/s."""


@dataclass(frozen=True)
class HeightConfig:
    """Limits of obstacles from 3D points, with nav2's names where nav2 has the parameter.

    Attributes:
        enabled: use 3D points; false: only the flat scan is used.
        min_obstacle_height: m above the ground; the robot can drive over lower points.
        max_obstacle_height: m; the robot can pass under higher points. The camera's mast is 1.20 m high.
        ground_tilt_deg: tolerated slope of the ground in degrees, real or from the robot's pitch.
        obstacle_min_range: m from the LiDAR; nearer points are on the robot's own body.
        obstacle_max_range: m; farther points are not marked.
        mark_threshold: number of points that make a cell an obstacle.
    """

    enabled: bool = True
    min_obstacle_height: Annotated[float, Plausible(0.01, 0.5)] = 0.05
    max_obstacle_height: Annotated[float, Plausible(0.2, 5)] = 1.30
    ground_tilt_deg: Annotated[float, Plausible(0, 5)] = 0.8
    obstacle_min_range: Annotated[float, Plausible(0, 2)] = 0.45
    obstacle_max_range: Annotated[float, Plausible(1, 100)] = 6.0
    mark_threshold: Annotated[int, Plausible(1, 10)] = 2

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.min_obstacle_height < self.max_obstacle_height:
            raise ValueError(f"min_obstacle_height must be below max_obstacle_height (got {self.min_obstacle_height})")
        if not self.obstacle_min_range < self.obstacle_max_range:
            raise ValueError(f"obstacle_min_range must be below obstacle_max_range (got {self.obstacle_min_range})")


@dataclass(frozen=True)
class SortedPoints:
    """Points of one sweep in a level frame, sorted by height, without invalid measurements."""

    obstacles: NDArray[np.float32]
    """(N, 3) obstacle points in metres; z is the height above the ground."""
    nearest: NDArray[np.float64]
    """(M, 2) nearest obstacle point in each direction that has one, as a flat scan would measure it."""
    ends: NDArray[np.float32]
    """(ROWS, AZIMUTHS) horizontal distance in metres to the nearest end of the beams of each elevation (from straight
    down) and azimuth (from -pi); inf where no beam returned."""
    origin: NDArray[np.float64]
    """(3,) position of the sensor at the end of the sweep."""
    counts: dict[str, int]
    """Number of points of each kind: kept by the height filter (``obstacle``), or dropped."""


def sort_points(
    points: NDArray[np.float32],
    time_s: NDArray[np.float32],
    level_from_lidar: NDArray[np.float64],
    duration_s: float,
    config: HeightConfig,
) -> SortedPoints:
    """Sort the points of a sweep by height in a level frame, each from the sensor's pose at its measurement.

    Args:
        points: (N, 3) in the sensor's frame, metres; non-finite points are left out.
        time_s: (N,) seconds since the first point.
        level_from_lidar: (K, 4, 4) poses of the sensor at K even instants from 0 to ``duration_s``, in a frame whose
            z is the height above the ground.
        duration_s: length of the sweep.
        config: height limits.
    """
    poses = np.ascontiguousarray(level_from_lidar, dtype=np.float64).reshape(-1, 4, 4)
    obstacles, nearest, ends, counts = _sort(
        np.ascontiguousarray(points, dtype=np.float32),
        np.ascontiguousarray(time_s, dtype=np.float32),
        poses,
        float(duration_s),
        config.min_obstacle_height,
        config.max_obstacle_height,
        math.tan(math.radians(config.ground_tilt_deg)),
        config.obstacle_min_range,
    )
    names = ("ground", "obstacle", "overhead", "near")
    return SortedPoints(
        obstacles, nearest, ends, poses[-1, :3, 3].copy(), {n: int(c) for n, c in zip(names, counts, strict=True)}
    )


class HeightLayer:
    """Cells of a rolling window that hold an obstacle between two heights.

    A cell is marked once ``mark_threshold`` points have fallen into it. It keeps the height of the lowest and highest
    of them, and is cleared when a beam between these heights ends well behind it and none ends in it.

    Noise of ranges and poses also marks cells in front of a surface. A mark is dismissed while nearly all beams at its
    heights end just behind it.
    """

    def __init__(self, config: HeightConfig, size: int, resolution: float) -> None:
        self.config = config
        self.size = size
        self.resolution = resolution
        self.hits = np.zeros((size, size), dtype=np.uint8)
        """(H, W) number of points in a cell; occupied from ``mark_threshold`` on."""
        self.low = np.zeros((size, size), dtype=np.float32)
        self.high = np.zeros((size, size), dtype=np.float32)
        self.evidence = np.zeros((size, size), dtype=np.int16)
        """(H, W) beams that ended in a mark, weighted, less those that ended just behind it; below 0: dismissed."""

    def reset(self) -> None:
        """Forget all marks."""
        self.hits.fill(0)

    def shift(self, columns: int, rows: int) -> None:
        """Move the window by whole cells; cells that leave it are forgotten."""
        self.hits = shifted(self.hits, columns, rows, 0)
        self.low = shifted(self.low, columns, rows, 0.0)
        self.high = shifted(self.high, columns, rows, 0.0)
        self.evidence = shifted(self.evidence, columns, rows, 0)

    def carry(self, cells: NDArray[np.intp], goals: NDArray[np.intp]) -> None:
        """Move marks from ``cells`` to ``goals``, rows and columns (2, N); all others are forgotten."""
        order = np.argsort(self.hits[cells[0], cells[1]])  # if two marks meet in a cell, the one with more points wins
        (rows, columns), (to_rows, to_columns) = cells[:, order], goals[:, order]
        for layer in (self.hits, self.low, self.high, self.evidence):
            kept = layer[rows, columns]
            layer.fill(0)
            layer[to_rows, to_columns] = kept

    def update(self, sweep: SortedPoints, placed: NDArray[np.float64], origin: NDArray[np.float64]) -> None:
        """Add a sweep. ``placed`` is the pose (x, y, yaw) of its frame in the window's frame.

        ``origin`` (2,) is the window's outer corner.
        """
        window = _Window(float(origin[0]), float(origin[1]), self.resolution)
        marks = _Marks(self.hits, self.low, self.high, self.evidence)
        pose = np.asarray(placed, dtype=np.float64)
        _clear(marks, window, sweep.ends, sweep.origin, pose)
        _mark(marks, window, sweep.obstacles, sweep.ends, sweep.origin, pose, self.config.obstacle_max_range)

    def occupied(self) -> NDArray[np.bool_]:
        """Return the mask (H, W) of the cells that hold an obstacle."""
        return (self.hits >= self.config.mark_threshold) & (self.evidence >= 0)

    def dismissed(self) -> NDArray[np.bool_]:
        """Return the mask (H, W) of the cells whose points are only noise of a surface behind them."""
        return (self.hits > 0) & (self.evidence < 0)


def shifted(array: NDArray[Cell], columns: int, rows: int, fill: float) -> NDArray[Cell]:
    """Return the window (H, W) moved by whole cells; new cells get ``fill``."""
    moved = np.full_like(array, fill)
    height, width = array.shape
    if abs(columns) < width and abs(rows) < height:
        moved[max(0, -rows) : height - max(0, rows), max(0, -columns) : width - max(0, columns)] = array[
            max(0, rows) : height - max(0, -rows), max(0, columns) : width - max(0, -columns)
        ]
    return moved


@njit(cache=True, fastmath=FAST)
def _angle(y: float, x: float) -> float:
    """Return atan2(y, x) to 1e-5 rad, four times as fast (Hastings: Approximations for digital computers, 1955)."""
    ax, ay = abs(x), abs(y)
    if ax == 0.0 and ay == 0.0:
        return 0.0
    z = min(ax, ay) / max(ax, ay)
    q = z * z
    angle = z * (0.9998660 - q * (0.3302995 - q * (0.1801410 - q * (0.0851330 - 0.0208351 * q))))
    if ay > ax:
        angle = 0.5 * math.pi - angle
    if x < 0.0:
        angle = math.pi - angle
    return -angle if y < 0.0 else angle


@njit(cache=True, fastmath=FAST)
def _bin(y: float, x: float) -> int:
    """Return the bin of the azimuth of (x, y)."""
    return min(int((_angle(y, x) + math.pi) * (AZIMUTHS / (2.0 * math.pi))), AZIMUTHS - 1)


@njit(cache=True, fastmath=FAST)
def _sort(
    points: NDArray[np.float32],
    time_s: NDArray[np.float32],
    poses: NDArray[np.float64],
    duration_s: float,
    low: float,
    high: float,
    slope: float,
    range_min: float,
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float32], NDArray[np.int64]]:
    between = _poses_between(poses, duration_s)
    sensor = poses[poses.shape[0] - 1, :3, 3]
    obstacles = np.empty((points.shape[0], 3), dtype=np.float32)
    ends = np.full((ROWS, AZIMUTHS), np.inf, dtype=np.float32)
    near_m = np.full(AZIMUTHS, np.inf)
    near_at = np.full(AZIMUTHS, -1, dtype=np.int64)
    counts = np.zeros(4, dtype=np.int64)
    kept = 0
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        if not (np.isfinite(px) and np.isfinite(py) and np.isfinite(pz)):
            continue
        m = between[0]
        if duration_s > 0.0:
            m = between[int(min(max(time_s[i] / duration_s, 0.0), 1.0) * (INSTANTS - 1) + 0.5)]
        dx = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz
        dy = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz
        dz = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz
        distance = math.sqrt(dx * dx + dy * dy)
        if distance < range_min:
            counts[3] += 1
            continue
        x, y, z = dx + m[0, 3], dy + m[1, 3], dz + m[2, 3]
        # Position relative to the sensor at the end of the sweep.
        dx, dy, dz = x - sensor[0], y - sensor[1], z - sensor[2]
        distance = math.sqrt(dx * dx + dy * dy)
        column = _bin(dy, dx)
        row = min(int(_row(dz, distance)), ROWS - 1)
        if distance < ends[row, column]:
            ends[row, column] = distance
        # The robot pitches a little, and a tilt raises the ground in proportion to the distance.
        if z < low + slope * distance:
            counts[0] += 1
        elif z > high:
            counts[2] += 1
        else:
            counts[1] += 1
            obstacles[kept, 0], obstacles[kept, 1], obstacles[kept, 2] = x, y, z
            if distance < near_m[column]:
                near_m[column], near_at[column] = distance, kept
            kept += 1
    nearest = obstacles[near_at[near_at >= 0]][:, :2].astype(np.float64)
    return obstacles[:kept].copy(), nearest, ends, counts


@njit(cache=True, fastmath=FAST)
def _row(dz: float, distance: float) -> float:
    """Return the elevation of a point ``dz`` above and ``distance`` from the sensor, in rows from straight down."""
    return (_angle(dz, distance) + 0.5 * math.pi) * (1.0 / ROW_RAD)


@njit(cache=True, fastmath=FAST)
def _poses_between(poses: NDArray[np.float64], duration_s: float) -> NDArray[np.float64]:
    """Return the sensor's poses (INSTANTS, 4, 4) at even instants of a sweep, interpolated from ``poses`` (K, 4, 4)."""
    last = poses.shape[0] - 1
    between = np.empty((INSTANTS, 4, 4))
    for i in range(INSTANTS):
        at = last * i / (INSTANTS - 1) if duration_s > 0.0 else float(last)
        k = min(int(at), max(last - 1, 0))
        between[i] = poses[k] + (at - k) * (poses[min(k + 1, last)] - poses[k])
    return between


class _Window(NamedTuple):
    """Outer corner of the window in metres, and its cell size in metres."""

    origin_x: float
    origin_y: float
    resolution: float


class _Marks(NamedTuple):
    """Layers of `HeightLayer`, (H, W)."""

    hits: NDArray[np.uint8]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    evidence: NDArray[np.int16]


@njit(cache=True)
def _clear(
    marks: _Marks,
    window: _Window,
    ends: NDArray[np.float32],
    sensor: NDArray[np.float64],
    placed: NDArray[np.float64],
) -> None:
    """Clear the marks that beams pass through. For the others, count the beams that end in them and just behind them.

    A beam above a low thing or below a hanging one proves nothing, and from near no beam sees the thing again. So only
    a beam well between a mark's heights clears it; a beam that ends in the mark or close to it keeps it.
    """
    hits, low, high, evidence = marks
    resolution = window.resolution
    cos, sin = math.cos(placed[2]), math.sin(placed[2])
    sensor_x = cos * sensor[0] - sin * sensor[1] + placed[0]
    sensor_y = sin * sensor[0] + cos * sensor[1] + placed[1]
    for r in range(hits.shape[0]):
        for c in range(hits.shape[1]):
            if hits[r, c] == 0:
                continue
            dx = window.origin_x + (c + 0.5) * resolution - sensor_x
            dy = window.origin_y + (r + 0.5) * resolution - sensor_y
            distance = math.sqrt(dx * dx + dy * dy)
            if distance < resolution:
                continue
            column = _bin(cos * dy - sin * dx, cos * dx + sin * dy)
            bottom, top = low[r, c] - sensor[2], high[r, c] - sensor[2]
            first, last = _row(bottom - 0.5 * resolution, distance), _row(top + 0.5 * resolution, distance)
            least, most = _row(bottom + SCATTER_M, distance), _row(top - SCATTER_M, distance)
            passed, stands = False, False
            for row in range(max(0, int(first)), min(ROWS - 1, int(last)) + 1):
                end = ends[row, column]
                if not np.isfinite(end):
                    continue
                if abs(end - distance) <= CLEAR_MARGIN_M:
                    stands = True
                elif end > distance and least <= row + 0.5 <= most:
                    passed = True
            if passed and not stands:
                hits[r, c] = 0
                continue
            rows = range(max(1, int(first)), min(ROWS - 2, int(last)) + 1)
            change = _evidence(ends, rows, column, distance, resolution)
            evidence[r, c] = min(max(evidence[r, c] + change, -MOST_EVIDENCE), MOST_EVIDENCE)


@njit(cache=True)
def _evidence(ends: NDArray[np.float32], rows: range, column: int, distance: float, resolution: float) -> int:
    """Return the weighted number of beams that end in a mark, less the number that end just behind it."""
    wide = int(0.5 * resolution / distance * AZIMUTHS / (2.0 * math.pi))
    change = 0
    for row in rows:
        for beside in range(column - wide, column + wide + 1):
            beam = beside % AZIMUTHS
            if abs(ends[row, beam] - distance) <= 0.5 * resolution:
                change += INSIDE_WEIGHT
                continue
            # A single ring may end on top of a low thing, or under a hanging one, and the mark is the thing's edge.
            behind = True
            for ring in range(row - 1, row + 2):
                behind &= 0.5 * resolution < ends[ring, beam] - distance <= CLEAR_MARGIN_M
            change -= behind
    return change


@njit(cache=True)
def _mark(
    marks: _Marks,
    window: _Window,
    obstacles: NDArray[np.float32],
    ends: NDArray[np.float32],
    sensor: NDArray[np.float64],
    placed: NDArray[np.float64],
    range_max: float,
) -> None:
    """Mark the cells of obstacle points, and the cells in front of a thing that only the lowest ring meets."""
    hits, low, high, evidence = marks
    resolution = window.resolution
    cos, sin = math.cos(placed[2]), math.sin(placed[2])
    sensor_x = cos * sensor[0] - sin * sensor[1] + placed[0]
    sensor_y = sin * sensor[0] + cos * sensor[1] + placed[1]
    lowest = 0
    while lowest < ROWS - 2 and not np.isfinite(ends[lowest].min()):
        lowest += 1
    for i in range(obstacles.shape[0]):
        px, py, z = obstacles[i, 0], obstacles[i, 1], obstacles[i, 2]
        x, y = cos * px - sin * py + placed[0], sin * px + cos * py + placed[1]
        dx, dy = x - sensor_x, y - sensor_y
        distance = math.sqrt(dx * dx + dy * dy)
        if distance > range_max:
            continue
        cells = 1
        if _row(z - sensor[2], distance) < lowest + 1:
            column = _bin(py - sensor[1], px - sensor[0])
            if np.isfinite(ends[lowest + 1, column]) and ends[lowest + 1, column] - distance > FAR_BEHIND_M:
                cells += int(min(UNSEEN_EDGE_M, 0.5 * distance) / resolution)
        for k in range(cells):
            share = k * resolution / max(distance, resolution)
            c = math.floor((x - share * dx - window.origin_x) / resolution)
            r = math.floor((y - share * dy - window.origin_y) / resolution)
            if 0 <= r < hits.shape[0] and 0 <= c < hits.shape[1]:
                if hits[r, c] == 0:
                    low[r, c], high[r, c], evidence[r, c] = z, z, 0
                else:
                    low[r, c], high[r, c] = min(low[r, c], z), max(high[r, c], z)
                hits[r, c] = min(hits[r, c] + 1, 250)
