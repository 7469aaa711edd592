"""Room of the demo: shaded boxes, cast along any directions, and its map as a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
FLOOR, CEILING, WALL, WHITE, CRATE = range(5)


@dataclass(frozen=True)
class Box:
    """Axis-aligned box, metres; ``inside`` boxes are rooms, visible from inside."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    material: int
    inside: bool = False


ROOM = Box((-4.0, -3.0, 0.0), (9.0, 3.0, 2.7), WALL, inside=True)
OBSTACLE = Box((3.0, -0.5, 0.0), (3.5, 0.5, 1.05), WHITE)
BOXES = (
    ROOM,
    OBSTACLE,
    Box((0.4, 1.9, 0.0), (1.5, 2.6, 0.8), CRATE),
    Box((5.6, -2.6, 0.0), (6.6, -1.6, 1.1), CRATE),
    Box((-2.6, -2.4, 0.0), (-2.2, -2.0, 2.7), WHITE),
    Box((7.4, 1.4, 0.0), (7.8, 1.8, 2.7), WHITE),
)


def shade(origin: tuple[float, float, float], directions: Array) -> NDArray[np.uint8]:
    """Return the BGR colours (..., 3) uint8 seen from ``origin`` along ``directions`` (..., 3)."""
    eye = np.asarray(origin, np.float32)
    shape = directions.shape[:-1]
    rays = directions.reshape(-1, 3) / np.linalg.norm(directions.reshape(-1, 3), axis=1, keepdims=True)
    nearest, axis, material = _cast(eye, rays)
    points = eye + rays * nearest[:, None]
    colour = _colours(points, axis, material)
    fog = np.exp(-nearest / 22)[:, None]
    return np.clip(255 * colour * fog, 0, 255).astype(np.uint8).reshape(*shape, 3)


def distances(origin: tuple[float, float, float], directions: Array) -> Array:
    """Return the distances (m) from ``origin`` along ``directions`` (..., 3) to the nearest surface."""
    rays = directions.reshape(-1, 3) / np.linalg.norm(directions.reshape(-1, 3), axis=1, keepdims=True)
    return _cast(np.asarray(origin, np.float32), rays)[0].reshape(directions.shape[:-1])


def _cast(eye: Array, rays: Array) -> tuple[Array, NDArray[np.int8], NDArray[np.int8]]:
    """Return distance, face axis and material at the first hit of unit ``rays`` (N, 3)."""
    inverse = 1.0 / np.where(np.abs(rays) < 1e-6, np.float32(1e-6), rays)
    nearest = np.full(len(rays), np.inf, np.float32)
    axis = np.zeros(len(rays), np.int8)
    material = np.zeros(len(rays), np.int8)
    for box in BOXES:
        first = (np.asarray(box.low, np.float32) - eye) * inverse
        second = (np.asarray(box.high, np.float32) - eye) * inverse
        near, far = np.minimum(first, second), np.maximum(first, second)
        if box.inside:
            distance, face = far.min(axis=1), far.argmin(axis=1)
            hit = distance < nearest
        else:
            distance, face = near.max(axis=1), near.argmax(axis=1)
            hit = (distance < far.min(axis=1)) & (distance > 0) & (distance < nearest)
        nearest[hit], axis[hit], material[hit] = distance[hit], face[hit], box.material
    return nearest, axis, material


def _colours(points: Array, axis: NDArray[np.int8], material: NDArray[np.int8]) -> Array:
    x, y, z = points.T
    colour = np.empty_like(points)
    wall = (material == WALL) & (axis != 2)
    along = np.where(axis == 0, y, x)
    stripe = 0.04 * np.sin(along * 9) * np.sin(z * 7)
    colour[:] = (np.array([0.66, 0.70, 0.72], np.float32) + stripe[:, None]).astype(np.float32)
    colour[wall & (z < 0.9)] = (0.47, 0.42, 0.33)
    colour[wall & (z < 0.1)] = (0.20, 0.18, 0.17)
    poster = wall & (np.abs(z - 1.6) < 0.42) & (np.abs((along + 0.7) % 3.0 - 1.5) < 0.55)
    hue = np.floor((along + 0.7) / 3.0)
    tint = np.stack([0.5 + 0.4 * np.sin(hue * 2.1 + k) for k in (0.0, 2.1, 4.2)], axis=1)
    rings = 0.65 + 0.35 * np.sign(np.sin(14 * np.hypot((along + 0.7) % 3.0 - 1.5, z - 1.6)))
    colour[poster] = (tint * rings[:, None])[poster]
    floor = (axis == 2) & (z < 0.01)
    plank = np.floor(y / 0.24)
    tone = 0.80 + 0.10 * np.sin(plank * 12.9) + 0.05 * np.sin(x * 3 + plank * 5) + 0.03 * np.sin(x * 41)
    seam = (np.abs((y / 0.24) % 1.0 - 0.5) > 0.475) | (np.abs((x / 1.6 + plank * 0.37) % 1.0 - 0.5) > 0.494)
    tone = np.where(seam, tone * 0.55, tone)
    colour[floor] = (np.array([0.30, 0.46, 0.62], np.float32) * tone[:, None])[floor]
    ceiling = (axis == 2) & (z > 2.69)
    colour[ceiling] = (0.80, 0.81, 0.80)
    lamp = ceiling & (np.abs(y) < 0.2) & (np.abs(x % 2.6 - 1.3) < 0.7)
    colour[material == WHITE] = (0.74, 0.77, 0.78)
    crate = material == CRATE
    board = 0.75 + 0.25 * np.sign(np.sin(z * 24))
    colour[crate] = (np.array([0.28, 0.44, 0.60], np.float32) * board[:, None])[crate]
    side = np.choose(axis, (0.86, 0.95, 1.0)).astype(np.float32)
    glow = 0.72 + 0.28 * np.exp(-(((x % 2.6) - 1.3) ** 2 + y**2) / 5)
    colour *= (side * glow)[:, None]
    colour[lamp] = 1.0
    return colour


def occupancy(resolution: float = 0.05) -> tuple[NDArray[np.int8], tuple[float, float]]:
    """Return the room's grid (H, W) int8, row 0 = lowest y, and its lower left corner (m)."""
    margin = 0.5
    origin = (ROOM.low[0] - margin, ROOM.low[1] - margin)
    width = round((ROOM.high[0] - ROOM.low[0] + 2 * margin) / resolution)
    height = round((ROOM.high[1] - ROOM.low[1] + 2 * margin) / resolution)
    grid = np.full((height, width), -1, np.int8)
    edge = round(margin / resolution)
    grid[edge - 2 : height - edge + 2, edge - 2 : width - edge + 2] = 100
    grid[edge : height - edge, edge : width - edge] = 0
    for box in BOXES[1:]:
        rows = slice(*(round((v - origin[1]) / resolution) for v in (box.low[1], box.high[1])))
        columns = slice(*(round((v - origin[0]) / resolution) for v in (box.low[0], box.high[0])))
        grid[rows, columns] = 100
    return grid, origin


def inflate(grid: NDArray[np.int8], resolution: float, radius_m: float = 0.5) -> NDArray[np.int8]:
    """Return costs (H, W) int8, 0..100, that fall linearly with the distance from occupied cells."""
    import cv2

    distance = cv2.distanceTransform((grid < 50).astype(np.uint8), cv2.DIST_L2, 5) * resolution
    return np.clip(100 * (1 - distance / radius_m), 0, 100).astype(np.int8)
