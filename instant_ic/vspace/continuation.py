"""Continuation of walls, floor and ceiling of a panorama behind what hides them.

Floor and ceiling are level planes. A wall is upright: what is seen of it above a near surface goes on below; where
nothing is, the planes of the walls at both sides go on. Each is continued in the colours of its own kind.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from instant_ic.vspace.nerf.field import Floats
from instant_ic.vspace.prior import fill_holes

SAME = 1.15
"""Distances of neighbours that differ by less than this factor are of one surface."""
WALL_BEHIND = 1.3
"""A wall is farther than what hides it by this factor: if it is nearer, depth errors hide the gap."""
FLOOR_SURE, CEILING_SURE = 1.0, 0.6
"""Share of the continued colour in the image; the rest is continued from the image's own surroundings."""
BESIDE_SURE, LEAST_SURE = 0.6, 0.2
"""The same of a wall that is continued from beside, at the side and far from it. Seen above it is 1: a wall that leads
on beside a doorway is a guess, one that leads on below what is seen of it is none."""
_FAR_SHARE = 0.25  # of a column's upright surfaces count as its farthest wall
_LOOK_RAD, _SPAN_RAD, _SEARCH_RAD = 0.15, 0.25, 1.5  # above a near surface; of a wall's plane; for colours
_SLOPE_PRIOR, _FARTHEST_M = 2.0, 30.0
_FADE_RAD, _SURE_FADE_RAD = 0.1, 0.37
_WALL_COLOURS, _LEVEL_COLOURS = 24, 40  # pixels that a common colour is the median of


def continued_walls(upright: Floats, wall: NDArray[np.bool_], hole: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Walls behind near surfaces.

    Args:
        upright: inverse of the horizontal distance, (h, w) 1/m.
        wall: (h, w) where that is of something upright; hole: (h, w) near surfaces.

    Returns:
        Inverse horizontal distance of the farthest wall of each column (w,) and of the wall behind each pixel of
        ``hole`` (h, w), both 0 where there is none.
    """
    from instant_ic.vspace import continuation_kernels as kernels

    height, width = hole.shape
    far, found = np.zeros(width, np.float32), np.zeros(hole.shape, np.float32)
    kernels.farthest_walls(upright, wall, np.float32(_FAR_SHARE), far)
    kernels.walls_behind(
        upright, wall, hole, far, _pixels(_LOOK_RAD, height), _pixels(_SPAN_RAD, height),
        *(np.float32(value) for value in (SAME, WALL_BEHIND, _SLOPE_PRIOR, _FARTHEST_M)), found,
    )  # fmt: skip
    return far, found


def continued_colours(
    rgb: NDArray[np.uint8], planes: Floats, kind: NDArray[np.uint8], edge: NDArray[np.bool_], hole: NDArray[np.bool_],
    upright: Floats, slope: Floats, far: Floats, found: Floats,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:  # fmt: skip
    """Colours of the surfaces behind near ones.

    Args:
        rgb: (h, w, 3).
        planes: inverse depth of walls, floor and ceiling where they lie behind, (3, h, w), 0 where they do not.
        kind: which of them a pixel shows, (h, w).
        edge: (h, w) pixels beside a depth edge, which have colours of both sides.
        hole, upright: as in ``continued_walls``; far, found: of it; slope: tangent of the elevation, (h, w).

    Returns:
        The panorama with ``hole`` in the colours of what lies behind, (h, w, 3), and how sure that is, (h, w) 0..255.
    """
    from instant_ic.vspace import continuation_kernels as kernels

    height, width = hole.shape
    reach = _pixels(_SEARCH_RAD, height)
    total, covered, sure = np.zeros(rgb.shape, np.float32), np.zeros(hole.shape, np.float32), np.zeros_like(upright)
    weight = np.maximum(upright, np.float32(1e-3)) ** np.float32(-4)  # what is far goes on behind what is near
    for number, plane in enumerate(planes):
        # Within a pixel of the line where two planes meet both have a share.
        ahead = plane - np.delete(planes, number, 0).max(axis=0)
        step = np.maximum(np.abs(np.gradient(ahead, axis=0)), np.float32(1e-6))
        coverage = (np.clip(np.float32(0.5) + ahead / step, 0, 1) * (hole & (plane > 0))).astype(np.float32)
        if not coverage.any():
            continue
        colour = np.full(rgb.shape, -1, np.float32)
        if number == 0:
            source = (kind == 0) & ~edge
            columns, own = np.empty((width, 3), np.float32), np.zeros(hole.shape, np.float32)
            kernels.wall_colours(rgb, source, upright, far, np.float32(SAME), columns)
            kernels.continue_walls(
                rgb, source, hole, coverage, slope, upright, far, found, columns, np.float32(SAME),
                np.float32(_pixels(_FADE_RAD, height)), reach, _WALL_COLOURS, np.float32(BESIDE_SURE),
                np.float32(_pixels(_SURE_FADE_RAD, height)), colour, own,
            )  # fmt: skip
            own = np.maximum(own, np.float32(LEAST_SURE))
        else:
            # Skirting and the feet of furniture are within the floor's tolerance, but not of its colour.
            source = ~grown(grown(kind != number)) & ~edge
            kernels.continue_level(rgb, source, hole, coverage, reach, _LEVEL_COLOURS, colour)
            own = np.full(hole.shape, FLOOR_SURE if number == 1 else CEILING_SURE, np.float32)
        lost = (coverage > 0) & (colour[..., 0] < 0)
        if lost.any():
            source = source if source.any() else ~hole
            known = np.where(source[..., None], rgb, 0).astype(np.float32)
            colour[lost] = fill_holes(known, source, weight)[lost]
        total += coverage[..., None] * colour
        covered += coverage
        sure += coverage * own
    share = np.maximum(covered, np.float32(1e-6))
    filled = np.where((covered > 0)[..., None], np.rint(total / share[..., None]), rgb).astype(np.uint8)
    return filled, np.rint(255 * sure / share).astype(np.uint8)


def grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Dilate by one pixel; columns wrap."""
    mask = mask | np.roll(mask, 1, 1) | np.roll(mask, -1, 1)
    padded = np.pad(mask, ((1, 1), (0, 0)))
    return padded[:-2] | mask | padded[2:]


def _pixels(angle_rad: float, height: int) -> int:
    return max(3, round(angle_rad / math.pi * height))
