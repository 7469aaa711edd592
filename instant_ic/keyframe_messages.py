"""Keyframe messages from depth and its pose."""

from __future__ import annotations

from typing import Any

from instant_ic.depth.keyframes import encode_sigma
from instant_ic.depth.sources import DepthResult
from instant_ic.geometry.poses import Matrix
from instant_ic.msg import Keyframe, header, image_message, pose_message, stamp_ns


def keyframe_message(number: int, frame: str, frame_from_camera: Matrix, panorama: Any, depth: DepthResult) -> Any:
    """A Keyframe message of a CompressedImage and its depth."""
    camera, stamp = panorama.header.frame_id, stamp_ns(panorama)
    return Keyframe(
        header=header(frame, stamp),
        id=number,
        pose=pose_message(frame_from_camera),
        panorama=panorama,
        depth=image_message(depth.depth_m, "32FC1", camera, stamp),
        sigma=image_message(encode_sigma(depth.sigma), "mono8", camera, stamp),
        source=depth.source,
        scale=depth.scale,
        quality=depth.quality,
        relative_sigma=depth.relative_sigma,
        fit=depth.ok,
        message=depth.message,
    )
