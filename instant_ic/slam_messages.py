"""Messages of the node ``grid_slam`` from the plain values of ``instant_ic.slam``, and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from instant_ic.geometry.poses import matrix_from_pose2, planar_covariance
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


def scan_of(message: LaserScan) -> Scan:
    """The scan of a LaserScan; ValueError if it cannot be used."""
    angles = (float(message.angle_min), float(message.angle_increment))
    limits = (float(message.range_min), float(message.range_max))
    return Scan(np.asarray(message.ranges), *angles, *limits, stamp_ns(message))


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
