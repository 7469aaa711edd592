"""Layers of the virtual space that the page renders by itself, and the frame that carries them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.console.protocol import PageProtocolError
from instant_ic.geometry.poses import Matrix, quaternion_from_matrix

MOST_LAYERS = 8
"""Largest number of layers; the page marks each by a bit of its stencil buffer."""


def pose_fields(map_from_camera: Matrix) -> dict[str, list[float]]:
    """Return a pose as the page reads it: the rotation ``q`` (x, y, z, w) and the position ``p`` in m."""
    return {"q": quaternion_from_matrix(map_from_camera).tolist(), "p": map_from_camera[:3, 3].tolist()}


@dataclass(frozen=True)
class PageLayer:
    """A surface around a keyframe, as triangles with an equirectangular image (``vspace.layer_mesh``).

    Attributes:
        image: colours, JPEG or PNG.
        confidence: grey PNG, white where the place was seen; empty if all of it was seen.
        gain: factors of the colours: red, green, blue.
        map_from_camera: pose of the keyframe's camera, (4, 4).
        size: height and width of the lattice that the corners belong to.
        corners: column and row of each vertex, (N, 2) uint16.
        inverse_depth: inverse depth of each vertex, 1/m along the ray, (N,) float32; 0 is infinitely far.
        triangles: indices of the vertices, (T, 3) uint32, counter-clockwise as seen by the keyframe's camera.
    """

    image: bytes
    confidence: bytes
    gain: tuple[float, float, float]
    map_from_camera: Matrix
    size: tuple[int, int]
    corners: NDArray[np.uint16]
    inverse_depth: NDArray[np.float32]
    triangles: NDArray[np.uint32]

    @cached_property
    def parts(self) -> dict[str, bytes]:
        """Bytes of the layer by name, arrays in little endian. Numbers come first, so that they stay aligned."""
        return {
            "inverse": self.inverse_depth.astype("<f4").tobytes(),
            "triangles": self.triangles.astype("<u4").tobytes(),
            "corners": self.corners.astype("<u2").tobytes(),
            "image": self.image,
            "confidence": self.confidence,
        }

    @cached_property
    def digest(self) -> str:
        """Digest of image, confidence and triangles."""
        content = hashlib.blake2b(repr(self.size).encode(), digest_size=12)
        for part in self.parts.values():
            content.update(len(part).to_bytes(8, "little") + part)
        return content.hexdigest()

    def check(self, name: str) -> None:
        """Check the fields of a layer that come from a message; raise PageProtocolError, which names the field."""
        if not np.isfinite(self.gain).all():
            raise PageProtocolError(f"{name}.gain must be 3 finite numbers (got {self.gain})")
        if not np.isfinite(self.map_from_camera).all():
            raise PageProtocolError(f"{name}.map_from_camera must be 4 x 4 finite numbers")
        if not self.image:
            raise PageProtocolError(f"{name}.image is empty")


@dataclass(frozen=True)
class PageLayers:
    """One version of the virtual space.

    Attributes:
        version: number of the version, which differs from that of the layers sent before.
        mount: position of the camera on the robot, m.
        layers: layers in order; each is shown where the ones before show nothing.
    """

    version: int
    mount: tuple[float, float, float]
    layers: tuple[PageLayer, ...]

    def check(self) -> None:
        """Check all layers; raise PageProtocolError, which names what is wrong."""
        if not 1 <= self.version <= 2**53:
            raise PageProtocolError(f"layers.version must be from 1 to 2**53 (got {self.version})")
        if not 1 <= len(self.layers) <= MOST_LAYERS:
            raise PageProtocolError(f"layers: there must be 1 to {MOST_LAYERS} (got {len(self.layers)})")
        if not np.isfinite(self.mount).all():
            raise PageProtocolError(f"layers.mount must be 3 finite numbers (got {self.mount})")
        for number, layer in enumerate(self.layers):
            layer.check(f"layers[{number}]")

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
                    "size": list(layer.size),
                    "gain": list(layer.gain),
                    **pose_fields(layer.map_from_camera),
                    "parts": ranges,
                }
            )
        return {"version": self.version, "mount": list(self.mount), "layers": layers}, bytes(payload)
