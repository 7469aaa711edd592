"""Laser scans of a bag, with odometry and the laser's mount, in the format of the log readers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from instant_ic.bag import BagError, BagReader
from instant_ic.experiments.slam_logs import LogEntry, LogError
from instant_ic.geometry.poses import Pose2, pose2_from_matrix
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.msg import deserialize, pose2_from_message, stamp_ns, transform_matrix
from instant_ic.slam import Scan
from instant_ic.slam.odometry import OdometryBuffer

_SCAN, _ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag: a folder, or a file with a bag's extension."""
    return path.is_dir() or path.suffix in (".mcap", ".db3")


def read_bag(path: Path, scan_topic: str | None = None) -> Iterator[LogEntry]:
    """Scans of a bag: of ``scan_topic``, or of ``/scan``, or of the only topic of type LaserScan.

    Odometry comes from the bag's Odometry topic (``/wheel/odom`` before ``/odom`` before any other), interpolated to
    the scan's stamp; the mount from ``/tf_static``. A scan outside the odometry's time range has none. Without a
    transform to ``base_link``, the laser is assumed to be mounted at the robot's centre.

    Raises:
        LogError: not a bag, no such topic, or a malformed scan.
    """
    try:
        with BagReader(path) as bag:
            types = {summary.topic: summary.type_name for summary in bag.topics}
            topic = _choose(path, types, _SCAN, scan_topic, ("/scan",))
            if topic is None:
                raise LogError(f"{path}: the bag has no topic of type LaserScan, only {', '.join(types) or 'none'}")
            odometry = OdometryBuffer(keep_s=1e9)
            wheels = _choose(path, types, _ODOMETRY, None, ("/wheel/odom", "/odom"))
            transforms = TransformBuffer()
            for message in bag.messages([name for name in (wheels, "/tf_static") if name in types]):
                value = deserialize(message.payload, message.type_name)
                if message.topic == wheels:
                    odometry.add(stamp_ns(value), pose2_from_message(value))
                    continue
                for one in value.transforms:
                    transforms.set(one.header.frame_id, one.child_frame_id, 0, transform_matrix(one), True)
            scans = 0
            for message in bag.messages([topic]):
                value = deserialize(message.payload, message.type_name)
                stamp = stamp_ns(value)
                try:
                    scan = Scan(
                        np.asarray(value.ranges), float(value.angle_min), float(value.angle_increment),
                        float(value.range_min), float(value.range_max), stamp,
                    )  # fmt: skip
                except ValueError as error:
                    raise LogError(f"{path}: scan {scans + 1} on {topic}: {error}") from None
                scans += 1
                yield LogEntry(scan, odometry.at(stamp), _mount(transforms, value.header.frame_id))
            if scans == 0:
                raise LogError(f"{path}: no scan on {topic}")
    except BagError as error:
        raise LogError(str(error)) from None


def _choose(path: Path, types: dict[str, str], kind: str, wanted: str | None, usual: tuple[str, ...]) -> str | None:
    found = sorted(topic for topic, type_name in types.items() if type_name == kind)
    if wanted is not None:
        if wanted not in found:
            raise LogError(f"{path}: no LaserScan topic {wanted}; available: {', '.join(found) or 'none'}")
        return wanted
    for topic in usual:
        if topic in found:
            return topic
    if len(found) > 1 and kind == _SCAN:
        raise LogError(f"{path}: several LaserScan topics ({', '.join(found)}): choose one with --scan-topic")
    return found[0] if found else None


def _mount(transforms: TransformBuffer, laser_frame: str) -> Pose2:
    try:
        return pose2_from_matrix(transforms.lookup("base_link", laser_frame))
    except TransformError:
        return np.zeros(3)
