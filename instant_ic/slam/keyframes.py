"""Keyframes: scans that make up the map, with poses that optimisation may change."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from instant_ic.geometry.poses import compose2
from instant_ic.slam.scan import FloatArray, ScanPoints

LOCAL_KEYFRAMES = 40
"""Number of recent keyframes in the local map. More keyframes reduce drift and cost more."""
NO_SCAN = ScanPoints(np.zeros((0, 2)), np.zeros(0, dtype=np.bool_), np.zeros(2))
"""Empty scan of a removed keyframe."""


@dataclass
class ScanKeyframe:
    """A scan kept for matching and for the map.

    Attributes:
        stamp_ns: time of the scan.
        map_from_base: pose, (3,), which optimisation changes.
        scan: points of the scan in the base frame.
        step: pose relative to the previous keyframe as measured at creation, (3,); zero for the first.
        step_covariance: covariance of ``step`` in the frame of the previous keyframe, (3, 3).
        drift: covariance of the pose in the map frame, (3, 3). It grows with the distance since the last loop closure.
        merged_into: keyframe that replaces this one, and this one's pose relative to it, (3,); None unless removed.
    """

    stamp_ns: int
    map_from_base: FloatArray
    scan: ScanPoints
    step: FloatArray
    step_covariance: FloatArray
    drift: FloatArray
    merged_into: tuple[ScanKeyframe, FloatArray] | None = None

    def pose(self) -> FloatArray:
        """Return the current map_from_base (3,). A removed keyframe's pose follows from the one that replaces it."""
        if self.merged_into is None:
            return self.map_from_base
        other, other_from_this = self.merged_into
        return compose2(other.pose(), other_from_this)


def grown_drift(drift: FloatArray, way: FloatArray, yaw: float, step_covariance: FloatArray) -> FloatArray:
    """Return the covariance, (3, 3) in the map frame, of the pose one step after a pose with covariance ``drift``.

    Args:
        drift: covariance of the first pose, (3, 3).
        way: translation from the first pose to the second in the map, (2,).
        yaw: heading of the first pose in the map.
        step_covariance: covariance of the step in the first pose's frame, (3, 3).
    """
    carry = np.eye(3)
    carry[0, 2], carry[1, 2] = -way[1], way[0]
    grown: FloatArray = carry @ drift @ carry.T + turned(step_covariance, yaw)
    return grown


def turned(covariance: FloatArray, yaw: float) -> FloatArray:
    """Rotate a covariance (3, 3) from a frame with heading ``yaw`` to the frame with heading zero."""
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    turn = np.array([[cos_yaw, -sin_yaw, 0.0], [sin_yaw, cos_yaw, 0.0], [0.0, 0.0, 1.0]])
    result: FloatArray = turn @ covariance @ turn.T
    return result
