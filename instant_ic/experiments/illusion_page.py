"""The page's image of the virtual space, composed without a browser (``console/static``: images.js, viewer.js).

Modelled: the JPEG, the mask of unseen places and the small depth image of a rendered view; the blur and pallor of
unseen places; the motion of the view by its depth; the magnification filter; the fade at the view's edge; the
dissolve with the camera's image. Not modelled: the colour matching at a switch (the simulated camera has one exposure),
the extrapolation between state messages, and overlays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.depth_picture import decode_depth, encode_depth, positions_before
from instant_ic.geometry.projections import perspective_directions
from instant_ic.vspace.view import View

Picture: TypeAlias = NDArray[np.uint8]
Floats: TypeAlias = NDArray[np.float32]

EDGE = 0.94
"""Position in the rendered view, 0 centre to 1 edge, from which it fades out."""
SOFT = 16
"""Pixels of the view averaged for unseen places."""
LEAST_M = 0.0005
GREY = np.array([0.30, 0.59, 0.11], np.float32)
NIGHT = np.array([0.035, 0.043, 0.055], np.float32)


@dataclass(frozen=True)
class PageView:
    """A rendered view as the page holds it.

    Attributes:
        rgb: (h, w, 3) float32 in 0..1, blurred and paler in unseen places.
        inverse_depth: (h', w') of ``depth_picture.decode_depth``; None where the view has no depth.
        map_from_camera: (4, 4) for which it was rendered.
        fov_rad: horizontal field of view.
    """

    rgb: Floats
    inverse_depth: Floats | None
    map_from_camera: NDArray[np.float64]
    fov_rad: float

    @classmethod
    def of(cls, view: View, map_from_camera: NDArray[np.float64], fov_rad: float, jpeg_quality: int) -> PageView:
        """A view after its way to the page: encoded, sent and decoded."""
        _, jpeg = cv2.imencode(".jpg", view.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
        rgb = _decoded(jpeg, cv2.IMREAD_COLOR)[..., ::-1] / np.float32(255)
        mask_png, (depth_png, near_m) = view.mask_png(), encode_depth(view.depth_m, fov_rad)
        if mask_png:
            mask = _decoded(np.frombuffer(mask_png, np.uint8), cv2.IMREAD_GRAYSCALE)
            rgb = softened(rgb, mask / np.float32(255))
        inverse = decode_depth(depth_png, near_m) if depth_png else None
        return cls(np.ascontiguousarray(rgb), inverse, np.asarray(map_from_camera, np.float64), fov_rad)


def softened(rgb: Floats, mask: Floats) -> Floats:
    """Blur an image (H, W, 3) and make it paler where the small mask (h, w) is dark: unseen places are guesses."""
    height, width = rgb.shape[:2]
    level = cv2.resize(cv2.erode(mask, np.ones((3, 3), np.uint8)), (width, height), interpolation=cv2.INTER_LINEAR)
    seen = _smoothstep(level)[..., None]
    size = max(width // SOFT, 1), max(height // SOFT, 1)
    soft = smooth_samples(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), _grid(width, height))
    pale = 0.5 * soft + 0.5 * (soft @ GREY)[..., None]
    return np.asarray(pale + seen * (rgb - pale), np.float32)


def smooth_samples(image: Floats, at: Floats) -> Floats:
    """Cubic B-spline samples of an image at positions (H, W, 2); 0 is its centre, 1 its right and its upper edge.

    Four bilinear look-ups at shifted positions, as in the page's shader.
    """
    rows, columns = image.shape[:2]
    p = np.stack([(1 + at[..., 0]) * (columns / 2), (1 - at[..., 1]) * (rows / 2)], axis=2) - np.float32(0.5)
    whole = np.floor(p)
    f = p - whole
    f2 = f * f
    f3 = f2 * f
    w0, w1, w3 = (1 - 3 * f + 3 * f2 - f3) / 6, (4 - 6 * f2 + 3 * f3) / 6, f3 / 6
    low, high = w0 + w1, 1 - w0 - w1
    a, b = (whole - 1 + w1 / low).astype(np.float32), (whole + 1 + w3 / high).astype(np.float32)

    def look(x: Floats, y: Floats) -> Floats:
        # Contiguous arrays: remap takes no views with strides.
        x, y = np.ascontiguousarray(x), np.ascontiguousarray(y)
        return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)

    ax, ay, bx, by = a[..., 0], a[..., 1], b[..., 0], b[..., 1]
    along, down = high[..., :1], high[..., 1:]
    upper, lower = (look(ax, y) + along * (look(bx, y) - look(ax, y)) for y in (ay, by))
    return np.asarray(upper + down * (lower - upper), np.float32)


@dataclass(frozen=True)
class Screen:
    """The page's window: pixels and horizontal field of view."""

    width: int = 640
    height: int = 360
    fov_rad: float = math.pi / 2


def place_on_screen(
    view: PageView, screen: Screen, map_from_look: NDArray[np.float64], moved_m: NDArray[np.floating]
) -> tuple[Floats, Floats]:
    """The view on the screen, (H, W, 3) in 0..1, and how far each pixel lies inside it, (H, W): 1 inside, 0 beyond.

    Args:
        view: as the page holds it.
        screen: the page's window.
        map_from_look: rotation (3, 3) of the shown line of sight.
        moved_m: (3,) motion of the camera since the view was rendered, in the map's frame.
    """
    map_from_view = view.map_from_camera[:3, :3]
    rotation = (map_from_view.T @ map_from_look).astype(np.float32)
    d = perspective_directions(screen.width, screen.height, screen.fov_rad) @ rotation.T
    half = math.tan(view.fov_rad / 2) * np.array([1, view.rgb.shape[0] / view.rgb.shape[1]], np.float32)
    ahead = d[..., 0] > 1e-3
    at = np.stack([-d[..., 1], d[..., 2]], axis=2) / (np.where(ahead, d[..., 0], 1)[..., None] * half)
    way = map_from_view.T @ np.asarray(moved_m, np.float64)
    if view.inverse_depth is not None and float(np.linalg.norm(way)) >= LEAST_M:
        at = positions_before(at.astype(np.float32), view.inverse_depth, way, half)
    edge = _smoothstep(np.clip((np.abs(at) - 1) / (EDGE - 1), 0, 1))
    return smooth_samples(view.rgb, at.astype(np.float32)), np.where(ahead, edge[..., 0] * edge[..., 1], 0)


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


def _decoded(data: NDArray[np.uint8], flags: int) -> Floats:
    image = cv2.imdecode(data, flags)
    assert image is not None, "an image that was just encoded"
    return np.asarray(image, np.float32)


def _grid(width: int, height: int) -> Floats:
    x, y = (2 * np.arange(width) + 1) / width - 1, 1 - (2 * np.arange(height) + 1) / height
    return np.stack(np.meshgrid(x, y), axis=2).astype(np.float32)


def _smoothstep(t: Floats | np.float32) -> Floats:
    return np.asarray(t * t * (3 - 2 * t), np.float32)
