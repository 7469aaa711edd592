"""Typed messages: every ROS 2 Jazzy type and our own, by short name, with conversions to and from numpy.

>>> from instant_ic.msg import LaserScan, scan_message, stamp_ns
>>> scan = scan_message([1.0, 2.0], -0.1, 0.2, 0.1, 30.0, "velodyne", 1_500_000_000)
>>> stamp_ns(scan), scan.ranges.dtype.name
(1500000000, 'float32')
"""

from __future__ import annotations

from typing import Any

from instant_ic.msg.convert import (
    HARD_STOP,
    battery_message,
    cloud_array,
    cloud_message,
    cloud_of_points,
    cloud_points,
    cloud_xyz,
    compressed_image_message,
    grid_array,
    grid_message,
    header,
    image_array,
    image_message,
    matrix_from_pose,
    odometry_message,
    path_array,
    path_message,
    pose2_from_message,
    pose2_message,
    pose_message,
    pose_stamped,
    scan_message,
    stamp_ns,
    to_time,
    transform_matrix,
    transform_message,
    twist_message,
    twist_stamped,
    twist_values,
)
from instant_ic.msg.types import (
    MessageError,
    deserialize,
    message_type,
    register_type,
    serialize,
    serializer,
    type_hash,
    type_name,
    typestore,
)

__all__ = [
    "HARD_STOP",
    "MessageError",
    "battery_message",
    "cloud_array",
    "cloud_message",
    "cloud_of_points",
    "cloud_points",
    "cloud_xyz",
    "compressed_image_message",
    "deserialize",
    "grid_array",
    "grid_message",
    "header",
    "image_array",
    "image_message",
    "matrix_from_pose",
    "message_type",
    "odometry_message",
    "path_array",
    "path_message",
    "pose2_from_message",
    "pose2_message",
    "pose_message",
    "pose_stamped",
    "register_type",
    "scan_message",
    "serialize",
    "serializer",
    "stamp_ns",
    "to_time",
    "transform_matrix",
    "transform_message",
    "twist_message",
    "twist_stamped",
    "twist_values",
    "type_hash",
    "type_name",
    "typestore",
]


def __getattr__(name: str) -> Any:
    """Return a message class by its short name: ``from instant_ic.msg import Odometry``."""
    if name.startswith("_"):
        raise AttributeError(name)
    try:
        return message_type(name)
    except MessageError as error:
        raise AttributeError(str(error)) from None
