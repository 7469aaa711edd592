"""Depth of the whole panorama from the points of one LiDAR revolution, with a structure of walls, floor and ceiling.

A VLP-16 covers 30 degrees of elevation, the panorama 180. The remaining part is filled with the usual structure of a
building: the last surface in a column of the image is an upright wall between a level floor and a level ceiling.
``LidarStructure`` takes these steps:

1. Level the points by ``level_from_camera``, and remove isolated points (``_confirmed``).
2. ``plane_height``: find floor and ceiling, on which vertically adjacent points have the same height.
3. ``_Building``: fill the level image column by column. ``_walls`` interpolates upright surfaces between points and
   continues them up (``_crown``) and down, ``_plates`` adds level surfaces between two points of the same height,
   ``_planes`` cuts all surfaces at floor and ceiling, and ``fill`` bridges narrow azimuths without a return.
4. ``structure_sigma``: give each pixel the uncertainty of its ``Origin``, fitted on simulated rooms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import NotNegative, Positive, Range, check_ranges
from instant_ic.depth.visibility import azimuth_problem, pixels_of
from instant_ic.geometry.projections import nearest_pixels, rays_of

Floats = NDArray[np.floating]
Indices = NDArray[np.signedinteger]


@dataclass(frozen=True)
class StructureTuning:
    """Tuning of the structure.

    Attributes:
        min_points: smallest number of points from which a structure is built.
        max_under_floor: largest share of points under the floor; a larger share means a wrong height or tilt of the
            camera, or stairs that lead down.
        max_gap_deg: widest azimuth without any return that is bridged; wider azimuths remain unknown.
        floor_tolerance_m: largest distance of a point from floor or ceiling that still counts as on it.
        same_surface: largest relative difference of the horizontal ranges of two points of one upright surface.
    """

    min_points: int = 300
    max_under_floor: float = 0.1
    max_gap_deg: float = 8.0
    floor_tolerance_m: float = 0.08
    same_surface: float = 0.15


TUNING = StructureTuning()


class Origin(IntEnum):
    """Origin of a pixel's depth."""

    UNKNOWN = 0
    BEAM = 1  # the pixel contains a point
    BETWEEN = 2  # between two points of the same upright surface
    EDGE = 3  # between two points of different surfaces, on one of them
    UP = 4  # upright surface, continued above its uppermost point
    DOWN = 5  # upright surface, continued below its lowest point
    FLOOR = 6  # level floor
    CEILING = 7  # level ceiling on which points were seen
    ASSUMED = 8  # level ceiling, or floor, at an assumed height


@dataclass(frozen=True)
class LidarDepthConfig:
    """Parameters of depth from points alone.

    Attributes:
        min_range_m: points nearer than this to the camera are left out (the robot itself).
        max_range_m: points farther than this are left out; farther surfaces are unknown.
        ceiling_height_m: height of the ceiling over the floor if no point was seen on the ceiling.
        top_ring_deg: elevation of the LiDAR's uppermost ring.
    """

    min_range_m: NotNegative = 0.4
    max_range_m: Positive = 40.0
    ceiling_height_m: Positive = 2.7
    top_ring_deg: Annotated[float, Range(0, 60)] = 15.0

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.min_range_m < self.max_range_m:
            raise ValueError(f"min_range_m must be below max_range_m (got {self.min_range_m}, {self.max_range_m})")


@dataclass(frozen=True)
class LidarDepth:
    """A depth image from points alone.

    Attributes:
        depth_m: radial depth in metres, (H, W) float32; 0 is unknown.
        origin: ``Origin`` of each pixel, (H, W) uint8.
        gap_rad: angle to the next point above or below, (H, W) float32; pi if there is none.
        points: number of points used.
        camera_height_m: height of the camera over the floor, given or found from points; None if unknown.
        ceiling_height_m: height of the ceiling over the camera, found from points; None if no ceiling was seen.
        message: reason for not trusting ``depth_m``; empty if it is trusted.
    """

    depth_m: NDArray[np.float32]
    origin: NDArray[np.uint8]
    gap_rad: NDArray[np.float32]
    points: int
    camera_height_m: float | None
    ceiling_height_m: float | None
    message: str = ""

    @property
    def sigma(self) -> NDArray[np.float32]:
        """Relative standard deviation, (H, W) float32; inf where unknown."""
        return structure_sigma(self.origin, self.gap_rad)


def level_from_camera(up: Floats) -> NDArray[np.float64]:
    """Return the smallest rotation (3, 3) from ``up`` (3,), the up direction in the camera's frame, to z.

    Raises:
        ValueError: ``up`` is not a direction, or the camera is within a degree of upside down.
    """
    up = np.asarray(up, np.float64)
    length = float(np.linalg.norm(up)) if up.shape == (3,) else float("nan")
    if not np.isfinite(length) or length < 1e-6:
        raise ValueError(f"up must be a direction of three finite numbers (got {up})")
    x, y, z = up / length
    if z < -0.9998:
        raise ValueError("the camera is upside down: up points along its -z axis")
    # Rodrigues' formula for the axis up x z.
    axis = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.asarray(np.eye(3) + axis + axis @ axis / (1.0 + z))


def plane_height(z: Floats, across_m: Floats, columns: NDArray[np.intp], bin_m: float = 0.04) -> float | None:
    """Return the height of the level plane on which most points lie; None if no plane stands out.

    Vertically adjacent points in a column of the image have the same height on a plane, and the same horizontal range
    on a wall.

    Args:
        z: heights in metres, (N,).
        across_m: horizontal ranges in metres, (N,).
        columns: columns of the image, (N,).
        bin_m: width of the histogram's bins in metres.
    """
    order = np.lexsort((across_m, columns))
    z, across_m, columns = z[order], across_m[order], columns[order]
    apart, rise = np.diff(across_m), np.abs(np.diff(z))
    pair = (np.diff(columns) == 0) & (apart > 0.3) & (rise < 0.1 * apart) & (rise < 0.1)
    if pair.sum() < 20:
        return None
    heights = 0.5 * (z[1:] + z[:-1])[pair]
    # Floor and ceiling have no points behind them, while a table has points on both sides.
    sign = 1.0 if heights.mean() > 0 else -1.0
    heights = heights[sign * heights > np.quantile(sign * z, 0.98) - 0.2]
    if len(heights) < 20:
        return None
    bins = ((heights - heights.min()) / bin_m).astype(np.intp)
    best = int(np.convolve(np.bincount(bins), np.ones(3), "same").argmax())
    return float(np.median(heights[np.abs(bins - best) <= 1]))


_AROUND = [(row, column) for row in (-2, -1, 0, 1, 2) for column in (-2, -1, 1, 2)]


def lonely(
    measured: Floats, rows: NDArray[np.intp], columns: NDArray[np.intp], alike: float = 0.12
) -> NDArray[np.bool_]:
    """Return a mask (N,) of points that no neighbour confirms, such as dust, mixed pixels and reflections.

    Args:
        measured: ranges in metres, (H, W); 0 if a pixel has no point.
        rows: rows of the pixels with points, (N,).
        columns: columns of the pixels with points, (N,).
        alike: largest relative difference of two ranges that confirm each other.
    """
    height, width = measured.shape
    own = measured[rows, columns]
    there = np.zeros(len(rows), np.int32)
    same = np.zeros(len(rows), np.int32)
    for row, column in _AROUND:
        other = measured[np.clip(rows + row, 0, height - 1), (columns + column) % width]
        there += other > 0
        same += np.abs(other - own) < alike * own
    # A point with a wrong range appears elsewhere in the camera's image, often without any neighbours.
    return np.asarray((same < 2) & (float(np.median(there)) >= 4))


def _confirmed(
    points: Floats, size: tuple[int, int]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], Floats]:
    """Return index, row, column and range, (M,) each, of the nearest point (N, 3) in each pixel, if it is confirmed."""
    rows, columns, range_m = pixels_of(points, size[1], size[0])
    nearest = np.full(size, -1, np.intp)
    far_first = np.argsort(-range_m, kind="stable")
    nearest[rows[far_first], columns[far_first]] = far_first
    kept = nearest[nearest >= 0]
    measured = np.zeros(size, np.float32)
    measured[rows[kept], columns[kept]] = range_m[kept]
    kept = kept[~lonely(measured, rows[kept], columns[kept])]
    return kept, rows[kept], columns[kept], range_m[kept]


class LidarStructure:
    """Estimator of depth images from points."""

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
        """Estimate the depth of every pixel that the structure reaches.

        Args:
            points: points in the camera's frame in metres, (N, 3); points that are not finite are left out.
            up: up direction (against gravity) in the camera's frame, (3,).
            camera_height_m: height of the camera over the floor; None to find the floor from the points.
            size: height and width of the image.
            ceiling_m: height of the ceiling over the camera if no point shows it; None for the configured height.

        Raises:
            ValueError: shapes or ``up`` are wrong.
        """
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points must be (N, 3) (got {points.shape})")
        turn = level_from_camera(up)
        level = self._usable(points) @ turn.T
        if len(level) < TUNING.min_points:
            words = (
                f"{len(level)} LiDAR points between {self.config.min_range_m} and {self.config.max_range_m} m; "
                f"{TUNING.min_points} are needed"
            )
            nothing = np.zeros(size, np.float32), np.zeros(size, np.uint8), np.full(size, np.pi, np.float32)
            return LidarDepth(*nothing, len(level), camera_height_m, None, words)
        kept, rows, columns, range_m = _confirmed(level, size)
        z, across = level[kept, 2], np.hypot(level[kept, 0], level[kept, 1])
        floor = camera_height_m
        if floor is None:
            lower = z < -0.2
            found = plane_height(z[lower], across[lower], columns[lower])
            floor = None if found is None else -found
        upper = z > 0.4
        ceiling = plane_height(z[upper], across[upper], columns[upper])
        building = _Building(self.config, rows, columns, range_m, size, floor, ceiling, ceiling_m)
        depth, origin, gap_rad = building.fill()
        if turn[2, 2] < 1 - 1e-6:
            where = nearest_pixels(rays_of(size) @ turn.T.astype(np.float32), size[1], size[0])
            depth, origin, gap_rad = depth[where], origin[where], gap_rad[where]
        return LidarDepth(
            depth, origin, gap_rad, len(level), floor, ceiling, self._problem(z, range_m, columns, size[1], floor)
        )

    def ranges(self, points: Floats, size: tuple[int, int]) -> NDArray[np.float32]:
        """Return the range (H, W) of the confirmed point (N, 3) in each pixel; 0 if there is none."""
        picture = np.zeros(size, np.float32)
        _, rows, columns, range_m = _confirmed(self._usable(points), size)
        picture[rows, columns] = range_m
        return picture

    def _usable(self, points: Floats) -> NDArray[np.float64]:
        distance = np.linalg.norm(points, axis=1)
        with np.errstate(invalid="ignore"):
            inside = (distance >= self.config.min_range_m) & (distance <= self.config.max_range_m)
        return np.asarray(points[inside], np.float64)

    def _problem(self, z: Floats, range_m: Floats, columns: NDArray[np.intp], width: int, floor: float | None) -> str:
        """Return the reason for not trusting the structure; empty if it is trusted."""
        if problem := azimuth_problem(columns, width):
            return problem
        under = 0.0 if floor is None else float((z < -floor - 0.15 - 0.02 * range_m).mean())
        if under > TUNING.max_under_floor:
            return (
                f"{under:.0%} of the points lie under the floor ({floor:.2f} m under the camera): "
                "height or tilt of the camera is wrong, or stairs lead down"
            )
        return ""


class _Building:
    """The structure in a level image, column by column.

    Attributes:
        hit: horizontal range of the point in each pixel, (H, W); 0 if there is none.
        flat: pixels whose point lies on the floor or the ceiling, (H, W).
        above, below: rows of the next points above and below, (H, W); -1 and H if there is none.
        up, down: indices of the next points in the image.
    """

    def __init__(
        self,
        config: LidarDepthConfig,
        rows: NDArray[np.intp],
        columns: NDArray[np.intp],
        range_m: Floats,
        size: tuple[int, int],
        floor: float | None,
        ceiling: float | None,
        ceiling_guess: float | None,
    ) -> None:
        self.config, self.size, self.floor = config, size, floor
        height = size[0]
        elevation = (np.pi / 2 - (np.arange(height) + 0.5) * (np.pi / height)).astype(np.float32)[:, None]
        self.cos, self.sin, self.tan = np.cos(elevation), np.sin(elevation), np.tan(elevation)
        z = range_m * self.sin[rows, 0]
        # A point's row is uncertain by half a pixel, which exceeds the tolerance at long range.
        slack = TUNING.floor_tolerance_m + range_m * (np.pi / height)
        of_plane = np.zeros(len(z), bool)
        if floor is not None:
            of_plane |= z < -floor + slack
        if ceiling is not None:
            of_plane |= z > ceiling - slack
        self.measured, self.hit = np.zeros(size, np.float32), np.zeros(size, np.float32)
        self.measured[rows, columns], self.hit[rows, columns] = range_m, range_m * self.cos[rows, 0]
        self.flat = np.zeros(size, bool)
        self.flat[rows, columns] = of_plane
        self.some = self.hit > 0
        # An unknown floor is assumed at the height of the lowest points.
        self.ground = floor if floor is not None else _highest(-z)
        self.ground_origin = Origin.FLOOR if floor is not None else Origin.ASSUMED
        usual = config.ceiling_height_m - self.ground if ceiling_guess is None else ceiling_guess
        self.top = max(usual, _highest(z[~of_plane])) if ceiling is None else ceiling
        self.top_origin = Origin.ASSUMED if ceiling is None else Origin.CEILING

    def fill(self) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.float32]]:
        """Return depth, origin and angle to the next point, each (H, W)."""
        height, width = self.size
        column = np.arange(width, dtype=np.int32)
        index = np.arange(height, dtype=np.int32)[:, None]
        self.above = above = np.maximum.accumulate(np.where(self.some, index, np.int32(-1)), axis=0)
        self.below = below = np.minimum.accumulate(np.where(self.some, index, np.int32(height))[::-1], axis=0)[::-1]
        self.up, self.down = (np.maximum(above, 0), column), (np.minimum(below, height - 1), column)
        gap = np.minimum(np.where(above < 0, height, index - above), np.where(below == height, height, below - index))
        wall, origin = self._walls(index)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(wall == 0, np.inf, wall / self.cos)
            self._plates(depth, origin)
            self._planes(depth, origin, wall)
        np.copyto(depth, self.measured, where=self.some)
        np.copyto(origin, np.uint8(Origin.BEAM), where=self.some)
        unknown = ~np.isfinite(depth) | (depth > self.config.max_range_m)
        np.copyto(depth, np.float32(0), where=unknown)
        np.copyto(origin, np.uint8(Origin.UNKNOWN), where=unknown)

        used = self._bridged(np.any(self.some, axis=0))
        bridged = (used >= 0) & (used != column)
        depth, origin, gap = depth[:, used], origin[:, used], gap[:, used]
        origin[:, bridged] = np.where(origin[:, bridged] == Origin.BEAM, Origin.EDGE, origin[:, bridged])
        # Columns without a return are open, or too near to be measured. Only the floor under the robot is certain.
        ground = np.zeros((height, 1), np.float32)
        if self.floor is not None:
            near = -self.floor / self.tan < self.config.min_range_m
            ground = np.where((self.sin < 0) & near, -self.floor / self.sin, 0)
        depth[:, used < 0] = ground
        origin[:, used < 0] = np.where(ground > 0, Origin.FLOOR, Origin.UNKNOWN)
        return depth.astype(np.float32), origin, (gap * (np.pi / height)).astype(np.float32)

    def _walls(self, index: Indices) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Return the horizontal range of each pixel's upright surface (0: none, NaN: unknown) and its origin.

        Args:
            index: rows of the image, (H, 1).
        """
        above, below = self.above, self.below
        wall_above = (above >= 0) & ~self.flat[self.up]
        wall_below = (below < len(index)) & ~self.flat[self.down]
        flat_above = (above >= 0) & ~wall_above
        flat_below = (below < len(index)) & ~wall_below
        r_above, r_below = self.hit[self.up], self.hit[self.down]
        both = wall_above & wall_below
        same = both & (np.abs(r_above - r_below) < TUNING.same_surface * np.minimum(r_above, r_below))
        up, down = self.up[0], self.down[0]
        share = ((index - up) / np.maximum(down - up, 1)).astype(np.float32)
        nearer_above = index - above <= below - index
        crown = self._crown()
        wall, origin = np.zeros(self.size, np.float32), np.zeros(self.size, np.uint8)
        for where, value, how in (
            (same, r_above * (1 - share) + r_below * share, Origin.BETWEEN),
            (both & ~same, np.where(nearer_above, r_above, r_below), Origin.EDGE),
            (wall_above & (flat_below | (below == len(index))), r_above, Origin.DOWN),
            (wall_below & flat_above & (self.sin > 0), r_below, Origin.UP),
            # A low object with floor visible above it: its top lies somewhere between the two points.
            (wall_below & flat_above & (self.sin <= 0) & ~nearer_above, r_below, Origin.EDGE),
            # Without a crown, the upper end of the surface is unknown (a window, the sky).
            (wall_below & (above < 0), np.where(crown > 0, crown, np.nan), Origin.UP),
        ):
            np.copyto(wall, value, where=where)
            np.copyto(origin, np.uint8(how), where=where)
        return wall, origin

    def _crown(self) -> NDArray[np.float32]:
        """Return the horizontal range (W,) at which each column continues above its uppermost point; 0 is unknown.

        If the LiDAR's uppermost ring has a return in a column, the column continues at that range. Otherwise the ring
        passed over the column's surface, and the range behind it is taken from the nearest column with such a return.
        """
        upright = np.where(self.flat, 0, self.hit)
        row = (upright > 0).argmax(axis=0)
        across = upright[row, np.arange(self.size[1])]
        donor = self._bridged(
            _reaches_top(across, across * self.tan[row, 0], math.tan(math.radians(self.config.top_ring_deg)))
        )
        return np.where(donor >= 0, across[donor], 0).astype(np.float32)

    def _plates(self, depth: Floats, origin: NDArray[np.uint8]) -> None:
        """Insert a level surface, such as a table or a bench, between two points of the same height."""
        high, low = (self.hit[place] * self.tan[place[0], 0] for place in (self.up, self.down))
        edge = (origin == Origin.EDGE) & (self.above >= 0) & (self.below < self.size[0])
        plate = edge & ~self.flat[self.up] & (high < -0.15) & (np.abs(high - low) < 0.05)
        np.copyto(depth, 0.5 * (high + low) / self.sin, where=plate)
        np.copyto(origin, np.uint8(Origin.BETWEEN), where=plate)

    def _planes(self, depth: Floats, origin: NDArray[np.uint8], wall: Floats) -> None:
        """Cut the surfaces at floor and ceiling, which hide everything behind them."""
        to_floor = np.where(self.sin < 0, -self.ground / self.sin, np.inf)
        np.copyto(origin, np.uint8(self.ground_origin), where=to_floor < depth)
        np.minimum(depth, to_floor, out=depth)
        # The ceiling is not lower than the highest upright surface that was seen in the column.
        seen = _middle(np.where(self.some & ~self.flat, self.hit * self.tan, 0).max(axis=0)) + 0.05
        roofed = (wall > 0) | np.any(self.flat & (self.hit * self.tan > 0), axis=0)
        to_top = np.where((self.sin > 0) & roofed, np.maximum(self.top, seen) / self.sin, np.inf)
        np.copyto(origin, np.uint8(self.top_origin), where=to_top < depth)
        np.minimum(depth, to_top, out=depth)

    def _bridged(self, seen: NDArray[np.bool_]) -> NDArray[np.intp]:
        return _bridge(seen, round(TUNING.max_gap_deg / 360 * self.size[1]))


#: Relative standard deviation at a point, and its growth (1/rad) with the angle to the point, for each ``Origin``.
#: Fitted on simulated rooms so that 68 % of the errors are smaller.
_SIGMA = np.array(
    [
        (np.inf, 0.0),  # UNKNOWN
        (0.0131, 0.0),  # BEAM
        (0.0005, 0.6406),  # BETWEEN
        (0.0735, 3.9778),  # EDGE
        (0.0125, 0.0333),  # UP
        (0.0159, 0.2729),  # DOWN
        (0.0001, 0.0001),  # FLOOR
        (0.0035, 0.0002),  # CEILING
        (0.1316, 0.0177),  # ASSUMED
    ],
    np.float32,
)
#: Smallest relative standard deviation of real surfaces. Simulated ones are even and the camera's pose is exact.
LEAST_SIGMA = 0.005


def structure_sigma(origin: NDArray[np.uint8], gap_rad: Floats) -> NDArray[np.float32]:
    """Return the relative standard deviation (H, W) of pixels by ``Origin`` and angle to the next point."""
    base, by_gap = (np.ascontiguousarray(column)[origin] for column in _SIGMA.T)
    sigma = np.hypot(base, by_gap * gap_rad)
    return np.asarray(np.maximum(sigma, LEAST_SIGMA), np.float32)


def _highest(z: Floats) -> float:
    """Return the height below which nearly all heights (N,) lie; at least 0.1 m."""
    return max(0.1, float(np.quantile(z, 0.995))) if len(z) else 0.1


def _reaches_top(across: Floats, z: Floats, slope: float) -> NDArray[np.bool_]:
    """Return the columns (W,) whose uppermost upright point was measured by the LiDAR's uppermost ring.

    In a diagram of height over range the ring is a line of known slope. Its height at range 0 is fitted to the highest
    points only, because lower rings see far walls and would distort a fit of the slope.

    Args:
        across: horizontal range of the uppermost upright point in metres, (W,); 0 if there is none.
        z: height of this point in metres, (W,).
        slope: height of the ring over range.
    """
    there = across > 0
    if not there.any():
        return there
    over = z - slope * across
    highest = over[there & (over > np.quantile(over[there], 0.9) - 0.1)]
    return np.asarray(there & (over > np.median(highest) - 0.1 - 0.03 * across))


def _middle(values: Floats, reach: int = 3) -> Floats:
    """Return the median over neighbouring columns (W,), which wrap."""
    return np.asarray(np.median([np.roll(values, k) for k in range(-reach, reach + 1)], axis=0))


def _bridge(seen: NDArray[np.bool_], most: int) -> NDArray[np.intp]:
    """Return for each column the nearest column with points, or -1 in gaps wider than ``most``. Columns wrap."""
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
