"""Layers of the virtual space that the page renders by itself, and the frame that carries them.

A layer is a panorama with depth, as triangles. Layers of seen surfaces come before layers of estimated surfaces behind
them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Hashable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.console.protocol import PageProtocolError
from instant_ic.geometry.poses import Matrix, quaternion_from_matrix
from instant_ic.vspace.layer_mesh import LayerMesh, layer_mesh
from instant_ic.vspace.layers import Content, Kind, Layer, Layers, LayersError, decode_layer
from instant_ic.vspace.prior import edge_quads

MOST_LAYERS = 8
"""Largest number of layers, because the page marks each layer with a bit of its stencil buffer."""
EDGE_RATIO = 0.2
"""Relative difference of neighbouring depths above which there is an edge. A smaller value would cut surfaces of noisy
depth into pieces (a loss of 0.7 dB in the corridor's live keyframes)."""


def pose_fields(map_from_camera: Matrix) -> dict[str, list[float]]:
    """Return a pose for the page: rotation ``q`` (x, y, z, w) and position ``p`` in metres."""
    return {"q": quaternion_from_matrix(map_from_camera).tolist(), "p": map_from_camera[:3, 3].tolist()}


@dataclass(frozen=True)
class PageLayer:
    """A surface around a keyframe.

    Attributes:
        image: colours, JPEG or PNG, equirectangular.
        confidence: grey PNG, white where the surface was seen; empty if the whole surface was seen.
        mesh: triangles; an inverse depth of 0 is infinitely far.
        map_from_camera: pose of the keyframe's camera, (4, 4).
        gain: factors of the colours: red, green, blue.
    """

    image: bytes
    confidence: bytes
    mesh: LayerMesh
    map_from_camera: Matrix
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @cached_property
    def parts(self) -> dict[str, bytes]:
        """Bytes of the layer by name. Arrays are little endian and come first, so that they are aligned."""
        return {
            "inverse": self.mesh.inverse_depth.astype("<f4").tobytes(),
            "triangles": self.mesh.triangles.astype("<u4").tobytes(),
            "corners": self.mesh.corners.astype("<u2").tobytes(),
            "image": self.image,
            "confidence": self.confidence,
        }

    @cached_property
    def digest(self) -> str:
        """Digest of image, confidence and triangles."""
        content = hashlib.blake2b(repr(self.mesh.size).encode(), digest_size=12)
        for part in self.parts.values():
            content.update(len(part).to_bytes(8, "little") + part)
        return content.hexdigest()


@dataclass(frozen=True)
class PageLayers:
    """One version of the virtual space.

    Attributes:
        version: number of the version, different from that of the layers sent before.
        mount: position of the camera on the robot in metres.
        layers: layers in order; each layer is shown where the earlier layers show nothing.
    """

    version: int
    mount: tuple[float, float, float]
    layers: tuple[PageLayer, ...]

    def check(self) -> None:
        """Check the values, which come from a message.

        Raises:
            PageProtocolError: a page could not render the layers; the message names the field.
        """
        _require(1 <= self.version <= 2**53, f"layers.version must be from 1 to 2**53 (got {self.version})")
        _require(
            1 <= len(self.layers) <= MOST_LAYERS, f"layers: there must be 1 to {MOST_LAYERS} (got {len(self.layers)})"
        )
        _require(np.isfinite(self.mount).all(), f"layers.mount must be 3 finite numbers (got {self.mount})")
        for number, layer in enumerate(self.layers):
            name = f"layers[{number}]"
            _require(np.isfinite(layer.gain).all(), f"{name}.gain must be 3 finite numbers (got {layer.gain})")
            _require(np.isfinite(layer.map_from_camera).all(), f"{name}.map_from_camera must be 4 x 4 finite numbers")
            _require(bool(layer.image), f"{name}.image is empty")

    @cached_property
    def digests(self) -> frozenset[str]:
        """Digests of the layers."""
        return frozenset(layer.digest for layer in self.layers)

    def frame(self, held: frozenset[str]) -> tuple[dict[str, Any], bytes]:
        """Return header and payload of the frame, without the layers whose digests are in ``held``."""
        payload = bytearray()
        layers: list[dict[str, Any]] = []
        for layer in self.layers:
            ranges: dict[str, list[int]] | None = None
            if layer.digest not in held:
                ranges = {}
                for name, part in layer.parts.items():
                    ranges[name] = [len(payload), len(part)]
                    payload += part
            layers.append(
                {
                    "id": layer.digest,
                    "size": list(layer.mesh.size),
                    "gain": list(layer.gain),
                    **pose_fields(layer.map_from_camera),
                    "parts": ranges,
                }
            )
        return {"version": self.version, "mount": list(self.mount), "layers": layers}, bytes(payload)


def _require(fine: bool | np.bool_, text: str) -> None:
    if not fine:
        raise PageProtocolError(text)


class LayerMeshes:
    """Conversion of each version's layers for the page. Layers that have not changed since the last call are reused."""

    def __init__(self) -> None:
        self._before: dict[Hashable, PageLayer] = {}

    def layers(self, version: Layers) -> tuple[PageLayer, ...]:
        """Return the layers in the order in which the page shows them: seen surfaces, then estimated surfaces.

        Args:
            version: a complete version of the virtual space.

        Raises:
            LayersError: no layer was seen by a camera, or a layer cannot be decoded.
        """
        if not any(layer.kind is Kind.SEEN for layer in version.layers):
            raise LayersError("the layers contain no keyframe")
        made: dict[Hashable, PageLayer] = {}
        for layer in sorted(version.layers, key=lambda layer: layer.kind):  # stable sort
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
    """Return a panorama with depth as triangles, in its own colours.

    Args:
        colour: JPEG or PNG, equirectangular.
        inverse_depth: inverse depth along the ray in 1/m, > 0, (h, 2 h).
        shown: mask of the pixels with a surface, (h, 2 h). For estimated surfaces an entry stands for the quad to the
            lower right of the pixel.
        confidence: confidence of an estimated surface, 0 to 1, (h', w'); None for a seen surface.
        map_from_camera: pose of the keyframe's camera, (4, 4).

    Raises:
        ValueError: the geometry is not a surface.
    """
    if confidence is not None:
        for axis in (0, 1):  # a quad has four pixels
            shown = shown | np.roll(shown, 1, axis)
    mesh = layer_mesh(inverse_depth, edge_quads(inverse_depth, EDGE_RATIO), shown)
    return PageLayer(colour, b"" if confidence is None else _confidence_png(confidence), mesh, map_from_camera)


def _confidence_png(confidence: NDArray[np.floating]) -> bytes:
    """Encode confidences (h, w) from 0 to 1 as a grey image."""
    return cv2.imencode(".png", np.rint(255 * confidence).astype(np.uint8))[1].tobytes()
