"""Messages of the node ``grid_slam`` from the plain values of ``instant_ic.slam``, and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from instant_ic.geometry.poses import matrix_from_pose2, planar_covariance
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.msg import (
    LaserScan,
    OccupancyGridUpdate,
    PoseIntegrity,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    header,
    stamp_ns,
)
from instant_ic.msg import pose_message as _pose
from instant_ic.slam import Scan
from instant_ic.slam.grid_slam import SlamResult
from instant_ic.slam.map_updates import MapPart
from instant_ic.slam.scan import FloatArray
from instant_ic.slam.scan_queue import ScanError, level_mount


def read_scan(message: LaserScan, mounts: TransformBuffer, base_frame: str) -> tuple[Scan, FloatArray]:
    """The scan of a LaserScan, and the laser's planar mount (3,) on the robot.

    Raises:
        ScanError: the mount is not known yet, or the scan cannot be used.
    """
    angles = (float(message.angle_min), float(message.angle_increment))
    limits = (float(message.range_min), float(message.range_max))
    try:
        mount = level_mount(mounts.lookup(base_frame, message.header.frame_id))
        return Scan(np.asarray(message.ranges), *angles, *limits, stamp_ns(message)), mount
    except TransformError as error:
        raise ScanError(f"where the laser stands is not known yet: {error}") from None
    except ValueError as error:
        raise ScanError(f"the scan cannot be used: {error}") from None


def integrity_message(result: SlamResult, map_frame: str, stamp: int) -> Any:
    """PoseIntegrity after a scan."""
    trust = result.integrity
    return PoseIntegrity(
        header=header(map_frame, stamp),
        lost_probability=trust.lost_probability,
        position_bound_m=trust.position_bound_m,
        heading_bound_rad=trust.heading_bound_rad,
        localized=result.localized,
        status=result.status.value,
    )


def pose_message(result: SlamResult, map_frame: str, stamp: int) -> Any:
    """PoseWithCovarianceStamped after a scan."""
    covariance = planar_covariance(result.covariance).reshape(36)
    pose = PoseWithCovariance(pose=_pose(matrix_from_pose2(result.map_from_base)), covariance=covariance)
    return PoseWithCovarianceStamped(header=header(map_frame, stamp), pose=pose)


def part_message(part: MapPart, map_frame: str, stamp: int) -> Any:
    """OccupancyGridUpdate of a changed part of the map."""
    (height, width), data = part.values.shape, np.ascontiguousarray(part.values).reshape(-1)
    place = {"x": part.x, "y": part.y, "width": width, "height": height}
    return OccupancyGridUpdate(header=header(map_frame, stamp), data=data, **place)
