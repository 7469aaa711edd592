"""Planar twists: linear speed along x and turn rate."""

from __future__ import annotations

import math


def clip_twist(linear: float, angular: float, max_linear: float, max_angular: float) -> tuple[float, float]:
    """Scale a twist to within two speed limits, keeping its curvature; return zero if it is not finite.

    >>> clip_twist(1.0, 0.5, max_linear=0.5, max_angular=1.0)
    (0.5, 0.25)
    >>> clip_twist(float("nan"), 0.5, max_linear=0.5, max_angular=1.0)
    (0.0, 0.0)
    """
    if not (math.isfinite(linear) and math.isfinite(angular)):
        return 0.0, 0.0
    excess = max(abs(linear) / max_linear, abs(angular) / max_angular, 1.0)
    return linear / excess, angular / excess
