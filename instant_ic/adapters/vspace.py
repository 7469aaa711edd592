"""Conversion between VspaceLayers messages and the layers of ``instant_ic.vspace.layers``."""

from __future__ import annotations

from typing import Any

import numpy as np

from instant_ic.msg import (
    VspaceLayer,
    VspaceLayers,
    compressed_image_message,
    header,
    matrix_from_pose,
    pose_message,
)
from instant_ic.vspace.layers import Kind, Layer, Layers, LayersError


def layers_message(layers: Layers, stamp_ns: int) -> Any:
    """Build the VspaceLayers message of a version of the layers, with its stamp."""
    return VspaceLayers(
        header=header("map", stamp_ns),
        version=layers.version,
        layers=[
            VspaceLayer(
                kind=int(layer.kind),
                keyframe_id=layer.keyframe_id,
                pose=pose_message(layer.map_from_camera),
                gain=np.asarray(layer.gain, np.float32),
                relative_sigma=layer.relative_sigma,
                colour_version=layer.colour_version,
                geometry_version=layer.geometry_version,
                colour=compressed_image_message(layer.colour, "camera", stamp_ns, _format(layer.colour)),
                near_m=layer.near_m,
                geometry_png=np.frombuffer(layer.geometry_png, np.uint8),
            )
            for layer in layers.layers
        ],
    )


def _format(image: bytes) -> str:
    return "png" if image.startswith(b"\x89PNG") else "jpeg"


def layers_of(message: Any) -> Layers:
    """Read the layers of a VspaceLayers message.

    Raises:
        LayersError: a layer has an unknown kind.
        ValueError: a pose is not valid.
    """
    found = []
    for layer in message.layers:
        if layer.kind not in tuple(Kind):
            raise LayersError(f"layer of unknown kind {layer.kind}: is the sender newer than this program?")
        found.append(
            Layer(
                kind=Kind(layer.kind),
                keyframe_id=int(layer.keyframe_id),
                map_from_camera=matrix_from_pose(layer.pose),
                gain=np.asarray(layer.gain, np.float32),
                relative_sigma=float(layer.relative_sigma),
                colour=np.asarray(layer.colour.data, np.uint8).tobytes(),
                near_m=float(layer.near_m),
                geometry_png=np.asarray(layer.geometry_png, np.uint8).tobytes(),
                colour_version=int(layer.colour_version),
                geometry_version=int(layer.geometry_version),
            )
        )
    return Layers(int(message.version), tuple(found))
