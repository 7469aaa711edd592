"""The virtual space as panoramic layers that any renderer can show: encoding and decoding.

Each keyframe has two layers: the visible surfaces, with the camera's image, and the hidden surfaces behind them.
``VspaceLayer.msg`` describes the encoding.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.util.limits import decode_image
from instant_ic.vspace.keyframes import Keyframe
from instant_ic.vspace.nerf.field import Floats

_CODES = 65535
_QUALITY = 90
"""JPEG quality of panoramas without a camera image."""


class Kind(enum.IntEnum):
    """Kind of a layer, numbered as in VspaceLayer.msg."""

    SEEN = 0
    BEHIND = 1


class Content(enum.IntEnum):
    """Content of a pixel (layer ``SEEN``) or of a quad (layer ``BEHIND``), numbered as in VspaceLayer.msg."""

    NOTHING = 0
    SKY = 1
    MOVED = 2
    SURFACE = 3


_CONTENT, _CONFIDENCE, _EDGE = np.uint8(7), np.uint8(120), np.uint8(128)
"""Bits of the geometry's blue channel."""
_SURE, _FILLED = 15, 8


class LayersError(ValueError):
    """Layers cannot be decoded; the message says which and why."""


@dataclass(frozen=True)
class Layer:
    """An encoded panorama with depth; fields as in VspaceLayer.msg, where the pose is called ``pose``."""

    kind: Kind
    keyframe_id: int
    map_from_camera: NDArray[np.float64]
    gain: Floats
    relative_sigma: float
    colour: bytes
    near_m: float
    geometry_png: bytes
    colour_version: int
    geometry_version: int


@dataclass(frozen=True)
class Layers:
    """One version of the space: the newest keyframe's visible and hidden surfaces."""

    version: int
    layers: tuple[Layer, ...]


def encode(keyframe: Keyframe, number: int, image: bytes | None, version: int) -> Layers:
    """Encode the keyframe that views show.

    Args:
        keyframe: the keyframe, prepared for rendering by the warp.
        number: id of the keyframe.
        image: encoded panorama from the camera; None to encode the keyframe's.
        version: number of this version of the space.
    """
    prior, background = keyframe.prior, keyframe.background
    seen = _encoded_geometry(prior.inverse_depth, _marks(keyframe))
    parts = [(Kind.SEEN, image or _jpeg(prior.rgb), seen)]
    marks = np.rint(background.opacity * np.float32(_SURE / 255)).astype(np.uint8) << 3
    for quads, content in ((background.quads, Content.SURFACE), (background.sky_quads, Content.SKY)):
        marks[tuple(quads.T)] |= np.uint8(content)
    parts.append((Kind.BEHIND, _jpeg(background.rgb), _encoded_geometry(background.inverse_depth, marks)))
    layers = [
        Layer(
            kind,
            number,
            prior.map_from_camera,
            np.ones(3, np.float32),
            prior.relative_sigma,
            colour,
            near_m,
            png,
            version,
            version,
        )
        for kind, colour, (near_m, png) in parts
    ]
    return Layers(version, tuple(layers))


def _marks(keyframe: Keyframe) -> NDArray[np.uint8]:
    prior = keyframe.prior
    confidence = np.where(prior.known == 1, _SURE, _FILLED).astype(np.uint8)
    return prior.content | confidence << 3 | _EDGE * np.minimum(keyframe.warp.depth_edge[1:-1], 1)


def _encoded_geometry(inverse_depth: Floats, marks: NDArray[np.uint8]) -> tuple[float, bytes]:
    """Return the depth in metres that the highest code stands for, and the PNG."""
    most = float(inverse_depth.max())
    code = np.maximum(np.rint(inverse_depth * np.float32(_CODES / most)), 1).astype(np.uint16)
    image = np.dstack([marks, (code & 255).astype(np.uint8), (code >> 8).astype(np.uint8)])  # OpenCV writes BGR
    fast = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    return 1 / most, cv2.imencode(".png", image, fast)[1].tobytes()


def _jpeg(rgb: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


@dataclass(frozen=True)
class DecodedLayer:
    """Arrays of a layer.

    Attributes:
        rgb: colours, (H, 2 H, 3) uint8.
        inverse_depth: 1/m along the ray, (h, 2 h) float32.
        content: ``Content`` of each pixel, or in ``BEHIND`` of the quad to its lower right, (h, 2 h) uint8.
        confidence: 0 to 1, (h, 2 h) float32; below 1 if the depth was filled. In ``BEHIND`` the surface's opacity.
        edge: mask of the pixels whose quad to the lower right crosses a depth edge, (h, 2 h).
    """

    rgb: NDArray[np.uint8]
    inverse_depth: Floats
    content: NDArray[np.uint8]
    confidence: Floats
    edge: NDArray[np.bool_]


def decode_layer(layer: Layer) -> DecodedLayer:
    """Decode the arrays of a whole layer.

    Raises:
        LayersError: an image cannot be decoded, or is not a panorama.
    """
    name = f"layer {layer.kind.name} of keyframe {layer.keyframe_id}"
    colour = decode_image(layer.colour, cv2.IMREAD_COLOR) if layer.colour else None
    geometry = decode_image(layer.geometry_png, cv2.IMREAD_UNCHANGED) if layer.geometry_png else None
    for what, image in (("colour", colour), ("geometry", geometry)):
        if image is None:
            raise LayersError(f"{name}: its {what} cannot be decoded as an image")
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or image.shape[1] != 2 * image.shape[0]:
            raise LayersError(f"{name}: its {what} must be 8-bit RGB, twice as wide as high (got {image.shape})")
    if not (math.isfinite(layer.near_m) and layer.near_m > 0):
        raise LayersError(f"{name}: near_m must be > 0 (got {layer.near_m})")
    assert colour is not None and geometry is not None
    marks = geometry[..., 0]
    code = 256 * geometry[..., 2].astype(np.float32) + geometry[..., 1]
    if not code.all():
        raise LayersError(f"{name}: its geometry has pixels without depth (code 0)")
    rgb = cv2.cvtColor(colour, cv2.COLOR_BGR2RGB)
    inverse_depth = code * np.float32(1 / (_CODES * layer.near_m))
    confidence = ((marks & _CONFIDENCE) >> 3).astype(np.float32) / np.float32(_SURE)
    return DecodedLayer(rgb, inverse_depth, marks & _CONTENT, confidence, marks & _EDGE > 0)
