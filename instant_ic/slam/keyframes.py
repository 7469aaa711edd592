"""Keyframes: the scans that the map is made of, with the poses that a later optimisation may move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from instant_ic.geometry.poses import compose2
from instant_ic.slam.scan import FloatArray, ScanPoints


@dataclass
class Keyframe:
    """A scan kept for matching and for the map.

    Attributes:
        stamp_ns: time of the scan.
        map_from_base: (3,), changed by optimisation.
        covariance: (3, 3) of the match that placed it, relative to the keyframes before.
        scan: its points in the base frame.
        dead_reckoned: whether the scan did not match and the pose is odometry's.
        merged_into: the keyframe that stands for this one since it was taken out, and this one's pose there (3,).
    """

    stamp_ns: int
    map_from_base: FloatArray
    covariance: FloatArray
    scan: ScanPoints
    dead_reckoned: bool
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

    def add(self, keyframe: Keyframe) -> None:
        """Append a keyframe."""
        self.keyframes.append(keyframe)

    def recent(self, count: int) -> list[Keyframe]:
        """The last ``count`` keyframes, oldest first."""
        return self.keyframes[-count:]

    def poses(self) -> FloatArray:
        """map_from_base of every keyframe, (n, 3)."""
        return np.array([keyframe.map_from_base for keyframe in self.keyframes]).reshape(-1, 3)
