"""Messages: numpy on both sides, CDR there and back, foreign bytes refused."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from instant_ic import msg
from instant_ic.geometry.poses import pose_matrix
from instant_ic.lidar.decode import POINT_DTYPE


def round_trip(message):
    return msg.deserialize(bytes(msg.serialize(message)), msg.type_name(message))


def test_cdr_bytes_by_hand():
    # Encapsulation 00 01 00 00 (little-endian CDR), sec i32, nanosec u32.
    assert bytes(msg.serialize(msg.to_time(3_000_000_007))) == bytes.fromhex("00010000 03000000 07000000")


@pytest.mark.parametrize(
    ("dtype", "shape", "encoding"),
    [("u1", (3, 5), "mono8"), ("u1", (3, 5, 3), "bgr8"), ("<f4", (3, 5), "32FC1"), ("<u2", (2, 2), "16UC1")],
)
def test_image_there_and_back(dtype, shape, encoding):
    array = np.arange(math.prod(shape)).reshape(shape).astype(dtype)
    out = round_trip(msg.image_message(array, encoding, "camera", 5))
    assert msg.stamp_ns(out) == 5 and out.header.frame_id == "camera"
    assert (msg.image_array(out) == array).all() and msg.image_array(out).dtype == array.dtype


def test_image_with_padded_rows_and_too_few_bytes():
    message = msg.image_message(np.arange(6, dtype=np.uint8).reshape(2, 3), "mono8", "c", 0)
    message.step, message.data = 4, np.array([0, 1, 2, 99, 3, 4, 5, 99], np.uint8)
    assert msg.image_array(message).tolist() == [[0, 1, 2], [3, 4, 5]]
    message.data = message.data[:5]
    with pytest.raises(msg.MessageError, match="has only 5 bytes"):
        msg.image_array(message)
    with pytest.raises(msg.MessageError, match="does not fit encoding bgr8"):
        msg.image_message(np.zeros((2, 2), np.uint8), "bgr8", "c", 0)


def test_cloud_keeps_the_ros_layout():
    points = np.zeros(3, POINT_DTYPE)
    points["x"], points["ring"], points["time"] = [1, 2, 3], [0, 7, 15], [0, 0.05, 0.1]
    out = round_trip(msg.cloud_message(points, "velodyne", 9))
    assert out.point_step == 22
    assert [(f.name, f.offset, f.datatype) for f in out.fields] == [
        ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("time", 18, 7),
    ]  # fmt: skip
    assert (msg.cloud_array(out) == points).all()
    assert msg.cloud_xyz(out)[:, 0].tolist() == [1, 2, 3]


def test_scan_grid_path_odometry():
    scan = round_trip(msg.scan_message([1, np.inf, -np.inf], -1.0, 0.5, 0.1, 30, "velodyne", 1))
    assert scan.angle_max == pytest.approx(0.0) and scan.ranges.tolist() == [1, np.inf, -np.inf]
    grid = np.array([[-1, 0], [50, 100], [0, 0]], np.int8)
    array, resolution, origin = msg.grid_array(round_trip(msg.grid_message(grid, 0.05, (-1.5, 2.0), "map", 1)))
    assert (array == grid).all() and resolution == pytest.approx(0.05) and origin == (-1.5, 2.0)
    poses = np.array([[1, 2, 0.5], [3, 4, -3.0]])
    assert msg.path_array(round_trip(msg.path_message(poses, "map", 1))) == pytest.approx(poses)
    matrix = pose_matrix(1, 2, 0, yaw=0.7)
    odometry = round_trip(msg.odometry_message(matrix, 0.4, -0.2, "odom", "base_link", 1))
    assert msg.matrix_from_pose(odometry) == pytest.approx(matrix)
    assert msg.twist_values(odometry) == (0.4, -0.2)
    transform = round_trip(msg.transform_message(matrix, "odom", "base_link", 4))
    assert msg.transform_matrix(transform) == pytest.approx(matrix)


def test_our_own_types_and_constants():
    assert msg.ControlState.VIRTUAL == 1
    assert msg.message_type("instant_ic_msgs/Keyframe") is msg.Keyframe
    packet = msg.VelodynePacket(stamp=msg.to_time(1), data=np.arange(1206, dtype=np.uint32).astype(np.uint8))
    scan = msg.VelodyneScan(header=msg.header("velodyne", 2), packets=[packet, packet])
    assert (round_trip(scan).packets[1].data == packet.data).all()


def test_unknown_and_wrong():
    with pytest.raises(ImportError):
        exec("from instant_ic.msg import NoSuchType")
    with pytest.raises(msg.MessageError, match="no message type"):
        msg.message_type("foo_msgs/Bar")
    with pytest.raises(msg.MessageError, match="VelodynePacket"):
        msg.serialize(msg.VelodynePacket(stamp=msg.to_time(1), data=np.zeros(3, np.uint8)))
    with pytest.raises(msg.MessageError, match="is not a message"):
        msg.serialize(object())
    with pytest.raises(msg.MessageError, match="quaternion"):
        pose = msg.pose_message(np.eye(4))
        pose.orientation.w = 0.0
        msg.matrix_from_pose(pose)


@settings(max_examples=200)
@given(st.binary(max_size=200), st.sampled_from(["Odometry", "LaserScan", "Keyframe", "TFMessage", "CompressedImage"]))
def test_foreign_bytes_are_an_error_or_a_message_never_a_crash(data, name):
    try:
        message = msg.deserialize(data, name)
    except msg.MessageError as error:
        assert f"{len(data)} bytes are not a" in str(error)
    else:
        assert msg.type_name(message).endswith(name)


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_time_there_and_back(ns):
    assert msg.stamp_ns(round_trip(msg.to_time(ns))) == ns
