"""Occupancy grids and costmaps as small PNGs for the page."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.console.protocol import PendingFrame

UNKNOWN = 255


def grid_image(grid: NDArray[np.int8], resolution: float, origin_xy: tuple[float, float]) -> PendingFrame | None:
    """Encode the known cells of a grid as a PNG, with a margin of 2 cells.

    Args:
        grid: cells, 0 to 100, or -1 if unknown, (H, W) int8; row 0 is the lowest y.
        resolution: cell size in metres.
        origin_xy: lower left corner of the grid in metres.

    Returns:
        A grey PNG whose row 0 is the highest y. Its header has resolution (m), width and height (cells), and x and y
        (m) of the lower left corner in the grid's frame. None if no cell is known.
    """
    known_rows = np.flatnonzero((grid >= 0).any(axis=1))
    known_columns = np.flatnonzero((grid >= 0).any(axis=0))
    if len(known_rows) == 0:
        return None
    row, column = max(known_rows[0] - 2, 0), max(known_columns[0] - 2, 0)
    cells = grid[row : known_rows[-1] + 3, column : known_columns[-1] + 3]
    grey = cells[::-1].astype(np.uint8, order="C")
    grey[cells[::-1] < 0] = UNKNOWN
    header = {
        "resolution": float(resolution),
        "width": int(grey.shape[1]),
        "height": int(grey.shape[0]),
        "x": float(origin_xy[0] + column * resolution),
        "y": float(origin_xy[1] + row * resolution),
    }
    return PendingFrame(header, cv2.imencode(".png", grey, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes())
