"""Motion of a differential drive: the arc of a constant twist, and steps within an acceleration limit.

Both functions are plain Python, so that numba can compile them too (``njit(along_arc)``).
"""

from __future__ import annotations

import math


def along_arc(
    x: float, y: float, yaw: float, forward: float, turn: float, sideways: float = 0.0
) -> tuple[float, float, float]:
    """Return the pose after a motion of constant twist: the exponential map of SE(2).

    Args:
        x: x of the start in metres.
        y: y of the start in metres.
        yaw: heading at the start in radians.
        forward: distance along the body's x axis in metres; negative is backward.
        turn: change of the heading in radians.
        sideways: distance along the body's y axis in metres; not zero if the tracks slip.

    Returns:
        x and y in metres, and the heading in radians, not wrapped.
    """
    half = 0.5 * turn
    chord_over_arc = math.sin(half) / half if half != 0.0 else 1.0
    ahead, aside = forward * chord_over_arc, sideways * chord_over_arc
    c, s = math.cos(yaw + half), math.sin(yaw + half)
    return x + ahead * c - aside * s, y + ahead * s + aside * c, yaw + 2.0 * half


def step_towards(value: float, target: float, largest_step: float) -> float:
    """Return ``value`` after a step towards ``target`` of at most ``largest_step``."""
    return value + min(max(target - value, -largest_step), largest_step)
