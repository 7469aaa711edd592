"""Keyframes: the scans that the map is made of, with the poses that a later optimisation may move."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from instant_ic.geometry.poses import compose2
from instant_ic.slam.scan import FloatArray, ScanPoints

NO_SCAN = ScanPoints(np.zeros((0, 2)), np.zeros(0, dtype=np.bool_), np.zeros(2), np.zeros((0, 2)))
"""Of a keyframe that was taken out."""


@dataclass
class Keyframe:
    """A scan kept for matching and for the map.

    Attributes:
        stamp_ns: time of the scan.
        map_from_base: (3,), changed by optimisation.
        covariance: (3, 3) of the match that placed it, relative to the keyframes before.
        scan: its points in the base frame.
        dead_reckoned: whether the scan did not match and the pose is odometry's.
        step: from the keyframe before to this one, as measured when it was made (3,); of the first, zero.
        step_covariance: of ``step``, in the frame of the keyframe before (3, 3).
        drift: covariance of the pose in the map as a whole (3, 3), map frame: grows with the way since the map was
            last met again.
        merged_into: the keyframe that stands for this one since it was taken out, and this one's pose there (3,).
    """

    stamp_ns: int
    map_from_base: FloatArray
    covariance: FloatArray
    scan: ScanPoints
    dead_reckoned: bool
    step: FloatArray
    step_covariance: FloatArray
    drift: FloatArray
    merged_into: tuple[Keyframe, FloatArray] | None = None

    def pose(self) -> FloatArray:
        """map_from_base as it is known now (3,); of a keyframe that was taken out, by the one it was merged into."""
        if self.merged_into is None:
            return self.map_from_base
        other, other_from_this = self.merged_into
        return compose2(other.pose(), other_from_this)


class Trajectory:
    """All keyframes in order of time."""

    def __init__(self) -> None:
        self.keyframes: list[Keyframe] = []

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def last(self) -> Keyframe:
        """The newest one."""
        return self.keyframes[-1]

    def add(self, keyframe: Keyframe) -> None:
        """Append a keyframe."""
        self.keyframes.append(keyframe)

    def recent(self, count: int) -> list[Keyframe]:
        """The last ``count`` keyframes, oldest first."""
        return self.keyframes[-count:]

    def poses(self) -> FloatArray:
        """map_from_base of every keyframe, (n, 3)."""
        return np.array([keyframe.map_from_base for keyframe in self.keyframes]).reshape(-1, 3)


def grown_drift(drift: FloatArray, way: FloatArray, yaw: float, step_covariance: FloatArray) -> FloatArray:
    """Covariance (3, 3), map frame, of a pose one step on from one with covariance ``drift``.

    Args:
        drift: (3, 3).
        way: from the first place to the second in the map, (2,).
        yaw: of the first pose in the map.
        step_covariance: (3, 3) in the first pose's frame.
    """
    carry = np.eye(3)
    carry[0, 2], carry[1, 2] = -way[1], way[0]
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    turn = np.array([[cos_yaw, -sin_yaw, 0.0], [sin_yaw, cos_yaw, 0.0], [0.0, 0.0, 1.0]])
    grown: FloatArray = carry @ drift @ carry.T + turn @ step_covariance @ turn.T
    return grown
