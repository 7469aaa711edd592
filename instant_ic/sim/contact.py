"""Floor plan of the space that a mesh occupies, for contact tests."""

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.floating]


@dataclass(frozen=True)
class OccupancyMask:
    """A floor plan of the objects in a height interval.

    Attributes:
        cells: (H, W) bool, row 0 = lowest y.
        origin: (2,) x and y of the lower corner of cell (0, 0), metres.
        cell_m: edge length of a cell, metres.
    """

    cells: npt.NDArray[np.bool_]
    origin: FloatArray
    cell_m: float

    def centre(self, rows_columns: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
        """Return the centres (N, 2), x and y, of cells (N, 2), row and column."""
        return np.asarray((rows_columns[:, ::-1] + 0.5) * self.cell_m + self.origin, np.float64)

    def index(self, xy: FloatArray) -> npt.NDArray[np.int64]:
        """Return the cells (N, 2), row and column, of points (N, 2); they may lie outside the mask."""
        return np.floor((np.asarray(xy) - self.origin) / self.cell_m).astype(np.int64)[:, ::-1]

    def at(self, xy: FloatArray) -> npt.NDArray[np.bool_]:
        """Return the mask (N,) of the points (N, 2) in occupied cells; space outside the floor plan is free."""
        index = self.index(xy)
        inside = ((index >= 0) & (index < self.cells.shape)).all(axis=1)
        result = np.zeros(len(index), bool)
        result[inside] = self.cells[index[inside, 0], index[inside, 1]]
        return result

    def distance_m(self) -> npt.NDArray[np.float32]:
        """Return the distance (H, W) from each cell to the nearest occupied cell, metres."""
        import cv2

        free = np.ascontiguousarray((~self.cells).astype(np.uint8))
        return np.asarray(cv2.distanceTransform(free, cv2.DIST_L2, 5) * self.cell_m, np.float32)

    def reachable(self, start_xy: tuple[float, float], clearance_m: float) -> npt.NDArray[np.int64]:
        """Return the cells (N, 2) with this clearance that are connected to the one nearest to ``start_xy``."""
        import cv2

        free = self.distance_m() >= clearance_m
        free[[0, -1]] = False
        free[:, [0, -1]] = False
        if not free.any():
            return np.zeros((0, 2), np.int64)
        _, labels = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
        rows, columns = np.nonzero(free)
        start = self.index(np.asarray([start_xy]))[0]
        nearest = np.argmin((rows - start[0]) ** 2 + (columns - start[1]) ** 2)
        return np.argwhere(labels == labels[rows[nearest], columns[nearest]])


@numba.njit(cache=True, nogil=True)
def _mark_segment(
    ax: float, ay: float, bx: float, by: float, x0: float, y0: float, cell: float, mask: npt.NDArray[np.bool_]
) -> None:
    n = int(2.0 * max(abs(bx - ax), abs(by - ay)) / cell) + 1
    for j in range(n + 1):
        s = j / n
        column = int(np.floor((ax + s * (bx - ax) - x0) / cell))
        row = int(np.floor((ay + s * (by - ay) - y0) / cell))
        if 0 <= row < mask.shape[0] and 0 <= column < mask.shape[1]:
            mask[row, column] = True


@numba.njit(cache=True, nogil=True)
def _fill(
    triangles: npt.NDArray[np.float64],
    low: float,
    high: float,
    x0: float,
    y0: float,
    cell: float,
    mask: npt.NDArray[np.bool_],
) -> None:
    """Mark the cells over which triangles (N, 3, 3) have a point between two heights.

    Each triangle is clipped to the height interval (a convex polygon of at most five corners). Segments from its first
    corner to points along its other edges, half a cell apart, then fill it. A vertical triangle is one segment.
    """
    polygon = np.empty((8, 2))
    for i in range(triangles.shape[0]):
        lowest = min(triangles[i, 0, 2], triangles[i, 1, 2], triangles[i, 2, 2])
        highest = max(triangles[i, 0, 2], triangles[i, 1, 2], triangles[i, 2, 2])
        if highest < low or lowest > high:
            continue
        count = 0
        for k in range(3):
            p, q = triangles[i, k], triangles[i, (k + 1) % 3]
            if low <= p[2] <= high:
                polygon[count, 0], polygon[count, 1] = p[0], p[1]
                count += 1
            rise = q[2] - p[2]
            if rise != 0.0:
                s0, s1 = (low - p[2]) / rise, (high - p[2]) / rise
                if s0 > s1:
                    s0, s1 = s1, s0
                for s in (s0, s1):
                    if 0.0 < s < 1.0:
                        polygon[count, 0] = p[0] + s * (q[0] - p[0])
                        polygon[count, 1] = p[1] + s * (q[1] - p[1])
                        count += 1
        area = 0.0
        for k in range(count):
            n = (k + 1) % count
            area += polygon[k, 0] * polygon[n, 1] - polygon[n, 0] * polygon[k, 1]
            _mark_segment(polygon[k, 0], polygon[k, 1], polygon[n, 0], polygon[n, 1], x0, y0, cell, mask)
        if abs(area) < 0.5 * cell * cell:
            continue
        for k in range(1, count - 1):
            a, b = polygon[k], polygon[k + 1]
            steps = int(2.0 * max(abs(b[0] - a[0]), abs(b[1] - a[1])) / cell) + 1
            for j in range(steps + 1):
                s = j / steps
                x, y = a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1])
                _mark_segment(polygon[0, 0], polygon[0, 1], x, y, x0, y0, cell, mask)


def occupied_mask(
    vertices: FloatArray, faces: npt.NDArray[np.integer], low_m: float, high_m: float, cell_m: float
) -> OccupancyMask:
    """Return a mask of the cells over which the mesh has a surface between two heights."""
    triangles = np.ascontiguousarray(np.asarray(vertices, np.float64)[faces])
    margin = 4 * cell_m
    origin = triangles[..., :2].reshape(-1, 2).min(axis=0) - margin
    extent = triangles[..., :2].reshape(-1, 2).max(axis=0) + margin - origin
    columns, rows = np.ceil(extent / cell_m).astype(int)
    mask = np.zeros((rows, columns), np.bool_)
    _fill(triangles, low_m, high_m, float(origin[0]), float(origin[1]), cell_m, mask)
    return OccupancyMask(mask, origin, cell_m)
