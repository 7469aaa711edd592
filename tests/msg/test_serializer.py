"""Our way of writing CDR beside rosbags' own: the same bytes, whatever the memory held before."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from instant_ic.msg import (
    MessageError,
    String,
    cloud_message,
    compressed_image_message,
    deserialize,
    grid_message,
    header,
    image_message,
    message_type,
    odometry_message,
    path_message,
    scan_message,
    serialize,
    serializer,
    transform_message,
    type_name,
    typestore,
)

text = st.text(max_size=12)
stamp = st.integers(0, 2**31 * 10**9 - 1)
counts = st.integers(0, 40) | st.integers(5_000, 6_000)


def noise(count: int, dtype: str = "u1") -> np.ndarray:
    data = np.random.default_rng(count).integers(0, 256, count * np.dtype(dtype).itemsize, dtype=np.uint8)
    return data.view(dtype)


def numbers(count: int) -> np.ndarray:
    return np.random.default_rng(count).normal(size=count).astype(np.float32)


def keyframe(frame: str, at: int, count: int):
    kind = message_type("Keyframe")
    values = {}
    for name, (node, detail) in ((f[0], f[1]) for f in typestore().fielddefs["instant_ic_msgs/msg/Keyframe"][1]):
        field = detail if isinstance(detail, str) else detail[0]
        if field == "std_msgs/msg/Header":
            values[name] = header(frame, at)
        elif field == "sensor_msgs/msg/CompressedImage":
            values[name] = compressed_image_message(noise(count), frame, at)
        elif field == "sensor_msgs/msg/Image":
            values[name] = image_message(numbers(count * 4).reshape(-1, 4), "32FC1", frame, at)
        elif field == "geometry_msgs/msg/Pose":
            values[name] = odometry_message(np.eye(4), 0, 0, "a", "b", 0).pose.pose
        elif field == "string":
            values[name] = frame
        else:
            values[name] = 3 if "int" in str(field) else 0.5
        assert node is not None
    return kind(**values)


def make(kind: str, frame: str, at: int, count: int):
    match kind:
        case "Image":
            return image_message(noise(count * 3).reshape(1, -1, 3), "rgb8", frame, at)
        case "CompressedImage":
            return compressed_image_message(noise(count), frame, at)
        case "PointCloud2":
            points = np.zeros(count, [("x", "<f4"), ("y", "<f4"), ("t", "<u2")])
            points["x"] = numbers(count)
            return cloud_message(points, frame, at)
        case "OccupancyGrid":
            return grid_message(noise(count, "i1").reshape(1, -1), 0.05, (1.0, 2.0), frame, at)
        case "LaserScan":
            return scan_message(numbers(count), -3.0, 0.01, 0.1, 30.0, frame, at, numbers(count))
        case "Odometry":
            return odometry_message(np.eye(4), 1.0, 2.0, frame, frame + "x", at)
        case "Path":
            return path_message(np.ones((count % 50, 3)), frame, at)
        case "TFMessage":
            return message_type("TFMessage")([transform_message(np.eye(4), frame, "c", at)] * (count % 4))
        case "Keyframe":
            return keyframe(frame, at, count)
        case "String":
            return String(data=frame * (count // 4))
    raise AssertionError(kind)


KINDS = (
    "Image", "CompressedImage", "PointCloud2", "OccupancyGrid", "LaserScan", "Odometry", "Path", "TFMessage",
    "Keyframe", "String",
)  # fmt: skip


@settings(max_examples=150, deadline=None)
@given(kind=st.sampled_from(KINDS), frame=text, at=stamp, count=counts, dirt=st.integers(1, 255))
def test_same_bytes_as_rosbags_in_memory_that_held_something(kind, frame, at, count, dirt) -> None:
    message = make(kind, frame, at, count)
    name = type_name(message)
    want = bytes(typestore().serialize_cdr(message, name))
    size, write = serializer(message)
    memory = bytearray([dirt]) * size
    write(memoryview(memory))
    assert bytes(memory) == want
    assert bytes(serialize(message)) == want
    assert bytes(serialize(deserialize(want, name))) == want


def test_wrong_value_names_the_type() -> None:
    with pytest.raises(MessageError, match="std_msgs/msg/String"):
        serialize(String(data=5))
    scan = scan_message(numbers(10), -3.0, 0.01, 0.1, 30.0, "velodyne", 0)
    scan.range_min = None
    with pytest.raises(MessageError, match="field range_min is missing"):
        serialize(scan)
