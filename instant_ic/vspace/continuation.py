"""Continuation of walls, floor and ceiling of a panorama behind nearer surfaces.

1. ``continued_walls``: find the wall behind each hidden pixel. Walls are vertical, so the part visible above a near
   surface is continued below it. If no part is visible, the planes of the walls on both sides are extended.
2. ``continued_colours``: colour each surface from its own visible part, and mix two surfaces within a pixel of the line
   where they meet. Floor and ceiling are horizontal, so that all pixels of a row are at the same distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.vspace.nerf.field import Floats
from instant_ic.vspace.prior import fill_holes


@dataclass(frozen=True)
class ContinuationConfig:
    """Tuning of the continuation; angles as seen from the keyframe's camera.

    Attributes:
        same: largest ratio of neighbouring distances of one surface.
        wall_behind: smallest ratio of a wall's distance to that of the surface in front of it; walls that are nearer
            cannot be distinguished from errors of the depth.
        far_share: share of a column's upright surfaces, from the far end, that count as its farthest wall.
        look_rad: height above a near surface in which the wall behind it is searched.
        span_rad: width over which a wall's plane is fitted.
        search_rad: largest distance at which colours are searched.
        slope_prior: number of pseudo-observations of a wall perpendicular to the ray.
        farthest_m: largest distance of a continued wall, in metres.
        fade_rad: distance over which a wall's pixels fade into the wall's median colour.
        wall_colours: number of pixels for the median colour of a wall.
        level_colours: number of pixels for the median colour of floor or ceiling.
        floor_opacity: weight of the continued floor in the view; the remainder is filled from neighbouring pixels.
        ceiling_opacity: weight of the continued ceiling.
        beside_opacity: weight of a sideways continued wall, next to its visible part. A wall continued downwards has
            weight 1. Sideways is less certain, because the wall may end, for instance at a doorway.
        least_opacity: weight of a sideways continued wall far from its visible part.
        opacity_fade_rad: distance over which the weight of a sideways continued wall falls by a factor of e.
    """

    same: float = 1.15
    wall_behind: float = 1.3
    far_share: float = 0.25
    look_rad: float = 0.15
    span_rad: float = 0.25
    search_rad: float = 1.5
    slope_prior: float = 2.0
    farthest_m: float = 30.0
    fade_rad: float = 0.1
    wall_colours: int = 24
    level_colours: int = 40
    floor_opacity: float = 1.0
    ceiling_opacity: float = 0.6
    beside_opacity: float = 0.6
    least_opacity: float = 0.2
    opacity_fade_rad: float = 0.37


CONFIG = ContinuationConfig()


@dataclass(frozen=True)
class HiddenSurfaces:
    """Walls behind the hidden pixels of a panorama.

    Attributes:
        hole: hidden pixels, (h, w).
        upright: inverse horizontal distance of the visible surfaces, 1/m, (h, w).
        far: inverse horizontal distance of the farthest wall of each column, (w,); 0 if there is none.
        found: inverse horizontal distance of the wall behind each hidden pixel, (h, w); 0 if there is none.
    """

    hole: NDArray[np.bool_]
    upright: Floats
    far: Floats
    found: Floats


def continued_walls(upright: Floats, wall: NDArray[np.bool_], hole: NDArray[np.bool_]) -> HiddenSurfaces:
    """Find the walls behind near surfaces.

    Args:
        upright: inverse of the horizontal distance, 1/m, (h, w).
        wall: mask of pixels on upright surfaces, (h, w).
        hole: mask of pixels on near surfaces, (h, w).
    """
    from instant_ic.vspace import continuation_kernels as kernels

    height, width = hole.shape
    far, found = np.zeros(width, np.float32), np.zeros(hole.shape, np.float32)
    kernels.farthest_walls(upright, wall, np.float32(CONFIG.far_share), far)
    kernels.walls_behind(
        upright, wall, hole, far, _pixels(CONFIG.look_rad, height), _pixels(CONFIG.span_rad, height),
        *(np.float32(value) for value in (CONFIG.same, CONFIG.wall_behind, CONFIG.slope_prior, CONFIG.farthest_m)),
        found,
    )  # fmt: skip
    return HiddenSurfaces(hole, upright, far, found)


def continued_colours(
    rgb: NDArray[np.uint8],
    planes: Floats,
    kind: NDArray[np.uint8],
    edge: NDArray[np.bool_],
    slope: Floats,
    walls: HiddenSurfaces,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Colour the surfaces behind near ones.

    Args:
        rgb: panorama, (h, w, 3).
        planes: inverse depth of hidden wall, floor and ceiling at each pixel, (3, h, w); 0 where there is none.
        kind: surface that a pixel shows, an index into ``planes``, (h, w).
        edge: mask of pixels beside a depth edge, which mix the colours of both sides, (h, w).
        slope: tangent of the elevation, (h, w).
        walls: result of ``continued_walls``.

    Returns:
        The panorama with the hidden surfaces' colours in hidden pixels, (h, w, 3), and their opacity, (h, w) uint8.
    """
    hole, upright = walls.hole, walls.upright
    total, covered, sure = np.zeros(rgb.shape, np.float32), np.zeros(hole.shape, np.float32), np.zeros_like(upright)
    weight = np.maximum(upright, np.float32(1e-3)) ** np.float32(-4)  # far surfaces are continued behind near ones
    for number, plane in enumerate(planes):
        # Two planes are mixed within a pixel of the line where they meet.
        ahead = plane - np.delete(planes, number, 0).max(axis=0)
        step = np.maximum(np.abs(np.gradient(ahead, axis=0)), np.float32(1e-6))
        coverage = (np.clip(np.float32(0.5) + ahead / step, 0, 1) * (hole & (plane > 0))).astype(np.float32)
        if not coverage.any():
            continue
        source, colour, own = _continued_surface(number, rgb, kind, edge, coverage, slope, walls)
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


def _continued_surface(
    number: int,
    rgb: NDArray[np.uint8],
    kind: NDArray[np.uint8],
    edge: NDArray[np.bool_],
    coverage: Floats,
    slope: Floats,
    walls: HiddenSurfaces,
) -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Continue the colours of one surface: walls (0), floor (1) or ceiling (2).

    Returns:
        Pixels that show the surface (h, w), their colours (h, w, 3), −1 if none was found, and their opacity (h, w).
    """
    from instant_ic.vspace import continuation_kernels as kernels

    hole, upright = walls.hole, walls.upright
    height, width = hole.shape
    reach, same = _pixels(CONFIG.search_rad, height), np.float32(CONFIG.same)
    colour = np.full(rgb.shape, -1, np.float32)
    if number:
        # Skirting and the feet of furniture lie on the floor's plane within its tolerance, but differ in colour.
        source = ~grown(grown(kind != number)) & ~edge
        kernels.continue_level(rgb, source, hole, coverage, reach, CONFIG.level_colours, colour)
        opacity = CONFIG.floor_opacity if number == 1 else CONFIG.ceiling_opacity
        return source, colour, np.full(hole.shape, opacity, np.float32)
    source = (kind == 0) & ~edge
    columns, own = np.empty((width, 3), np.float32), np.zeros(hole.shape, np.float32)
    kernels.wall_colours(rgb, source, upright, walls.far, same, columns)
    kernels.continue_walls(
        rgb, source, hole, coverage, slope, upright, walls.far, walls.found, columns, same,
        np.float32(_pixels(CONFIG.fade_rad, height)), reach, CONFIG.wall_colours, np.float32(CONFIG.beside_opacity),
        np.float32(_pixels(CONFIG.opacity_fade_rad, height)), colour, own,
    )  # fmt: skip
    return source, colour, np.maximum(own, np.float32(CONFIG.least_opacity))


def grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Dilate by one pixel; columns wrap."""
    mask = mask | np.roll(mask, 1, 1) | np.roll(mask, -1, 1)
    padded = np.pad(mask, ((1, 1), (0, 0)))
    return padded[:-2] | mask | padded[2:]


def _pixels(angle_rad: float, height: int) -> int:
    return max(3, round(angle_rad / math.pi * height))
