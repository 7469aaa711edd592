"""The small depth image that accompanies a rendered view, and reprojection of the view to a nearby pose.

Virtual-reality headsets call this positional time warp: the newest image is shown from the eye's present position, so
that motion is visible before the next image has been rendered. The depth image stores the inverse of the depth along
the camera's axis. On a plane this value is linear over the image, so a low resolution is enough.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import perspective_directions
from instant_ic.limits import decode_image

WIDTH = 96
NEAREST_M = 0.2
"""Depths below this count as this depth, in metres."""
STEPS = 2
MOST_PARALLAX = 0.5
"""Largest motion-to-depth ratio: nearer points are placed so far away that they do not shift more than this."""


@functools.lru_cache(maxsize=2)
def _axial(width: int, height: int, fov_rad: float) -> NDArray[np.float32]:
    """Metres along the optical axis per metre along the ray, (H, W)."""
    along: NDArray[np.float32] = 1 / np.linalg.norm(perspective_directions(width, height, fov_rad), axis=2)
    return along


def encode_depth(depth_m: NDArray[np.floating], fov_rad: float) -> tuple[bytes, float]:
    """Encode the depth of a perspective image for display.

    Args:
        depth_m: (H, W) along the rays, metres; 0 where nothing is hit.
        fov_rad: horizontal field of view.

    Returns:
        Grey PNG, (h, ``WIDTH``), each pixel with the nearest depth inside it, and the axial depth in metres that the
        value 255 stands for: v means ``near_m * 255 / v``, 0 means no depth. Without any depth the PNG is empty and
        the number is 0.

    Raises:
        ValueError: the array is not an image, or the field of view is invalid.
    """
    import cv2

    if depth_m.ndim != 2 or depth_m.size == 0:
        raise ValueError(f"depth must be (H, W) (got shape {depth_m.shape})")
    rows, columns = depth_m.shape
    axial = np.asarray(depth_m, np.float32) * _axial(columns, rows, round(fov_rad, 6))
    known = np.isfinite(axial) & (axial > 0)
    inverse = np.where(known, 1 / np.maximum(np.where(known, axial, 1), NEAREST_M), 0).astype(np.float32)
    width = min(WIDTH, columns)
    height = max(1, round(rows * width / columns))
    # A moved edge drags a fringe of its background along: dilation keeps the edge whole and stretches the background.
    cell = math.ceil(columns / width) + 1
    small = cv2.resize(cv2.dilate(inverse, np.ones((cell, cell), np.uint8)), (width, height))
    most = float(small.max())
    if most <= 0:
        return b"", 0.0
    ok, png = cv2.imencode(".png", np.rint(small * (255 / most)).astype(np.uint8))
    if not ok:
        raise ValueError(f"PNG encoder refused an image of shape {small.shape}")
    return bytes(png.tobytes()), 1 / most


def decode_depth(png: bytes, near_m: float) -> NDArray[np.float32]:
    """Inverse axial depth, (h, w), 1/m, from the result of ``encode_depth``.

    Raises:
        ValueError: not a grey image.
    """
    import cv2

    grey = decode_image(png, cv2.IMREAD_UNCHANGED)
    if grey is None or grey.ndim != 2 or grey.dtype != np.uint8:
        raise ValueError(f"a depth image of {len(png)} bytes is not an 8-bit grey PNG")
    return grey.astype(np.float32) * np.float32(1 / (255 * near_m))


def positions_before(
    here: NDArray[np.float32], inverse: NDArray[np.float32], moved_m: NDArray[np.floating], half: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Positions in an image of what a moved camera sees at given positions, as the page's shader finds them.

    Each position is found iteratively against the depth there, starting at the nearest depth, so that near surfaces
    cover far ones. Areas that open up behind an edge show the far side.

    Args:
        here: (H, W, 2) positions; 0 is the image's centre, 1 its right and its upper edge.
        inverse: (h, w) of ``decode_depth``.
        moved_m: (3,) in the image's camera frame (x forward, y left, z up).
        half: (2,) tangents of half the horizontal and vertical field of view.
    """
    forward, left, up = (float(value) for value in moved_m)
    per_inverse = (np.array([-left, up]) / half - forward * here).astype(np.float32)  # of a point at 1 m
    size = math.hypot(forward, left, up)
    most = min(float(inverse.max()), MOST_PARALLAX / size if size > 0 else math.inf)
    found = np.full(here.shape[:2], most, np.float32)
    for _ in range(STEPS):
        found = np.minimum(_sample(inverse, here + per_inverse * found[..., None]), np.float32(most))
    return np.asarray(here + per_inverse * found[..., None], np.float32)


def _sample(image: NDArray[np.generic], at: NDArray[np.float32]) -> NDArray[np.generic]:
    """Bilinear samples of an image at positions (H, W, 2) as in ``positions_before``."""
    import cv2

    rows, columns = image.shape[:2]
    u, v = (1 + at[..., 0]) * (columns / 2) - 0.5, (1 - at[..., 1]) * (rows / 2) - 0.5
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
