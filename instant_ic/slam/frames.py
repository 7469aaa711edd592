"""Poses of the base in the map and in odometry, and the transform between the two frames."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from instant_ic.geometry.poses import compose2, inverse2, relative2
from instant_ic.slam.front_end import FrontEnd, Guess
from instant_ic.slam.scan import FloatArray

MAX_ODOMETRY_GAP_S = 5.0
"""Longest gap in odometry that is bridged. After a longer one, the encoders may have been reset."""


class ScanStep(NamedTuple):
    """Motion from the previous scan to this one.

    Attributes:
        motion: motion from scan matching, in the frame of the previous pose, (3,).
        wheels: the same motion from odometry; None unless both scans have odometry.
        elapsed_s: time between the scans.
    """

    motion: FloatArray
    wheels: FloatArray | None
    elapsed_s: float


class BaseFrames:
    """Predicts the pose of each scan and takes over the matched pose.

    `map_from_odom` absorbs all corrections. `odom_from_base` is the given odometry. For scans without odometry, LiDAR
    odometry continues it.

    Attributes:
        map_from_base: pose of the last scan, (3,).
        odom_from_base: pose of the last scan in odometry, (3,).
        map_from_odom: pose of odometry's frame in the map, (3,).
        stamp_ns: time of the last scan; None before the first.
    """

    def __init__(self) -> None:
        self.map_from_base: FloatArray = np.zeros(3)
        self.odom_from_base: FloatArray = np.zeros(3)
        self.map_from_odom: FloatArray = np.zeros(3)
        self.stamp_ns: int | None = None
        self._step: FloatArray = np.zeros(3)
        self._step_s = 0.0
        # Stamp, odometry and map pose of the last scan with odometry.
        self._odometry_stamp_ns: int | None = None
        self._odometry_pose: FloatArray = np.zeros(3)
        self._pose_at_odometry: FloatArray = np.zeros(3)

    def elapsed_s(self, stamp_ns: int) -> float:
        """Return the time since the last scan; 0 before the first."""
        return 0.0 if self.stamp_ns is None else (stamp_ns - self.stamp_ns) * 1e-9

    def predict(self, front_end: FrontEnd, odometry: FloatArray | None, stamp_ns: int) -> Guess:
        """Predict the pose of a scan from odometry (3,), or with constant velocity if there is none."""
        if self.stamp_ns is None:
            start = np.zeros(3) if odometry is None else odometry
            return front_end.guess_from_odometry(start, np.zeros(3))
        elapsed_s = self.elapsed_s(stamp_ns)
        gap_s = math.inf if self._odometry_stamp_ns is None else (stamp_ns - self._odometry_stamp_ns) * 1e-9
        if odometry is not None and gap_s <= max(MAX_ODOMETRY_GAP_S, 2 * elapsed_s):
            step = relative2(self._odometry_pose, odometry)
            return front_end.guess_from_odometry(compose2(self._pose_at_odometry, step), step)
        pose = front_end.constant_velocity(self.map_from_base, self._step, self._step_s, elapsed_s)
        return front_end.guess_from_velocity(pose, elapsed_s)

    def follow(self, pose: FloatArray, matched: bool, odometry: FloatArray | None, stamp_ns: int) -> ScanStep | None:
        """Accept the pose of a scan and put its correction into map_from_odom.

        Args:
            pose: map_from_base of the scan, (3,).
            matched: whether the pose comes from scan matching.
            odometry: odom_from_base of the scan, (3,); None without odometry.
            stamp_ns: time of the scan.

        Returns:
            The motion since the previous scan; None for the first scan.
        """
        step, scan_step = relative2(self.map_from_base, pose), None
        if self.stamp_ns is not None:
            wheels = None
            if odometry is not None and self._odometry_stamp_ns == self.stamp_ns:
                wheels = relative2(self._odometry_pose, odometry)
            self._step_s = self.elapsed_s(stamp_ns)
            scan_step = ScanStep(step, wheels, self._step_s)
            # Damp the velocity, so that the estimate does not keep moving without a match.
            self._step = step if matched else 0.5 * step
        if odometry is None:
            self.odom_from_base = compose2(self.odom_from_base, step)
        else:
            self.odom_from_base = odometry
            self._odometry_stamp_ns, self._odometry_pose, self._pose_at_odometry = stamp_ns, odometry, pose
            self.map_from_odom = compose2(pose, inverse2(odometry))
        self.map_from_base, self.stamp_ns = pose, stamp_ns
        return scan_step

    def move(self, moved: FloatArray) -> None:
        """Move the current pose in the map by ``moved`` (3,). Odometry stays unchanged."""
        self.map_from_base = compose2(moved, self.map_from_base)
        self.map_from_odom = compose2(moved, self.map_from_odom)
        self._pose_at_odometry = compose2(moved, self._pose_at_odometry)
