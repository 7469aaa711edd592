"""Layers for the page from panoramas with depth: triangles of what was seen, and of the guess behind it."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.console.layers import PageLayer
from instant_ic.geometry.poses import Matrix
from instant_ic.vspace.layer_mesh import layer_mesh
from instant_ic.vspace.layers import Content, Kind, Layer, Layers, LayersError, decode_layer
from instant_ic.vspace.prior import edge_quads

EDGE_RATIO = 0.2
"""Two neighbours are an edge when their depths differ by more than this share. Where the depth is noisy, smaller steps
are no edges: as squares of their own they would look like shards (0.7 dB in the corridor's live keyframes)."""


class LayerMeshes:
    """Makes the page's layers; what has not changed since the last call is not made again."""

    def __init__(self) -> None:
        self._before: dict[Hashable, PageLayer] = {}

    def layers(self, version: Layers) -> tuple[PageLayer, ...]:
        """Return the layers in the order in which the page shows them: what was seen before all guesses.

        Args:
            version: a whole version of the virtual space.

        Raises:
            LayersError: there is none that a camera saw, or one cannot be decoded.
        """
        if not any(layer.kind is Kind.SEEN for layer in version.layers):
            raise LayersError("the layers hold no keyframe")
        made: dict[Hashable, PageLayer] = {}
        for layer in sorted(version.layers, key=lambda layer: layer.kind):  # stable
            key = layer.kind, layer.keyframe_id, layer.colour_version, layer.geometry_version
            made[key] = _layer(layer, self._before.get(key))
        self._before = made
        return tuple(made.values())


def _layer(layer: Layer, before: PageLayer | None) -> PageLayer:
    red, green, blue = (float(value) for value in layer.gain)
    if before is not None:
        if before.gain == (red, green, blue) and np.array_equal(before.map_from_camera, layer.map_from_camera):
            return before
        return replace(before, gain=(red, green, blue), map_from_camera=layer.map_from_camera)
    decoded = decode_layer(layer)
    confidence = None if layer.kind is Kind.SEEN else decoded.confidence
    shown = decoded.content == Content.SURFACE if confidence is None else decoded.content > Content.NOTHING
    made = page_layer(layer.colour, decoded.inverse_depth, shown, confidence, layer.map_from_camera)
    return replace(made, gain=(red, green, blue))


def page_layer(
    colour: bytes,
    inverse_depth: NDArray[np.float32],
    shown: NDArray[np.bool_],
    confidence: NDArray[np.floating] | None,
    map_from_camera: Matrix,
) -> PageLayer:
    """Return one panorama with depth as triangles, in its own colours.

    Args:
        colour: JPEG or PNG, equirectangular.
        inverse_depth: in 1/m along the ray, > 0, (h, 2 h).
        shown: where there is a surface, (h, 2 h): by pixel, or for a guess by the quad right of and below it.
        confidence: of a guess: shares from 0 to 1 of what was seen, (h', w'); None: all of it was seen.
        map_from_camera: pose of the keyframe's camera, (4, 4).

    Raises:
        ValueError: a geometry that is none.
    """
    if confidence is not None:
        for axis in (0, 1):  # a quad has four pixels
            shown = shown | np.roll(shown, 1, axis)
    mesh = layer_mesh(inverse_depth, edge_quads(inverse_depth, EDGE_RATIO), shown)
    return PageLayer(
        image=colour,
        confidence=b"" if confidence is None else _confidence_png(confidence),
        gain=(1.0, 1.0, 1.0),
        map_from_camera=map_from_camera,
        size=mesh.size,
        corners=mesh.corners,
        inverse_depth=mesh.inverse_depth,
        triangles=mesh.triangles,
    )


def _confidence_png(confidence: NDArray[np.floating]) -> bytes:
    """Encode shares (h, w) from 0 to 1 as a grey image."""
    return bytes(cv2.imencode(".png", np.rint(255 * confidence).astype(np.uint8))[1].tobytes())
