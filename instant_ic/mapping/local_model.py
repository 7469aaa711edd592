"""Local 3D model: what LiDAR revolutions of the last metres showed, with free space carved, and its depth images.

The model is a window of columns of voxels around the robot. Beams free the voxels that they pass, so people and moved
things vanish. Each column also keeps the moments of its points, from which surfaces get their place between voxels. A
depth image is cast through the columns. Where a column was not measured, the usual structure of a building is assumed,
in space: an upright surface goes on up until something free, floor and ceiling are level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import Checked, NotNegative, Positive, Range
from instant_ic.geometry.poses import Matrix
from instant_ic.geometry.projections import rays_of
from instant_ic.mapping import kernels
from instant_ic.util.jit import leave_out_blas

Floats = NDArray[np.floating]
_WINDOW, _CELL_M = 512, 0.05
_REACH_M = 12.0
"""Farther points are not kept; the window reaches 12.8 m."""
STRIDE = 4
"""Every so many beams of a revolution free space, other ones each time."""
_LOW_M = -0.2
_FLOOR_M = 0.1
"""Points below this height belong to the floor."""
_BODY_M = (0.1, 2.2)
"""Heights of the points that place an upright surface; above, a ceiling may be among them."""
_LEAST_CEILING_M = 1.8
_CEILING_CLEAR_M = 1.2
"""Nothing was measured so far below a ceiling."""
_UNSEEN_M = 0.4
"""A ray that runs farther through columns nobody has seen ends nowhere."""
_PLATE_ABOVE_M = 0.3
"""Things whose top is less than this above the camera may get a plate on top."""


@dataclass(frozen=True)
class LocalModelConfig(Checked):
    """Parameters of the local model.

    Attributes:
        keep_m: what was measured farther back on the path than this is forgotten; odometry drifts.
        height_m: height of the window over the floor.
        behind_m: how far the top of a low thing goes on behind its face, where nothing was measured.
    """

    keep_m: Positive = 10.0
    height_m: Annotated[float, Range(2, 6)] = 4.0
    behind_m: NotNegative = 0.5


@dataclass(frozen=True)
class LocalDepth:
    """Depth image of the model.

    Attributes:
        depth_m: (H, W) float32 radial metres, 0 where the model does not know.
        sigma: (H, W) float32 relative standard deviation, inf where unknown.
        kind: (H, W) uint8, what each pixel shows (constants of ``kernels``).
        free_m: (H, W) float32, nothing stands nearer than this.
    """

    depth_m: NDArray[np.float32]
    sigma: NDArray[np.float32]
    kind: NDArray[np.uint8]
    free_m: NDArray[np.float32]


class LocalModel:
    """Accumulates points in a frame whose z axis is up and whose floor is z = 0. Memory is fixed: about 35 MB."""

    def __init__(self, config: LocalModelConfig | None = None) -> None:
        self.config = config or LocalModelConfig()
        self._levels = math.ceil((self.config.height_m - _LOW_M) / _CELL_M)
        self._key = np.empty((_WINDOW, _WINDOW, 2), np.int32)
        self._odds = np.empty((_WINDOW, _WINDOW, self._levels), np.int8)
        self._sums = np.empty((_WINDOW, _WINDOW, 6), np.float32)
        self._last = np.empty((_WINDOW, _WINDOW), np.float32)
        self._sight = np.empty((_WINDOW, _WINDOW), np.float32)
        self._index = np.empty((_WINDOW, _WINDOW), np.int32)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._key[:] = np.iinfo(np.int32).min
        self._odds[:], self._sums[:], self._last[:], self._sight[:] = 0, 0, -np.inf, -np.inf
        self._path_m, self.revolutions = 0.0, 0

    def add(self, points: Floats, origin: Floats, advance_m: float = 0.0, stride: int = STRIDE) -> None:
        """Add a revolution.

        Args:
            points: (N, 3) in the model's frame, metres; points that are not finite are left out.
            origin: (3,) of the beams.
            advance_m: how far the robot has come since the last one; ages what is known.
            stride: every so many beams free space.

        Raises:
            ValueError: other shapes, an origin that is not finite, or a negative advance.
        """
        points, origin = np.asarray(points, np.float64), np.asarray(origin, np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or origin.shape != (3,):
            raise ValueError(f"points must be (N, 3) and the origin (3,) (got {points.shape}, {origin.shape})")
        if not (np.isfinite(origin).all() and np.abs(origin).max() < 1e6):
            raise ValueError(f"the LiDAR's position must be finite and within 1000 km (got {origin})")
        if not 0 <= advance_m < math.inf:
            raise ValueError(f"advance_m must be >= 0 (got {advance_m})")
        points = points[np.isfinite(points).all(axis=1)]
        self._path_m += advance_m
        kernels.add_revolution(
            self._key, self._odds, self._sums, self._last, self._sight, points, origin, _CELL_M, _LOW_M, _BODY_M,
            np.float32(self._path_m), np.float32(self.config.keep_m), self.revolutions % stride, stride, _REACH_M,
        )  # fmt: skip
        self.revolutions += 1

    def ceiling_m(self, origin: Floats) -> float | None:
        """Height of the level ceiling around a place (3,) over the floor; None where none was seen."""
        first = round((_LEAST_CEILING_M - _LOW_M) / _CELL_M)
        centre = np.floor(np.asarray(origin)[:2] / _CELL_M).astype(np.int64)
        found = kernels.ceiling_levels(
            self._key, self._odds, self._last, np.float32(self._path_m), np.float32(self.config.keep_m), centre,
            round(_REACH_M / _CELL_M), first, round(_CEILING_CLEAR_M / _CELL_M),
        )  # fmt: skip
        # Nothing is seen through a ceiling: the highest level that is as wide as some other counts.
        wide = np.convolve(found, np.ones(3), "same")
        enough = np.flatnonzero(wide >= max(_LEAST_CEILING_COLUMNS, 0.3 * wide.max()))
        if len(enough) == 0:
            return None
        best = max(range(max(int(enough[-1]) - 2, 0), int(enough[-1]) + 1), key=lambda level: wide[level])
        near = np.arange(max(best - 1, 0), min(best + 2, len(found)))
        return float(_LOW_M + (np.average(near, weights=found[near]) + 0.5) * _CELL_M)

    def render(self, model_from_camera: Matrix, size: tuple[int, int], ceiling_m: float | None = None) -> LocalDepth:
        """Depth of a panorama.

        Args:
            model_from_camera: (4, 4) pose of the camera.
            size: height and width.
            ceiling_m: height over the floor of the ceiling to assume where none was seen; None: unknown.
        """
        config, cell = self.config, _CELL_M
        origin = np.asarray(model_from_camera[:3, 3], np.float64)
        depth, kind, free = np.zeros(size, np.float32), np.zeros(size, np.uint8), np.zeros(size, np.float32)
        if self.revolutions == 0 or not np.isfinite(model_from_camera).all():
            return LocalDepth(depth, np.full(size, np.inf, np.float32), kind, free)
        measured = self.ceiling_m(origin)
        ceiling = measured if measured is not None else ceiling_m if ceiling_m is not None else math.inf
        ground = round((_FLOOR_M - _LOW_M) / cell)
        top = self._levels if ceiling == math.inf else min(int((ceiling - 0.08 - _LOW_M) / cell), self._levels)
        codes, faces = kernels.solid_columns(
            self._key, self._odds, self._sums, self._last, self._sight, np.float32(self._path_m),
            np.float32(config.keep_m), cell, _LOW_M, ground, top, self._index,
        )  # fmt: skip
        if config.behind_m > 0:
            highest = int((origin[2] + _PLATE_ABOVE_M - _LOW_M) / cell)
            kernels.put_plates(
                self._key, self._odds, self._index, codes, faces, origin, cell, ground, config.behind_m, highest
            )
        rays = rays_of(size) @ np.asarray(model_from_camera[:3, :3], np.float32).T
        kernels.cast_rays(
            self._key, self._index, codes, faces, origin, rays.reshape(-1, 3), cell, _LOW_M, ceiling, measured is None,
            _REACH_M, _UNSEEN_M, depth.reshape(-1), kind.reshape(-1), free.reshape(-1),
        )  # fmt: skip
        return LocalDepth(depth, _SIGMA[kind], kind, free)

    def points(self) -> NDArray[np.float32]:
        """(N, 3) centres of the solid voxels in the model's frame, on the surface of their column."""
        known = (self._path_m - self._last) <= self.config.keep_m
        a, b, level = np.nonzero((self._odds >= kernels.OCCUPIED) & known[..., None])
        count = self._sums[a, b, 0]
        mean = self._sums[a, b, 1:3] / np.maximum(count, 1)[:, None]
        across = (self._key[a, b] + 0.5) * _CELL_M + mean
        z = _LOW_M + (level + 0.5) * _CELL_M
        return np.column_stack([across, z]).astype(np.float32)


_LEAST_CEILING_COLUMNS = 60

#: Relative standard deviation of depth for each kind of pixel: 68 % of the errors are smaller in seven generated and
#: scanned worlds (docs/depth.md).
_SIGMA = np.array([np.inf, 0.012, 0.012, 0.015, 0.015, 0.1, 0.07, 0.005, 0.027, 0.13, 0.014], np.float32)


def warm_up() -> None:
    """Compile the kernels, or load them from numba's cache."""
    leave_out_blas()
    model = LocalModel()
    # A box ahead with a wall behind it.
    y, z = (each.ravel() for each in np.meshgrid(np.arange(-0.5, 0.5, 0.02), np.arange(0.0, 0.8, 0.02)))
    model.add(np.column_stack([np.full_like(y, 1.0), y, z]), np.array([0.0, 0.0, 0.6]))
    pose = np.eye(4)
    pose[2, 3] = 1.2
    model.render(pose, (8, 16))
