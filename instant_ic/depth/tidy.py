"""Regularisation of one photo's depth without a LiDAR: level floor and ceiling, upright walls.

A network's depth bends a little everywhere, and a view from beside the camera shows it: uneven floors, walls with
kinks. Rooms have a flat floor under the camera, mostly a flat ceiling, and walls that go straight down to the one and
up to the other. ``tidy`` takes these steps:

1. ``_planes``: find floor and ceiling, the level planes on which most steep pixels agree (``plane_below``), and scale
   the depth to the camera's height.
2. ``_smooth_walls``: smooth the inverse horizontal distance, guided by the depth's own edges (fast global smoother, Min
   et al., 2014); on an upright wall it varies with azimuth only.
3. ``_meet_planes``: let walls go straight on (``continued``) until they meet floor or ceiling.
4. Put floor where the image shows the robot itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class TidyConfig:
    """Tuning of the regularisation.

    Attributes:
        pad: columns by which a panorama is continued on both sides before it is filtered.
        plane_share: smallest share of the steep pixels that must lie on a floor or ceiling.
        smoothing: strength of the edge-preserving smoother.
        edge: step of the depth that counts as an edge, in units of 1.8 %.
        wall_below: pixels nearer than this share of the way to a plane belong to a wall or a thing.
        beyond: pixels farther than this multiple of the way to a plane do not belong to it (another ceiling, a stair).
        body_below_rad: elevation below which the image shows the robot or its stand.
    """

    pad: int = 64
    plane_share: float = 0.15
    smoothing: float = 20.0
    edge: float = 3.0
    wall_below: float = 0.8
    beyond: float = 1.5
    body_below_rad: float = -math.pi / 3


CONFIG = TidyConfig()


@dataclass(frozen=True)
class Tidied:
    """Regularised depth.

    Attributes:
        depth_m: radial depth in metres, (h, 2 h); 0 is unknown.
        floor_m: distance of the floor below the camera; None if there is none.
        ceiling_m: distance of the ceiling above the camera; None if there is none.
        scale: factor by which the estimated metres were multiplied.
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
    """Regularise the depth of a level indoor panorama.

    Args:
        depth_m: radial depth as estimated, (h, 2 h); 0 is unknown.
        camera_height_m: height of the camera above the floor, to which the whole depth is scaled; None to leave the
            floor where the depth says.
        height: rows of the result: floor and walls meet as sharply as that.

    Raises:
        ValueError: wrong shape or height, or a height is given and no floor is found in the depth.
    """
    if depth_m.ndim != 2 or depth_m.shape[1] != 2 * depth_m.shape[0]:
        raise ValueError(f"a panorama's depth is twice as wide as high (got {depth_m.shape})")
    if camera_height_m is not None and not 0.05 <= camera_height_m <= 10:
        raise ValueError(f"the camera's height must be 0.05 to 10 m (got {camera_height_m:g})")
    known = np.isfinite(depth_m) & (depth_m > 0)
    if not known.any():
        raise ValueError("the depth is nowhere known")
    inverse = np.where(known, 1 / np.where(known, depth_m, 1), 0).astype(np.float32)
    inverse, weight = (_resized(a, height) for a in (inverse, known.astype(np.float32)))
    unknown = weight < 0.5
    depth = np.where(unknown, 0, weight / np.maximum(inverse, 1e-6)).astype(np.float32)
    elevation = np.pi / 2 - (np.arange(height, dtype=np.float32) + 0.5) * np.float32(np.pi / height)
    rise = np.sin(elevation)[:, None]
    depth, floor, ceiling, scale = _planes(depth, elevation, camera_height_m)
    result = _meet_planes(_smooth_walls(depth, unknown, elevation), depth, unknown, elevation, floor, ceiling)
    if floor is not None:  # nothing lies under the floor, and the robot is not part of the room
        under = np.maximum(-rise, 0) / np.float32(floor)
        body = np.broadcast_to((elevation < CONFIG.body_below_rad)[:, None], depth.shape)
        result = np.where(body, under, np.maximum(result, under)).astype(np.float32)
        unknown &= ~body
    depth = np.where(unknown, 0, 1 / np.maximum(result, 1e-4)).astype(np.float32)
    return Tidied(depth, floor, ceiling, scale)


def _planes(
    depth: Floats, elevation: Floats, camera_height_m: float | None
) -> tuple[Floats, float | None, float | None, float]:
    """Find floor and ceiling, and return the depth scaled to the camera's height, both distances, and the scale."""
    rise = np.sin(elevation)[:, None]
    floor = plane_below(depth, -rise, elevation < -np.radians(20), elevation > CONFIG.body_below_rad)
    ceiling = plane_below(depth, rise, elevation > np.radians(25), elevation < np.radians(75))
    if camera_height_m is None:
        return depth, floor, ceiling, 1.0
    if floor is None:
        raise ValueError("no floor is to be seen in the depth: leave the camera's height out")
    scale = camera_height_m / floor
    return depth * np.float32(scale), camera_height_m, None if ceiling is None else ceiling * scale, scale


def _smooth_walls(depth: Floats, unknown: NDArray[np.bool_], elevation: Floats) -> Floats:
    """Return the smoothed inverse horizontal distance, (h, 2 h)."""
    import cv2

    # Guided by the depth itself: an image's edges are mostly texture, and posters came out of their walls.
    logarithm = np.log(np.clip(np.where(unknown, 1, depth), 0.2, 20) / 0.2) * (255 / np.log(100))
    guide = np.ascontiguousarray(_padded(np.rint(logarithm).astype(np.uint8)))

    def smooth(values: Floats) -> Floats:
        padded = np.ascontiguousarray(_padded(values))
        filtered = cv2.ximgproc.fastGlobalSmootherFilter(guide, padded, CONFIG.smoothing, CONFIG.edge)
        return np.asarray(filtered[:, CONFIG.pad : -CONFIG.pad], np.float32)

    flat = np.maximum(np.cos(elevation), 1e-3)[:, None]
    nearness = np.where(unknown, 0, 1 / np.maximum(depth * flat, 1e-3)).astype(np.float32)
    share = (~unknown * flat).astype(np.float32)  # rows at the poles are few directions
    return (smooth((nearness * share).astype(np.float32)) / np.maximum(smooth(share), 1e-9)).astype(np.float32)


def _meet_planes(
    nearness: Floats,
    depth: Floats,
    unknown: NDArray[np.bool_],
    elevation: Floats,
    floor: float | None,
    ceiling: float | None,
) -> Floats:
    """Continue walls to floor and ceiling; return the inverse depth, (h, 2 h).

    Args:
        nearness: inverse horizontal distance of the walls, (h, 2 h).
        depth: radial depth, (h, 2 h).
        unknown: pixels without depth, (h, 2 h).
        elevation: elevation of the rows, (h,).
        floor: distance of the floor; None if there is none.
        ceiling: distance of the ceiling; None if there is none.
    """
    flat, rise = np.maximum(np.cos(elevation), 1e-3)[:, None], np.sin(elevation)[:, None]
    result: Floats = (nearness * flat).astype(np.float32)
    for at, side in ((floor, -rise), (ceiling, rise)):
        if at is None:
            continue
        plane = np.maximum(side, 0) / np.float32(at)  # inverse distance
        share_of_plane = depth * plane
        wall = (share_of_plane < CONFIG.wall_below) & ~unknown
        onto = (share_of_plane < CONFIG.beyond) & (side > 0)
        upright = continued(nearness, wall, upwards=side[0, 0] > 0) * flat
        result = np.where(onto, np.maximum(upright, plane), result).astype(np.float32)
    return result


def plane_below(depth: Floats, down: Floats, *rows: NDArray[np.bool_]) -> float | None:
    """Return the distance of the level plane that most pixels of some rows lie on; None where no plane stands out.

    Args:
        depth: radial depth, (h, w); 0 is unknown.
        down: sine of the angle towards the plane, (h, 1).
        rows: masks of the rows, (h,) each, that must all hold.
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
    if weight[near].sum() < CONFIG.plane_share * weight.sum():
        return None
    return float(np.median(away[near]))


def continued(values: Floats, sure: NDArray[np.bool_], upwards: bool) -> Floats:
    """Continue the value of the last sure pixel from the horizon to a pole, in each column.

    Args:
        values: values to continue, (h, w).
        sure: pixels whose values are used, (h, w).
        upwards: towards the upper pole, else the lower one.
    """
    rows = values.shape[0]
    order = range(rows // 2, -1, -1) if upwards else range(rows // 2, rows)
    result, last = values.copy(), values[rows // 2]
    for row in order:
        last = np.where(sure[row], values[row], last)
        result[row] = last
    return result


def _padded(values: NDArray) -> NDArray:
    """Pad a panorama on both sides by its own columns."""
    return np.concatenate([values[:, -CONFIG.pad :], values, values[:, : CONFIG.pad]], axis=1)


def _resized(values: Floats, height: int) -> Floats:
    """Resize a panorama; interpolation goes on across its seam."""
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
