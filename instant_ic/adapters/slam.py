"""Conversion of messages and transforms, and the background jobs, of the node ``grid_slam``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from instant_ic.geometry.poses import Matrix, matrix_from_pose2, planar_covariance
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.msg import (
    LaserScan,
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
from instant_ic.slam.localization import FoundPlace
from instant_ic.slam.loop_closure import LoopOutcome
from instant_ic.slam.odometry import CorrectionLimiter
from instant_ic.slam.scan import FloatArray
from instant_ic.slam.scan_queue import ScanError, level_mount
from instant_ic.util.diagnosis import Diagnosis, Level


def read_scan(message: LaserScan, mounts: TransformBuffer) -> tuple[Scan, FloatArray]:
    """Return the scan of a LaserScan, and the laser's planar mount (3,) on the robot.

    Raises:
        ScanError: the mount is not known yet or the scan cannot be used.
    """
    angles = (float(message.angle_min), float(message.angle_increment))
    limits = (float(message.range_min), float(message.range_max))
    try:
        mount = level_mount(mounts.lookup("base_link", message.header.frame_id))
        return Scan(np.asarray(message.ranges), *angles, *limits, stamp_ns(message)), mount
    except TransformError as error:
        raise ScanError(f"The laser's mount is not known yet: {error}") from None
    except ValueError as error:
        raise ScanError(f"The scan cannot be used: {error}") from None


def integrity_message(slam: GridSlam, result: SlamResult, stamp: int) -> Any:
    """Return the PoseIntegrity message after a scan with this result."""
    trust, found = result.integrity, slam.contradiction
    return PoseIntegrity(
        header=header("map", stamp),
        lost_probability=trust.lost_probability,
        position_bound_m=trust.position_bound_m,
        heading_bound_rad=trust.heading_bound_rad,
        localized=result.localized,
        status=result.status.value,
        contradiction=int(found.state),
        contradictions=found.count,
    )


def pose_message(result: SlamResult, stamp: int) -> Any:
    """Return the PoseWithCovarianceStamped message after a scan."""
    covariance = planar_covariance(result.covariance).reshape(36)
    pose = PoseWithCovariance(pose=_pose(matrix_from_pose2(result.map_from_base)), covariance=covariance)
    return PoseWithCovarianceStamped(header=header("map", stamp), pose=pose)


def read_mounts(message: TFMessage, mounts: TransformBuffer) -> None:
    """Put the fixed transforms of a TFMessage into a buffer."""
    for mount in message.transforms:
        parent, child = mount.header.frame_id, mount.child_frame_id
        mounts.set(parent, child, stamp_ns(mount), transform_matrix(mount), static=True)


def read_initial_pose(message: PoseWithCovarianceStamped) -> FloatArray:
    """Return the pose (3,) of a robot that was set by hand.

    Raises:
        ValueError: the pose is in another frame than the map's.
    """
    if message.header.frame_id not in ("", "map"):
        raise ValueError(f"the pose is in frame {message.header.frame_id!r}, not 'map'")
    return pose2_from_message(message)


def map_message(slam: GridSlam, stamp: int) -> Any:
    """Return the map as an OccupancyGrid."""
    values, resolution, origin = slam.grid()
    return grid_message(values, resolution, (float(origin[0]), float(origin[1])), "map", stamp)


def transforms(
    slam: GridSlam, limiter: CorrectionLimiter, stamp_ns: int, with_odometry: bool
) -> Iterator[tuple[str, str, Matrix]]:
    """Yield the transforms to broadcast after a scan: parent, child and parent_from_child (4, 4)."""
    if not with_odometry:
        yield "odom", "base_link", matrix_from_pose2(slam.frames.odom_from_base)
    # A lost robot keeps its last map→odom, so that it can drive on slowly until its place is recognized.
    if slam.in_map_frame:
        map_from_odom = limiter.follow(slam.frames.map_from_odom, slam.frames.odom_from_base, stamp_ns)
        yield "map", "odom", matrix_from_pose2(map_from_odom)
    else:
        limiter.reset()


class JobResult(NamedTuple):
    """Result of a background job of a SLAM; ``outcome`` is None, with a diagnosis, if the job failed."""

    slam: GridSlam
    outcome: FoundPlace | LoopOutcome | None
    diagnosis: Diagnosis | None = None


def run_job(item: tuple[GridSlam, Callable[[], FoundPlace | LoopOutcome]]) -> JobResult:
    """Run a ``background_job`` of a SLAM. Any thread may call this."""
    slam, job = item
    try:
        return JobResult(slam, job())
    except Exception as error:  # noqa: BLE001 - a failed job must not stop the processing of scans
        text = f"Loop closure failed ({type(error).__name__}: {error}). Restart the node to use it again"
        return JobResult(slam, None, Diagnosis("loops", Level.ERROR, text))
