"""Conversion between messages of the node ``depth_scaler`` and the plain values of ``instant_ic.depth``."""

from __future__ import annotations

import functools
from typing import Any

from instant_ic.depth.inputs import HeldImage
from instant_ic.depth.keyframes import encode_sigma
from instant_ic.depth.sources import DepthResult
from instant_ic.geometry.poses import Matrix
from instant_ic.lidar.deskew import TimedPoints
from instant_ic.msg import Keyframe, cloud_array, cloud_points, header, image_message, pose_message, stamp_ns


def held_image(message: Any) -> HeldImage:
    """Return frame and stamp of an Image or CompressedImage."""
    return HeldImage(message.header.frame_id, stamp_ns(message))


def revolution_of(message: Any) -> TimedPoints:
    """Convert a PointCloud2 to a revolution.

    Raises:
        ValueError: the points cannot be read or have no times.
    """
    points = cloud_array(message)
    xyz = functools.partial(cloud_points, points)
    return TimedPoints(message.header.frame_id, stamp_ns(message), points["time"], xyz)


def keyframe_message(number: int, frame: str, frame_from_camera: Matrix, panorama: Any, depth: DepthResult) -> Any:
    """Build the Keyframe message from a CompressedImage and its depth."""
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
