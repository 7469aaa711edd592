"""Motion of the base during a revolution, from the transform buffer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from instant_ic.geometry.poses import pose2_from_matrix
from instant_ic.geometry.transforms import TransformBuffer, TransformError

_SAMPLES = 13
_LEAST_NS = 50_000_000
_MAX_EXTRAPOLATION_S = 0.2
"""Largest extrapolation beyond the first and the last pose."""


class MotionError(ValueError):
    """The poses do not cover the requested time; the text says which part is missing."""


@dataclass(frozen=True)
class PlanarMotion:
    """Poses of the base over time, interpolated linearly and extrapolated with the velocity of the last poses.

    Attributes:
        stamps_ns: stamps in rising order, (M,), M >= 2.
        odom_from_base: (x, y, yaw), metres and radians, (M, 3).
    """

    stamps_ns: NDArray[np.int64]
    odom_from_base: NDArray[np.float64]

    def at(self, stamps_ns: ArrayLike) -> NDArray[np.float64]:
        """Return the poses at the given times, (..., 3); yaw is not wrapped.

        Raises:
            MotionError: a time is too far before the first or after the last pose.
        """
        wanted = np.asarray(stamps_ns, np.int64)
        first, last = int(self.stamps_ns[0]), int(self.stamps_ns[-1])
        outside_s = max(first - int(wanted.min()), int(wanted.max()) - last) * 1e-9
        if outside_s > _MAX_EXTRAPOLATION_S:
            raise MotionError(
                f"no pose of the base within {_MAX_EXTRAPOLATION_S} s (the nearest is {outside_s:.3f} s away)"
            )
        poses = self.odom_from_base.copy()
        poses[:, 2] = np.unwrap(poses[:, 2])
        # Relative to the first stamp, because a float64 cannot hold nanoseconds since the epoch exactly.
        times = (self.stamps_ns - first) * 1e-9
        queries = (wanted - first) * 1e-9
        at = np.clip(np.searchsorted(times, queries, side="right") - 1, 0, len(times) - 2)
        alpha = (queries - times[at]) / (times[at + 1] - times[at])
        return np.asarray(poses[at] + alpha[..., None] * (poses[at + 1] - poses[at]))

    def end_from_time(self, end_ns: int, stamps_ns: ArrayLike) -> NDArray[np.float64]:
        """Return the poses of the base at the given times relative to the base at ``end_ns``: (x, y, yaw), (..., 3)."""
        end = self.at(end_ns)
        relative = self.at(stamps_ns) - end
        c, s = np.cos(end[2]), np.sin(end[2])
        relative[..., :2] = relative[..., :2] @ np.array([[c, -s], [s, c]])
        return relative


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
