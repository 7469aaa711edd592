"""The demo's room as layers round a keyframe, made as the virtual space makes them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.console import demo_world
from instant_ic.console.layers import PageLayer, PageLayers
from instant_ic.geometry.poses import Matrix
from instant_ic.geometry.projections import equirect_directions
from instant_ic.vspace.background import Background
from instant_ic.vspace.layer_mesh import LayerMesh, layer_mesh
from instant_ic.vspace.prior import ROOM, edge_quads
from instant_ic.vspace.warp import PanoramaWarp

NEAR_EDGE, FAR_EDGE = 0.05, 0.12
"""Shares by which depths differ at an edge, of the first and the second layer."""


def demo_layers(version: int, map_from_camera: Matrix, width: int = 1024, depth_width: int = 512) -> PageLayers:
    """Return what a keyframe at this pose shows: the camera's surfaces, and the guess behind them.

    Args:
        version: see ``PageLayers``.
        map_from_camera: pose of the keyframe, (4, 4).
        width: of the panorama, pixels.
        depth_width: of its depth, pixels.
    """
    eye = tuple(float(value) for value in map_from_camera[:3, 3])
    rotation = map_from_camera[:3, :3].astype(np.float32)
    position = (eye[0], eye[1], eye[2])
    rgb = demo_world.shade(position, equirect_directions(width, width // 2) @ rotation.T)[..., ::-1]
    depth = demo_world.distances(position, equirect_directions(depth_width, depth_width // 2) @ rotation.T)
    prior = PanoramaWarp(np.ascontiguousarray(rgb), depth, map_from_camera).prior
    behind = Background.of(prior)
    guessed = np.zeros(behind.inverse.shape, np.bool_)
    for quads in (behind.guessed, behind.sky):
        guessed[quads[:, 0], quads[:, 1]] = True
    for axis in (0, 1):  # a quad has four pixels
        guessed |= np.roll(guessed, 1, axis)
    first = layer_mesh(prior.inverse_depth, edge_quads(prior.inverse_depth, NEAR_EDGE), prior.content == ROOM)
    second = layer_mesh(behind.inverse, edge_quads(behind.inverse, FAR_EDGE), guessed)
    layers = (_layer(rgb, first, seen=True), _layer(behind.rgb, second, seen=False))
    return PageLayers(version, version, map_from_camera, (0.0, 0.0, position[2]), layers)


def _layer(rgb: NDArray[np.uint8], mesh: LayerMesh, *, seen: bool) -> PageLayer:
    image = _encoded(".jpg", np.ascontiguousarray(rgb[..., ::-1]))
    confidence = b"" if seen else _encoded(".png", np.zeros((1, 2), np.uint8))
    return PageLayer(
        image, confidence, (1.0, 1.0, 1.0), mesh.size, mesh.corners, mesh.inverse_depth, mesh.triangles
    )  # fmt: skip


def _encoded(ending: str, image: NDArray[np.uint8]) -> bytes:
    ok, data = cv2.imencode(ending, image)
    if not ok:
        raise ValueError(f"encoder of {ending} failed on an image of shape {image.shape}")
    return bytes(data.tobytes())
