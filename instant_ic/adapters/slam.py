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
    TFMessage,
    grid_message,
    header,
    pose2_from_message,
    stamp_ns,
    transform_matrix,
)
from instant_ic.msg import pose_message as _pose
from instant_ic.slam import GridSlam, Scan
from instant_ic.slam.grid_slam import SlamResult
from instant_ic.slam.map_updates import MapUpdates
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


def integrity_message(slam: GridSlam, result: SlamResult, map_frame: str, stamp: int) -> Any:
    """PoseIntegrity after a scan, of which ``result`` is the result."""
    trust, found = result.integrity, slam.contradiction
    return PoseIntegrity(
        header=header(map_frame, stamp),
        lost_probability=trust.lost_probability,
        position_bound_m=trust.position_bound_m,
        heading_bound_rad=trust.heading_bound_rad,
        localized=result.localized,
        status=result.status.value,
        contradiction=int(found.state),
        contradictions=found.count,
    )


def pose_message(result: SlamResult, map_frame: str, stamp: int) -> Any:
    """PoseWithCovarianceStamped after a scan."""
    covariance = planar_covariance(result.covariance).reshape(36)
    pose = PoseWithCovariance(pose=_pose(matrix_from_pose2(result.map_from_base)), covariance=covariance)
    return PoseWithCovarianceStamped(header=header(map_frame, stamp), pose=pose)


def read_mounts(message: TFMessage, mounts: TransformBuffer) -> None:
    """Put the fixed transforms of a TFMessage into a buffer."""
    for mount in message.transforms:
        parent, child = mount.header.frame_id, mount.child_frame_id
        mounts.set(parent, child, stamp_ns(mount), transform_matrix(mount), static=True)


def read_initial_pose(message: PoseWithCovarianceStamped, map_frame: str) -> FloatArray:
    """Pose (3,) that was set from outside.

    Raises:
        ValueError: it is in another frame than the map's.
    """
    if message.header.frame_id not in ("", map_frame):
        raise ValueError(f"it is in frame {message.header.frame_id!r}, not {map_frame!r}")
    return pose2_from_message(message)


def map_messages(updates: MapUpdates, slam: GridSlam, map_frame: str, stamp: int, steady_ns: int) -> tuple[Any, Any]:
    """OccupancyGridUpdate of the changed part and OccupancyGrid of the whole map; None for what is not to be sent."""
    part, whole = updates.update(slam.map_version, slam.grid, steady_ns)
    update = grid = None
    if part is not None:
        (height, width), data = part.values.shape, np.ascontiguousarray(part.values).reshape(-1)
        place = {"x": part.x, "y": part.y, "width": width, "height": height}
        update = OccupancyGridUpdate(header=header(map_frame, stamp), data=data, **place)
    if whole is not None:
        origin = (float(whole.origin[0]), float(whole.origin[1]))
        grid = grid_message(whole.values, whole.resolution, origin, map_frame, stamp)
    return update, grid
