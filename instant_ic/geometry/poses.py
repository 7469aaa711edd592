"""Rigid transforms as 4×4 float64 matrices and planar poses as ``(x, y, yaw)`` arrays.

A pose is named ``target_from_source``: ``p_target = target_from_source @ p_source``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Matrix = NDArray[np.float64]
Pose2 = NDArray[np.float64]


def rotation_matrix(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Matrix:
    """Return the rotation matrix (3, 3) about the fixed axes x, y, z in this order (REP-103); angles in radians."""
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def pose_matrix(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0
) -> Matrix:
    """Return the pose (4, 4) from a translation in metres and fixed-axis angles in radians."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(roll, pitch, yaw)
    matrix[:3, 3] = (x, y, z)
    return matrix


def matrix_from_quaternion(xyzw: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> Matrix:
    """Return the pose from a quaternion (x, y, z, w) of any length and a translation.

    Raises:
        ValueError: the quaternion is zero or not finite.
    """
    # Plain floats, because numpy's overhead on arrays of three or four numbers is ten times the arithmetic.
    x, y, z, w = np.asarray(xyzw, dtype=np.float64).tolist()
    tx, ty, tz = np.asarray(translation, dtype=np.float64).tolist()
    norm2 = x * x + y * y + z * z + w * w
    if not math.isfinite(norm2) or norm2 < 1e-12:
        raise ValueError(f"quaternion ({x}, {y}, {z}, {w}) has no direction")
    s = 2.0 / norm2
    return np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w), tx],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w), ty],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y), tz],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def quaternion_from_matrix(matrix: ArrayLike) -> NDArray[np.float64]:
    """Return the unit quaternion (x, y, z, w), w ≥ 0, of a pose or a rotation matrix."""
    return np.array(_quaternion(np.asarray(matrix, dtype=np.float64)))


def _quaternion(matrix: NDArray[np.float64]) -> tuple[float, float, float, float]:
    (a, b, c), (d, e, f), (g, h, i) = matrix[:3, :3].tolist()
    # Dividing by the largest of the four squared components keeps the precision near 180°.
    squares = (1 + a - e - i, 1 - a + e - i, 1 - a - e + i, 1 + a + e + i)
    largest = squares.index(max(squares))
    x, y, z, w = (
        (squares[0], b + d, c + g, h - f),
        (b + d, squares[1], f + h, c - g),
        (c + g, f + h, squares[2], d - b),
        (h - f, c - g, d - b, squares[3]),
    )[largest]
    norm = math.copysign(math.sqrt(x * x + y * y + z * z + w * w), w)
    return x / norm, y / norm, z / norm, w / norm


def inverse(matrix: Matrix) -> Matrix:
    """Return the inverse of a rigid transform."""
    (a, b, c, x), (d, e, f, y), (g, h, i, z), _ = matrix.tolist()
    return np.array(
        [
            [a, d, g, -(a * x + d * y + g * z)],
            [b, e, h, -(b * x + e * y + h * z)],
            [c, f, i, -(c * x + f * y + i * z)],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def transform_points(target_from_source: Matrix, points: NDArray[np.floating]) -> NDArray[np.floating]:
    """Transform points (..., 3) from the source frame to the target frame, in their own float type."""
    rotation = target_from_source[:3, :3].astype(points.dtype)
    translation = target_from_source[:3, 3].astype(points.dtype)
    result: NDArray[np.floating] = points @ rotation.T + translation
    return result


def yaw_of(matrix: Matrix) -> float:
    """Return the yaw of a pose, radians."""
    return math.atan2(matrix[1, 0], matrix[0, 0])


def interpolate(matrix0: Matrix, matrix1: Matrix, alpha: float) -> Matrix:
    """Return the pose between two poses: linear in translation, shortest arc in rotation (slerp).

    ``alpha`` outside 0..1 extrapolates.
    """
    q0, q1 = _quaternion(matrix0), _quaternion(matrix1)
    dot = sum(a * b for a, b in zip(q0, q1, strict=True))
    sign, dot = (-1.0, -dot) if dot < 0 else (1.0, dot)
    if dot > 0.9995:
        share0, share1 = 1.0 - alpha, sign * alpha
    else:
        angle = math.acos(min(dot, 1.0))
        share0 = math.sin((1 - alpha) * angle) / math.sin(angle)
        share1 = sign * math.sin(alpha * angle) / math.sin(angle)
    translation = (1 - alpha) * matrix0[:3, 3] + alpha * matrix1[:3, 3]
    return matrix_from_quaternion([share0 * a + share1 * b for a, b in zip(q0, q1, strict=True)], translation)


def wrap_angle(angle_rad: float) -> float:
    """Return the angle wrapped to (−π, π]."""
    wrapped = math.remainder(angle_rad, 2 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped


def pose2_from_matrix(matrix: Matrix) -> Pose2:
    """Return the planar part ``(x, y, yaw)`` of a pose."""
    return np.array([matrix[0, 3], matrix[1, 3], yaw_of(matrix)])


def matrix_from_pose2(pose: ArrayLike) -> Matrix:
    """Return the pose on the plane z = 0 from ``(x, y, yaw)``."""
    x, y, yaw = np.asarray(pose, dtype=np.float64).tolist()
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def compose2(a: ArrayLike, b: ArrayLike) -> Pose2:
    """Return the planar composition ``a ∘ b``: ``b``, given in the frame of ``a``, in the parent frame of ``a``."""
    ax, ay, ayaw = np.asarray(a, dtype=np.float64).tolist()
    bx, by, byaw = np.asarray(b, dtype=np.float64).tolist()
    c, s = math.cos(ayaw), math.sin(ayaw)
    return np.array([ax + c * bx - s * by, ay + s * bx + c * by, wrap_angle(ayaw + byaw)])


def inverse2(a: ArrayLike) -> Pose2:
    x, y, yaw = np.asarray(a, dtype=np.float64).tolist()
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([-c * x - s * y, s * x - c * y, wrap_angle(-yaw)])


def relative2(a: ArrayLike, b: ArrayLike) -> Pose2:
    """Return ``b`` in the frame of ``a``: ``inverse2(a) ∘ b``."""
    return compose2(inverse2(a), b)


def planar_covariance(covariance: NDArray[np.float64], unmeasured: float = 0.0) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of x, y, z, roll, pitch and yaw from a planar one.

    Args:
        covariance: covariance of x, y and yaw, (3, 3).
        unmeasured: variance of z, roll and pitch.
    """
    full = np.diag(np.full(6, unmeasured))
    planar = np.ix_([0, 1, 5], [0, 1, 5])
    full[planar] = covariance
    return full
