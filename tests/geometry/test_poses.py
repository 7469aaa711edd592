"""Poses: values by hand, and scipy's rotations as the oracle."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from instant_ic.geometry import poses

angles = st.floats(-3.1, 3.1)


@given(angles, angles, angles)
def test_rotation_agrees_with_scipy(roll, pitch, yaw):
    expected = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    assert poses.rotation_matrix(roll, pitch, yaw) == pytest.approx(expected, abs=1e-12)


@given(angles, angles, angles, st.tuples(*[st.floats(-9, 9)] * 3))
def test_quaternion_there_and_back(roll, pitch, yaw, xyz):
    matrix = poses.pose_matrix(*xyz, roll, pitch, yaw)
    q = poses.quaternion_from_matrix(matrix)
    assert q[3] >= 0 and np.linalg.norm(q) == pytest.approx(1)
    assert poses.matrix_from_quaternion(q, xyz) == pytest.approx(matrix, abs=1e-9)
    assert poses.matrix_from_quaternion(3 * q, xyz) == pytest.approx(matrix, abs=1e-9)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0.8, 0)])
def test_quaternion_of_half_a_turn(axis):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(math.pi * np.array(axis)).as_matrix()
    assert poses.matrix_from_quaternion(poses.quaternion_from_matrix(matrix)) == pytest.approx(matrix, abs=1e-9)


@pytest.mark.parametrize("bad", [(0, 0, 0, 0), (math.nan, 0, 0, 1), (math.inf, 0, 0, 1)])
def test_quaternion_without_direction(bad):
    with pytest.raises(ValueError, match="no direction"):
        poses.matrix_from_quaternion(bad)


def test_transform_points_by_hand():
    # Turned left by 90° and moved to (1, 2, 3): the point one metre ahead lies one metre to the left of there.
    matrix = poses.pose_matrix(1, 2, 3, yaw=math.pi / 2)
    points = np.array([[1.0, 0, 0], [0, 1, 0]], np.float32)
    moved = poses.transform_points(matrix, points)
    assert moved.dtype == np.float32
    assert moved == pytest.approx(np.array([[1, 3, 3], [0, 2, 3]]), abs=1e-6)


@given(angles, angles, angles, st.floats(0, 1))
def test_interpolation_agrees_with_scipys_slerp(roll, pitch, yaw, alpha):
    a, b = poses.pose_matrix(0, 0, 0, 0.3, -0.2, 0.1), poses.pose_matrix(2, 4, 6, roll, pitch, yaw)
    key = Rotation.from_matrix(np.stack([a[:3, :3], b[:3, :3]]))
    if (key[0].inv() * key[1]).magnitude() > math.pi - 1e-3:  # two arcs of the same length
        return
    middle = poses.interpolate(a, b, alpha)
    assert middle[:3, 3] == pytest.approx(alpha * np.array([2, 4, 6]), abs=1e-9)
    assert middle[:3, :3] == pytest.approx(Slerp([0, 1], key)(alpha).as_matrix(), abs=1e-4)


@given(st.floats(-1000, 1000))
def test_wrap_angle(angle):
    wrapped = poses.wrap_angle(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


poses2 = st.tuples(st.floats(-9, 9), st.floats(-9, 9), angles).map(np.array)


@given(poses2, poses2)
def test_planar_poses_agree_with_matrices(a, b):
    product = poses.pose2_from_matrix(poses.matrix_from_pose2(a) @ poses.matrix_from_pose2(b))
    composed = poses.compose2(a, b)
    assert composed[:2] == pytest.approx(product[:2], abs=1e-9)
    assert poses.wrap_angle(composed[2] - product[2]) == pytest.approx(0, abs=1e-9)
    back = poses.compose2(a, poses.relative2(a, b))
    assert back[:2] == pytest.approx(b[:2], abs=1e-9)
