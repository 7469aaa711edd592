"""Depth of the whole panorama from LiDAR points alone, by a structure of walls, floor and ceiling. numpy only.

A VLP-16 sees a band of 30 degrees; the panorama has 180. What lies outside the band is taken as a building is made:
what a column of the picture sees last stands upright, on a level floor, under a level ceiling. Every pixel is told how
it came about and how uncertain it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import equirect_directions, equirect_pixels

from ..ranges import NotNegative, Positive, Range, check_ranges
from .visibility import project_points

Floats = NDArray[np.floating]
_NONE = 1 << 20


class Origin(IntEnum):
    """How the depth of a pixel came about."""

    UNKNOWN = 0
    BEAM = 1  # a point fell into it
    BETWEEN = 2  # between two points of the same upright surface
    EDGE = 3  # between two points of different surfaces: one of the two
    UP = 4  # upright surface, continued above its uppermost point
    DOWN = 5  # upright surface, continued below its lowest point
    FLOOR = 6  # level floor
    CEILING = 7  # level ceiling that points were seen on
    ASSUMED = 8  # level ceiling at the assumed height


@dataclass(frozen=True)
class LidarDepthConfig:
    """How depth is made from points alone.

    Attributes:
        min_range_m: points nearer than this to the camera are left out (the robot itself).
        max_range_m: farther points are left out; what lies farther is unknown.
        min_points: fewer points give no depth.
        max_gap_deg: an azimuth without any return is bridged up to this width; a wider one is open: unknown.
        ceiling_height_m: of the ceiling over the floor, where no point was seen on it.
        floor_tolerance_m: a point this near the floor's plane belongs to the floor.
        same_surface: two points above each other are of one surface when their horizontal ranges differ by less than
            this share.
    """

    min_range_m: NotNegative = 0.4
    max_range_m: Positive = 40.0
    min_points: Annotated[int, Range(20)] = 300
    max_gap_deg: Annotated[float, Range(0, 90)] = 8.0
    ceiling_height_m: Positive = 2.7
    floor_tolerance_m: Positive = 0.08
    same_surface: Annotated[float, Range(above=0, below=1)] = 0.15

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.min_range_m < self.max_range_m:
            raise ValueError(f"min_range_m must be under max_range_m (got {self.min_range_m}, {self.max_range_m})")


@dataclass(frozen=True)
class LidarDepth:
    """Depth from points alone.

    Attributes:
        depth_m: (H, W) float32 radial metres, 0 = unknown.
        sigma: (H, W) float32 relative standard deviation, inf where unknown.
        origin: (H, W) uint8, an ``Origin`` each.
        points: number of points used.
        camera_height_m: of the camera over the floor, given or found; None where neither.
        ceiling_height_m: of the ceiling over the camera, found from points; None where no ceiling was seen.
        message: why there is no depth; empty where there is.
    """

    depth_m: NDArray[np.float32]
    sigma: NDArray[np.float32]
    origin: NDArray[np.uint8]
    points: int
    camera_height_m: float | None
    ceiling_height_m: float | None
    message: str = ""


def level_from_camera(up: Floats) -> NDArray[np.float64]:
    """The smallest rotation (3, 3) that turns ``up`` (3,), gravity's up in the camera's frame, onto z.

    Raises:
        ValueError: ``up`` is no direction, or the camera hangs upside down within a degree.
    """
    up = np.asarray(up, np.float64)
    length = float(np.linalg.norm(up)) if up.shape == (3,) else float("nan")
    if not np.isfinite(length) or length < 1e-6:
        raise ValueError(f"up must be a direction of three finite numbers (got {up})")
    x, y, z = up / length
    if z < -0.9998:
        raise ValueError("the camera hangs upside down: up points along its -z")
    # Rodrigues' formula for the axis up x z.
    axis = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.asarray(np.eye(3) + axis + axis @ axis / (1.0 + z))


def plane_height(z: Floats, across_m: Floats, columns: NDArray[np.intp], bin_m: float = 0.04) -> float | None:
    """Height of the level plane that most points lie on; None where no plane stands out.

    Points that follow each other upwards in a column of the picture are of one height on a plane, and of one
    horizontal range on a wall.

    Args:
        z: (N,) heights, metres.
        across_m: (N,) horizontal ranges.
        columns: (N,) columns of the picture.
        bin_m: width of the histogram's bins.
    """
    order = np.lexsort((across_m, columns))
    z, across_m, columns = z[order], across_m[order], columns[order]
    apart, rise = np.diff(across_m), np.abs(np.diff(z))
    pair = (np.diff(columns) == 0) & (apart > 0.3) & (rise < 0.1 * apart) & (rise < 0.1)
    if pair.sum() < 20:
        return None
    heights = 0.5 * (z[1:] + z[:-1])[pair]
    # Nothing is seen through a floor or a ceiling; a table has points on both sides.
    sign = 1.0 if heights.mean() > 0 else -1.0
    heights = heights[sign * heights > np.quantile(sign * z, 0.98) - 0.2]
    if len(heights) < 20:
        return None
    bins = ((heights - heights.min()) / bin_m).astype(np.intp)
    best = int(np.convolve(np.bincount(bins), np.ones(3), "same").argmax())
    return float(np.median(heights[np.abs(bins - best) <= 1]))


_AROUND = [(row, column) for row in (-2, -1, 0, 1, 2) for column in (-2, -1, 1, 2)]


def lonely(measured: Floats, rows: NDArray[np.intp], columns: NDArray[np.intp], alike: float = 0.12) -> Floats:
    """Which points (N,) nothing around them confirms: dust, mixed pixels, mirrors.

    Args:
        measured: (H, W) ranges, 0 where no point is.
        rows, columns: (N,) the pixels with points.
        alike: two ranges are alike when they differ by less than this share.
    """
    height, width = measured.shape
    own = measured[rows, columns]
    there = np.zeros(len(rows), np.int32)
    same = np.zeros(len(rows), np.int32)
    for row, column in _AROUND:
        other = measured[np.clip(rows + row, 0, height - 1), (columns + column) % width]
        there += other > 0
        same += np.abs(other - own) < alike * own
    # A point that is wrong along its beam shows elsewhere in the camera's picture, often with nothing around it.
    return (same < 2) & (float(np.median(there)) >= 4)


def _confirmed(
    points: Floats, size: tuple[int, int]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], Floats]:
    """Of points (N, 3) the nearest in each pixel, without the lonely ones: index, row, column and range, each (M,)."""
    u, v, range_m = project_points(points, size[1], size[0])
    rows = np.clip(np.rint(v).astype(np.intp), 0, size[0] - 1)
    columns = np.rint(u).astype(np.intp) % size[1]
    nearest = np.full(size, -1, np.intp)
    far_first = np.argsort(-range_m, kind="stable")
    nearest[rows[far_first], columns[far_first]] = far_first
    kept = nearest[nearest >= 0]
    measured = np.zeros(size, np.float32)
    measured[rows[kept], columns[kept]] = range_m[kept]
    kept = kept[~lonely(measured, rows[kept], columns[kept])]
    return kept, rows[kept], columns[kept], range_m[kept]


@lru_cache(maxsize=4)
def _rays(height: int, width: int) -> NDArray[np.float32]:
    return equirect_directions(width, height)


class LidarStructure:
    """Makes depth pictures from points."""

    def __init__(self, config: LidarDepthConfig | None = None) -> None:
        self.config = config or LidarDepthConfig()

    def estimate(
        self,
        points: Floats,
        up: Floats,
        camera_height_m: float | None = None,
        size: tuple[int, int] = (256, 512),
        ceiling_m: float | None = None,
    ) -> LidarDepth:
        """Depth of every pixel that the structure reaches.

        Args:
            points: (N, 3) in the camera's frame, metres; points that are not finite are left out.
            up: (3,) gravity's up in the camera's frame.
            camera_height_m: of the camera over the floor; None: the floor is looked for in the points.
            size: height and width of the picture.
            ceiling_m: height of a ceiling over the camera that is taken where no point shows one (instead of the
                assumed height).

        Raises:
            ValueError: shapes or ``up`` are wrong.
        """
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points must be (N, 3) (got {points.shape})")
        config = self.config
        turn = level_from_camera(up)
        level = np.asarray(points, np.float64) @ turn.T
        distance = np.linalg.norm(level, axis=1)
        with np.errstate(invalid="ignore"):
            level = level[(distance >= config.min_range_m) & (distance <= config.max_range_m)]
        height, width = size
        if len(level) < config.min_points:
            nothing = np.zeros(size, np.float32)
            words = (
                f"{len(level)} LiDAR points between {config.min_range_m} and {config.max_range_m} m, "
                f"{config.min_points} are needed"
            )
            return LidarDepth(
                nothing, np.full(size, np.inf, np.float32), nothing.astype(np.uint8), len(level), camera_height_m, None,
                words,
            )  # fmt: skip
        kept, rows, columns, range_m = _confirmed(level, size)
        z, across = level[kept, 2], np.hypot(level[kept, 0], level[kept, 1])
        floor = camera_height_m
        if floor is None:
            lower = z < -0.2
            found = plane_height(z[lower], across[lower], columns[lower])
            floor = None if found is None else -found
        upper = z > 0.4
        ceiling = plane_height(z[upper], across[upper], columns[upper])
        depth, sigma, origin = self._columns((rows, columns, range_m), size, floor, ceiling, ceiling_m)
        if abs(turn[2, 2]) < 1 - 1e-6:
            u, v = equirect_pixels(_rays(height, width) @ turn.T.astype(np.float32), width, height)
            rows, columns = np.clip(np.rint(v).astype(np.intp), 0, height - 1), np.rint(u).astype(np.intp) % width
            depth, sigma, origin = depth[rows, columns], sigma[rows, columns], origin[rows, columns]
        return LidarDepth(depth, sigma, origin, len(level), floor, ceiling)

    def ranges(self, points: Floats, size: tuple[int, int]) -> NDArray[np.float32]:
        """Range (H, W) in each pixel of the camera's picture that a confirmed point (N, 3) falls into, else 0."""
        distance = np.linalg.norm(points, axis=1)
        with np.errstate(invalid="ignore"):
            inside = (distance >= self.config.min_range_m) & (distance <= self.config.max_range_m)
        _, rows, columns, range_m = _confirmed(points[inside], size)
        picture = np.zeros(size, np.float32)
        picture[rows, columns] = range_m
        return picture

    def _columns(
        self,
        hits: tuple[NDArray[np.intp], NDArray[np.intp], Floats],
        size: tuple[int, int],
        floor: float | None,
        ceiling: float | None,
        ceiling_guess: float | None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
        """The structure column by column, in a level picture."""
        config = self.config
        (rows, columns, range_m), (height, width) = hits, size
        measured = np.zeros(size, np.float32)
        measured[rows, columns] = range_m
        elevation = (np.pi / 2 - (np.arange(height) + 0.5) * (np.pi / height)).astype(np.float32)[:, None]
        cos, sin = np.cos(elevation), np.sin(elevation)
        tan = sin / cos
        hit = np.zeros((height, width), np.float32)  # horizontal range; inf on floor and ceiling
        flat = np.zeros((height, width), bool)
        z = range_m * sin[rows, 0]
        # A row's own height is half a pixel wide, which far away is more than the tolerance.
        slack = config.floor_tolerance_m + range_m * (np.pi / height)
        level_point = np.zeros(len(z), bool)
        if floor is not None:
            level_point |= z < -floor + slack
        if ceiling is not None:
            level_point |= z > ceiling - slack
        hit[rows, columns] = range_m * cos[rows, 0]
        flat[rows, columns] = level_point

        some = hit > 0
        columns_used = _bridge(np.any(some, axis=0), round(config.max_gap_deg / 360 * width))
        index = np.arange(height, dtype=np.int32)[:, None]
        above = np.maximum.accumulate(np.where(some, index, -1), axis=0)
        below = np.minimum.accumulate(np.where(some, index, _NONE)[::-1], axis=0)[::-1]
        has_above, has_below = above >= 0, below < _NONE
        column = np.broadcast_to(np.arange(width), (height, width))
        r_above = np.where(has_above, hit[np.maximum(above, 0), column], 0)
        r_below = np.where(has_below, hit[np.minimum(below, height - 1), column], 0)
        f_above = has_above & flat[np.maximum(above, 0), column]
        f_below = has_below & flat[np.minimum(below, height - 1), column]
        w_above, w_below = has_above & ~f_above, has_below & ~f_below
        to_above = np.where(has_above, index - above, _NONE)
        to_below = np.where(has_below, below - index, _NONE)
        gap = np.minimum(to_above, to_below)
        share = to_above / np.maximum(to_above + to_below, 1)

        both = w_above & w_below
        same = both & (np.abs(r_above - r_below) < config.same_surface * np.minimum(r_above, r_below))
        nearer_above = to_above <= to_below
        wall = np.zeros((height, width), np.float32)  # horizontal range of the upright surface, 0: none
        origin = np.zeros((height, width), np.uint8)

        def put(where: NDArray[np.bool_], value: Floats, how: Origin) -> None:
            wall[where] = value[where]
            origin[where] = how

        # Up to its top a column is known where the LiDAR's uppermost ring came back; else what is above is taken from
        # the nearest column where it did.
        whole = _reaches_top(np.where(some, hit, 0) * ~flat, sin / cos)
        donor = _bridge(whole, round(config.max_gap_deg / 360 * width))
        first = np.where(some.any(axis=0), some.argmax(axis=0), 0)
        crown = np.where(donor >= 0, hit[first[donor], donor], 0)
        wall_top = np.where(whole, r_below, crown)
        put(same, r_above * (1 - share) + r_below * share, Origin.BETWEEN)
        put(both & ~same, np.where(nearer_above, r_above, r_below), Origin.EDGE)
        put(w_above & f_below, r_above, Origin.DOWN)
        put(w_below & f_above & (elevation > 0), r_below, Origin.UP)
        # Something low with floor seen over it: its top is somewhere between.
        put(w_below & f_above & (elevation <= 0) & ~nearer_above, r_below, Origin.EDGE)
        put(w_below & ~has_above & (wall_top > 0), wall_top, Origin.UP)
        put(w_above & ~has_below, r_above, Origin.DOWN)

        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(wall > 0, wall / cos, np.inf)
            # A level surface between two points of one height: a table, a bench.
            h_above, h_below = r_above * tan[np.maximum(above, 0), 0], r_below * tan[np.minimum(below, height - 1), 0]
            plate = both & ~same & (h_above < -0.15) & (np.abs(h_above - h_below) < 0.05)
            depth = np.where(plate, 0.5 * (h_above + h_below) / sin, depth)
            origin[plate] = Origin.BETWEEN
            if floor is not None:
                to_floor = np.where(sin < 0, floor / -sin, np.inf)
                origin[to_floor < depth] = Origin.FLOOR
                depth = np.minimum(depth, to_floor)
            top, how = (ceiling, Origin.CEILING) if ceiling is not None else (ceiling_guess, Origin.ASSUMED)
            if top is None and floor is not None:
                top = max(config.ceiling_height_m - floor, _upper(z[~level_point]))
            if top is not None:
                # Never lower than what was seen upright in this column: there the ceiling is higher.
                seen = _middle(np.where(some & ~flat, hit * (sin / cos), 0).max(axis=0))
                to_top = np.where(
                    (sin > 0) & ((wall > 0) | (flat & (hit * sin > 0)).any(axis=0)),
                    np.maximum(top, seen + 0.05) / sin,
                    np.inf,
                )
                origin[to_top < depth] = how
                depth = np.minimum(depth, to_top)
        beam = some
        depth[beam] = measured[beam]
        origin[beam] = Origin.BEAM
        unknown = ~np.isfinite(depth) | (depth > config.max_range_m)
        depth[unknown], origin[unknown] = 0, Origin.UNKNOWN
        depth, origin, gap = depth[:, columns_used], origin[:, columns_used], gap[:, columns_used]
        open_ = columns_used != np.arange(width)
        origin[:, open_] = np.where(origin[:, open_] == Origin.BEAM, Origin.EDGE, origin[:, open_])
        never = columns_used < 0
        if never.any():
            ground = to_floor[:, 0] if floor is not None else np.full(height, np.inf)
            # Nothing came back: open, or too near to be measured. Only what the robot stands on is sure.
            ground = np.where(ground * cos[:, 0] <= config.min_range_m, ground, 0)[:, None]
            depth[:, never] = ground
            origin[:, never] = np.where(ground > 0, Origin.FLOOR, Origin.UNKNOWN)
        gap_rad = np.minimum(gap, height) * (np.pi / height)
        return depth.astype(np.float32), structure_sigma(origin, gap_rad), origin


#: Relative standard deviation at the points and its growth with the angle (rad) to the next one, for each ``Origin``.
_SIGMA = np.array(
    [
        [np.inf, 0.0], [0.02, 0.0], [0.03, 0.2], [0.25, 0.5], [0.1, 0.3], [0.1, 0.3], [0.05, 0.05], [0.05, 0.05],
        [0.25, 0.0],
    ], np.float32,
)  # fmt: skip


def structure_sigma(origin: NDArray[np.uint8], gap_rad: Floats) -> NDArray[np.float32]:
    """Relative standard deviation (H, W) of pixels of an ``Origin`` whose next point is ``gap_rad`` away."""
    return np.hypot(_SIGMA[origin, 0], _SIGMA[origin, 1] * gap_rad.astype(np.float32))


def _upper(z: Floats) -> float:
    """Height under which nearly all of the points' heights (N,) lie, at least 0.1 m."""
    return max(0.1, float(np.quantile(z, 0.995))) if len(z) else 0.1


def _reaches_top(hit: Floats, tan: Floats) -> NDArray[np.bool_]:
    """Columns (W,) whose uppermost upright point lies where the LiDAR's uppermost ring runs.

    Args:
        hit: (H, W) horizontal ranges of upright points, 0 where none is.
        tan: (H, 1) tangent of each row's elevation.
    """
    some = hit > 0
    there = some.any(axis=0)
    row = some.argmax(axis=0)
    across = hit[row, np.arange(hit.shape[1])]
    z = across * tan[row, 0]
    use = there.copy()
    line = np.zeros(2)
    # The ring is a line in range and height; what ends below it is left out by and by.
    for slack in (np.inf, 0.3, 0.15):
        use = there & (z > line[0] + line[1] * across - slack)
        if use.sum() < 10 or np.ptp(across[use]) < 0.2:
            return there
        line = np.polynomial.polynomial.polyfit(across[use], z[use], 1)
    return np.asarray(there & (z > line[0] + line[1] * across - 0.1 - 0.03 * across))


def _middle(values: Floats, reach: int = 3) -> Floats:
    """Median over neighbouring columns (W,), which wrap."""
    return np.asarray(np.median([np.roll(values, k) for k in range(-reach, reach + 1)], axis=0))


def _bridge(seen: NDArray[np.bool_], most: int) -> NDArray[np.intp]:
    """For each column the nearest that has points, -1 where none is within a gap of ``most`` columns; they wrap."""
    width = len(seen)
    places = np.flatnonzero(seen)
    if len(places) == 0:
        return np.full(width, -1, np.intp)
    index = np.arange(width)
    after = np.searchsorted(places, index)
    right = np.append(places, places[0] + width)[after]
    left = np.append(places[-1] - width, places)[np.where(seen[index], after + 1, after)]
    used = np.where(index - left <= right - index, left, right) % width
    return np.where((right - left - 1 <= most) | seen, used, -1)
