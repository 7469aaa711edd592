"""Layers for the page from panoramas with depth: triangles of seen surfaces, and of estimated ones behind them."""

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
"""Relative difference of depth above which two neighbours are an edge. With noisy depth, a smaller value would tear the
surface into shards (0.7 dB in the corridor's live keyframes)."""


class LayerMeshes:
    """The page's layers of each version; a layer that has not changed since the last call is reused."""

    def __init__(self) -> None:
        self._before: dict[Hashable, PageLayer] = {}

    def layers(self, version: Layers) -> tuple[PageLayer, ...]:
        """Return the layers in the order in which the page shows them: seen surfaces first, then the estimated ones.

        Args:
            version: a whole version of the virtual space.

        Raises:
            LayersError: no layer was seen by a camera, or a layer cannot be decoded.
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
        shown: True where there is a surface, (h, 2 h): by pixel, or for an estimated surface by the quad right of and
            below the pixel.
        confidence: confidence of an estimated surface, 0 to 1, (h', w'); None if all of it was seen.
        map_from_camera: pose of the keyframe's camera, (4, 4).

    Raises:
        ValueError: the geometry is not a surface.
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
