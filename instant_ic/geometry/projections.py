"""Directions and pixels of equirect panoramas, cube faces and perspective views.

Camera frame: x forward, y left, z up. Equirect: the centre column looks along x, columns run clockwise seen from
above, rows run from +90° to −90° elevation. Pixel centres have integer coordinates.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.poses import rotation_matrix

Floats = NDArray[np.floating]
Indices = NDArray[np.intp]


def equirect_directions(width: int, height: int) -> NDArray[np.float32]:
    """Return the unit viewing direction of every pixel of a panorama, (height, width, 3)."""
    azimuth = math.pi - (np.arange(width) + 0.5) * (2 * math.pi / width)
    return directions_at(azimuth, math.pi / 2 - (np.arange(height) + 0.5) * (math.pi / height))


@functools.lru_cache(maxsize=4)
def rays_of(size: tuple[int, int]) -> NDArray[np.float32]:
    """Return the cached ``equirect_directions`` of a panorama of (height, width); the array must not be changed."""
    return equirect_directions(size[1], size[0])


def directions_at(azimuth: Floats, elevation: Floats) -> NDArray[np.float32]:
    """Return the unit directions (H, W, 3) for all pairs of elevations (H,) and azimuths (W,), in radians."""
    horizontal = np.cos(elevation)[:, None]
    directions = np.empty((len(elevation), len(azimuth), 3), np.float32)
    directions[..., 0] = horizontal * np.cos(azimuth)
    directions[..., 1] = horizontal * np.sin(azimuth)
    directions[..., 2] = np.sin(elevation)[:, None]
    return directions


def equirect_pixels(directions: Floats, width: int, height: int) -> tuple[Floats, Floats]:
    """Return the pixel coordinates ``(u, v)`` of directions (..., 3) of any length.

    ``u`` is in [−0.5, width − 0.5); the sampler must wrap column ``width`` to 0. ``v`` is in [−0.5, height − 0.5].
    """
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    azimuth = np.arctan2(y, x)
    elevation = np.arctan2(z, np.hypot(x, y))
    u = (math.pi - azimuth) * (width / (2 * math.pi)) - 0.5
    u = np.where(u >= width - 0.5, u - width, u)
    v = (math.pi / 2 - elevation) * (height / math.pi) - 0.5
    return u, v


def nearest_pixels(directions: Floats, width: int, height: int) -> tuple[Indices, Indices]:
    """Return the rows and columns of the pixels nearest to directions (..., 3) of any length."""
    u, v = equirect_pixels(directions, width, height)
    return np.clip(np.rint(v).astype(np.intp), 0, height - 1), np.rint(u).astype(np.intp) % width


def perspective_directions(width: int, height: int, hfov_rad: float) -> NDArray[np.float32]:
    """Return the viewing directions (x = 1, not normalised) of a pinhole image that looks along x, (height, width, 3).

    Raises:
        ValueError: the field of view is not between 0 and π.
    """
    if not 0 < hfov_rad < math.pi:
        raise ValueError(f"hfov_rad must lie between 0 and π (got {hfov_rad})")
    half = math.tan(hfov_rad / 2)
    pixel = 2 * half / width
    directions = np.empty((height, width, 3), np.float32)
    directions[..., 0] = 1.0
    directions[..., 1] = (half - (np.arange(width) + 0.5) * pixel)[None, :]
    directions[..., 2] = (height * pixel / 2 - (np.arange(height) + 0.5) * pixel)[:, None]
    return directions


def sample_equirect(image: NDArray[np.generic], directions: Floats) -> NDArray[np.float32]:
    """Sample a panorama (H, W) or (H, W, C) bilinearly along directions (..., 3), across the seam too."""
    height, width = image.shape[:2]
    u, v = equirect_pixels(directions, width, height)
    v = np.clip(v, 0, height - 1)
    u0, v0 = np.floor(u).astype(np.intp), np.floor(v).astype(np.intp)
    fu, fv = (u - u0).astype(np.float32), (v - v0).astype(np.float32)
    v1 = np.minimum(v0 + 1, height - 1)
    u0, u1 = u0 % width, (u0 + 1) % width
    if image.ndim == 3:
        fu, fv = fu[..., None], fv[..., None]
    top = image[v0, u0] * (1 - fu) + image[v0, u1] * fu
    bottom = image[v1, u0] * (1 - fu) + image[v1, u1] * fu
    return np.asarray(top * (1 - fv) + bottom * fv, dtype=np.float32)


CUBE_FACES: dict[str, NDArray[np.float64]] = {
    "front": rotation_matrix(),
    "left": rotation_matrix(yaw=math.pi / 2),
    "back": rotation_matrix(yaw=math.pi),
    "right": rotation_matrix(yaw=-math.pi / 2),
    "up": rotation_matrix(pitch=-math.pi / 2),
    "down": rotation_matrix(pitch=math.pi / 2),
}
"""``camera_from_face`` rotations of the six 90° faces; each face looks along its own x axis."""


def equirect_to_cube(image: NDArray[np.generic], size: int) -> NDArray[np.float32]:
    """Return the six 90° × 90° faces (paper, IV.A) in the order of ``CUBE_FACES``, (6, size, size[, C])."""
    face = perspective_directions(size, size, math.pi / 2)
    return np.stack([sample_equirect(image, face @ r.T.astype(np.float32)) for r in CUBE_FACES.values()])
