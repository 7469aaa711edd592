"""Regularisation of one photo's depth without a LiDAR: level floor and ceiling, upright walls.

A network's depth bends a little everywhere, and an image from beside the camera shows it: uneven floors, walls with
kinks. Rooms have a flat floor under the camera, mostly a flat ceiling, and walls that go straight down to the one and
up to the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
_PAD = 64  # columns that the image is continued by on both sides, so that its edge is none
_LEAST_SHARE = 0.15  # of the pixels that look at it have to lie on a floor or ceiling, or there is none

_SMOOTHING, _EDGE = 20.0, 3.0
"""Of the edge-preserving smoother: its strength, and the step of depth that is an edge, in units of 1.8 %."""
_WALL_BELOW = 0.8
"""What is nearer than this share of the way to floor or ceiling is surely a wall or a thing; beyond goes the wall
straight on to the plane."""
_BEYOND = 1.5
"""What is farther than so many times the way to a plane is not under it: another ceiling, a stair."""
_BODY_BELOW_RAD = np.radians(-60.0)
"""Below this elevation the image shows the robot or its stand, and floor is put there."""


@dataclass(frozen=True)
class Tidied:
    """Depth (h, 2 h) float32 in metres, 0 unknown; heights of floor (below) and ceiling (above) from the camera, None
    where there is none; ``scale``: what the estimated metres were multiplied by.
    """

    depth_m: Floats
    floor_m: float | None
    ceiling_m: float | None
    scale: float


def tidy(
    depth_m: NDArray[np.floating],
    camera_height_m: float | None = None,
    height: int = 512,
) -> Tidied:
    """Depth of a level indoor panorama, tidied.

    Args:
        depth_m: radial depth as estimated, (h, 2 h), 0 = unknown.
        camera_height_m: of the camera above the floor; where given, the whole depth is scaled so that the floor lies
            there. None: the floor lies where the depth says.
        height: rows of the result: floor and walls meet as sharply as that.

    Raises:
        ValueError: shapes or height no good, or a height is given and no floor is found in the depth.
    """
    import cv2

    if depth_m.ndim != 2 or depth_m.shape[1] != 2 * depth_m.shape[0]:
        raise ValueError(f"a panorama's depth is twice as wide as high (got {depth_m.shape})")
    if camera_height_m is not None and not 0.05 <= camera_height_m <= 10:
        raise ValueError(f"the camera's height must be 0.05 to 10 m (got {camera_height_m:g})")
    known = np.isfinite(depth_m) & (depth_m > 0)
    if not known.any():
        raise ValueError("the depth is nowhere known")
    inverse = np.where(known, 1 / np.where(known, depth_m, 1), 0).astype(np.float32)
    # Padded by a column, so that interpolation goes on across the seam.
    inverse, weight = (_resized(a, height) for a in (inverse, known.astype(np.float32)))
    unknown = weight < 0.5
    depth = np.where(unknown, 0, weight / np.maximum(inverse, 1e-6)).astype(np.float32)
    elevation = np.pi / 2 - (np.arange(height, dtype=np.float32) + 0.5) * np.float32(np.pi / height)
    rise = np.sin(elevation)[:, None]
    floor = plane_below(depth, -rise, elevation < -np.radians(20), elevation > _BODY_BELOW_RAD)
    ceiling = plane_below(depth, rise, elevation > np.radians(25), elevation < np.radians(75))
    scale = 1.0
    if camera_height_m is not None:
        if floor is None:
            raise ValueError("no floor is to be seen in the depth: leave the camera's height out")
        scale = camera_height_m / floor
        depth, floor, ceiling = depth * np.float32(scale), camera_height_m, None if ceiling is None else ceiling * scale
    # Guided by the depth itself: an image's edges are mostly texture, and posters came out of their walls.
    logarithm = np.log(np.clip(np.where(unknown, 1, depth), 0.2, 20) / 0.2) * (255 / np.log(100))
    guide = np.ascontiguousarray(_padded(np.rint(logarithm).astype(np.uint8)))

    def smooth(values: Floats) -> Floats:
        padded = np.ascontiguousarray(_padded(values))
        filtered = cv2.ximgproc.fastGlobalSmootherFilter(guide, padded, _SMOOTHING, _EDGE)
        return np.asarray(filtered[:, _PAD:-_PAD], np.float32)

    # Walls: of one horizontal range from foot to top, so its inverse varies only with azimuth.
    flat = np.maximum(np.cos(elevation), 1e-3)[:, None]
    nearness = np.where(unknown, 0, 1 / np.maximum(depth * flat, 1e-3)).astype(np.float32)
    share = (~unknown * flat).astype(np.float32)  # rows at the poles are few directions
    nearness = (smooth((nearness * share).astype(np.float32)) / np.maximum(smooth(share), 1e-9)).astype(np.float32)
    result: Floats = (nearness * flat).astype(np.float32)
    for at, side in ((floor, -rise), (ceiling, rise)):
        if at is None:
            continue
        plane = np.maximum(side, 0) / np.float32(at)  # inverse distance
        share_of_plane = depth * plane
        wall = (share_of_plane < _WALL_BELOW) & ~unknown
        onto = (share_of_plane < _BEYOND) & (side > 0)
        # From the horizon on, a wall goes straight down (or up) until it meets the plane.
        upright = continued(nearness, wall, upwards=side[0, 0] > 0) * flat
        result = np.where(onto, np.maximum(upright, plane), result).astype(np.float32)
    if floor is not None:  # nothing lies under the floor, and the robot is none of the room
        under = np.maximum(-rise, 0) / np.float32(floor)
        body = np.broadcast_to((elevation < _BODY_BELOW_RAD)[:, None], depth.shape)
        result = np.where(body, under, np.maximum(result, under)).astype(np.float32)
        unknown &= ~body
    depth = np.where(unknown, 0, 1 / np.maximum(result, 1e-4)).astype(np.float32)
    return Tidied(depth, floor, ceiling, scale)


def plane_below(depth: Floats, down: Floats, *rows: NDArray[np.bool_]) -> float | None:
    """Distance of the level plane that most pixels of some rows lie on; None where no plane stands out.

    Args:
        depth: (h, w), 0 unknown; down: (h, 1) sine of the angle towards the plane; rows: (h,) masks, all to hold.
    """
    chosen = np.logical_and.reduce(rows)
    weight = np.broadcast_to(np.sqrt(1 - down * down), depth.shape)[chosen]
    away = (depth * down)[chosen]
    weight, away = weight[away > 0.05], away[away > 0.05]
    if not len(away):
        return None
    # Bins of equal ratio: an estimate's error grows with the distance.
    bins = np.floor(np.log(away) / 0.04).astype(np.intp)
    counts = np.convolve(np.bincount(bins - bins.min(), weight), np.ones(3), "same")
    best = int(counts.argmax()) + bins.min()
    near = np.abs(bins - best) <= 1
    if weight[near].sum() < _LEAST_SHARE * weight.sum():
        return None
    return float(np.median(away[near]))


def continued(values: Floats, sure: NDArray[np.bool_], upwards: bool) -> Floats:
    """Values (h, w) of the last ``sure`` pixel on the way from the horizon to the pole, in each column."""
    rows = values.shape[0]
    order = range(rows // 2, -1, -1) if upwards else range(rows // 2, rows)
    result, last = values.copy(), values[rows // 2]
    for row in order:
        last = np.where(sure[row], values[row], last)
        result[row] = last
    return result


def _padded(values: NDArray) -> NDArray:
    """Pad a panorama on both sides by its own columns."""
    return np.concatenate([values[:, -_PAD:], values, values[:, :_PAD]], axis=1)


def _resized(values: Floats, height: int) -> Floats:
    """A panorama brought to another size, across its seam."""
    import cv2

    rows = values.shape[0]
    if rows == height:
        return values
    wrapped = np.concatenate([values[:, -2:], values, values[:, :2]], axis=1)
    factor = height / rows
    pad = round(2 * factor)
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    large = cv2.resize(wrapped, (2 * height + 2 * pad, height), interpolation=how)
    return np.ascontiguousarray(large[:, pad : pad + 2 * height])
