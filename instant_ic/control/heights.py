"""Obstacles by their height, from 3D points: low things, hanging things, and nothing that can be driven over or under.

A scanner with few rings sees a low or a hanging thing only from afar: at 0.6 m above the ground, a lowest beam of -15°
meets a thing 0.1 m high no nearer than 1.9 m. So what was seen stays marked until a beam is seen to pass through the
very heights at which it was marked; a beam of the flat scan that passes over it says nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..ranges import NotNegative, Positive, Range, check_ranges

Cell = TypeVar("Cell", bound=np.generic)

GROUND, OBSTACLE, OVERHEAD = 0, 1, 2
"""Kinds of points: driven over, stands in the way, passed under."""


@dataclass(frozen=True)
class HeightConfig:
    """Which points stand in the robot's way, and how they are kept. nav2's names where nav2 has the parameter."""

    enabled: bool = True
    min_obstacle_height: float = 0.05
    max_obstacle_height: float = 1.30
    ground_tilt_deg: NotNegative = 0.8
    obstacle_min_range: NotNegative = 0.45
    obstacle_max_range: Positive = 6.0
    mark_threshold: Annotated[int, Range(1, 250)] = 2
    vertical_resolution_deg: Positive = 2.0
    clear_margin_m: Positive = 0.15

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.min_obstacle_height < self.max_obstacle_height:
            raise ValueError(f"min_obstacle_height must be below max_obstacle_height (got {self.min_obstacle_height})")


@dataclass(frozen=True)
class SortedPoints:
    """The points of one sweep in a level frame, told apart by height; what is no measurement is left out."""

    points: NDArray[np.float32]
    """(N, 3) metres, z above the ground."""
    kind: NDArray[np.uint8]
    """(N,) GROUND, OBSTACLE or OVERHEAD."""
    origin: NDArray[np.float64]
    """(3,) where the sensor was at the end of the sweep."""
    near: int
    """Points left out because they were nearer than ``obstacle_min_range``: the robot's own body."""

    def obstacles(self) -> NDArray[np.float64]:
        """Places (M, 2) of the points that stand in the way."""
        return self.points[self.kind == OBSTACLE, :2].astype(np.float64)

    def nearest(self, directions: int = 720) -> NDArray[np.float64]:
        """The nearest obstacle in each direction from the sensor that has one, (M, 2): what a flat scan would say."""
        return _nearest(self.points, self.kind, self.origin, directions)

    def counts(self) -> dict[str, int]:
        """How many points of each kind: what the height filter took, and what it dropped."""
        number = np.bincount(self.kind, minlength=3)
        return {
            "obstacle": int(number[OBSTACLE]),
            "ground": int(number[GROUND]),
            "overhead": int(number[OVERHEAD]),
            "near": self.near,
        }

    def moved(self, pose: NDArray[np.float64]) -> SortedPoints:
        """The same points in a frame in which this one stands at ``pose`` (x, y, yaw)."""
        c, s = math.cos(pose[2]), math.sin(pose[2])
        turn, shift = np.array([[c, s], [-s, c]]), np.asarray(pose, np.float64)[:2]
        points, origin = self.points.copy(), self.origin.copy()
        points[:, :2] = points[:, :2] @ turn.astype(np.float32) + shift.astype(np.float32)
        origin[:2] = origin[:2] @ turn + shift
        return SortedPoints(points, self.kind, origin, self.near)


def sort_points(
    points: NDArray[np.float32],
    time_s: NDArray[np.float32],
    level_from_lidar: NDArray[np.float64],
    duration_s: float,
    config: HeightConfig,
) -> SortedPoints:
    """Points of a sweep brought into a level frame, each from where the sensor was when it was measured.

    Args:
        points: (N, 3) in the sensor's frame, metres; what is not finite is left out.
        time_s: (N,) since the first point.
        level_from_lidar: (K, 4, 4) poses of the sensor at K even instants from 0 to ``duration_s``, in a frame whose
            z is the height above the ground.
        duration_s: of the sweep.
        config: the heights that count.
    """
    placed, kind, near = _sort(
        np.ascontiguousarray(points, dtype=np.float32),
        np.ascontiguousarray(time_s, dtype=np.float32),
        np.ascontiguousarray(level_from_lidar, dtype=np.float64).reshape(-1, 4, 4),
        float(duration_s),
        config.min_obstacle_height,
        config.max_obstacle_height,
        math.tan(math.radians(config.ground_tilt_deg)),
        config.obstacle_min_range,
    )
    return SortedPoints(placed, kind, np.array(level_from_lidar, np.float64).reshape(-1, 4, 4)[-1, :3, 3], int(near))


class HeightLayer:
    """Cells of a rolling window in which something stands between two heights.

    A cell is marked once ``mark_threshold`` points have fallen into it, with the lowest and highest of them. It is
    cleared when a beam at one of those heights is seen to end well behind it, and none ends at it.
    """

    AZIMUTHS = 720

    def __init__(self, config: HeightConfig, size: int, resolution: float) -> None:
        self.config = config
        self.size = size
        self.resolution = resolution
        self.hits = np.zeros((size, size), dtype=np.uint8)
        """(H, W) points that fell into a cell; from ``mark_threshold`` on it is occupied."""
        self.low = np.zeros((size, size), dtype=np.float32)
        self.high = np.zeros((size, size), dtype=np.float32)
        self._rows = math.ceil(180.0 / config.vertical_resolution_deg)
        self._seen = np.empty((self._rows, self.AZIMUTHS), dtype=np.float32)

    def reset(self) -> None:
        """Forgets everything."""
        self.hits.fill(0)

    def shift(self, columns: int, rows: int) -> None:
        """Moves the window by whole cells; what leaves it is forgotten."""
        self.hits = shifted(self.hits, columns, rows, 0)
        self.low = shifted(self.low, columns, rows, 0.0)
        self.high = shifted(self.high, columns, rows, 0.0)

    def update(self, sweep: SortedPoints, origin: NDArray[np.float64]) -> None:
        """Takes in a sweep given in the frame of the window, whose outer corner is ``origin`` (2,)."""
        _see_and_mark(
            sweep.points,
            sweep.kind,
            sweep.origin,
            float(origin[0]),
            float(origin[1]),
            self.resolution,
            self.config.obstacle_max_range,
            self.config.mark_threshold,
            math.radians(self.config.vertical_resolution_deg),
            self.config.clear_margin_m,
            self.hits,
            self.low,
            self.high,
            self._seen,
        )

    def occupied(self) -> NDArray[np.bool_]:
        """Cells (H, W) in which something stands in the way."""
        return self.hits >= self.config.mark_threshold


def shifted(array: NDArray[Cell], columns: int, rows: int, fill: float) -> NDArray[Cell]:
    """A window (H, W) moved by whole cells; ``fill`` where it has not been before."""
    moved = np.full_like(array, fill)
    height, width = array.shape
    if abs(columns) < width and abs(rows) < height:
        moved[max(0, -rows) : height - max(0, rows), max(0, -columns) : width - max(0, columns)] = array[
            max(0, rows) : height - max(0, -rows), max(0, columns) : width - max(0, -columns)
        ]
    return moved


@njit(cache=True)
def _sort(
    points: NDArray[np.float32],
    time_s: NDArray[np.float32],
    poses: NDArray[np.float64],
    duration_s: float,
    low: float,
    high: float,
    slope: float,
    range_min: float,
) -> tuple[NDArray[np.float32], NDArray[np.uint8], int]:
    count = points.shape[0]
    placed = np.empty((count, 3), dtype=np.float32)
    kind = np.empty(count, dtype=np.uint8)
    last = poses.shape[0] - 1
    kept, near = 0, 0
    for i in range(count):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        if not (np.isfinite(px) and np.isfinite(py) and np.isfinite(pz)):
            continue
        at = min(max(time_s[i] / duration_s, 0.0), 1.0) * last if duration_s > 0.0 else float(last)
        k = min(int(at), max(last - 1, 0))
        after = min(k + 1, last)
        a = at - k
        b = 1.0 - a
        m, n = poses[k], poses[after]
        dx = (b * m[0, 0] + a * n[0, 0]) * px + (b * m[0, 1] + a * n[0, 1]) * py + (b * m[0, 2] + a * n[0, 2]) * pz
        dy = (b * m[1, 0] + a * n[1, 0]) * px + (b * m[1, 1] + a * n[1, 1]) * py + (b * m[1, 2] + a * n[1, 2]) * pz
        dz = (b * m[2, 0] + a * n[2, 0]) * px + (b * m[2, 1] + a * n[2, 1]) * py + (b * m[2, 2] + a * n[2, 2]) * pz
        distance = math.sqrt(dx * dx + dy * dy)
        if distance < range_min:
            near += 1
            continue
        z = dz + b * m[2, 3] + a * n[2, 3]
        placed[kept, 0] = dx + b * m[0, 3] + a * n[0, 3]
        placed[kept, 1] = dy + b * m[1, 3] + a * n[1, 3]
        placed[kept, 2] = z
        # The robot pitches a little: far off, a given tilt lifts the ground by its share of the distance.
        kind[kept] = 0 if z < low + slope * distance else (2 if z > high else 1)
        kept += 1
    return placed[:kept], kind[:kept], near


@njit(cache=True)
def _nearest(
    points: NDArray[np.float32], kind: NDArray[np.uint8], sensor: NDArray[np.float64], directions: int
) -> NDArray[np.float64]:
    best = np.full(directions, np.inf)
    which = np.full(directions, -1, dtype=np.int64)
    for i in range(points.shape[0]):
        if kind[i] != 1:
            continue
        dx, dy = points[i, 0] - sensor[0], points[i, 1] - sensor[1]
        column = int((math.atan2(dy, dx) + math.pi) * directions / (2.0 * math.pi)) % directions
        distance = dx * dx + dy * dy
        if distance < best[column]:
            best[column], which[column] = distance, i
    found = np.empty((directions, 2))
    count = 0
    for nearest in which:
        if nearest >= 0:
            found[count, 0], found[count, 1] = points[nearest, 0], points[nearest, 1]
            count += 1
    return found[:count]


@njit(cache=True)
def _see_and_mark(
    points: NDArray[np.float32],
    kind: NDArray[np.uint8],
    sensor: NDArray[np.float64],
    origin_x: float,
    origin_y: float,
    resolution: float,
    range_max: float,
    threshold: int,
    per_row: float,
    margin: float,
    hits: NDArray[np.uint8],
    low: NDArray[np.float32],
    high: NDArray[np.float32],
    seen: NDArray[np.float32],
) -> None:
    """Clears what beams pass through, then marks. ``seen`` (E, A): nearest end of the beams of each direction, m."""
    rows, azimuths = seen.shape
    size_y, size_x = hits.shape
    per_azimuth = 2.0 * math.pi / azimuths
    seen[:] = np.inf
    for i in range(points.shape[0]):
        dx, dy, dz = points[i, 0] - sensor[0], points[i, 1] - sensor[1], points[i, 2] - sensor[2]
        distance = math.sqrt(dx * dx + dy * dy)
        row = int((math.atan2(dz, distance) + 0.5 * math.pi) / per_row)
        column = int((math.atan2(dy, dx) + math.pi) / per_azimuth) % azimuths
        if 0 <= row < rows and distance < seen[row, column]:
            seen[row, column] = distance
    for r in range(size_y):
        for c in range(size_x):
            if hits[r, c] == 0:
                continue
            dx = origin_x + (c + 0.5) * resolution - sensor[0]
            dy = origin_y + (r + 0.5) * resolution - sensor[1]
            distance = math.sqrt(dx * dx + dy * dy)
            if distance < resolution:
                continue
            column = int((math.atan2(dy, dx) + math.pi) / per_azimuth) % azimuths
            # Half a cell more each way: the points of a surface scatter by that much.
            first = math.atan2(low[r, c] - 0.5 * resolution - sensor[2], distance) + 0.5 * math.pi
            last = math.atan2(high[r, c] + 0.5 * resolution - sensor[2], distance) + 0.5 * math.pi
            passed, stands = False, False
            for row in range(max(0, int(first / per_row)), min(rows - 1, int(last / per_row)) + 1):
                middle = (row + 0.5) * per_row
                end = seen[row, column]
                if not np.isfinite(end):
                    continue
                if abs(end - distance) <= margin:
                    stands = True
                elif end > distance and first <= middle <= last:
                    passed = True
            if passed and not stands:
                hits[r, c] = 0
    for i in range(points.shape[0]):
        if kind[i] != 1:
            continue
        x, y = points[i, 0], points[i, 1]
        if (x - sensor[0]) ** 2 + (y - sensor[1]) ** 2 > range_max * range_max:
            continue
        c, r = math.floor((x - origin_x) / resolution), math.floor((y - origin_y) / resolution)
        if 0 <= r < size_y and 0 <= c < size_x:
            z = points[i, 2]
            if hits[r, c] == 0:
                low[r, c], high[r, c] = z, z
            else:
                low[r, c], high[r, c] = min(low[r, c], z), max(high[r, c], z)
            hits[r, c] = min(hits[r, c] + 1, 250)
