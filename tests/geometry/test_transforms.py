"""The transform buffer."""

import math

import numpy as np
import pytest

from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.transforms import TransformBuffer, TransformError

S = 1_000_000_000


@pytest.fixture
def buffer():
    buffer = TransformBuffer(cache_s=10)
    buffer.set("base_link", "camera", 0, pose_matrix(z=1.2), static=True)
    buffer.set("base_link", "velodyne", 0, pose_matrix(x=0.1, z=0.6), static=True)
    buffer.set("odom", "base_link", 10 * S, pose_matrix(x=0))
    buffer.set("odom", "base_link", 12 * S, pose_matrix(x=2, yaw=math.pi / 2))
    buffer.set("map", "odom", 10 * S, pose_matrix(y=5))
    buffer.set("map", "odom", 12 * S, pose_matrix(y=5))
    return buffer


def test_chain_with_interpolation(buffer):
    # Half-way: 1 m ahead, turned by 45°, and the LiDAR 0.1 m ahead of that.
    position = buffer.lookup("map", "velodyne", 11 * S)[:3, 3]
    d = 0.1 * math.sqrt(0.5)
    assert position == pytest.approx([1 + d, 5 + d, 0.6])


def test_newest_without_a_time_and_both_directions(buffer):
    assert buffer.lookup("map", "base_link")[:3, 3] == pytest.approx([2, 5, 0])
    # Seen from the robot, which looks along the map's y at (2, 5): the origin is 5 m behind and 2 m to its left.
    assert buffer.lookup("base_link", "map")[:3, 3] == pytest.approx([-5, 2, 0])
    assert buffer.lookup("camera", "velodyne")[:3, 3] == pytest.approx([0.1, 0, -0.6])
    assert buffer.lookup("camera", "camera") == pytest.approx(np.eye(4))


def test_values_out_of_order_and_twice(buffer):
    buffer.set("odom", "base_link", 11 * S, pose_matrix(x=9))
    assert buffer.lookup("odom", "base_link", 11 * S)[0, 3] == 9
    buffer.set("odom", "base_link", 11 * S, pose_matrix(x=1))
    assert buffer.lookup("odom", "base_link", 11 * S)[0, 3] == 1


def test_a_clock_that_was_set_back_freezes_no_frame(buffer):
    buffer.set("odom", "base_link", 9 * S, pose_matrix(x=3), now_ns=9 * S)  # newest so far: x=2 at 12 s
    assert buffer.lookup("odom", "base_link")[0, 3] == 3
    with pytest.raises(TransformError, match="after the newest"):
        buffer.lookup("odom", "base_link", 11 * S)
    assert buffer.lookup("map", "odom")[1, 3] == 5  # each frame by its own stamps
    # A message from before the setting arrives after it.
    buffer.set("odom", "base_link", 12 * S, pose_matrix(x=2), now_ns=9 * S)
    buffer.set("odom", "base_link", 10 * S, pose_matrix(x=4), now_ns=10 * S)
    assert buffer.lookup("odom", "base_link")[0, 3] == 4


def test_old_values_of_another_sender_drop_nothing(buffer):
    buffer.set("odom", "base_link", 1 * S, pose_matrix(x=3), now_ns=12 * S)
    assert buffer.lookup("odom", "base_link")[0, 3] == 2
    assert buffer.lookup("odom", "base_link", 11 * S)[0, 3] == pytest.approx(1)


def test_outside_what_is_held(buffer):
    with pytest.raises(TransformError, match=r"odom → base_link: asked for 3\.000 s after the newest"):
        buffer.lookup("odom", "base_link", 15 * S)
    with pytest.raises(TransformError, match=r"before the oldest"):
        buffer.lookup("odom", "base_link", 5 * S)
    # A little after the newest value is what drivers ask for all the time: the newest value holds.
    assert buffer.lookup("odom", "base_link", 12 * S + S // 10)[0, 3] == 2


@pytest.mark.parametrize("pair", [("map", "gripper"), ("gripper", "map")])
def test_unknown_frame(buffer, pair):
    with pytest.raises(TransformError, match="no path"):
        buffer.lookup(*pair)


def test_bad_values(buffer):
    with pytest.raises(TransformError, match="not a finite"):
        buffer.set("odom", "base_link", 13 * S, np.full((4, 4), np.nan))
    with pytest.raises(TransformError, match="loop"):
        buffer.set("camera", "map", 13 * S, np.eye(4))


def test_old_values_are_let_go():
    buffer = TransformBuffer(cache_s=1)
    for i in range(1000):
        buffer.set("odom", "base_link", i * S // 50, pose_matrix(x=i))
    assert len(buffer._edges["base_link"].stamps_ns) < 130
    assert buffer.lookup("odom", "base_link", 999 * S // 50)[0, 3] == 999
