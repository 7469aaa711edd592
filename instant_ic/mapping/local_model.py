"""Local 3D model of the LiDAR revolutions of the last metres, and its depth images.

The model is a window of voxel columns around the robot. Beams free the voxels that they pass, so people and moved
objects vanish. Each column also keeps the moments of its points, which place surfaces more finely than voxels do. Depth
images are rendered by casting rays through the columns. Where nothing was measured, the usual structure of a building
is assumed: upright surfaces continue upwards to the first free voxel, and floor and ceiling are level.
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
STRIDE = 4
"""One beam in this many frees space; each revolution uses others."""


@dataclass(frozen=True)
class ModelTuning:
    """Size and tuning of the model. Lengths are metres, heights are above the floor.

    Attributes:
        window: number of columns of the window in x and in y, a power of two.
        cell_m: side of a voxel.
        reach_m: largest range of points that are kept; the window reaches 12.8 m.
        low_m: height of the lowest voxels.
        floor_m: height below which points belong to the floor.
        body_m: range of heights of the points that place an upright surface; higher points may belong to a ceiling.
        ceiling_m: lowest height of a ceiling.
        ceiling_clear_m: depth below a ceiling in which a column must have no points.
        ceiling_columns: smallest number of columns in a ceiling.
        unseen_m: largest distance of a ray through unseen columns; a ray that goes farther has no hit.
        plate_above_m: largest height of an object's top above the camera at which it is continued by a plate.
    """

    window: int = 512
    cell_m: float = 0.05
    reach_m: float = 12.0
    low_m: float = -0.2
    floor_m: float = 0.1
    body_m: tuple[float, float] = (0.1, 2.2)
    ceiling_m: float = 1.8
    ceiling_clear_m: float = 1.2
    ceiling_columns: int = 60
    unseen_m: float = 0.4
    plate_above_m: float = 0.3


TUNING = ModelTuning()


@dataclass(frozen=True)
class LocalModelConfig(Checked):
    """Parameters of the local model.

    Attributes:
        keep_m: path length of the robot after which measurements are forgotten, because odometry drifts.
        height_m: height of the window above the floor.
        behind_m: length by which the top of a low object continues behind its face, where nothing was measured.
    """

    keep_m: Positive = 10.0
    height_m: Annotated[float, Range(2, 6)] = 4.0
    behind_m: NotNegative = 0.5


@dataclass(frozen=True)
class LocalDepth:
    """Depth image rendered from the model.

    Attributes:
        depth_m: radial depth in metres, (H, W) float32; 0 is unknown.
        sigma: relative standard deviation, (H, W) float32; inf where unknown.
        kind: kind of surface of each pixel (constants of ``kernels``), (H, W) uint8.
        free_m: distance up to which the ray is free, (H, W) float32.
    """

    depth_m: NDArray[np.float32]
    sigma: NDArray[np.float32]
    kind: NDArray[np.uint8]
    free_m: NDArray[np.float32]


class LocalModel:
    """Accumulates points in a frame with z up and the floor at z = 0. It takes 35 MB of memory."""

    def __init__(self, config: LocalModelConfig | None = None) -> None:
        self.config = config or LocalModelConfig()
        self._levels = math.ceil((self.config.height_m - TUNING.low_m) / TUNING.cell_m)
        self._key = np.empty((TUNING.window, TUNING.window, 2), np.int32)
        self._odds = np.empty((TUNING.window, TUNING.window, self._levels), np.int8)
        self._sums = np.empty((TUNING.window, TUNING.window, 6), np.float32)
        self._last = np.empty((TUNING.window, TUNING.window), np.float32)
        self._sight = np.empty((TUNING.window, TUNING.window), np.float32)
        self._index = np.empty((TUNING.window, TUNING.window), np.int32)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._key[:] = np.iinfo(np.int32).min
        self._odds[:], self._sums[:], self._last[:], self._sight[:] = 0, 0, -np.inf, -np.inf
        self._path_m, self.revolutions = 0.0, 0

    def add(self, points: Floats, origin: Floats, advance_m: float = 0.0, stride: int = STRIDE) -> None:
        """Add a revolution.

        Args:
            points: points in the model's frame, (N, 3) metres; non-finite points are ignored.
            origin: start of the beams, (3,).
            advance_m: path length of the robot since the last revolution.
            stride: one beam in this many frees space.

        Raises:
            ValueError: a shape is wrong, the origin is not finite, or the advance is negative.
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
            self._key, self._odds, self._sums, self._last, self._sight, points, origin,
            TUNING.cell_m, TUNING.low_m, TUNING.body_m,
            np.float32(self._path_m), np.float32(self.config.keep_m), self.revolutions % stride, stride, TUNING.reach_m,
        )  # fmt: skip
        self.revolutions += 1

    def ceiling_m(self, origin: Floats) -> float | None:
        """Return the height above the floor of the level ceiling around a point (3,); None if none was seen."""
        first = round((TUNING.ceiling_m - TUNING.low_m) / TUNING.cell_m)
        centre = np.floor(np.asarray(origin)[:2] / TUNING.cell_m).astype(np.int64)
        found = kernels.ceiling_levels(
            self._key, self._odds, self._last, np.float32(self._path_m), np.float32(self.config.keep_m), centre,
            round(TUNING.reach_m / TUNING.cell_m), first, round(TUNING.ceiling_clear_m / TUNING.cell_m),
        )  # fmt: skip
        # Nothing is visible through a ceiling, so the highest level that is about as wide as the widest is chosen.
        wide = np.convolve(found, np.ones(3), "same")
        enough = np.flatnonzero(wide >= max(TUNING.ceiling_columns, 0.3 * wide.max()))
        if len(enough) == 0:
            return None
        best = max(range(max(int(enough[-1]) - 2, 0), int(enough[-1]) + 1), key=lambda level: wide[level])
        near = np.arange(max(best - 1, 0), min(best + 2, len(found)))
        return float(TUNING.low_m + (np.average(near, weights=found[near]) + 0.5) * TUNING.cell_m)

    def render(self, model_from_camera: Matrix, size: tuple[int, int], ceiling_m: float | None = None) -> LocalDepth:
        """Render an equirectangular depth image.

        Args:
            model_from_camera: pose of the camera, (4, 4).
            size: height and width in pixels.
            ceiling_m: height of the ceiling above the floor, used if the model has seen none; None if unknown.
        """
        config, cell = self.config, TUNING.cell_m
        origin = np.asarray(model_from_camera[:3, 3], np.float64)
        depth, kind, free = np.zeros(size, np.float32), np.zeros(size, np.uint8), np.zeros(size, np.float32)
        if self.revolutions == 0 or not np.isfinite(model_from_camera).all():
            return LocalDepth(depth, np.full(size, np.inf, np.float32), kind, free)
        measured = self.ceiling_m(origin)
        ceiling = measured if measured is not None else ceiling_m if ceiling_m is not None else math.inf
        ground = round((TUNING.floor_m - TUNING.low_m) / cell)
        top = self._levels if ceiling == math.inf else min(int((ceiling - 0.08 - TUNING.low_m) / cell), self._levels)
        codes, faces = kernels.solid_columns(
            self._key, self._odds, self._sums, self._last, self._sight, np.float32(self._path_m),
            np.float32(config.keep_m), cell, TUNING.low_m, ground, top, self._index,
        )  # fmt: skip
        if config.behind_m > 0:
            highest = int((origin[2] + TUNING.plate_above_m - TUNING.low_m) / cell)
            kernels.put_plates(
                self._key, self._odds, self._index, codes, faces, origin, cell, ground, config.behind_m, highest
            )
        rays = rays_of(size) @ np.asarray(model_from_camera[:3, :3], np.float32).T
        kernels.cast_rays(
            self._key, self._index, codes, faces, origin, rays.reshape(-1, 3), cell, TUNING.low_m, ceiling,
            measured is None,
            TUNING.reach_m, TUNING.unseen_m, depth.reshape(-1), kind.reshape(-1), free.reshape(-1),
        )  # fmt: skip
        return LocalDepth(depth, _SIGMA[kind], kind, free)

    def points(self) -> NDArray[np.float32]:
        """Return a point for each solid voxel, (N, 3): the mean x, y of its column, and the voxel's height."""
        known = (self._path_m - self._last) <= self.config.keep_m
        a, b, level = np.nonzero((self._odds >= kernels.OCCUPIED) & known[..., None])
        count = self._sums[a, b, 0]
        mean = self._sums[a, b, 1:3] / np.maximum(count, 1)[:, None]
        across = (self._key[a, b] + 0.5) * TUNING.cell_m + mean
        z = TUNING.low_m + (level + 0.5) * TUNING.cell_m
        return np.column_stack([across, z]).astype(np.float32)


#: Relative standard deviation of depth by kind of pixel. In seven generated and scanned worlds, 68 % of the errors are
#: smaller (docs/depth.md).
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
