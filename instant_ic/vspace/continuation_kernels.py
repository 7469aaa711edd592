"""CPU kernels that continue walls, floor and ceiling of a panorama behind nearer surfaces (numba)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from instant_ic.vspace.nerf.kernels import _OPTIONS


@njit(**_OPTIONS)
def farthest_walls(upright, wall, share, far):  # type: ignore[no-untyped-def]
    """Write the inverse distance of the farthest wall in each column of a panorama.

    Args:
        upright: inverse of the horizontal distance, (h, w).
        wall: mask of pixels on upright surfaces, (h, w).
        share: quantile of a column's distances, from the far end, that counts as its farthest wall.
        far: inverse horizontal distance of the wall, (w,); written; 0 if no wall is visible.
    """
    height, width = upright.shape
    column = np.empty(height, np.float32)
    for u in range(width):
        count = 0
        for v in range(height):
            if wall[v, u]:
                column[count] = upright[v, u]
                count += 1
        far[u] = np.sort(column[:count])[int(share * count)] if count >= 3 else np.float32(0)


@njit(**_OPTIONS)
def walls_behind(  # type: ignore[no-untyped-def]
    upright, wall, hole, far, look, span, same, behind, slope_prior, farthest, found
):
    """Continue upright walls behind near surfaces.

    A wall that is visible above a near surface is continued behind it. If no wall is visible there, the planes of the
    walls on the left and right are extended until they meet in a corner.

    Args:
        upright, wall: as in ``farthest_walls``.
        hole: mask of pixels on near surfaces, (h, w).
        far: result of ``farthest_walls``.
        look, span: rows above a near surface, and columns beside it, to which a wall is fitted.
        same: largest ratio of neighbouring distances of one surface.
        behind: smallest ratio of a wall's distance to that of the surface in front of it.
        slope_prior: number of pseudo-observations of a wall perpendicular to the ray.
        farthest: largest distance of a continued wall, in metres.
        found: inverse horizontal distance of the wall, (h, w); written; 0 if there is none.
    """
    height, width = upright.shape
    found[:] = 0
    for u in range(width):
        top = 0
        while top < height:
            if not hole[top, u]:
                top += 1
                continue
            end = top + 1
            while end < height and hole[end, u] and _alike(upright[end, u], upright[end - 1, u], same):
                end += 1
            hidden = upright[(top + end) // 2, u]
            value, count = np.float32(0), 0
            for v in range(top - 3, max(top - 3 - look, -1), -1):
                if wall[v, u] and upright[v, u] * behind < hidden:
                    value += upright[v, u]
                    count += 1
            if count >= 3:
                value = min(value / count, far[u]) if far[u] > 0 else value / count
            else:
                value = np.float32(0)
                for side in (-1, 1):
                    value = max(value, _plane_beside(
                        upright, far, u, (top + end) // 2, hidden, side, span, same, behind, slope_prior, farthest
                    ))  # fmt: skip
            found[top:end, u] = value
            top = end


@njit(**_OPTIONS)
def _alike(a, b, factor):  # type: ignore[no-untyped-def]
    return max(a, b) < factor * min(a, b)


@njit(**_OPTIONS)
def _plane_beside(upright, far, u, row, hidden, side, span, same, behind, slope_prior, farthest):  # type: ignore[no-untyped-def]
    """Return the inverse distance at column ``u`` of the wall that is visible on one side; 0 if there is no wall."""
    width = far.shape[0]
    step = np.float32(2 * math.pi / width)
    front = hidden
    for gap in range(1, width // 4):
        anchor = (u + side * gap) % width
        if far[anchor] > 0 and far[anchor] * behind < front and far[anchor] * behind < hidden:
            break
        if _alike(upright[row, anchor], front, same):
            front = upright[row, anchor]
        elif far[anchor] > 0:
            front = far[anchor]
    else:
        return np.float32(0)
    anchor = (anchor + 2 * side) % width  # the first columns mix near surface and wall
    gap += 2
    # A plane is q(a) = x cos a + y sin a, where a is the angle from the anchor, away from the gap.
    sum_cc, sum_cs, sum_ss, sum_cq, sum_sq = 0.0, 0.0, 0.0, 0.0, 0.0
    last = far[anchor]
    for k in range(span):
        q = far[(anchor + side * k) % width]
        if q <= 0 or not _alike(q, last, same):
            break
        last = q
        c, s = math.cos(k * step), math.sin(k * step)
        sum_cc, sum_cs, sum_ss = sum_cc + c * c, sum_cs + c * s, sum_ss + s * s
        sum_cq, sum_sq = sum_cq + c * q, sum_sq + s * q
    if sum_cc == 0:
        return np.float32(0)
    sum_ss += slope_prior * math.sin(span * step) ** 2
    determinant = sum_cc * sum_ss - sum_cs * sum_cs
    x = (sum_cq * sum_ss - sum_sq * sum_cs) / determinant
    y = (sum_sq * sum_cc - sum_cq * sum_cs) / determinant
    value = x * math.cos(gap * step) - y * math.sin(gap * step)
    value = min(max(value, 1 / farthest, 0.3 * far[anchor]), 3 * far[anchor])
    return np.float32(value) if value * behind < hidden else np.float32(0)


@njit(**_OPTIONS)
def wall_colours(rgb, source, upright, far, same, colours):  # type: ignore[no-untyped-def]
    """Write the common colour of the farthest wall in each column, (w, 3) float32; −1 if it is not visible.

    Args:
        rgb: panorama, (h, w, 3).
        source: mask of pixels that show walls, (h, w).
        upright, far, same: as in ``walls_behind``.
    """
    height, width = source.shape
    some = np.empty((height, 3), np.float32)
    for u in range(width):
        count = 0
        for v in range(height):
            if source[v, u] and _alike(upright[v, u], far[u], same):
                for c in range(3):
                    some[count, c] = rgb[v, u, c]
                count += 1
        for c in range(3):
            colours[u, c] = np.median(some[:count, c]) if count else np.float32(-1)


@njit(**_OPTIONS)
def _colour_above(rgb, source, upright, found, v, u, same, some, total):  # type: ignore[no-untyped-def]
    """Write the median colour of the wall's visible part above a pixel; return False if there is none.

    Args:
        rgb, source, upright, found, same: as in ``continue_walls``.
        v, u: row and column of the pixel.
        some: scratch memory, (most, 3).
        total: the colour, (3,); written.
    """
    count, first = 0, 0
    for n in range(v - 1, -1, -1):
        if source[n, u] and _alike(upright[n, u], found[v, u], same):
            first = first if count else v - n
            for c in range(3):
                some[count, c] = rgb[n, u, c]
            count += 1
            if count >= min(some.shape[0], 2 + first):
                break
    for c in range(3):
        total[c] = np.median(some[:count, c]) if count else np.float32(0)
    return count > 0


@njit(**_OPTIONS)
def _colour_beside(  # type: ignore[no-untyped-def]
    rgb, source, slope, upright, far, found, column_colour, v, u, side, same, fade, reach, some, total
):
    """Add the colour of the wall on one side of a pixel to ``total`` (3,).

    Args:
        rgb, source, slope, upright, far, found, column_colour, same, fade, reach: as in ``continue_walls``.
        v, u: row and column of the pixel.
        side: −1 left, 1 right.
        some: scratch memory, (most, 3).

    Returns:
        Weight of the colour and distance of the wall in columns; weight 0 if no wall is visible on this side.
    """
    height, width = source.shape
    rows = np.float32(height / math.pi)
    count, first, q, anchor = 0, 0, found[v, u], 0
    for gap in range(1, reach):
        m = (u + side * gap) % width
        if column_colour[m, 0] < 0 or not _alike(far[m], q, same):
            if count > 0:
                break
            continue
        q = far[m]
        if count == 0:
            first, anchor = gap, m
        for c in range(3):
            some[count, c] = column_colour[m, c]
        count += 1
        if count >= some.shape[0]:
            break
    if count == 0:
        return np.float32(0), reach
    q = far[anchor]
    n = int((np.float32(math.pi / 2) - math.atan(slope[v, u] * q / found[v, u])) * rows)
    here, weight = 0.0, np.float32(0.05) / np.float32(first * first)
    if 0 <= n < height and source[n, anchor] and _alike(upright[n, anchor], q, same):
        here = math.exp(-np.float32(first) / fade)
        weight *= 20
    for c in range(3):
        common = np.median(some[:count, c])
        total[c] += weight * (common + here * (np.float32(rgb[n, anchor, c]) - common) if here > 0 else common)
    return weight, first


@njit(**_OPTIONS)
def continue_walls(  # type: ignore[no-untyped-def]
    rgb, source, hole, coverage, slope, upright, far, found, column_colour, same, fade, reach, most, sure_share,
    sure_fade, colour, sure,
):  # fmt: skip
    """Continue the colours of walls into holes.

    If the wall is visible above a pixel, its colour is taken from there. Otherwise the visible parts on both sides are
    mixed: near them, with their colours at the same height; farther away, with the wall's median colour.

    Args:
        rgb: panorama, (h, w, 3).
        source, hole: masks of the pixels that show walls, and of the pixels to fill, (h, w) each.
        coverage: share of the wall in each pixel; pixels above 0 are coloured, (h, w).
        slope: tangent of each pixel's elevation, (h, w).
        upright, far, found, same: as in ``walls_behind``.
        column_colour: colours of ``wall_colours``.
        fade: columns over which colours at the same height fade into the median colour.
        reach: largest number of columns that are searched.
        most: number of pixels for a median colour.
        sure_share, sure_fade: opacity beside a visible part, and columns over which it falls by a factor of e.
        colour: colours of the hidden walls, (h, w, 3) float32; written; −1 if none was found.
        sure: opacity, (h, w); written; 1 below a visible part of the wall.
    """
    height, width = hole.shape
    some = np.empty((most, 3), np.float32)
    total = np.zeros(3, np.float32)
    for v in range(height):
        for u in range(width):
            if not hole[v, u] or coverage[v, u] <= 0:
                continue
            weights, nearest = np.float32(1), 0
            if not _colour_above(rgb, source, upright, found, v, u, same, some, total):
                weights, nearest = np.float32(0), reach
                for side in (-1, 1):
                    weight, first = _colour_beside(
                        rgb, source, slope, upright, far, found, column_colour, v, u, side, same, fade, reach, some,
                        total,
                    )  # fmt: skip
                    weights += weight
                    nearest = min(nearest, first)
            sure[v, u] = np.float32(1) if nearest == 0 else sure_share * math.exp(-np.float32(nearest) / sure_fade)
            for c in range(3):
                colour[v, u, c] = total[c] / weights if weights > 0 else np.float32(-1)


@njit(**_OPTIONS)
def continue_level(rgb, source, hole, coverage, reach, most, colour):  # type: ignore[no-untyped-def]
    """Continue floor or ceiling into holes along rows, because all pixels of a row are at the same distance.

    Args:
        rgb, source, hole, coverage, reach, colour: as in ``continue_walls``.
        most: number of pixels on each side for a median colour; fewer are used close by.
    """
    height, width = hole.shape
    some = np.empty((most, 3), np.float32)
    total = np.zeros(3, np.float32)
    for v in range(height):
        for u in range(width):
            if not hole[v, u] or coverage[v, u] <= 0:
                continue
            total[:] = 0
            weights = np.float32(0)
            for side in (-1, 1):
                count, weight = 0, np.float32(0)
                for gap in range(1, reach):
                    m = (u + side * gap) % width
                    if not source[v, m]:
                        continue
                    if count == 0:
                        weight = np.float32(1) / np.float32(gap * gap)
                    for c in range(3):
                        some[count, c] = rgb[v, m, c]
                    count += 1
                    if count >= min(most, 1 + gap):
                        break
                if count:
                    weights += weight
                    for c in range(3):
                        total[c] += weight * np.median(some[:count, c])
            for c in range(3):
                colour[v, u, c] = total[c] / weights if weights > 0 else np.float32(-1)
