"""Occupancy grid around the keyframes' surfaces. Rendering queries the field only in occupied cells."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import equirect_directions
from instant_ic.vspace.config import GeometryConfig
from instant_ic.vspace.prior import ROOM, PanoramaPrior

MAX_DISTANCE = 100
MARGIN_CELLS = 2
_MAX_PARTS = 16
MAX_CELLS = 6_000_000  # limit of a grid, one byte per cell; in a large scene the cells grow instead


@dataclass(frozen=True)
class Occupancy:
    """A grid of distances to the nearest occupied cell.

    Attributes:
        distance: city-block distance in cells, 0 in an occupied cell, at most ``MAX_DISTANCE``, (nx, ny, nz) uint8.
        origin: corner of cell (0, 0, 0) in the map frame, metres, (3,) float32.
        cell_m: edge of a cell in metres.
    """

    distance: NDArray[np.uint8]
    origin: NDArray[np.float32]
    cell_m: float


def surface_points(prior: PanoramaPrior, cell_m: float) -> NDArray[np.float32]:
    """Return points of the keyframe's surfaces in the map, (N, 3), without gaps as wide as a cell.

    Quads of pixels on the room without a depth edge are divided into up to 16 × 16 parts if their corners are further
    apart than a cell, as on slanted planes. Within a quad the inverse depth is linear. With an infinite ``cell_m`` only
    the points of the pixels are returned.
    """
    height, width = prior.inverse_depth.shape
    directions = equirect_directions(width, height)
    directions = np.einsum("vuj,ij->vui", directions, prior.map_from_camera[:3, :3].astype(np.float32))
    inverse = prior.inverse_depth
    points = directions / inverse[..., None]
    room = prior.content == ROOM
    clouds = [points[room] if room.any() else points.reshape(-1, 3)]
    if math.isinf(cell_m):
        return clouds[0] + prior.map_from_camera[:3, 3].astype(np.float32)
    down = np.linalg.norm(points[1:] - points[:-1], axis=2)
    across = np.linalg.norm(np.roll(points, -1, 1) - points, axis=2)[:-1]
    parts = np.ceil(np.maximum(down, across) / cell_m)
    parts = 2 ** np.ceil(np.log2(np.clip(parts, 1, _MAX_PARTS))).astype(np.intp)
    right = np.roll(room, -1, 1)
    whole = room[:-1] & right[:-1] & room[1:] & right[1:]  # the sky's corners may lie outside the grid
    parts[(prior.depth_edge[:-1] > 0) | ~whole] = 1
    for count in np.unique(parts):
        if count == 1:
            continue
        v, u = np.nonzero(parts == count)
        u1 = (u + 1) % width
        step = np.arange(count, dtype=np.float32) / np.float32(count)
        share_v, share_u = (axis.reshape(-1)[:, None] for axis in np.meshgrid(step, step, indexing="ij"))
        weights = ((1 - share_v) * (1 - share_u), (1 - share_v) * share_u, share_v * (1 - share_u), share_v * share_u)
        corners = ((v, u), (v, u1), (v + 1, u), (v + 1, u1))
        direction = sum(w[..., None] * directions[c] for w, c in zip(weights, corners, strict=True))
        nearness = sum(w * inverse[c] for w, c in zip(weights, corners, strict=True))
        clouds.append((direction / np.asarray(nearness)[..., None]).reshape(-1, 3))
    cloud = np.concatenate(clouds)
    cloud += prior.map_from_camera[:3, 3].astype(np.float32)
    return np.asarray(cloud, np.float32)


def build_occupancy(priors: Sequence[PanoramaPrior], config: GeometryConfig) -> Occupancy:
    """Build the occupancy grid of the keyframes' surfaces, with a margin of ``MARGIN_CELLS`` around them."""
    corners = np.concatenate([surface_points(prior, math.inf) for prior in priors])
    low, high = corners.min(axis=0), corners.max(axis=0)  # encloses the divided quads too
    volume = float(np.prod((high - low).astype(np.float64) + 8 * config.cell_m))
    cell = max(config.cell_m, (volume / MAX_CELLS) ** (1 / 3))
    origin = low - np.float32(4 * cell)
    shape = tuple(int(n) for n in np.ceil((high - origin) / cell).astype(int) + 4)
    distance = np.full(shape, MAX_DISTANCE, np.uint8)
    for prior in priors:
        index = ((surface_points(prior, cell) - origin) * np.float32(1 / cell)).astype(np.intp)
        distance.reshape(-1)[np.ravel_multi_index(tuple(index.T), shape)] = 0
    _spread(distance)
    # The margin covers surfaces between samples, the ray's step length, and small deviations of the field's surface.
    distance -= np.minimum(distance, np.uint8(MARGIN_CELLS))
    return Occupancy(distance, origin.astype(np.float32), float(cell))


def _spread(distance: NDArray[np.uint8]) -> None:
    """Compute city-block distances in place. One pass per axis is exact, because the metric is a sum over the axes."""
    for axis in range(3):
        lines = np.moveaxis(distance, axis, 0)
        for order in (1, -1):
            ordered = lines[::order]
            for previous, current in itertools.pairwise(ordered):
                np.minimum(current, previous + np.uint8(1), out=current)
