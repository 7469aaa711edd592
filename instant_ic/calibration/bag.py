"""Reads pairs of panorama and LiDAR revolution from a bag, for the camera-LiDAR calibration."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.bag import BagError, BagReader
from instant_ic.calibration.mount import CalibrationError, CalibrationFrame
from instant_ic.geometry.poses import Matrix, inverse, wrap_angle, yaw_of
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.lidar.deskew import points_at
from instant_ic.lidar.stream import PacketStream
from instant_ic.msg import MessageError, cloud_array, deserialize, stamp_ns, transform_matrix
from instant_ic.util.limits import decode_image

IMAGE, CLOUD, PACKETS = (
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/PointCloud2",
    "velodyne_msgs/msg/VelodyneScan",
)
_FIELDS = ("x", "y", "z", "intensity", "ring", "time")
_BASE, _ODOM = "base_link", "odom"
_NEAREST_M = 0.3
_FEW = 12
_DISTANCE_M, _ANGLE_DEG = 0.25, 15.0
"""Motion after which a new place begins."""
_MOST_GAP_S = 0.15
"""Largest time between an image and the middle of its revolution."""


@dataclass(frozen=True)
class CalibrationRecording:
    """Calibration data of a bag.

    Attributes:
        frames: pairs of image and revolution, from as many places as the recording has.
        camera_from_lidar: (4, 4) from the transforms in the bag; None if they are missing.
        base_from_lidar: (4, 4) from the transforms in the bag; None if they are missing.
        images: number of images in the bag.
        places: number of places in the recording.
        moves: True if the bag has odometry, which compensates the motion.
    """

    frames: list[CalibrationFrame]
    camera_from_lidar: Matrix | None
    base_from_lidar: Matrix | None
    images: int
    places: int
    moves: bool


@dataclass(frozen=True)
class CalibrationCloud:
    points: NDArray[Any]
    stamp_ns: int
    frame_id: str

    @property
    def middle_ns(self) -> int:
        time = self.points["time"]
        return self.stamp_ns + round(0.5e9 * float(time.min() + time.max()))


def read_recording(path: Path, most_frames: int = 24) -> CalibrationRecording:
    """Read at most ``most_frames`` images of a bag, with a revolution of ``/lidar/points`` or ``/lidar/packets`` each.

    Raises:
        BagError: the path is not a bag, or the bag is damaged.
        CalibrationError: the bag lacks images or revolutions, or none of them coincide in time.
    """
    with BagReader(path) as bag:
        image_topic = _choose(bag, (IMAGE,), ("/camera/image/compressed",))
        transforms = _transforms(bag)
        stamps, camera = _stamps(bag, image_topic)
        moves = {_BASE, _ODOM} <= transforms.frames()

        def odom_from(frame: str, stamp: int) -> Matrix:
            return transforms.lookup(_ODOM, frame, stamp) if moves else np.eye(4)

        chosen, places = _places(stamps, odom_from, most_frames)
        if not chosen:
            raise CalibrationError(f"{path}: odometry on /tf does not overlap in time with the {len(stamps)} images")
        clouds = _nearest_clouds(bag, list(chosen))
        frames = []
        for message in bag.messages([image_topic]):
            image = deserialize(message.payload, message.type_name)
            stamp = stamp_ns(image)
            if stamp in clouds:
                rgb = _decoded(path, image)
                try:
                    frames.append(_frame(rgb, clouds[stamp], stamp, chosen[stamp], odom_from))
                except TransformError as error:
                    raise CalibrationError(f"{path}: no odometry at {stamp / 1e9:.3f} s: {error}") from None
    lidar = next(iter(clouds.values())).frame_id
    return CalibrationRecording(
        frames=frames,
        camera_from_lidar=_known(transforms, camera, lidar),
        base_from_lidar=_known(transforms, _BASE, lidar),
        images=len(stamps),
        places=places,
        moves=moves,
    )


def _transforms(bag: BagReader) -> TransformBuffer:
    buffer = TransformBuffer(cache_s=1e9)
    recorded = {topic.topic for topic in bag.topics}
    for message in bag.messages([topic for topic in ("/tf_static", "/tf") if topic in recorded]):
        for one in deserialize(message.payload, message.type_name).transforms:
            try:
                buffer.set(
                    one.header.frame_id, one.child_frame_id, stamp_ns(one), transform_matrix(one),
                    static=message.topic == "/tf_static",
                )  # fmt: skip
            except (TransformError, MessageError) as error:
                raise BagError(f"{bag.path}: {message.topic}: {error}") from None
    return buffer


def _clouds(bag: BagReader, near: Callable[[int], bool]) -> Iterator[CalibrationCloud]:
    """Yield the revolutions, from points or packets, for which ``near`` accepts the time (ns) of the message."""
    topic = _choose(bag, (CLOUD, PACKETS), ("/lidar/points", "/lidar/packets"))
    stream = PacketStream()
    for message in bag.messages([topic]):
        if message.type_name == CLOUD:
            if near(message.stamp_ns):
                cloud = deserialize(message.payload, message.type_name)
                yield CalibrationCloud(cloud_array(cloud), stamp_ns(cloud), cloud.header.frame_id)
            continue
        scan = deserialize(message.payload, message.type_name)
        for packet in scan.packets:
            revolution = stream.feed(bytes(packet.data), stamp_ns(packet))
            if revolution is not None and revolution.complete and near(revolution.end_ns):
                yield CalibrationCloud(revolution.points, revolution.stamp_ns, scan.header.frame_id)


def _choose(bag: BagReader, kinds: tuple[str, ...], usual: tuple[str, ...]) -> str:
    """Return the first of the usual topics, or the only one of these types."""
    types = {topic.topic: topic.type_name for topic in bag.topics}
    found = [topic for topic, kind in types.items() if kind in kinds]
    choice = next((topic for topic in usual if topic in found), found[0] if len(found) == 1 else "")
    if not choice:
        names = " or ".join(kind.rsplit("/", 1)[-1] for kind in kinds)
        there = ", ".join(found or types) or "none"
        raise CalibrationError(f"{bag.path}: no {' or '.join(usual)} ({names}); topics of the bag: {there}")
    return choice


def _stamps(bag: BagReader, topic: str) -> tuple[list[int], str]:
    """Return the stamps of the images in rising order, and their frame id."""
    headers = [deserialize(message.payload, message.type_name).header for message in bag.messages([topic])]
    if not headers:
        raise CalibrationError(f"{bag.path}: no image on {topic}")
    return sorted({stamp_ns(each) for each in headers}), headers[-1].frame_id


def _known(transforms: TransformBuffer, target: str, source: str) -> Matrix | None:
    try:
        return transforms.lookup(target, source)
    except TransformError:
        return None


def _places(stamps: list[int], odom_from: Callable[[str, int], Matrix], most_frames: int) -> tuple[dict[int, int], int]:
    """Select images: stamp → number of its place; and the number of places.

    The drive is divided into sections, each of which ends when the robot has moved or turned enough. Each section
    contributes the image of its slowest moment, where errors of the stamps matter least. A place is a position,
    independent of the heading.
    """
    centres: list[NDArray[np.float64]] = []
    place: dict[int, int] = {}
    best: list[tuple[float, int]] = []  # speed and stamp of each section
    start: Matrix | None = None
    for stamp in stamps:
        try:
            before, pose, after = (odom_from(_BASE, stamp + shift) for shift in (-50_000_000, 0, 50_000_000))
        except TransformError:
            continue  # outside the odometry: cannot be compensated
        speed = sum(_moved(before, after)) / 0.1
        near = [k for k, xyz in enumerate(centres) if np.linalg.norm(xyz - pose[:3, 3]) < _DISTANCE_M]
        if not near:
            centres.append(pose[:3, 3])
        place[stamp] = near[0] if near else len(centres) - 1
        distance, angle = (np.inf, 0.0) if start is None else _moved(start, pose)
        if distance >= _DISTANCE_M or np.degrees(angle) >= _ANGLE_DEG:
            start = pose
            best.append((speed, stamp))
        elif speed < best[-1][0]:
            best[-1] = (speed, stamp)
    chosen = _evenly([stamp for _, stamp in best], most_frames)
    rest = [stamp for stamp in place if stamp not in chosen]
    chosen += _evenly(rest, max(min(_FEW, most_frames) - len(chosen), 0))
    return {stamp: place[stamp] for stamp in sorted(chosen)}, len(centres)


def _moved(a: Matrix, b: Matrix) -> tuple[float, float]:
    """Return the distance in metres and yaw in radians between two poses."""
    return float(np.linalg.norm(b[:3, 3] - a[:3, 3])), abs(wrap_angle(yaw_of(b) - yaw_of(a)))


def _evenly(values: list[int], most: int) -> list[int]:
    if len(values) <= most:
        return list(values)
    return [values[round(k)] for k in np.linspace(0, len(values) - 1, most)] if most else []


def _nearest_clouds(bag: BagReader, stamps: list[int]) -> dict[int, CalibrationCloud]:
    """Return the revolution nearest in time to each stamp; stamps without a near enough revolution are left out."""
    # The bag stamps messages on arrival, up to a second late on a busy machine.
    at = np.array(stamps)
    found: dict[int, CalibrationCloud] = {}
    count = 0
    for cloud in _clouds(bag, lambda ns: bool((np.abs(at - ns) < 1_500_000_000).any())):
        missing = [name for name in _FIELDS if name not in (cloud.points.dtype.names or ())]
        if missing:
            raise CalibrationError(f"{bag.path}: the points lack the field {', '.join(missing)}")
        count += 1
        if len(cloud.points) == 0:
            continue
        middle = cloud.middle_ns
        for stamp in stamps:
            gap = abs(middle - stamp)
            if gap <= _MOST_GAP_S * 1e9 and (stamp not in found or gap < abs(found[stamp].middle_ns - stamp)):
                found[stamp] = cloud
    if not found:
        raise CalibrationError(
            f"{bag.path}: {count} revolutions, none within {_MOST_GAP_S} s of "
            f"one of the {len(stamps)} selected images. Check that both clocks were synchronised."
        )
    return found


def _decoded(path: Path, image: Any) -> NDArray[np.uint8]:
    import cv2

    bgr = decode_image(bytes(image.data), cv2.IMREAD_COLOR)
    if bgr is None:
        raise CalibrationError(f"{path}: the image at {stamp_ns(image) / 1e9:.3f} s cannot be decoded")
    if bgr.shape[1] != 2 * bgr.shape[0]:
        raise CalibrationError(f"{path}: an image of {bgr.shape[1]} x {bgr.shape[0]} is not a full panorama (2:1)")
    return np.ascontiguousarray(bgr[..., ::-1])


def _frame(
    rgb: NDArray[np.uint8], cloud: CalibrationCloud, stamp: int, place: int, odom_from: Callable[[str, int], Matrix]
) -> CalibrationFrame:
    """Build a frame of image and revolution, with the points moved to the LiDAR's pose at the time of the image."""
    points = cloud.points
    xyz = np.stack([points[name] for name in "xyz"], axis=1).astype(np.float64)
    usable = np.isfinite(xyz).all(axis=1) & np.isfinite(points["time"])
    usable &= np.linalg.norm(np.where(usable[:, None], xyz, 0), axis=1) > _NEAREST_M
    kept, lidar_from_odom = points[usable], inverse(odom_from(cloud.frame_id, stamp))
    xyz = points_at(
        xyz[usable], kept["time"], cloud.stamp_ns, lambda at: lidar_from_odom @ odom_from(cloud.frame_id, at)
    )
    return CalibrationFrame(rgb, xyz, kept["intensity"].astype(np.float64), kept["ring"].astype(np.int64), place)
