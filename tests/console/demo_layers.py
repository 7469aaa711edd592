"""The demo's room as layers round a keyframe, made as the virtual space makes them."""

from __future__ import annotations

import cv2
import demo_world
import numpy as np
from numpy.typing import NDArray

from instant_ic.console.layers import PageLayers, page_layer
from instant_ic.geometry.poses import Matrix
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
    rgb = demo_world.panorama(map_from_camera, width).rgb
    depth = demo_world.panorama(map_from_camera, depth_width).depth_m
    prior = prepare(rgb, depth, map_from_camera, 0.0, GeometryConfig(), 4096)
    behind = Background.of(prior)
    guessed = np.zeros(behind.inverse_depth.shape, np.bool_)
    for quads in (behind.quads, behind.sky_quads):
        guessed[quads[:, 0], quads[:, 1]] = True
    guess = page_layer(_jpeg(behind.rgb), behind.inverse_depth, guessed, behind.opacity / 255, map_from_camera)
    seen = page_layer(_jpeg(rgb), prior.inverse_depth, prior.content == ROOM, None, map_from_camera)
    return PageLayers(version, (0.0, 0.0, float(map_from_camera[2, 3])), (seen, guess))


def _jpeg(rgb: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".jpg", rgb[..., ::-1])[1].tobytes()
