"""Layers for the page from panoramas with depth: triangles of what was seen, and of the guess behind it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace

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


@dataclass(frozen=True)
class Geometry:
    """Depth of a panorama.

    Attributes:
        inverse_depth: in 1/m along the ray, > 0, (h, 2 h).
        shown: where there is a surface, (h, 2 h): by pixel, or for a guess by the quad right of and below it.
        confidence: see ``PageLayer``.
    """

    inverse_depth: NDArray[np.float32]
    shown: NDArray[np.bool_]
    confidence: bytes = b""


@dataclass(frozen=True)
class LayerSource:
    """One panorama with depth.

    Attributes:
        key: changes when colour or geometry change.
        behind: a guess of what becomes visible behind what was seen; else what the camera saw.
        colour: JPEG or PNG, equirectangular.
        gain: factors of the colours: red, green, blue.
        map_from_camera: pose of the keyframe's camera, (4, 4).
        geometry: returns the depth; called once for each key.
    """

    key: Hashable
    behind: bool
    colour: bytes
    gain: tuple[float, float, float]
    map_from_camera: Matrix
    geometry: Callable[[], Geometry]


class LayerMeshes:
    """Makes the page's layers; what has not changed since the last call is not made again."""

    def __init__(self) -> None:
        self._before: dict[Hashable, PageLayer] = {}

    def layers(self, sources: Sequence[LayerSource]) -> tuple[PageLayer, ...]:
        """Return the layers in the order in which the page shows them: what was seen before all guesses.

        Args:
            sources: the newest keyframe first.

        Raises:
            ValueError: a geometry that is none.
        """
        made = {
            source.key: _layer(source, self._before.get(source.key))
            for source in sorted(sources, key=lambda source: source.behind)  # stable
        }
        self._before = made
        return tuple(made.values())


def _layer(source: LayerSource, before: PageLayer | None) -> PageLayer:
    if before is not None:
        if before.gain == source.gain and np.array_equal(before.map_from_camera, source.map_from_camera):
            return before
        return replace(before, gain=source.gain, map_from_camera=source.map_from_camera)
    geometry = source.geometry()
    shown = geometry.shown
    if source.behind:
        for axis in (0, 1):  # a quad has four pixels
            shown = shown | np.roll(shown, 1, axis)
    mesh = layer_mesh(geometry.inverse_depth, edge_quads(geometry.inverse_depth, EDGE_RATIO), shown)
    return PageLayer(
        image=source.colour,
        confidence=geometry.confidence,
        gain=source.gain,
        map_from_camera=source.map_from_camera,
        size=mesh.size,
        corners=mesh.corners,
        inverse_depth=mesh.inverse_depth,
        triangles=mesh.triangles,
    )


def layer_sources(layers: Layers) -> list[LayerSource]:
    """The layers of a whole version of the virtual space.

    Raises:
        LayersError: there is none that a camera saw.
    """
    if not any(layer.kind is Kind.SEEN for layer in layers.layers):
        raise LayersError("the layers hold no keyframe")
    return [_source(layer) for layer in layers.layers]


def _source(layer: Layer) -> LayerSource:
    red, green, blue = (float(value) for value in layer.gain)
    key = layer.kind, layer.keyframe_id, layer.colour_version, layer.geometry_version
    return LayerSource(
        key, layer.kind is Kind.BEHIND, layer.colour, (red, green, blue), layer.map_from_camera,
        functools.partial(_geometry, layer),
    )  # fmt: skip


def _geometry(layer: Layer) -> Geometry:
    decoded = decode_layer(layer)
    if layer.kind is Kind.SEEN:
        return Geometry(decoded.inverse_depth, decoded.content == Content.SURFACE)
    return Geometry(decoded.inverse_depth, decoded.content > Content.NOTHING, confidence_png(decoded.confidence))


def confidence_png(confidence: NDArray[np.floating]) -> bytes:
    """Encode shares (h, w) from 0 to 1 as a grey image."""
    return bytes(cv2.imencode(".png", np.rint(255 * confidence).astype(np.uint8))[1].tobytes())
