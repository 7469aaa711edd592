"""Conversion between messages of the node ``nerf`` and the plain values of ``instant_ic.vspace``."""

from __future__ import annotations

from typing import Any

import numpy as np

from instant_ic.depth.keyframes import decode_sigma
from instant_ic.msg import (
    RenderedView,
    VspaceStatus,
    compressed_image_message,
    header,
    image_array,
    matrix_from_pose,
    pose_message,
    to_time,
)
from instant_ic.util.jpeg import JpegError
from instant_ic.util.limits import decode_rgb
from instant_ic.vspace import KeyframeError
from instant_ic.vspace.worker import EncodedView, KeyframeArrays, SpaceWorker, ViewOrder


def decode_keyframe(keyframe: Any) -> KeyframeArrays:
    """Return the arrays of a Keyframe message, for ``VirtualSpace.prepare``.

    Raises:
        KeyframeError: the keyframe is marked unfit or cannot be decoded.
    """
    if not keyframe.fit:
        raise KeyframeError(f"its depth is marked unfit: {keyframe.message or 'no reason given'}")
    try:
        rgb = decode_rgb(np.asarray(keyframe.panorama.data, np.uint8))
    except JpegError as error:
        raise KeyframeError(f"the panorama {error}") from error
    if keyframe.depth.encoding != "32FC1":
        raise KeyframeError(f"depth must be 32FC1 (got {keyframe.depth.encoding!r})")
    sigma = decode_sigma(image_array(keyframe.sigma)) if keyframe.sigma.data.size else keyframe.relative_sigma
    return rgb, image_array(keyframe.depth), matrix_from_pose(keyframe.pose), sigma


def view_message(order: ViewOrder, encoded: EncodedView, worker: SpaceWorker, now_ns: int) -> Any:
    """Build the RenderedView message that answers a request, with the pose of the rendered request."""
    return RenderedView(
        header=header("map", now_ns),
        request_id=order.id,
        keyframe_id=0 if worker.keyframe is None else worker.keyframe.id,
        pose=encoded.order.message.pose,
        fov_rad=order.fov_rad,
        width=order.width,
        height=order.height,
        confidence=float(encoded.view.confidence.mean()),
        render_ms=worker.figures()["render_ms"],
        image=compressed_image_message(encoded.jpeg, "map", now_ns),
    )


def status_message(worker: SpaceWorker, now_ns: int) -> Any:
    """Build a VspaceStatus message."""
    keyframe = worker.keyframe
    return VspaceStatus(
        header=header("map", now_ns),
        keyframe_pose=pose_message(np.eye(4)) if keyframe is None else keyframe.message.pose,
        keyframe_stamp=to_time(0) if keyframe is None else keyframe.message.header.stamp,
        **worker.figures(),
    )
