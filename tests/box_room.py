"""A textured box room with a box in it, rendered exactly in numpy: ground truth for tests and benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import equirect_directions, perspective_directions

ROOM_LOW = np.array([-3.0, -2.5, -1.2])
ROOM_HIGH = np.array([4.0, 2.0, 1.3])
BOX_LOW = np.array([1.6, 0.4, -1.2])
BOX_HIGH = np.array([2.2, 1.1, 0.1])


@dataclass(frozen=True)
class RoomPicture:
    """``rgb`` (H, W, 3) uint8 and exact radial ``depth_m`` (H, W)."""

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]


def panorama(map_from_camera: NDArray[np.floating], height: int = 256) -> RoomPicture:
    """Render an equirect image (height, 2 · height) from a pose inside the room."""
    return _draw(map_from_camera, equirect_directions(2 * height, height))


def perspective(map_from_camera: NDArray[np.floating], width: int, height: int, fov_rad: float) -> RoomPicture:
    """Render a pinhole image from a pose inside the room."""
    directions = perspective_directions(width, height, fov_rad)
    return _draw(map_from_camera, directions / np.linalg.norm(directions, axis=-1, keepdims=True))


def _draw(map_from_camera: NDArray[np.floating], directions: NDArray[np.float32]) -> RoomPicture:
    origin = np.asarray(map_from_camera, np.float64)[:3, 3]
    rays = directions.astype(np.float64) @ np.asarray(map_from_camera, np.float64)[:3, :3].T
    rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    walls = np.where(rays > 0, (ROOM_HIGH - origin) / rays, (ROOM_LOW - origin) / rays)
    depth = walls.min(axis=-1)
    axis = walls.argmin(axis=-1)
    near = np.minimum((BOX_LOW - origin) / rays, (BOX_HIGH - origin) / rays)
    far = np.maximum((BOX_LOW - origin) / rays, (BOX_HIGH - origin) / rays)
    enter = near.max(axis=-1)
    on_box = (enter > 0) & (enter < far.min(axis=-1))
    depth = np.where(on_box, enter, depth)
    axis = np.where(on_box, near.argmax(axis=-1), axis)
    point = origin + depth[..., None] * rays
    across = np.where(axis == 0, point[..., 1], point[..., 0])
    up = np.where(axis == 2, point[..., 1], point[..., 2])
    return RoomPicture(_paint(across, up, axis, on_box), depth.astype(np.float32))


def _paint(
    across: NDArray[np.floating], up: NDArray[np.floating], axis: NDArray[np.intp], on_box: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Render smooth waves and soft-edged tiles, with a tint for each wall direction and for the box."""
    waves = 0.5 + 0.18 * np.sin(5.1 * across + 2.0 * up) + 0.14 * np.sin(9.7 * up - 3.3 * across)
    tiles = np.tanh(6 * np.sin(2 * np.pi * across) * np.sin(2 * np.pi * up))
    base = waves + 0.14 * tiles
    tints = np.array([[0.9, 0.7, 0.55], [0.6, 0.85, 0.7], [0.65, 0.7, 0.95]])[axis]
    tints = np.where(on_box[..., None], np.array([1.0, 0.45, 0.35]), tints)
    drift = np.stack([0.1 * np.sin(1.3 * across), 0.1 * np.cos(1.7 * up), 0.1 * np.sin(across + up)], axis=-1)
    rgb: NDArray[np.uint8] = np.rint(255 * np.clip(base[..., None] * tints + drift, 0, 1)).astype(np.uint8)
    return rgb
