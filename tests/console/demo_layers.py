"""The demo's room as layers round a keyframe, made as the virtual space makes them."""

from __future__ import annotations

import cv2
import demo_world
import numpy as np
from numpy.typing import NDArray

from instant_ic.console.layers import PageLayers, page_layer
from instant_ic.geometry.poses import Matrix
from instant_ic.geometry.projections import equirect_directions
from instant_ic.vspace.background import Background
from instant_ic.vspace.config import GeometryConfig
from instant_ic.vspace.prior import ROOM, prepare


def demo_layers(version: int, map_from_camera: Matrix, width: int = 768, depth_width: int = 384) -> PageLayers:
    """Return what a keyframe at this pose shows: the camera's surfaces, and the guess behind them.

    Args:
        version: see ``PageLayers``.
        map_from_camera: pose of the keyframe, (4, 4).
        width: of the panorama, pixels.
        depth_width: of its depth, pixels.
    """
    x, y, z = (float(value) for value in map_from_camera[:3, 3])
    rotation = map_from_camera[:3, :3].astype(np.float32)
    rgb = demo_world.shade((x, y, z), equirect_directions(width, width // 2) @ rotation.T)[..., ::-1]
    depth = demo_world.distances((x, y, z), equirect_directions(depth_width, depth_width // 2) @ rotation.T)
    prior = prepare(np.ascontiguousarray(rgb), depth, map_from_camera, 0.0, GeometryConfig(), 4096)
    behind = Background.of(prior)
    guessed = np.zeros(behind.inverse_depth.shape, np.bool_)
    for quads in (behind.quads, behind.sky_quads):
        guessed[quads[:, 0], quads[:, 1]] = True
    guess = page_layer(_jpeg(behind.rgb), behind.inverse_depth, guessed, behind.opacity / 255, map_from_camera)
    seen = page_layer(_jpeg(rgb), prior.inverse_depth, prior.content == ROOM, None, map_from_camera)
    return PageLayers(version, (0.0, 0.0, z), (seen, guess))


def _jpeg(rgb: NDArray[np.uint8]) -> bytes:
    ok, data = cv2.imencode(".jpg", np.ascontiguousarray(rgb[..., ::-1]))
    if not ok:
        raise ValueError(f"JPEG encoder failed on an image of shape {rgb.shape}")
    return bytes(data.tobytes())
