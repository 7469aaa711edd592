"""Likelihood field: agreement of a point with the surfaces seen in recent keyframes.

The value at a point is ``exp(−d²/2σ²)``, with ``d`` the distance to the nearest seen surface (Thrun, Burgard, Fox,
Probabilistic Robotics, 6.4). It is stored on a square grid around the robot. The surface in a cell is the mean of all
hits in and near the cell. A field of single hits would have a flat ridge along each wall, as wide as the range noise,
on which scans drift.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.slam.scan import FloatArray

SIGMA_M = 0.06
"""σ of the field around a surface. A larger value tolerates larger errors but is less precise."""
SURFACE_SIGMA_M = 0.04
"""Distance within which hits are averaged to one surface, about the range noise of a laser."""
GAP_WEIGHT = 0.1
"""Weight of an interpolated point between two joined hits, relative to a hit."""


@njit(cache=True)
def _add(weight, sum_x, sum_y, touched, count, x, y, w, margin):  # type: ignore[no-untyped-def]
    """Add a surface point to its cell. Return the new number of touched cells."""
    height, width = weight.shape
    ix, iy = math.floor(x + 0.5), math.floor(y + 0.5)
    if ix < margin or iy < margin or ix >= width - margin or iy >= height - margin:
        return count
    if weight[iy, ix] == 0.0:
        if count == touched.shape[0]:
            return count
        touched[count, 0] = iy
        touched[count, 1] = ix
        count += 1
    weight[iy, ix] += w
    sum_x[iy, ix] += w * x
    sum_y[iy, ix] += w * y
    return count


@njit(cache=True)
def accumulate(  # type: ignore[no-untyped-def]
    weight, sum_x, sum_y, touched, count, origin, resolution, pose, points, joined, margin
):
    """Add the hits of one keyframe, and the surface between joined hits, to the cell sums.

    Args:
        weight: weights of the hits, (H, W) float64; changed in place.
        sum_x: weighted sums of the hits' x, in cells, (H, W); changed in place.
        sum_y: weighted sums of the hits' y, in cells, (H, W); changed in place.
        touched: row and column of the cells with weight, (n, 2) int32; changed in place.
        count: number of rows of ``touched`` in use.
        origin: centre of cell (0, 0) in metres, (2,).
        resolution: metres per cell.
        pose: field_from_base, (3,).
        points: hits in the base frame, (n, 2).
        joined: whether point ``i`` continues the surface of point ``i - 1``, (n,).
        margin: width of the border, in cells, in which no points are added.

    Returns:
        The new ``count``.
    """
    cos_yaw, sin_yaw = math.cos(pose[2]), math.sin(pose[2])
    last_x = 0.0
    last_y = 0.0
    for i in range(points.shape[0]):
        x = (pose[0] + cos_yaw * points[i, 0] - sin_yaw * points[i, 1] - origin[0]) / resolution
        y = (pose[1] + sin_yaw * points[i, 0] + cos_yaw * points[i, 1] - origin[1]) / resolution
        if i > 0 and joined[i]:
            # Beams leave gaps on far walls. A dotted wall would lock scans to the poses from which the field was built.
            steps = int(math.hypot(x - last_x, y - last_y))
            for k in range(1, steps + 1):
                part = k / (steps + 1.0)
                count = _add(
                    weight, sum_x, sum_y, touched, count,
                    last_x + part * (x - last_x), last_y + part * (y - last_y), GAP_WEIGHT, margin,
                )  # fmt: skip
        count = _add(weight, sum_x, sum_y, touched, count, x, y, 1.0, margin)
        last_x = x
        last_y = y
    return count


@njit(cache=True)
def fill_cells(field, weight, sum_x, sum_y, touched, count, sigma, pull):  # type: ignore[no-untyped-def]
    """Fill the field with a Gaussian around the surface in each touched cell.

    Args:
        field: values of the field, (H, W) float32; changed in place.
        weight: weights of the hits, (H, W).
        sum_x: weighted sums of the hits' x, in cells, (H, W).
        sum_y: weighted sums of the hits' y, in cells, (H, W).
        touched: row and column of the cells with weight, (n, 2).
        count: number of rows of ``touched`` in use.
        sigma: standard deviation of the field, in cells.
        pull: σ, in cells, within which the hits of neighbouring cells count as the same surface.
    """
    radius = math.ceil(3.0 * sigma)
    scale = -0.5 / (sigma * sigma)
    pull_scale = -0.5 / (pull * pull)
    across = np.empty(2 * radius + 1)
    for t in range(count):
        iy, ix = touched[t, 0], touched[t, 1]
        cx, cy = sum_x[iy, ix] / weight[iy, ix], sum_y[iy, ix] / weight[iy, ix]
        # Do one mean-shift step, because the hits of a wall along a cell border fall into two rows of cells.
        total = 0.0
        x = 0.0
        y = 0.0
        for j in range(iy - 1, iy + 2):
            for i in range(ix - 1, ix + 2):
                w = weight[j, i]
                if w > 0.0:
                    nx, ny = sum_x[j, i] / w, sum_y[j, i] / w
                    w *= math.exp(pull_scale * ((nx - cx) ** 2 + (ny - cy) ** 2))
                    total += w
                    x += w * nx
                    y += w * ny
        x /= total
        y /= total
        ix, iy = math.floor(x + 0.5), math.floor(y + 0.5)
        for i in range(-radius, radius + 1):
            across[i + radius] = math.exp(scale * (ix + i - x) ** 2)
        for j in range(-radius, radius + 1):
            down = math.exp(scale * (iy + j - y) ** 2)
            for i in range(-radius, radius + 1):
                value = np.float32(down * across[i + radius])
                if value > field[iy + j, ix + i]:
                    field[iy + j, ix + i] = value


@njit(cache=True)
def _forget(weight, sum_x, sum_y, touched, count):  # type: ignore[no-untyped-def]
    for t in range(count):
        iy, ix = touched[t, 0], touched[t, 1]
        weight[iy, ix] = 0.0
        sum_x[iy, ix] = 0.0
        sum_y[iy, ix] = 0.0


@dataclass(frozen=True)
class FieldSurface:
    """Contribution of a keyframe to the field: pose (3,), points (n, 2) in its base frame, joined (n,)."""

    pose: FloatArray
    points: FloatArray
    joined: NDArray[np.bool_]


class LikelihoodField:
    """A square likelihood field around the robot.

    Attributes:
        values: values of the field, (n, n) float32.
        origin: centre of cell (0, 0) in metres, (2,).
        resolution: metres per cell.

    Args:
        resolution_m: cell size.
        reach_m: half the side of the square.
    """

    def __init__(self, resolution_m: float, reach_m: float) -> None:
        self.resolution = resolution_m
        half = math.ceil(reach_m / resolution_m)
        size = 2 * half + 1
        self.values = np.zeros((size, size), dtype=np.float32)
        self.origin = np.array([-half * resolution_m, -half * resolution_m])
        self._weight = np.zeros((size, size))
        self._sum_x = np.zeros((size, size))
        self._sum_y = np.zeros((size, size))
        self._touched = np.zeros((200_000, 2), dtype=np.int32)

    def rebuild(self, centre: FloatArray, surfaces: Sequence[FieldSurface]) -> None:
        """Rebuild the field from ``surfaces``, with its middle within a cell of ``centre`` (2,)."""
        half = self.values.shape[0] // 2
        self.origin = (np.round(np.asarray(centre[:2]) / self.resolution) - half) * self.resolution
        self.values.fill(0.0)
        sigma = SIGMA_M / self.resolution
        margin = math.ceil(3.0 * sigma) + 2
        count = 0
        for surface in surfaces:
            count = accumulate(
                self._weight, self._sum_x, self._sum_y, self._touched, count, self.origin, self.resolution,
                surface.pose, surface.points, surface.joined, margin,
            )  # fmt: skip
        fill_cells(
            self.values, self._weight, self._sum_x, self._sum_y, self._touched, count, sigma,
            SURFACE_SIGMA_M / self.resolution,
        )  # fmt: skip
        _forget(self._weight, self._sum_x, self._sum_y, self._touched, count)
