"""CPU kernels of ``layer_mesh`` (numba)."""

from __future__ import annotations

import numpy as np
from numba import njit

from instant_ic.vspace.nerf.kernels import _OPTIONS

SAME_SURFACE = 0.1
"""Largest relative difference of inverse depths at which pixels around a corner show the same surface."""


@njit(**_OPTIONS)
def corner_values(inverse, torn):  # type: ignore[no-untyped-def]
    """Return the inverse depth at the pixels' corners, (h + 1, w): the mean of the pixels around, at poles of a row."""
    height, width = inverse.shape
    corners = np.empty((height + 1, width), np.float32)
    for u in range(width):
        before = (u - 1) % width
        for v in range(1, height):
            mean = inverse[v - 1, before] + inverse[v - 1, u] + inverse[v, before] + inverse[v, u]
            corners[v, u] = np.float32(0.25) * mean
    corners[0] = inverse[0].mean()
    corners[height] = inverse[height - 1].mean()
    return corners


@njit(**_OPTIONS)
def _apart(corners, directions, a, b, c, m):  # type: ignore[no-untyped-def]
    """Return the error of the inverse depth at corner ``m`` on the plane through corners ``a``, ``b`` and ``c``.

    Corners are (row, column). On a plane the inverse depth is a linear function of the direction.
    """
    width = corners.shape[1]
    da, db = directions[a[0], a[1] % width], directions[b[0], b[1] % width]
    dc, dm = directions[c[0], c[1] % width], directions[m[0], m[1] % width]
    ia, ib = corners[a[0], a[1] % width], corners[b[0], b[1] % width]
    ic, im = corners[c[0], c[1] % width], corners[m[0], m[1] % width]
    bx, by, bz = db[1] * dc[2] - db[2] * dc[1], db[2] * dc[0] - db[0] * dc[2], db[0] * dc[1] - db[1] * dc[0]
    cx, cy, cz = dc[1] * da[2] - dc[2] * da[1], dc[2] * da[0] - dc[0] * da[2], dc[0] * da[1] - dc[1] * da[0]
    ax, ay, az = da[1] * db[2] - da[2] * db[1], da[2] * db[0] - da[0] * db[2], da[0] * db[1] - da[1] * db[0]
    volume = da[0] * bx + da[1] * by + da[2] * bz
    if abs(volume) < 1e-7:  # at a pole
        return abs(np.float32(0.5) * (ia + ib) - im)
    at = ia * (dm[0] * bx + dm[1] * by + dm[2] * bz)
    at += ib * (dm[0] * cx + dm[1] * cy + dm[2] * cz)
    at += ic * (dm[0] * ax + dm[1] * ay + dm[2] * az)
    return abs(at / volume - im)


@njit(**_OPTIONS)
def lattice_errors(corners, directions, alone, tile):  # type: ignore[no-untyped-def]
    """Return the largest error of the inverse depth if a corner, and all corners that depend on it, are left out.

    A corner is the middle of the longest side of the two triangles that it splits. A square is split first at its
    centre, then at the middles of its sides, then at the centres of its quarters. The error of a corner is at least
    that of the corners split after it. The result is (h + 1, w).

    Args:
        corners: inverse depth at the corners, (h + 1, w).
        directions: unit vectors of the corners, (h + 1, w, 3).
        alone: mask of pixels that are separate squares, whose corners are never left out, (h, w).
        tile: side of the largest squares, in pixels, a power of two.
    """
    height, width = alone.shape
    errors = np.zeros((height + 1, width), np.float32)
    for v in range(height):
        for u in range(width):
            if alone[v, u]:
                right = (u + 1) % width
                errors[v, u] = errors[v, right] = errors[v + 1, u] = errors[v + 1, right] = np.inf
    side = 2
    while side <= tile:
        half = side // 2
        for v in range(0, height + 1, half):  # middles of sides
            for u in range(half if v % side == 0 else 0, width, side):
                if v % side == 0:
                    a, b = (v, u - half), (v, u + half)
                    c, d = (v - half, u), (v + half, u)
                else:
                    a, b = (v - half, u), (v + half, u)
                    c, d = (v, u - half), (v, u + half)
                m = (v, u)
                worst = errors[v, u]
                if c[0] >= 0:
                    worst = max(worst, _apart(corners, directions, a, b, c, m))
                if d[0] <= height:
                    worst = max(worst, _apart(corners, directions, a, b, d, m))
                if half > 1:  # centres of the quarters around
                    quarter = half // 2
                    for dv in (-quarter, quarter):
                        for du in (-quarter, quarter):
                            if 0 <= v + dv <= height:
                                worst = max(worst, errors[v + dv, (u + du) % width])
                errors[v, u] = worst
        for v in range(half, height, side):  # centres
            for u in range(half, width, side):
                # The diagonal points to the centre of the next larger square.
                if ((v // side) + (u // side)) % 2 == 0:
                    a, b, c, d = (v - half, u - half), (v + half, u + half), (v - half, u + half), (v + half, u - half)
                else:
                    a, b, c, d = (v - half, u + half), (v + half, u - half), (v - half, u - half), (v + half, u + half)
                m = (v, u)
                worst = max(errors[v, u], _apart(corners, directions, a, b, c, m))
                worst = max(worst, _apart(corners, directions, a, b, d, m))
                worst = max(worst, errors[v - half, u], errors[v + half, u])
                worst = max(worst, errors[v, u - half], errors[v, (u + half) % width])
                errors[v, u] = worst
        side *= 2
    return errors


@njit(**_OPTIONS)
def _push(stack, n, cv, cu, av, au, bv, bu):  # type: ignore[no-untyped-def]
    stack[n, 0], stack[n, 1], stack[n, 2], stack[n, 3], stack[n, 4], stack[n, 5] = cv, cu, av, au, bv, bu


@njit(**_OPTIONS)
def _leaves(errors, alone, tile, limit, out):  # type: ignore[no-untyped-def]
    """Write the triangles to ``out``, (T, 6) int32: row and column of the apex and of the long side's two ends.

    Return the number of triangles; if ``out`` has no rows, they are only counted. Triangles in pixels that are
    ``alone`` are left out.
    """
    height, width = alone.shape
    stack = np.empty((64, 6), np.int32)
    count = 0
    for top in range(0, height, tile):
        for left in range(0, width, tile):
            bottom, right = top + tile, left + tile
            if ((top // tile) + (left // tile)) % 2 == 0:
                _push(stack, 0, top, right, top, left, bottom, right)
                _push(stack, 1, bottom, left, bottom, right, top, left)
            else:
                _push(stack, 0, top, left, bottom, left, top, right)
                _push(stack, 1, bottom, right, top, right, bottom, left)
            filled = 2
            while filled > 0:
                filled -= 1
                cv, cu, av, au, bv, bu = stack[filled]
                mv, mu = (av + bv) // 2, (au + bu) // 2
                smallest = abs(av - bv) + abs(au - bu) == 2 and av != bv and au != bu
                if not smallest and errors[mv, mu % width] > limit:
                    _push(stack, filled, mv, mu, cv, cu, av, au)
                    _push(stack, filled + 1, mv, mu, bv, bu, cv, cu)
                    filled += 2
                    continue
                if smallest and alone[min(av, bv), min(au, bu)]:
                    continue
                if len(out) > 0:
                    _push(out, count, cv, cu, av, au, bv, bu)
                count += 1
    return count


@njit(**_OPTIONS)
def count_triangles(errors, alone, shown, tile, limit):  # type: ignore[no-untyped-def]
    """Return the number of vertices (an upper limit) and of triangles."""
    triangles = _leaves(errors, alone, tile, limit, np.empty((0, 6), np.int32))
    squares = 0
    for v in range(alone.shape[0]):
        for u in range(alone.shape[1]):
            squares += alone[v, u] and shown[v, u]
    return 3 * triangles + 4 * squares, triangles + 2 * squares


@njit(**_OPTIONS)
def _inner_slope(own, inner, shown):  # type: ignore[no-untyped-def]
    """Return the change of inverse depth from the pixel on the inner side; 0 if that pixel shows another surface."""
    same = shown and abs(own - inner) <= SAME_SURFACE * min(own, inner)
    return own - inner if same else np.float32(0)


@njit(**_OPTIONS)
def _continued(inverse, shown, v, u, down, right):  # type: ignore[no-untyped-def]
    """Return the inverse depth at a pixel's corner (``down``, ``right``: 0 or 1) if its surface is continued."""
    height, width = inverse.shape
    own = inverse[v, u]
    side, above = (u + 1 - 2 * right) % width, min(max(v + 1 - 2 * down, 0), height - 1)
    slope = _inner_slope(own, inverse[v, side], shown[v, side]) + _inner_slope(own, inverse[above, u], shown[above, u])
    return own + np.float32(0.5) * slope


@njit(**_OPTIONS)
def _edge_value(inverse, shown, v, u, down, right):  # type: ignore[no-untyped-def]
    """Return the inverse depth at a corner of a pixel on a depth edge: the mean of the same surface's pixels around."""
    height, width = inverse.shape
    own = _continued(inverse, shown, v, u, down, right)
    total, count = own, 1
    for dv in (0, 1):
        for du in (0, 1):
            row, column = v + down - 1 + dv, (u + right - 1 + du) % width
            if (row == v and column == u) or row < 0 or row >= height or not shown[row, column]:
                continue
            value = _continued(inverse, shown, row, column, 1 - dv, 1 - du)
            if abs(value - own) <= SAME_SURFACE * min(value, own):
                total += value
                count += 1
    return total / np.float32(count)


@njit(**_OPTIONS)
def write_triangles(errors, alone, shown, torn, inverse, corners, tile, limit, places, values, indices):  # type: ignore[no-untyped-def]
    """Write vertices and triangles, and return the number of vertices."""
    height, width = alone.shape
    at = np.full((height + 1, width), -1, np.int64)  # vertex of each corner that is shared
    leaves = np.empty((len(indices), 6), np.int32)
    count = _leaves(errors, alone, tile, limit, leaves)
    used = 0
    for n in range(count):
        for k in range(3):
            v, u = leaves[n, 2 * k], leaves[n, 2 * k + 1] % width
            if at[v, u] < 0:
                at[v, u] = used
                places[used, 0], places[used, 1], values[used] = u, v, corners[v, u]
                used += 1
            indices[n, k] = at[v, u]
    for v in range(height):
        for u in range(width):
            if not (alone[v, u] and shown[v, u]):
                continue
            square = np.empty(4, np.int64)
            for k in range(4):
                row, column = v + k // 2, (u + k % 2) % width
                if torn[row, column] or at[row, column] < 0:
                    places[used, 0], places[used, 1] = column, row
                    if torn[row, column]:
                        values[used] = _edge_value(inverse, shown, v, u, k // 2, k % 2)
                    else:
                        values[used] = corners[row, column]
                    square[k] = used
                    if not torn[row, column]:
                        at[row, column] = used
                    used += 1
                else:
                    square[k] = at[row, column]
            indices[count, 0], indices[count, 1], indices[count, 2] = square[0], square[2], square[1]
            indices[count + 1, 0], indices[count + 1, 1], indices[count + 1, 2] = square[1], square[2], square[3]
            count += 2
    return used
