"""Search for recent scans in an older part of the map, up to metres away from their estimated pose.

The search is coarse to fine, after Olson (2015). Every pose of a wide window is scored on a pooled field, whose cells
hold the best value nearby. The surroundings of the best poses that are far enough apart are then searched on the full
field and refined. The score of the second best place shows whether the result is unique.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.geometry.poses import wrap_angle
from instant_ic.slam.likelihood_field import LikelihoodField
from instant_ic.slam.matcher import correlate, refine
from instant_ic.slam.scan import FloatArray

MIN_PLACE_SCORE = 0.6
"""Minimum match score (0..1) of a loop and of the robot's place in a saved map."""
POOL = 4
"""Number of field cells along a side of a pooled cell."""

COARSE_POINTS = 100
"""Number of query points in the wide search. The fine search uses all points."""
ROTATION_STEP_RAD = 0.035
"""Heading step of the coarse search, which at 6 m is the side of a pooled cell."""
CANDIDATES = 12
"""Number of coarse peaks that are refined."""
APART_M, APART_RAD = 0.6, 0.3
"""Distance, or difference in heading, beyond which two poses are different places."""
LEAST = np.float64(0.05)  # float32 would round it up and so change the result for this value
"""Largest value of the field that counts as 0 in the pooled field."""


def pool(field: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Return the best value near each pooled cell.

    Args:
        field: likelihood field, (H, W).
        size: number of field cells along a side of a pooled cell.

    Returns:
        Pooled field, (ceil(H/size), ceil(W/size)). Cell (j, i) holds the maximum within ``size`` cells of the field's
        cell (j·size, i·size) along either axis.
    """
    height, width = field.shape
    whole = np.pad(field, ((0, -height % size), (0, -width % size)))
    # Reduce whole rows first. A maximum over both axes of a block at once takes ten times as long.
    rows = functools.reduce(np.maximum, [whole[k::size] for k in range(size)])
    blocks = functools.reduce(np.maximum, [rows[:, k::size] for k in range(size)])
    blocks[~(blocks > LEAST)] = 0.0
    blocks[1:] = np.maximum(blocks[1:], blocks[:-1])
    blocks[:, 1:] = np.maximum(blocks[:, 1:], blocks[:, :-1])
    return blocks


@njit(cache=True)
def score_volume(field, origin, resolution, points, centre, cells, rotations, rotation_step):  # type: ignore[no-untyped-def]
    """Return the mean field value of the points at each pose of a window.

    The arguments are those of `matcher.correlate`.

    Returns:
        Scores by rotation, y and x, (2·rotations + 1, 2·cells + 1, 2·cells + 1) float32.
    """
    height, width = field.shape
    n = points.shape[0]
    size = 2 * cells + 1
    sums = np.zeros((2 * rotations + 1, size, size), dtype=np.float32)
    for r in range(2 * rotations + 1):
        yaw = centre[2] + (r - rotations) * rotation_step
        cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
        plane = sums[r]
        for i in range(n):
            x = centre[0] + cos_yaw * points[i, 0] - sin_yaw * points[i, 1]
            y = centre[1] + sin_yaw * points[i, 0] + cos_yaw * points[i, 1]
            ix = round((x - origin[0]) / resolution) - cells
            iy = round((y - origin[1]) / resolution) - cells
            first_u, last_u = max(0, -ix), min(size, width - ix)
            for v in range(max(0, -iy), min(size, height - iy)):
                for u in range(first_u, last_u):
                    plane[v, u] += field[iy + v, ix + u]
    sums /= np.float32(n)
    return sums


def peaks(volume: NDArray[np.float32], count: int, apart: int, apart_rotations: int) -> NDArray[np.int64]:
    """Return the best poses of a score volume that are apart from every better one, as rotation, y and x indices."""
    left, found = volume.copy(), list[NDArray[np.int64]]()
    reach = np.array([apart_rotations, apart, apart])
    while len(found) < count:
        best = np.array(np.unravel_index(np.argmax(left), left.shape))
        if left[tuple(best)] <= 0.0:
            break
        found.append(best)
        left[tuple(map(slice, np.maximum(best - reach, 0), best + reach + 1))] = 0.0
    return np.array(found, dtype=np.int64).reshape(-1, 3)


@dataclass(frozen=True)
class Found:
    """Pose at which the query fits.

    Attributes:
        pose: field_from_base, (3,).
        covariance: covariance from the scans alone, in the field's frame, (3, 3).
        score: mean field value over the points, 0..1.
        shape: ratio of smallest to largest information over all directions, 0..1; near 0 in a bare corridor.
        runner_up: score of the second best place; 0 if there is none.
    """

    pose: FloatArray
    covariance: FloatArray
    score: float
    shape: float
    runner_up: float


def find_place(
    field: LikelihoodField, points: FloatArray, centre: FloatArray, reach_m: float, reach_rad: float
) -> Found | None:
    """Return the best pose of ``points`` (n, 2) within ``reach_m`` and ``reach_rad`` of ``centre`` (3,), or None."""
    resolution = field.resolution
    coarse = POOL * resolution
    cells = max(1, math.ceil(reach_m / coarse))
    rotations = max(1, min(math.ceil(reach_rad / ROTATION_STEP_RAD), int(math.pi / ROTATION_STEP_RAD)))
    few = points[:: max(1, len(points) // COARSE_POINTS)]
    volume = score_volume(
        pool(field.values, POOL), field.origin, coarse, few, centre, cells, rotations, ROTATION_STEP_RAD
    )
    tops = peaks(volume, CANDIDATES, 1, 1)
    close: list[Found] = []
    for r, j, i in tops:
        start = centre + np.array([(i - cells) * coarse, (j - cells) * coarse, (r - rotations) * ROTATION_STEP_RAD])
        if close and volume[r, j, i] < close[0].score - 0.1:
            break  # a pooled score is close to an upper bound, so no later candidate can come near the best
        one = refined(field, points, start)
        if one is not None:
            close.append(one)
            close.sort(key=lambda entry: -entry.score)
    if not close:
        return None
    best = close[0]
    return replace(best, runner_up=max((one.score for one in close[1:] if apart(one.pose, best.pose)), default=0.0))


def refined(field: LikelihoodField, points: FloatArray, start: FloatArray) -> Found | None:
    """Return the best pose of ``points`` (n, 2) within a pooled cell and a heading step of ``start`` (3,).

    Return None if the points give no information.
    """
    none = np.zeros(3)
    x, y, yaw, _ = correlate(
        field.values, field.origin, field.resolution, points, start, POOL, 4, ROTATION_STEP_RAD / 4, start,
        none, 1.0, 1.0,
    )  # fmt: skip
    start = np.array([x, y, yaw])
    pose, hessian, score, squares = refine(
        field.values, field.origin, field.resolution, points, start, start, none, 1.0, 12, 0.15, 0.04
    )
    try:
        covariance = max(squares / max(len(points) - 3, 1), 1e-3) * np.linalg.inv(hessian)
        # The Schur complement is the information on the translation at unknown heading.
        known = hessian[:2, :2] - np.outer(hessian[:2, 2], hessian[2, :2]) / hessian[2, 2]
        low, high = np.linalg.eigvalsh(known)
    except np.linalg.LinAlgError:
        return None
    shape = float(max(low, 0.0) / high) if high > 0 else 0.0
    pose = np.array([pose[0], pose[1], wrap_angle(float(pose[2]))])
    return Found(pose, 0.5 * (covariance + covariance.T), float(score), shape, 0.0)


def apart(a: FloatArray, b: FloatArray) -> bool:
    """Return whether two poses (3,) are different places."""
    turn = abs(wrap_angle(float(a[2] - b[2])))
    return math.hypot(a[0] - b[0], a[1] - b[1]) >= APART_M or turn >= APART_RAD


def spread(points: FloatArray, cell_m: float, max_points: int) -> FloatArray:
    """Return one point per cell of side ``cell_m``, (n, 2); at most ``max_points``, evenly chosen."""
    if len(points) == 0:
        return points
    _, first = np.unique(np.floor(points / cell_m).astype(np.int64), axis=0, return_index=True)
    kept = points[first]  # in cell order, so that an even choice covers the whole area
    if len(kept) > max_points:
        kept = kept[(np.arange(max_points) * len(kept)) // max_points]
    return np.ascontiguousarray(kept)


def warm_up() -> None:
    """Compile the kernels of the search."""
    field = LikelihoodField(resolution_m=0.05, reach_m=5.0)
    field.values[:] = 0.5
    # Use more points than the coarse search takes, so that the code for an even choice is compiled too.
    find_place(field, np.zeros((2 * COARSE_POINTS, 2)), np.zeros(3), reach_m=0.5, reach_rad=0.1)
