"""The virtual space as layers that the page renders by itself: their check, and the frame that carries them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.console.protocol import ProtocolError
from instant_ic.geometry.poses import Matrix, quaternion_from_matrix
from instant_ic.vspace.layer_mesh import layer_mesh
from instant_ic.vspace.layers import Content, Kind, Layer, Layers, LayersError, decode_layer
from instant_ic.vspace.prior import edge_quads

BEHIND_EDGE = 0.12
"""Share by which depths differ at an edge of what lies behind."""
MOST_LAYERS = 8
"""The page marks each layer by a bit of its stencil buffer."""


@dataclass(frozen=True)
class PageLayer:
    """Surface round a keyframe, as triangles with an equirectangular image (``vspace.layer_mesh``).

    Attributes:
        image: colours, JPEG or PNG.
        confidence: grey PNG, white where the place was seen; empty: all of it.
        gain: factors of the colours: red, green, blue.
        size: height and width of the lattice that the corners belong to.
        corners: column and row of each vertex, (N, 2) uint16.
        inverse_depth: of each vertex, in 1/m along the ray, (N,) float32; 0 is endlessly far.
        triangles: indices of vertices, (T, 3) uint32, counter-clockwise as the keyframe's camera sees them.
    """

    image: bytes
    confidence: bytes
    gain: tuple[float, float, float]
    size: tuple[int, int]
    corners: NDArray[np.uint16]
    inverse_depth: NDArray[np.float32]
    triangles: NDArray[np.uint32]

    @cached_property
    def parts(self) -> dict[str, bytes]:
        """The bytes of the layer by name, the arrays in little endian; numbers first, so that they stay aligned."""
        return {
            "inverse": self.inverse_depth.astype("<f4").tobytes(),
            "triangles": self.triangles.astype("<u4").tobytes(),
            "corners": self.corners.astype("<u2").tobytes(),
            "image": self.image,
            "confidence": self.confidence,
        }

    @cached_property
    def digest(self) -> str:
        """Identifies the layer: equal for equal content."""
        content = hashlib.blake2b(repr((self.gain, self.size)).encode(), digest_size=12)
        for part in self.parts.values():
            content.update(len(part).to_bytes(8, "little") + part)
        return content.hexdigest()

    def check(self, name: str) -> None:
        """Check the layer; raise ProtocolError, which names what is wrong."""
        height, width = self.size
        if not (1 <= height <= 65535 and 1 <= width <= 65535):
            raise ProtocolError(f"{name}.size must be 1 to 65535 (got {self.size})")
        count = len(self.corners)
        if self.corners.shape != (count, 2) or self.inverse_depth.shape != (count,):
            raise ProtocolError(
                f"{name}: corners {self.corners.shape} and inverse depth {self.inverse_depth.shape} do not fit"
            )
        if count and (self.corners.max(axis=0) > (width, height)).any():
            raise ProtocolError(f"{name}.corners must lie within {width} x {height}")
        if not (np.isfinite(self.inverse_depth).all() and (self.inverse_depth >= 0).all()):
            raise ProtocolError(f"{name}.inverse_depth must be finite and >= 0")
        if self.triangles.ndim != 2 or self.triangles.shape[1] != 3:
            raise ProtocolError(f"{name}.triangles must have three corners each (got {self.triangles.shape})")
        if self.triangles.size and int(self.triangles.max()) >= count:
            raise ProtocolError(f"{name}.triangles must be indices below {count} (got {int(self.triangles.max())})")
        if not (np.isfinite(self.gain).all() and len(self.gain) == 3):
            raise ProtocolError(f"{name}.gain must be 3 finite numbers (got {self.gain})")
        if not self.image:
            raise ProtocolError(f"{name}.image is empty")


@dataclass(frozen=True)
class PageLayers:
    """One version of the virtual space.

    Attributes:
        version: differs from that of the layers sent before.
        keyframe: id of the keyframe.
        map_from_camera: pose of the keyframe's camera, (4, 4).
        mount: position of the camera on the robot, m.
        layers: the nearest first.
    """

    version: int
    keyframe: int
    map_from_camera: Matrix
    mount: tuple[float, float, float]
    layers: tuple[PageLayer, ...]

    def check(self) -> None:
        """Check all layers; raise ProtocolError, which names what is wrong."""
        if not 1 <= self.version <= 2**53:
            raise ProtocolError(f"layers.version must be from 1 to 2**53 (got {self.version})")
        if not 1 <= len(self.layers) <= MOST_LAYERS:
            raise ProtocolError(f"layers: there must be 1 to {MOST_LAYERS} (got {len(self.layers)})")
        if not (np.isfinite(self.map_from_camera).all() and np.isfinite(self.mount).all()):
            raise ProtocolError("layers: the keyframe's pose and the camera's mount must be finite")
        for number, layer in enumerate(self.layers):
            layer.check(f"layers[{number}]")

    @cached_property
    def digests(self) -> frozenset[str]:
        """Digests of the layers."""
        return frozenset(layer.digest for layer in self.layers)

    def frame(self, held: frozenset[str]) -> tuple[dict[str, Any], bytes]:
        """Return header and payload of the frame, without the layers that the page holds already (``held``)."""
        payload = bytearray()
        layers = []
        for layer in self.layers:
            ranges: dict[str, list[int]] | None = None
            if layer.digest not in held:
                ranges = {}
                for name, part in layer.parts.items():
                    ranges[name] = [len(payload), len(part)]
                    payload += part
            layers.append({"id": layer.digest, "size": list(layer.size), "gain": list(layer.gain), "parts": ranges})
        header = {
            "version": self.version,
            "keyframe": self.keyframe,
            "q": quaternion_from_matrix(self.map_from_camera).tolist(),
            "p": self.map_from_camera[:3, 3].tolist(),
            "mount": list(self.mount),
            "layers": layers,
        }
        return header, bytes(payload)


def page_layers(layers: Layers, mount: tuple[float, float, float]) -> PageLayers:
    """What a page renders of a version of the virtual space: the layers of the newest keyframe. Needs numba.

    Args:
        layers: a whole version.
        mount: position of the camera on the robot, m.

    Raises:
        LayersError: a layer cannot be decoded, or there is none that the camera saw.
    """
    if not layers.layers or layers.layers[0].kind is not Kind.SEEN:
        raise LayersError("the layers do not begin with what a camera saw")
    newest = layers.layers[0]
    own = tuple(_page_layer(layer) for layer in layers.layers if layer.keyframe_id == newest.keyframe_id)
    return PageLayers(layers.version, newest.keyframe_id, newest.map_from_camera, mount, own)


def _page_layer(layer: Layer) -> PageLayer:
    decoded = decode_layer(layer)
    if layer.kind is Kind.SEEN:
        shown, edge = decoded.content == Content.SURFACE, decoded.edge
        confidence = b""
    else:
        quads = decoded.content > Content.NOTHING
        shown = quads | np.roll(quads, 1, 1)  # a quad has four pixels
        shown[1:] |= shown[:-1]
        edge = edge_quads(decoded.inverse_depth, BEHIND_EDGE) > 0
        confidence = cv2.imencode(".png", np.rint(255 * decoded.confidence).astype(np.uint8))[1].tobytes()
    mesh = layer_mesh(decoded.inverse_depth, edge, shown)
    red, green, blue = (float(value) for value in layer.gain)
    return PageLayer(
        layer.colour, confidence, (red, green, blue), mesh.size, mesh.corners, mesh.inverse_depth, mesh.triangles
    )  # fmt: skip
