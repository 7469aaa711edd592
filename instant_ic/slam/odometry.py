"""Wheel odometry interpolated at scan stamps, and smoothing of map→odom."""

from __future__ import annotations

import bisect
import math

import numpy as np

from instant_ic.geometry.motion import along_arc
from instant_ic.geometry.poses import compose2, relative2, wrap_angle
from instant_ic.slam.scan import FloatArray


class OdometryBuffer:
    """Recent poses odom_from_base (3,) by time.

    Args:
        keep_s: length of the history in seconds.
    """

    def __init__(self, keep_s: float = 10.0) -> None:
        self._keep_ns = int(keep_s * 1e9)
        self._stamps: list[int] = []
        self._poses: list[FloatArray] = []

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest pose; None when empty."""
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp_ns: int, odom_from_base: FloatArray) -> bool:
        """Append a pose, unless it is not newer than the last or not finite. Return whether it was added."""
        if not np.isfinite(odom_from_base).all() or (self._stamps and stamp_ns <= self._stamps[-1]):
            return False
        self._stamps.append(stamp_ns)
        self._poses.append(np.asarray(odom_from_base, dtype=np.float64))
        old = bisect.bisect_left(self._stamps, stamp_ns - self._keep_ns)
        if old > 0:
            del self._stamps[:old], self._poses[:old]
        return True

    def clear(self) -> None:
        self._stamps.clear()
        self._poses.clear()

    def at(self, stamp_ns: int, extrapolate_s: float = 0.0) -> FloatArray | None:
        """Return the pose (3,) at a time, along the arc between its neighbours.

        After the newest pose, the last motion is extrapolated by at most ``extrapolate_s``. Return None if the time is
        not covered.
        """
        if not self._stamps or stamp_ns < self._stamps[0]:
            return None
        after = bisect.bisect_left(self._stamps, stamp_ns)
        if after < len(self._stamps) and self._stamps[after] == stamp_ns:
            return self._poses[after].copy()
        if after == len(self._stamps):
            if stamp_ns - self._stamps[-1] > extrapolate_s * 1e9:
                return None
            if after < 2:
                return self._poses[-1].copy()
            after -= 1
        before = after - 1
        part = (stamp_ns - self._stamps[before]) / (self._stamps[after] - self._stamps[before])
        return compose2(self._poses[before], _part_of_arc(relative2(self._poses[before], self._poses[after]), part))


def _part_of_arc(step: FloatArray, part: float) -> FloatArray:
    """Return the fraction ``part`` of a planar step (3,) along its circular arc."""
    x, y, turn = step.tolist()
    half = 0.5 * turn
    # Logarithm of SE(2): turn the chord back by half the turn, and stretch it to the length of the arc.
    arc_over_chord = half / math.sin(half) if half != 0.0 else 1.0
    c, s = math.cos(half) * arc_over_chord, math.sin(half) * arc_over_chord
    forward, sideways = c * x + s * y, c * y - s * x
    return np.array(along_arc(0.0, 0.0, 0.0, part * forward, part * turn, part * sideways))


SPEED_MPS, YAW_RATE_RADPS = 1.0, 1.0
"""Speed limits of a correction of the base's position in the map and of its heading."""
JUMP_M, JUMP_RAD = 0.5, 0.5
"""Correction above which the new value is broadcast at once."""


class CorrectionLimiter:
    """Makes map_from_odom follow its estimate at a limited speed.

    A recovered track or a closed loop may correct the pose by decimetres at once. The limiter keeps the robot's pose in
    the map continuous. Ordinary corrections of a few centimetres per scan pass unchanged. A correction above ``JUMP_M``
    or ``JUMP_RAD`` also passes at once, because the old pose is wrong and would mislead as long as it is broadcast.
    """

    def __init__(self) -> None:
        self._map_from_odom: FloatArray | None = None
        self._stamp_ns = 0

    def reset(self) -> None:
        """Let the next value pass without a limit."""
        self._map_from_odom = None

    def follow(self, map_from_odom: FloatArray, odom_from_base: FloatArray, stamp_ns: int) -> FloatArray:
        """Return map_from_odom to broadcast (3,), as close to the estimate as the speed limits at the base allow."""
        if self._map_from_odom is None:
            limited = map_from_odom.copy()
        else:
            elapsed_s = max(0.0, (stamp_ns - self._stamp_ns) * 1e-9)
            shown = compose2(self._map_from_odom, odom_from_base)
            wanted = compose2(map_from_odom, odom_from_base)
            way = wanted[:2] - shown[:2]
            turn = wrap_angle(float(wanted[2] - shown[2]))
            distance = math.hypot(way[0], way[1])
            part = 1.0
            jumps = distance > JUMP_M or abs(turn) > JUMP_RAD
            if distance > 0 and not jumps:
                part = min(part, SPEED_MPS * elapsed_s / distance)
            if turn != 0 and not jumps:
                part = min(part, YAW_RATE_RADPS * elapsed_s / abs(turn))
            if part >= 1.0:
                limited = map_from_odom.copy()
            else:
                base = np.array([*(shown[:2] + part * way), shown[2] + part * turn])
                limited = compose2(base, relative2(odom_from_base, np.zeros(3)))
        self._map_from_odom, self._stamp_ns = limited, stamp_ns
        return limited
