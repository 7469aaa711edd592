"""Visibility of LiDAR points from the camera, which is mounted elsewhere, and their pixels; needs only numpy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import nearest_pixels

Floats = NDArray[np.floating]
Indices = NDArray[np.intp]
CELL_DEG = 1.0
_LEAST_AZIMUTH_DEG = 90.0


def pixels_of(points: Floats, width: int, height: int) -> tuple[Indices, Indices, Floats]:
    """Return rows, columns and ranges in metres, (N,) each, of points (N, 3) in the camera's frame."""
    return *nearest_pixels(points, width, height), np.linalg.norm(points, axis=-1)


def nearest_points(points: Floats, width: int, height: int) -> tuple[Indices, Indices, Floats]:
    """Return rows, columns and ranges of the nearest point in each pixel that has one.

    The camera sees only the nearest of several points in one pixel.
    """
    rows, columns, range_m = pixels_of(points, width, height)
    pixel = rows * width + columns
    order = np.lexsort((range_m, pixel))
    first = np.ones(len(order), bool)
    first[1:] = pixel[order[1:]] != pixel[order[:-1]]
    kept = order[first]
    return rows[kept], columns[kept], range_m[kept]


def hidden(points: Floats, margin: float = 0.25, cell_deg: float = CELL_DEG) -> NDArray[np.bool_]:
    """Return a mask (N,) of the points (N, 3) in the camera's frame that the camera probably does not see.

    A point is hidden if two others, in the same or one of the eight neighbouring cells of ``cell_deg``, are nearer by
    more than ``margin`` of its range; a single one may be an outlier. Neighbouring cells count because rings are two
    degrees apart: otherwise the wall behind a table would be visible between two rings on the table's top. On a floor
    seen from 1.2 m, the range changes by less than the margin per cell up to about 7 m. Farther away some visible
    points are lost, which is acceptable.
    """
    height = max(round(180.0 / cell_deg), 1)
    rows, columns, range_m = pixels_of(points, 2 * height, height)
    cell = (rows + 1) * (2 * height) + columns
    order = np.lexsort((range_m, cell))
    start = np.flatnonzero(np.diff(cell[order], prepend=-1))
    second = start[np.diff(start, append=len(order)) > 1] + 1
    nearest = np.full((height + 2, 2 * height), np.inf)
    nearest.reshape(-1)[cell[order[second]]] = range_m[order[second]]
    nearest = np.minimum(np.minimum(nearest[:-2], nearest[1:-1]), nearest[2:])
    nearest = np.minimum(np.minimum(np.roll(nearest, 1, axis=1), nearest), np.roll(nearest, -1, axis=1))
    return np.asarray(nearest[rows, columns] < (1 - margin) * range_m)


def azimuth_problem(columns: Indices, width: int) -> str:
    """Return an error text if points in these columns (N,) cover too little azimuth; otherwise an empty text."""
    covered = len(np.unique(columns * 120 // width)) * 3.0
    if covered >= _LEAST_AZIMUTH_DEG:
        return ""
    return f"LiDAR points cover {covered:.0f} deg of azimuth; {_LEAST_AZIMUTH_DEG:.0f} are needed"


def on_depth_edge(depth: Floats, rows: Indices, columns: Indices, ratio: float = 1.25) -> NDArray[np.bool_]:
    """Return a mask (N,) of pixels in whose 3 x 3 neighbourhood known depth (H, W) differs by more than ``ratio``.

    At such an edge a point may belong to either side, and a network's edge is blurred or off by a pixel.
    """
    height, width = depth.shape
    around = np.stack(
        [depth[np.clip(rows + i, 0, height - 1), (columns + j) % width] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    )
    known = np.isfinite(around) & (around > 0)
    low = np.where(known, around, np.inf).min(axis=0)
    high = np.where(known, around, 0.0).max(axis=0)
    return np.asarray(high > ratio * low)
