"""The page's image of the virtual space, composed without a browser (``console/static``: images.js, viewer.js).

Modelled: the JPEG of a rendered view with the blur and pallor of unseen places, its magnification, the fade at its
edge, and the dissolve with the camera's image. Not modelled: the colour matching at a switch (the simulated camera has
one exposure), the extrapolation between state messages, and overlays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import perspective_directions
from instant_ic.vspace.view import View

Picture: TypeAlias = NDArray[np.uint8]
Floats: TypeAlias = NDArray[np.float32]

EDGE = 0.94
"""Position in the rendered view, 0 centre to 1 edge, from which it fades out."""
GREY = np.array([0.30, 0.59, 0.11], np.float32)
NIGHT = np.array([0.035, 0.043, 0.055], np.float32)


@dataclass(frozen=True)
class PageView:
    """A rendered view (h, w, 3) in 0..1 as the page holds it, with the pose (4, 4) for which it was rendered."""

    rgb: Floats
    map_from_camera: NDArray[np.float64]
    fov_rad: float

    @classmethod
    def of(cls, view: View, map_from_camera: NDArray[np.float64], fov_rad: float, jpeg_quality: int) -> PageView:
        """A view after its way to the page: encoded, sent and decoded."""
        _, jpeg = cv2.imencode(".jpg", view.softened()[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
        image = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
        assert image is not None, "an image that was just encoded"
        rgb = np.ascontiguousarray(image[..., ::-1], np.float32) / np.float32(255)
        return cls(rgb, np.asarray(map_from_camera, np.float64), fov_rad)


@dataclass(frozen=True)
class Screen:
    """The page's window: pixels and horizontal field of view."""

    width: int = 640
    height: int = 360
    fov_rad: float = math.pi / 2


def place_on_screen(view: PageView, screen: Screen, map_from_look: NDArray[np.float64]) -> tuple[Floats, Floats]:
    """The view on the screen, (H, W, 3) in 0..1, and how far each pixel lies inside it, (H, W): 1 inside, 0 beyond.

    ``map_from_look`` is the rotation (3, 3) of the shown line of sight.
    """
    map_from_view = view.map_from_camera[:3, :3]
    rotation = (map_from_view.T @ map_from_look).astype(np.float32)
    d = perspective_directions(screen.width, screen.height, screen.fov_rad) @ rotation.T
    half = math.tan(view.fov_rad / 2) * np.array([1, view.rgb.shape[0] / view.rgb.shape[1]], np.float32)
    ahead = d[..., 0] > 1e-3
    at = np.stack([-d[..., 1], d[..., 2]], axis=2) / (np.where(ahead, d[..., 0], 1)[..., None] * half)
    edge = _smoothstep(np.clip((np.abs(at) - 1) / (EDGE - 1), 0, 1))
    rows, columns = view.rgb.shape[:2]
    u, v = (1 + at[..., 0]) * (columns / 2) - 0.5, (1 - at[..., 1]) * (rows / 2) - 0.5
    wide = u.astype(np.float32), v.astype(np.float32)
    shown = cv2.remap(view.rgb, *wide, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(shown, np.float32), np.where(ahead, edge[..., 0] * edge[..., 1], 0)


def compose(placed: Floats, inside: Floats, camera: Picture | None, blend: float) -> Picture:
    """The page's image (H, W, 3).

    Args:
        placed, inside: of ``place_on_screen``.
        camera: the camera's image in the same projection; None where it cannot be seen.
        blend: 0 the camera's image, 1 the view; in between they dissolve.
    """
    if camera is None:
        colour: NDArray[np.floating] = placed
    else:
        real = camera.astype(np.float32) / 255
        around = NIGHT + np.float32(0.35) * ((real @ GREY)[..., None] - NIGHT)
        shown = around + inside[..., None] * (placed - around)
        colour = real + np.float32(_smoothstep(np.float32(blend))) * (shown - real)
    return np.rint(255 * np.clip(colour, 0, 1)).astype(np.uint8)


def _smoothstep(t: Floats | np.float32) -> Floats:
    return np.asarray(t * t * (3 - 2 * t), np.float32)
