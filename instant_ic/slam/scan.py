"""A planar laser scan and its points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Scan:
    """One scan, as in sensor_msgs/LaserScan.

    ``ranges`` is (n,) in metres. As in REP-117, −inf is too close, NaN an error and +inf no return. Beam ``i`` points
    to ``angle_min + i·angle_increment`` radians in the laser's frame. All beams are treated as measured at
    ``stamp_ns``.
    """

    ranges: NDArray[np.floating]
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    stamp_ns: int

    def __post_init__(self) -> None:
        if np.ndim(self.ranges) != 1:
            raise ValueError(f"ranges must be one-dimensional (got shape {np.shape(self.ranges)})")
        if not self.range_max > self.range_min >= 0:
            raise ValueError(f"need range_max > range_min >= 0 (got {self.range_max} and {self.range_min})")
        if not (np.isfinite(self.angle_min) and np.isfinite(self.angle_increment)):
            raise ValueError(f"angles must be finite (got {self.angle_min}, {self.angle_increment})")


@dataclass(frozen=True)
class ScanPoints:
    """Points of a scan used by SLAM, in the robot's base frame.

    Attributes:
        points: hits in beam order, (n, 2).
        joined: whether point ``i`` continues the surface of point ``i - 1``, (n,).
        origin: centre of the laser, (2,).
    """

    points: FloatArray
    joined: NDArray[np.bool_]
    origin: FloatArray


JOIN_GAP_M = 0.3
"""Largest distance between neighbouring hits of one surface, less than the width of a door."""
POINT_SPACING_M = 0.04
"""Minimum spacing of the matched points along a surface, below the cell size of the field."""
COLLINEAR_M = 0.05
COLLINEAR_GAP_M = 8.0
COLLINEAR_GAP_RATIO = 2.0


def _joined(points: FloatArray, beams: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which points (n, 2) continue the surface of the previous point.

    Points of neighbouring beams are joined if they are close together. Points on a wall at a grazing angle, where hits
    are metres apart, are joined if they are in line with the next hit on either side.
    """
    joined = np.zeros(len(points), dtype=np.bool_)
    if len(points) < 2:
        return joined
    step = points[1:] - points[:-1]
    length = np.sqrt((step**2).sum(axis=1))
    neighbours = np.diff(beams) == 1
    in_line = np.zeros(len(step), dtype=np.bool_)
    if len(step) > 1:
        # cross / shorter is the distance of the longer step's far end from the line of the shorter step.
        cross = np.abs(step[:-1, 0] * step[1:, 1] - step[:-1, 1] * step[1:, 0])
        forward = (step[:-1] * step[1:]).sum(axis=1) > 0
        straight = neighbours[:-1] & neighbours[1:] & forward
        shorter, longer = np.minimum(length[:-1], length[1:]), np.maximum(length[:-1], length[1:])
        straight &= (cross <= COLLINEAR_M * shorter) & (longer <= COLLINEAR_GAP_RATIO * shorter)
        in_line[:-1] |= straight
        in_line[1:] |= straight
    joined[1:] = neighbours & ((length <= JOIN_GAP_M) | (in_line & (length <= COLLINEAR_GAP_M)))
    return joined


def scan_points(scan: Scan, base_from_laser: FloatArray) -> ScanPoints:
    """Return the hits of ``scan``. A range is a hit if ``range_min <= r <= range_max`` (REP-117).

    Hits of neighbouring beams are one surface if they are at most `JOIN_GAP_M` apart or in a line.
    """
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    angles = scan.angle_min + scan.angle_increment * np.arange(ranges.size) + base_from_laser[2]
    origin = np.array([base_from_laser[0], base_from_laser[1]])
    with np.errstate(invalid="ignore"):
        hit = (ranges >= scan.range_min) & (ranges <= scan.range_max)
    beams = np.flatnonzero(hit)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = origin + ranges[beams, None] * directions[beams]
    return ScanPoints(points, _joined(points, beams), origin)


def thin(points: FloatArray, joined: NDArray[np.bool_], max_points: int) -> FloatArray:
    """Return the points for matching: `POINT_SPACING_M` apart along a surface, at most ``max_points``.

    Without thinning, a near wall hit by many beams outweighs the far walls that determine the heading.
    """
    if len(points) == 0:
        return points
    step = np.zeros(len(points))
    step[1:] = np.where(joined[1:], np.sqrt(((points[1:] - points[:-1]) ** 2).sum(axis=1)), np.inf)
    # Keep a point where the arc length along its surface enters a new interval of POINT_SPACING_M.
    step[~np.isfinite(step)] = POINT_SPACING_M
    stretch = np.floor(np.cumsum(step) / POINT_SPACING_M)
    keep = np.ones(len(points), dtype=np.bool_)
    keep[1:] = stretch[1:] != stretch[:-1]
    kept = points[keep]
    if len(kept) > max_points:
        kept = kept[(np.arange(max_points) * len(kept)) // max_points]
    return np.ascontiguousarray(kept)
