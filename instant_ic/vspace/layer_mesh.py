"""Triangle mesh of a panorama with depth: large triangles on planes, single pixels at depth edges.

A page renders the virtual space from this mesh. Vertices lie on the lattice of the pixels' corners. The surface is a
right-triangulated irregular network (Evans, Kirkpatrick and Townsend, 2001), which has no cracks and is refined until
its inverse depth is correct within a tolerance. A plane needs few triangles, even if it is seen at a flat angle. At a
depth edge, a pixel is a separate square at its own depth.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import directions_at

TOLERANCE = 0.004
"""Largest error of the inverse depth, in 1/m. It shifts a point by 0.6 pixels in a 640 pixel view from 0.5 m aside."""


@dataclass(frozen=True)
class LayerMesh:
    """Triangles of one layer.

    Attributes:
        corners: column and row of each vertex on the lattice of pixel corners, (N, 2) uint16: column 0 is the left edge
            of the panorama, row 0 its upper edge.
        inverse_depth: inverse depth of each vertex, 1/m along the ray, (N,) float32.
        triangles: indices of vertices, (T, 3) uint32, counter-clockwise as the panorama's camera sees them.
        size: height and width of the panorama's depth image.
    """

    corners: NDArray[np.uint16]
    inverse_depth: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    size: tuple[int, int]


def layer_mesh(
    inverse_depth: NDArray[np.float32],
    depth_edge: NDArray[np.bool_] | NDArray[np.uint8],
    shown: NDArray[np.bool_],
    tolerance: float = TOLERANCE,
) -> LayerMesh:
    """Triangulate a panorama's surface.

    Args:
        inverse_depth: inverse depth along the ray in 1/m, > 0, (h, w), w = 2 h.
        depth_edge: quads that cross a depth edge (``prior.edge_quads``), (h, w).
        shown: mask of the pixels on which the layer has a surface, (h, w).
        tolerance: largest error of the inverse depth, in 1/m.

    Raises:
        ValueError: shapes do not match, or values are not finite and positive.
    """
    from instant_ic.vspace.layer_kernels import corner_values, count_triangles, lattice_errors, write_triangles

    height, width = inverse_depth.shape
    if width != 2 * height or height < 2 or depth_edge.shape != shown.shape or shown.shape != (height, width):
        raise ValueError(
            f"shapes of inverse depth {inverse_depth.shape}, edges {depth_edge.shape} and mask {shown.shape} differ"
        )
    if not (np.isfinite(inverse_depth).all() and (inverse_depth > 0).all()):
        raise ValueError("inverse depth must be finite and > 0")
    inverse = np.ascontiguousarray(inverse_depth, np.float32)
    torn = np.zeros((height + 1, width), np.bool_)  # by corner
    torn[1:height] = np.roll(depth_edge[:-1].astype(np.bool_), 1, 1)
    gone = ~shown
    left = np.roll(gone, 1, 1)
    torn[:-1] |= gone | left
    torn[1:] |= gone | left
    right = np.roll(torn, -1, 1)
    alone = torn[:-1] | right[:-1] | torn[1:] | right[1:]  # pixels that are separate squares
    corners = corner_values(inverse, torn)
    tile = int(np.gcd(height, width) & -np.gcd(height, width))  # the largest power of two that divides both
    errors = lattice_errors(corners, corner_directions(height, width), alone, tile)
    limit = np.float32(tolerance)
    vertices, triangles = count_triangles(errors, alone, shown, tile, limit)
    places = np.empty((vertices, 2), np.uint16)
    values = np.empty(vertices, np.float32)
    indices = np.empty((triangles, 3), np.uint32)
    used = write_triangles(errors, alone, shown, torn, inverse, corners, tile, limit, places, values, indices)
    return LayerMesh(places[:used].copy(), values[:used].copy(), indices, (height, width))


@functools.lru_cache(maxsize=4)
def corner_directions(height: int, width: int) -> NDArray[np.float32]:
    """Return the unit vectors at the pixels' corners, (height + 1, width, 3)."""
    azimuth = np.pi - np.arange(width) * (2 * np.pi / width)
    directions = directions_at(azimuth, np.pi / 2 - np.arange(height + 1) * (np.pi / height))
    directions[[0, -1], :, :2] = 0
    return directions
