"""Motion of the base during a revolution."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

_MAX_EXTRAPOLATION_S = 0.2
"""Largest extrapolation beyond the first and the last pose."""


class MotionError(ValueError):
    """The poses do not cover the requested time; the text says which part is missing."""


@dataclass(frozen=True)
class PlanarMotion:
    """Poses of the base over time, interpolated linearly and extrapolated with the velocity of the last poses.

    Attributes:
        stamps_ns: stamps in rising order, (M,), M >= 1.
        odom_from_base: (x, y, yaw), metres and radians, (M, 3).
    """

    stamps_ns: NDArray[np.int64]
    odom_from_base: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.stamps_ns.ndim != 1 or self.odom_from_base.shape != (len(self.stamps_ns), 3):
            raise MotionError(f"poses {self.odom_from_base.shape} do not match stamps {self.stamps_ns.shape}")
        if len(self.stamps_ns) == 0 or (np.diff(self.stamps_ns) <= 0).any():
            raise MotionError("stamps must increase, and at least one is required")

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
        if len(self.stamps_ns) == 1:
            return np.broadcast_to(self.odom_from_base[0], (*wanted.shape, 3)).copy()
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
        x, y = relative[..., 0].copy(), relative[..., 1].copy()
        relative[..., 0] = c * x + s * y
        relative[..., 1] = -s * x + c * y
        return relative
