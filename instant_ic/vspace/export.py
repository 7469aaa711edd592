"""Export of a space: coloured points, a mesh, a camera flight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import equirect_directions
from instant_ic.vspace.prior import DEPTH_EDGE_RATIO, edge_quads
from instant_ic.vspace.space import NotReadyError, VirtualSpace


@dataclass(frozen=True)
class Surface:
    """Surfaces of a space in its map frame.

    Attributes:
        points: (N, 3) float32, metres.
        rgb: (N, 3) uint8.
        triangles: (M, 3) int32 into ``points``, counter-clockwise seen from the camera; none for a cloud.
    """

    points: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    triangles: NDArray[np.int32]


def surface(space: VirtualSpace, width: int = 1024) -> Surface:
    """The surfaces that the keyframe has seen, through the trained field, as a mesh cut at depth edges.

    Args:
        space: with a keyframe.
        width: of the panorama whose pixels become vertices.

    Raises:
        NotReadyError: no keyframe yet.
    """
    if space.keyframe is None:
        raise NotReadyError("no keyframe yet: there is no surface")
    pose = space.keyframe.map_from_camera
    view = space.render_equirect(pose, width)
    known = view.confidence > 0
    directions = equirect_directions(width, width // 2) @ pose[:3, :3].T.astype(np.float32)
    points = pose[:3, 3].astype(np.float32) + directions * view.depth_m[..., None]
    number = np.cumsum(known.reshape(-1), dtype=np.int32).reshape(known.shape) - 1
    with np.errstate(divide="ignore"):
        inverse = np.where(known, 1 / view.depth_m, 0).astype(np.float32)
    whole = edge_quads(inverse, DEPTH_EDGE_RATIO)[:-1] == 0
    for corner in _corners(known):
        whole &= corner
    a, b, c, d = (corner[whole] for corner in _corners(number))
    triangles = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    return Surface(points[known], view.rgb[known], triangles)


def _corners(values: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Upper left, upper right, lower left and lower right of each quad; columns wrap, (H − 1, W) each."""
    right = np.roll(values, -1, 1)
    return values[:-1], right[:-1], values[1:], right[1:]


def default_flight(radius_m: float) -> list[NDArray[np.float64]]:
    """Waypoints (x, y, z, yaw) relative to the camera: ahead, back, and a full turn; within ``radius_m``."""
    reach = min(radius_m, 1.0)
    turns = [(0.0, 0.0, 0.0, 0.5 * math.pi * quarter) for quarter in range(1, 5)]
    aside = (0.5 * reach, 0.3 * reach, 0.0, -0.3)
    return [np.array(p) for p in ((0.0, 0.0, 0.0, 0.0), (reach, 0.0, 0.0, 0.0), aside, (0.0, 0.0, 0.0, 0.0), *turns)]


def flight(waypoints: Sequence[Sequence[float] | NDArray[np.floating]], count: int) -> list[NDArray[np.float64]]:
    """``count`` poses (4, 4) along waypoints (x, y, z, yaw): a smooth curve through them at an even pace.

    Between two waypoints the heading turns by the difference of their yaws as they are given: from 0 to 2π is one turn.

    Raises:
        ValueError: fewer than two waypoints or poses, or a value that is not finite.
    """
    from scipy.interpolate import PchipInterpolator

    points = np.array([list(p) for p in waypoints], np.float64)
    if points.ndim != 2 or points.shape[1] != 4 or len(points) < 2 or not np.isfinite(points).all():
        raise ValueError("a flight needs two waypoints or more, each x, y, z, yaw and finite")
    if count < 2:
        raise ValueError(f"a flight needs two images or more (got {count})")
    step = np.diff(points, axis=0)
    # A turn of a radian takes as long as half a metre; a waypoint given twice is a short stop.
    length = np.linalg.norm(step[:, :3], axis=1) + 0.5 * np.abs(step[:, 3])
    place = np.concatenate([[0.0], np.cumsum(np.maximum(length, 1e-3))])
    curve = PchipInterpolator(place, points, axis=0)(np.linspace(0, place[-1], count))
    return [pose_matrix(x, y, z, yaw=yaw) for x, y, z, yaw in curve]
