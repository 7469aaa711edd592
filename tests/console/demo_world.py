"""Room of the demo: ``tests.box_room`` with its floor at z = 0, and its map as grids."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.poses import Matrix, pose_matrix
from tests import box_room

RESOLUTION_M, MARGIN_M = 0.05, 0.5
_LOW = box_room.ROOM_LOW[:2] - MARGIN_M
_FROM_FLOOR = pose_matrix(z=box_room.ROOM_LOW[2])


def panorama(map_from_camera: Matrix, width: int) -> box_room.RoomPicture:
    """Return an equirect image, ``width`` pixels wide."""
    return box_room.panorama(_FROM_FLOOR @ map_from_camera, width // 2)


def perspective(map_from_camera: Matrix, width: int, height: int, fov_rad: float) -> box_room.RoomPicture:
    """Return a pinhole image."""
    return box_room.perspective(_FROM_FLOOR @ map_from_camera, width, height, fov_rad)


def occupancy() -> tuple[NDArray[np.int8], tuple[float, float]]:
    """Return the room's grid (H, W) int8, row 0 = lowest y, and its lower left corner (m)."""
    width, height = _cells(box_room.ROOM_HIGH[:2] + MARGIN_M)
    grid = np.full((height, width), -1, np.int8)
    for low, high, cost in (
        (box_room.ROOM_LOW[:2] - 0.1, box_room.ROOM_HIGH[:2] + 0.1, 100),
        (box_room.ROOM_LOW, box_room.ROOM_HIGH, 0),
        (box_room.BOX_LOW, box_room.BOX_HIGH, 100),
    ):
        (left, below), (right, above) = _cells(low), _cells(high)
        grid[below:above, left:right] = cost
    return grid, (float(_LOW[0]), float(_LOW[1]))


def _cells(point: NDArray[np.floating]) -> tuple[int, int]:
    column, row = np.rint((point[:2] - _LOW) / RESOLUTION_M).astype(int)
    return int(column), int(row)


def inflate(grid: NDArray[np.int8], radius_m: float = 0.5) -> NDArray[np.int8]:
    """Return costs (H, W) int8, 0..100, that fall linearly with the distance from occupied cells."""
    distance = cv2.distanceTransform((grid < 50).astype(np.uint8), cv2.DIST_L2, 5) * RESOLUTION_M
    return np.clip(100 * (1 - distance / radius_m), 0, 100).astype(np.int8)
