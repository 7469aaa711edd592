"""Flat scan of a revolution, compensated by the base's motion from the transform buffer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.poses import pose2_from_matrix
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.lidar.config import FlatScanConfig
from instant_ic.lidar.flatscan import flat_scan
from instant_ic.lidar.motion import MotionError, PlanarMotion
from instant_ic.lidar.stream import Revolution
from instant_ic.util.diagnosis import Diagnosis, Level

_SAMPLES = 13
_LEAST_NS = 50_000_000


def compensated_scan(
    revolution: Revolution, base_from_lidar: NDArray[np.float64], config: FlatScanConfig, tf: TransformBuffer
) -> tuple[NDArray[np.float32], Diagnosis]:
    """Return the flat scan of a revolution, and a diagnosis of its motion compensation.

    Args:
        revolution: decoded points.
        base_from_lidar: mount of the sensor, (4, 4).
        config: height interval and beams.
        tf: holds ``odom`` to ``base_link``; without it the base is assumed to stand still.

    Returns:
        Ranges as in `flat_scan`, (beams,), and the diagnosis ``motion``.
    """
    try:
        motion = base_motion(tf, revolution.stamp_ns, revolution.end_ns)
        text = "no odometry: the base is assumed to stand still" if motion is None else "scan is motion-compensated"
        return flat_scan(revolution, base_from_lidar, config, motion), Diagnosis("motion", Level.OK, text)
    except (MotionError, TransformError) as error:
        state = Diagnosis("motion", Level.WARN, f"scan is not motion-compensated: {error}")
    return flat_scan(revolution, base_from_lidar, config, None), state


def base_pose(tf: TransformBuffer) -> NDArray[np.float64]:
    """Return the newest pose of the base in ``odom``, (3,); the origin if it is unknown."""
    try:
        return pose2_from_matrix(tf.lookup("odom", "base_link"))
    except TransformError:
        return np.zeros(3)


def base_motion(tf: TransformBuffer, start_ns: int, end_ns: int) -> PlanarMotion | None:
    """Return the poses of the base around a revolution; None if they are not published.

    Raises:
        TransformError: the poses of this time are missing.
    """
    newest_ns = tf.newest_ns("base_link")
    if newest_ns is None:
        return None
    # Odometry of the last milliseconds has not arrived yet: the motion is extrapolated.
    stop_ns = min(end_ns, newest_ns)
    stamps_ns = np.linspace(min(start_ns, stop_ns - _LEAST_NS), stop_ns, _SAMPLES).astype(np.int64)
    poses = [pose2_from_matrix(tf.lookup("odom", "base_link", int(stamp))) for stamp in stamps_ns]
    return PlanarMotion(stamps_ns, np.array(poses))
