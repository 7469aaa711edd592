"""Conversions between messages and arrays."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from instant_ic.geometry.poses import (
    Matrix,
    matrix_from_quaternion,
    pose2_from_matrix,
    quaternion_from_matrix,
    wrap_angle,
)
from instant_ic.msg.types import MessageError, message_type

_POINT_FIELD_TYPES = {
    1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8",
}  # fmt: skip
_POINT_FIELD_CODES = {np.dtype(v): k for k, v in _POINT_FIELD_TYPES.items()}
_IMAGE_CODES = {
    "mono8": ("u1", 1), "8UC1": ("u1", 1), "rgb8": ("u1", 3), "bgr8": ("u1", 3), "8UC3": ("u1", 3),
    "rgba8": ("u1", 4), "bgra8": ("u1", 4), "mono16": ("<u2", 1), "16UC1": ("<u2", 1),
    "32FC1": ("<f4", 1), "32FC3": ("<f4", 3), "64FC1": ("<f8", 1),
}  # fmt: skip
_IMAGE_DTYPES = {encoding: (np.dtype(code), channels) for encoding, (code, channels) in _IMAGE_CODES.items()}


# -- time and header -----------------------------------------------------------------------------


def to_time(ns: int) -> Any:
    """Return a builtin_interfaces/Time from nanoseconds since the epoch."""
    return message_type("Time")(sec=int(ns // 1_000_000_000), nanosec=int(ns % 1_000_000_000))


def stamp_ns(message: Any) -> int:
    """Return the stamp in nanoseconds of a message with a header, of a header, or of a Time.

    Raises:
        MessageError: the message has no stamp.
    """
    value = getattr(message, "header", message)
    value = getattr(value, "stamp", value)
    try:
        return int(value.sec) * 1_000_000_000 + int(value.nanosec)
    except AttributeError:
        raise MessageError(f"{type(message).__name__} carries no stamp") from None


def header(frame_id: str, stamp: int) -> Any:
    """Return a std_msgs/Header."""
    return message_type("Header")(stamp=to_time(stamp), frame_id=frame_id)


# -- images --------------------------------------------------------------------------------------


def image_message(array: NDArray[Any], encoding: str, frame_id: str, stamp: int) -> Any:
    """Return a sensor_msgs/Image from an array (H, W) or (H, W, C). A contiguous array is not copied.

    Raises:
        MessageError: the encoding is unknown, or the array's shape or dtype does not fit it.
    """
    if encoding not in _IMAGE_DTYPES:
        raise MessageError(f"image encoding {encoding!r} is not one of {', '.join(_IMAGE_DTYPES)}")
    dtype, channels = _IMAGE_DTYPES[encoding]
    shape_fits = array.ndim == 2 if channels == 1 else array.ndim == 3 and array.shape[2] == channels
    if not shape_fits or array.dtype != dtype:
        raise MessageError(f"array {array.shape} {array.dtype} does not fit encoding {encoding}")
    height, width = array.shape[:2]
    data = array.ravel().view(np.uint8)
    return message_type("Image")(
        header=header(frame_id, stamp),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=width * channels * dtype.itemsize,
        data=data,
    )


def image_array(message: Any) -> NDArray[Any]:
    """Return the array (H, W) or (H, W, C) of a sensor_msgs/Image, as a read-only view unless rows are padded.

    Raises:
        MessageError: the encoding is unknown, the data is big-endian, or bytes are missing.
    """
    if message.encoding not in _IMAGE_DTYPES:
        raise MessageError(f"image encoding {message.encoding!r} is not one of {', '.join(_IMAGE_DTYPES)}")
    dtype, channels = _IMAGE_DTYPES[message.encoding]
    if message.is_bigendian and dtype.itemsize > 1:
        raise MessageError("big-endian images are not supported: send them little-endian")
    row = message.width * channels * dtype.itemsize
    data, height, width, step = message.data, message.height, message.width, message.step
    if step < row or data.size < step * height:
        raise MessageError(f"image {width}×{height} {message.encoding} with step {step} has only {data.size} bytes")
    shape, strides = (height, width, channels), (step, channels * dtype.itemsize, dtype.itemsize)
    end = None if channels > 1 else 2
    array: NDArray[Any] = np.ndarray(shape[:end], dtype, data, 0, strides[:end])
    return array if step == row else np.ascontiguousarray(array)


def compressed_image_message(
    data: bytes | bytearray | memoryview | NDArray[np.uint8], frame_id: str, stamp: int, format: str = "jpeg"
) -> Any:
    """Return a sensor_msgs/CompressedImage from encoded bytes."""
    array = data if isinstance(data, np.ndarray) else np.frombuffer(data, np.uint8)
    return message_type("CompressedImage")(header=header(frame_id, stamp), format=format, data=array)


# -- points, scans, grids ------------------------------------------------------------------------


def cloud_message(points: NDArray[Any], frame_id: str, stamp: int) -> Any:
    """Return a sensor_msgs/PointCloud2 with the layout and, uncopied, the data of a structured array (N,)."""
    if points.dtype.fields is None or points.ndim != 1:
        raise MessageError(f"a point cloud needs a structured array (N,), got {points.dtype} {points.shape}")
    field_type = message_type("PointField")
    fields = [
        field_type(name=name, offset=int(offset), datatype=_POINT_FIELD_CODES[dtype], count=1)
        for name, (dtype, offset, *_) in points.dtype.fields.items()
    ]
    data = np.ascontiguousarray(points)
    return message_type("PointCloud2")(
        header=header(frame_id, stamp),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=points.dtype.itemsize,
        row_step=points.dtype.itemsize * len(points),
        data=np.frombuffer(data, np.uint8),
        is_dense=True,
    )


def cloud_of_points(xyz: NDArray[np.floating], frame_id: str, stamp: int) -> Any:
    """Return a sensor_msgs/PointCloud2 of points (N, 3) in metres."""
    points = np.zeros(len(xyz), [("x", np.float32), ("y", np.float32), ("z", np.float32)])
    points["x"], points["y"], points["z"] = np.asarray(xyz, np.float32).T
    return cloud_message(points, frame_id, stamp)


@functools.lru_cache(maxsize=16)
def _cloud_dtype(fields: tuple[tuple[str, int, int], ...], step: int) -> np.dtype[Any]:
    return np.dtype(
        {
            "names": [name for name, _, _ in fields],
            "formats": [_POINT_FIELD_TYPES[code] for _, _, code in fields],
            "offsets": [offset for _, offset, _ in fields],
            "itemsize": step,
        }
    )


def cloud_array(message: Any) -> NDArray[Any]:
    """Return the points of a PointCloud2, of all rows, as a structured view (N,).

    Raises:
        MessageError: the data is big-endian, a field's type is unknown, or bytes are missing.
    """
    if message.is_bigendian:
        raise MessageError("big-endian point clouds are not supported")
    try:
        dtype = _cloud_dtype(
            tuple((f.name, int(f.offset), int(f.datatype)) for f in message.fields), int(message.point_step)
        )
    except (KeyError, ValueError) as error:
        raise MessageError(f"point cloud fields cannot be read: {error}") from error
    count = message.width * message.height
    data = np.asarray(message.data)
    if data.size < count * dtype.itemsize:
        raise MessageError(f"point cloud of {count} points × {dtype.itemsize} bytes has only {data.size} bytes")
    return np.ascontiguousarray(data[: count * dtype.itemsize]).view(dtype)


def cloud_xyz(message: Any) -> NDArray[np.float32]:
    """Return the coordinates (N, 3) of a PointCloud2, in metres."""
    return cloud_points(cloud_array(message))


def cloud_points(points: NDArray[Any]) -> NDArray[np.float32]:
    """Return the coordinates (N, 3) of a structured array (N,) with the fields x, y and z."""
    return np.stack([points["x"], points["y"], points["z"]], axis=1).astype(np.float32, copy=False)


def scan_message(
    ranges: ArrayLike,
    angle_min: float,
    angle_increment: float,
    range_min: float,
    range_max: float,
    frame_id: str,
    stamp: int,
    intensities: ArrayLike | None = None,
    scan_time: float = 0.1,
) -> Any:
    """Return a sensor_msgs/LaserScan with ranges in metres; inf is no return (REP-117)."""
    values = np.asarray(ranges, np.float32)
    return message_type("LaserScan")(
        header=header(frame_id, stamp),
        angle_min=float(angle_min),
        angle_max=float(angle_min + angle_increment * (len(values) - 1)),
        angle_increment=float(angle_increment),
        time_increment=0.0,
        scan_time=float(scan_time),
        range_min=float(range_min),
        range_max=float(range_max),
        ranges=values,
        intensities=np.asarray([] if intensities is None else intensities, np.float32),
    )


def grid_message(
    grid: NDArray[np.int8], resolution: float, origin_xy: Sequence[float], frame_id: str, stamp: int
) -> Any:
    """Return a nav_msgs/OccupancyGrid from ``grid`` (H, W) int8: −1 unknown, else 0..100; row 0 has the lowest y."""
    height, width = grid.shape
    origin = np.eye(4)
    origin[:2, 3] = origin_xy[:2]
    info = message_type("MapMetaData")(
        map_load_time=to_time(stamp),
        resolution=float(resolution),
        width=width,
        height=height,
        origin=pose_message(origin),
    )
    return message_type("OccupancyGrid")(
        header=header(frame_id, stamp), info=info, data=np.ascontiguousarray(grid, np.int8).reshape(-1)
    )


def grid_array(message: Any) -> tuple[NDArray[np.int8], float, tuple[float, float]]:
    """Return ``(grid (H, W) int8, resolution in m, (x, y) of the grid's corner)`` from an OccupancyGrid.

    Raises:
        MessageError: the number of cells is not width × height.
    """
    info = message.info
    data = np.asarray(message.data, np.int8)
    if data.size != info.width * info.height:
        raise MessageError(f"grid {info.width}×{info.height} has {data.size} cells")
    position = info.origin.position
    grid = data.reshape(info.height, info.width)
    return grid, float(info.resolution), (float(position.x), float(position.y))


# -- poses and motion ----------------------------------------------------------------------------


def pose_message(matrix: Matrix) -> Any:
    """Return a geometry_msgs/Pose from a 4×4 matrix."""
    x, y, z = matrix[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_from_matrix(matrix).tolist()
    return message_type("Pose")(
        position=message_type("Point")(x=x, y=y, z=z),
        orientation=message_type("Quaternion")(x=qx, y=qy, z=qz, w=qw),
    )


def pose2_from_message(message: Any) -> NDArray[np.float64]:
    """Return the planar pose (3,) of a pose message or Odometry; see `matrix_from_pose` for errors."""
    return pose2_from_matrix(matrix_from_pose(message))


def pose2_message(pose: ArrayLike) -> Any:
    """Return a geometry_msgs/Pose from a planar pose (x, y, yaw)."""
    x, y, yaw = np.asarray(pose, np.float64).tolist()
    half = 0.5 * wrap_angle(yaw)
    return message_type("Pose")(
        position=message_type("Point")(x=x, y=y, z=0.0),
        orientation=message_type("Quaternion")(x=0.0, y=0.0, z=math.sin(half), w=math.cos(half)),
    )


def matrix_from_pose(pose: Any) -> Matrix:
    """Return the 4×4 matrix from a Pose, PoseStamped, PoseWithCovariance(Stamped) or Odometry.

    Raises:
        MessageError: the quaternion is zero or not finite.
    """
    while hasattr(pose, "pose"):
        pose = pose.pose
    return _matrix(pose.orientation, pose.position, "pose")


def _matrix(rotation: Any, translation: Any, what: str) -> Matrix:
    q, t = rotation, translation
    try:
        return matrix_from_quaternion((q.x, q.y, q.z, q.w), (t.x, t.y, t.z))
    except ValueError as error:
        raise MessageError(f"{what}: {error}") from None


def pose_stamped(matrix: Matrix, frame_id: str, stamp: int) -> Any:
    """Return a geometry_msgs/PoseStamped."""
    return message_type("PoseStamped")(header=header(frame_id, stamp), pose=pose_message(matrix))


def transform_message(parent_from_child: Matrix, parent: str, child: str, stamp: int) -> Any:
    """Return a geometry_msgs/TransformStamped."""
    pose = pose_message(parent_from_child)
    translation = message_type("Vector3")(x=pose.position.x, y=pose.position.y, z=pose.position.z)
    return message_type("TransformStamped")(
        header=header(parent, stamp),
        child_frame_id=child,
        transform=message_type("Transform")(translation=translation, rotation=pose.orientation),
    )


def transform_matrix(message: Any) -> Matrix:
    """Return the 4×4 ``parent_from_child`` from a Transform or TransformStamped.

    Raises:
        MessageError: the quaternion is zero or not finite.
    """
    transform = getattr(message, "transform", message)
    return _matrix(transform.rotation, transform.translation, "transform")


def twist_message(v: float = 0.0, w: float = 0.0) -> Any:
    """Return a geometry_msgs/Twist of a planar robot: m/s forward, rad/s counter-clockwise."""
    vector = message_type("Vector3")
    return message_type("Twist")(linear=vector(x=float(v), y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=float(w)))


HARD_STOP = "hard_stop"
"""``frame_id`` of a zero twist that the base executes at its hard deceleration."""


def twist_stamped(v: float, w: float, stamp: int, frame_id: str = "base_link") -> Any:
    """Return a TwistStamped of a planar robot; ``frame_id`` ``HARD_STOP`` demands a stop without the soft ramp."""
    return message_type("TwistStamped")(header=header(frame_id, stamp), twist=twist_message(v, w))


def twist_values(message: Any) -> tuple[float, float]:
    """Return ``(v in m/s, w in rad/s)`` from a Twist, TwistStamped, TwistWithCovariance or Odometry."""
    while hasattr(message, "twist"):
        message = message.twist
    return float(message.linear.x), float(message.angular.z)


def battery_message(voltage_v: float, charge: float, frame_id: str, stamp: int) -> Any:
    """Return a sensor_msgs/BatteryState of a discharging battery, ``charge`` 0-1; unmeasured fields are NaN."""
    state, nan, none = message_type("BatteryState"), float("nan"), np.zeros(0, np.float32)
    return state(
        header=header(frame_id, stamp),
        voltage=voltage_v,
        temperature=nan,
        current=nan,
        charge=nan,
        capacity=nan,
        design_capacity=nan,
        percentage=charge,
        power_supply_status=state.POWER_SUPPLY_STATUS_DISCHARGING,
        power_supply_health=state.POWER_SUPPLY_HEALTH_UNKNOWN,
        power_supply_technology=state.POWER_SUPPLY_TECHNOLOGY_UNKNOWN,
        present=True,
        cell_voltage=none,
        cell_temperature=none,
        location="base",
        serial_number="",
    )


def odometry_message(
    parent_from_child: Matrix,
    v: float,
    w: float,
    frame_id: str,
    child_frame_id: str,
    stamp: int,
    pose_covariance: NDArray[np.float64] | None = None,
    twist_covariance: NDArray[np.float64] | None = None,
) -> Any:
    """Return a nav_msgs/Odometry. Covariances are (6, 6) in the order x y z rx ry rz (REP-103), zero by default."""
    zero = np.zeros((6, 6))
    pose_cov = zero if pose_covariance is None else pose_covariance
    twist_cov = zero if twist_covariance is None else twist_covariance
    return message_type("Odometry")(
        header=header(frame_id, stamp),
        child_frame_id=child_frame_id,
        pose=message_type("PoseWithCovariance")(
            pose=pose_message(parent_from_child),
            covariance=np.ascontiguousarray(pose_cov, np.float64).reshape(36),
        ),
        twist=message_type("TwistWithCovariance")(
            twist=twist_message(v, w), covariance=np.ascontiguousarray(twist_cov, np.float64).reshape(36)
        ),
    )


def path_message(poses: ArrayLike, frame_id: str, stamp: int) -> Any:
    """Return a nav_msgs/Path from planar poses (N, 3)."""
    array, shared = np.asarray(poses, np.float64).reshape(-1, 3), header(frame_id, stamp)
    stamped = message_type("PoseStamped")
    return message_type("Path")(
        header=shared, poses=[stamped(header=shared, pose=pose2_message(pose)) for pose in array]
    )


def path_array(message: Any) -> NDArray[np.float64]:
    """Return the planar poses (N, 3) from a nav_msgs/Path."""
    return np.array([pose2_from_message(p) for p in message.poses]).reshape(-1, 3)
