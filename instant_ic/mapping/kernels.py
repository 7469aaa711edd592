"""Compiled loops of the local model, a window of voxel columns that moves with the robot.

Adding a revolution (``add_revolution``; occupancy mapping by log odds, Moravec and Elfes, 1985):

1. ``_free_beams``: walk every n-th beam through the columns (Amanatides and Woo, 1987) and lower the odds of the voxels
   that it passes, except where it passes beside or along a known surface.
2. ``_add_ends``: raise the odds of the voxels in which beams end, and add the ends to the moments of their column.

Rendering a depth image:

3. ``solid_columns``: find the solid voxels and the surface of each column. ``_index_columns`` numbers the columns,
   ``_measured_voxels`` marks measured voxels and those between them, ``_continue_upwards`` marks voxels above them, and
   ``_bridge`` closes gaps between columns.
4. ``put_plates``: continue the tops of low objects behind their faces.
5. ``cast_rays``: walk each pixel's ray through the columns to the first surface (``_cast``).

State of the model, with N a power of two:

- ``key`` (N, N, 2) int32: cell that each column holds. The window is never shifted: a column is reused when a point or
  a beam reaches another cell with the same index modulo N.
- ``odds`` (N, N, L) int8: log odds of each voxel, 0 where nothing was measured.
- ``sums`` (N, N, 6) float32: count, x, y, xx, xy and yy of a column's points, relative to its cell's centre.
- ``last`` (N, N) float32: path length of the robot at the newest point, in the unit of ``now``.
- ``sight`` (N, N) float32: greatest height that the uppermost ring has reached in a column with points.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

HIT, MOST, LEAST = 4, 12, -8
THROUGH = 2  # odds that a beam subtracts in a column through whose mean it passes; in an empty column it subtracts 1
OCCUPIED, FREE = 3, -2
UNSEEN, OPEN, PLATE = -2, -1, -10  # values in the index of columns
_BESIDE_M = 0.02  # largest distance from a column's mean at which a beam counts as passing through its surface
_GRAZING = 4.0  # a beam grazes a surface if the variance of its points along the beam is this factor of that across
_CROWDED_M = 1.2  # below this range, beams are so dense that a quarter of them is enough
_SHORT_OF_M = 0.12  # distance before a beam's end at which it stops freeing space
_THING_CELLS = 12  # distance, in cells, up to which columns of an object share their height
_HANGS_M = 1.5  # height that separates sills, shelves and table tops from lintels
_RINGS = math.radians(2.0)  # angle between two rings; the uppermost ring alone may lack a return
_MOST_POINTS = 256.0  # number of points at which a column's sums are halved, so that they follow changes

# Reasons for a voxel to be solid.
EMPTY, MEASURED, BETWEEN, UP, DOWN, BEHIND = 0, 1, 2, 3, 4, 5
# Surfaces on which a ray ends: one of the above for an upright surface, or:
NOTHING, TOP, FLOOR, CEILING, ASSUMED = 0, 6, 7, 8, 9
# A doubtful UP: beams there had no return (a window above the wall or behind the object), or the column has free space
# below (a sill). A ray passes through it as long as the columns behind are known.
PANE = 10


@njit(cache=True)
def _take(key, odds, sums, last, sight, ix, iy, now, keep):  # type: ignore[no-untyped-def]
    """Return the indices of a cell's column. Clear the column first if it holds another cell or is too old."""
    n = key.shape[0]
    a, b = ix & (n - 1), iy & (n - 1)
    if key[a, b, 0] != ix or key[a, b, 1] != iy or now - last[a, b] > keep:
        key[a, b, 0], key[a, b, 1] = ix, iy
        odds[a, b, :] = 0
        sums[a, b, :] = 0
        last[a, b] = now
        sight[a, b] = -np.inf
    return a, b


@njit(cache=True)
def _walk(origin, dx, dy, t, cell):  # type: ignore[no-untyped-def]
    """Return the cell at ``t`` along a ray, the steps to the next cell, ``t`` at the next borders, its increments."""
    ix, iy = math.floor((origin[0] + t * dx) / cell), math.floor((origin[1] + t * dy) / cell)
    step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    next_x = ((ix + (dx > 0)) * cell - origin[0]) / dx if dx != 0 else np.inf
    next_y = ((iy + (dy > 0)) * cell - origin[1]) / dy if dy != 0 else np.inf
    per_x = cell / abs(dx) if dx != 0 else np.inf
    per_y = cell / abs(dy) if dy != 0 else np.inf
    return ix, iy, step_x, step_y, next_x, next_y, per_x, per_y


@njit(cache=True)
def _free_beams(key, odds, sums, last, sight, points, origin, cell, low, now, keep, first, stride, reach):  # type: ignore[no-untyped-def]
    """Lower the odds of the voxels that beams have passed; see ``add_revolution`` for the arguments."""
    levels, moments = odds.shape[2], np.empty(6)
    for i in range(first, len(points), stride):
        dx, dy, dz = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if not length > 0.3:
            continue
        dx, dy, dz = dx / length, dy / length, dz / length
        end = min(length - _SHORT_OF_M, reach)
        flat = math.sqrt(dx * dx + dy * dy)
        t = 0.0 if (i >> 6) & 3 == 0 else _CROWDED_M
        ix, iy, step_x, step_y, next_x, next_y, per_x, per_y = _walk(origin, dx, dy, t, cell)
        while t < end:
            leave = min(next_x, next_y, end)
            a, b = _take(key, odds, sums, last, sight, ix, iy, now, keep)
            passes, takes = True, 1
            count = sums[a, b, 0]
            if count > 0:
                mx = (ix + 0.5) * cell + sums[a, b, 1] / count - origin[0]
                my = (iy + 0.5) * cell + sums[a, b, 2] / count - origin[1]
                passes, takes = abs(mx * dy - my * dx) < _BESIDE_M * flat, THROUGH
                passes = passes and not _runs_along(key, sums, a, b, cell, dx / flat, dy / flat, moments)
            if passes:
                z0 = math.floor((origin[2] + t * dz - low) / cell)
                z1 = math.floor((origin[2] + leave * dz - low) / cell)
                for level in range(max(min(z0, z1), 0), min(max(z0, z1), levels - 1) + 1):
                    if odds[a, b, level] > LEAST:
                        odds[a, b, level] -= takes
            t = leave
            if next_x < next_y:
                ix += step_x
                next_x += per_x
            else:
                iy += step_y
                next_y += per_y


@njit(cache=True)
def _add_ends(key, odds, sums, last, sight, points, origin, cell, low, body, now, keep, reach):  # type: ignore[no-untyped-def]
    """Raise the odds at the beams' ends and add the ends to their columns; see ``add_revolution`` for the arguments."""
    levels, steepest = odds.shape[2], -np.inf
    for i in range(len(points)):
        dx, dy = points[i, 0] - origin[0], points[i, 1] - origin[1]
        steepest = max(steepest, (points[i, 2] - origin[2]) / max(math.sqrt(dx * dx + dy * dy), 1e-3))
    slope = math.tan(math.atan(steepest) - _RINGS)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        dx, dy = x - origin[0], y - origin[1]
        if not dx * dx + dy * dy < reach * reach:
            continue
        ix, iy = math.floor(x / cell), math.floor(y / cell)
        a, b = _take(key, odds, sums, last, sight, ix, iy, now, keep)
        last[a, b] = now
        sight[a, b] = max(sight[a, b], origin[2] + slope * math.sqrt(dx * dx + dy * dy))
        level = math.floor((z - low) / cell)
        if 0 <= level < levels:
            odds[a, b, level] = min(odds[a, b, level] + HIT, MOST)
        if body[0] < z < body[1]:
            if sums[a, b, 0] >= _MOST_POINTS:
                sums[a, b, :] *= np.float32(0.5)
            u, v = x - (ix + 0.5) * cell, y - (iy + 0.5) * cell
            sums[a, b, 0] += 1
            sums[a, b, 1] += u
            sums[a, b, 2] += v
            sums[a, b, 3] += u * u
            sums[a, b, 4] += u * v
            sums[a, b, 5] += v * v


@njit(cache=True)
def add_revolution(key, odds, sums, last, sight, points, origin, cell, low, body, now, keep, first, stride, reach):  # type: ignore[no-untyped-def]
    """Free the voxels that beams have passed, then add the beams' ends. All lengths are metres in the model's frame.

    Args:
        key, odds, sums, last, sight: state of the model.
        points: ends of the beams, (M, 3); origin: start of the beams, (3,).
        cell: side of a voxel; low: height of the lowest voxels.
        body: range of heights (from, to) whose points enter a column's moments.
        now, keep: path length of the robot now, and path length after which columns are forgotten.
        first, stride: the beams ``first``, ``first + stride``, ... free space.
        reach: largest range; farther points are not added, and beams free space only up to it.
    """
    _free_beams(key, odds, sums, last, sight, points, origin, cell, low, now, keep, first, stride, reach)
    _add_ends(key, odds, sums, last, sight, points, origin, cell, low, body, now, keep, reach)


@njit(cache=True)
def _runs_along(key, sums, a, b, cell, dx, dy, moments):  # type: ignore[no-untyped-def]
    """Return whether a beam of horizontal direction (``dx``, ``dy``) grazes the surface of a column's points.

    Such a beam passes close to the surface in many columns. Whether it passes beside or through it would depend on a
    centimetre, and poses are not that accurate.
    """
    _moments(key, sums, a, b, cell, 1, moments)
    along = moments[2] * dx * dx + 2 * moments[3] * dx * dy + moments[4] * dy * dy
    return along > _GRAZING * (moments[2] + moments[4] - along)


@njit(cache=True)
def ceiling_levels(key, odds, last, now, keep, centre, within, first, under):  # type: ignore[no-untyped-def]
    """Return the histogram (L,) of the level of the uppermost solid voxel in the columns around cell ``centre`` (2,).

    Columns with points in the ``under`` levels below it, except directly below, do not count: they may be walls.
    """
    n, levels = key.shape[0], odds.shape[2]
    found = np.zeros(levels, np.int64)
    for a in range(n):
        for b in range(n):
            if now - last[a, b] > keep:
                continue
            if abs(key[a, b, 0] - centre[0]) > within or abs(key[a, b, 1] - centre[1]) > within:
                continue
            for level in range(levels - 1, first, -1):
                if odds[a, b, level] >= OCCUPIED:
                    alone = True  # false for a wall, which has points below
                    for below in range(max(level - under, 0), level - 1):
                        alone = alone and odds[a, b, below] <= 0
                    found[level] += alone
                    break
    return found


@njit(cache=True)
def _index_columns(odds, sums, last, now, keep, ground, top, index):  # type: ignore[no-untyped-def]
    """Assign a number in ``index`` to each column with a solid voxel, and return their count."""
    n, count = odds.shape[0], 0
    for a in range(n):
        for b in range(n):
            index[a, b] = UNSEEN
            if now - last[a, b] > keep:
                continue
            index[a, b] = OPEN
            if sums[a, b, 0] > 0:
                for level in range(ground, top):
                    if odds[a, b, level] >= OCCUPIED:
                        index[a, b] = count
                        count += 1
                        break
    return count


@njit(cache=True)
def _measured_voxels(odds, code, tops, ground, top):  # type: ignore[no-untyped-def]
    """Mark the solid voxels of a column that follow from its own measurements.

    Args:
        odds: log odds of the column, (L,); code: result, (L,); ground, top: as in ``solid_columns``.
        tops: result, (3,): one past the highest measured level, first free level above it, and one past the highest
            level with repeated hits.
    """
    levels, below = len(odds), -1
    for level in range(ground, top):
        if odds[level] < OCCUPIED:
            continue
        code[level] = MEASURED
        if odds[level] >= 2 * HIT:
            tops[2] = level + 1
        _fill_between(code, odds, below, level, ground)
        below = level
    tops[0] = tops[1] = below + 1
    while tops[1] < levels and odds[tops[1]] > FREE:
        tops[1] += 1


@njit(cache=True)
def _continue_upwards(key, odds, sight, index, a, b, tops, highest, low, cell, ground, top, code):  # type: ignore[no-untyped-def]
    """Continue a column above its measured part to the ceiling or its object's top, as most neighbours do."""
    n, levels = key.shape[0], odds.shape[2]
    at, x0, y0 = index[a, b], key[a, b, 0], key[a, b, 1]
    open_above, ends = 0, 0
    for i in range(-2, 3):
        for j in range(-2, 3):
            p, q = (x0 + i) & (n - 1), (y0 + j) & (n - 1)
            if index[p, q] >= 0 and key[p, q, 0] == x0 + i and key[p, q, 1] == y0 + j:
                if tops[index[p, q], 1] >= top:
                    open_above += 1
                else:
                    ends += 1
    end = tops[at, 1]
    height = low + tops[at, 0] * cell
    hangs = height < _HANGS_M and _hangs(odds[a, b], ground)
    if end < top and open_above > 2 * ends:
        end = levels
    elif end >= top and ends > 2 * open_above:
        end = tops[at, 0]
    elif end < top:
        # The column ends between the highest point and the lowest beam above, and is as high as its object. A sill, a
        # shelf or a table top is thin. If it extended half way to the beam above, it would hide the wall behind it.
        end = max(tops[at, 0] if hangs else (tops[at, 0] + end) // 2, highest[at])
    doubtful = sight[a, b] > height or hangs
    code[tops[at, 0] : end] = PANE if end == levels and doubtful else UP


@njit(cache=True)
def solid_columns(key, odds, sums, last, sight, now, keep, cell, low, ground, top, index):  # type: ignore[no-untyped-def]
    """Find the solid voxels and the surface of every column with points.

    Args:
        key, odds, sums, last, sight: state of the model; now, keep, cell, low: as in ``add_revolution``.
        ground, top: lowest level and one past the highest level between floor and ceiling.
        index: result, (N, N) int32: row of each column in ``codes`` and ``faces``; ``OPEN`` without a solid voxel,
            ``UNSEEN`` if nothing was measured there recently.

    Returns:
        ``codes`` (M, L) uint8, the reason for each voxel to be solid; and ``faces`` (M, 6) float32: a point (x, y) of
        the surface, its normal (0, 0 if it has none), and its extent from the point to either side.
    """
    n, levels = key.shape[0], odds.shape[2]
    count = _index_columns(odds, sums, last, now, keep, ground, top, index)
    codes = np.zeros((count, levels), np.uint8)
    faces = np.zeros((count, 6), np.float32)
    tops = np.zeros((count, 3), np.int32)
    for a in range(n):
        for b in range(n):
            at = index[a, b]
            if at >= 0:
                _measured_voxels(odds[a, b], codes[at], tops[at], ground, top)
                _set_face(key, sums, index, a, b, cell, faces[at])
    highest = _highest_around(key, index, tops, top)
    for a in range(n):
        for b in range(n):
            at = index[a, b]
            if at >= 0:
                _continue_upwards(key, odds, sight, index, a, b, tops, highest, low, cell, ground, top, codes[at])
    _bridge(key, index, faces, cell)
    return codes, faces


@njit(cache=True)
def _hangs(odds, ground):  # type: ignore[no-untyped-def]
    """Return whether a column has free space below its lowest solid voxel."""
    for level in range(ground, len(odds)):
        if odds[level] >= OCCUPIED:
            return False
        if odds[level] <= FREE:
            return True
    return False


@njit(cache=True)
def _highest_around(key, index, tops, top):  # type: ignore[no-untyped-def]
    """Return one past the highest measured level of each column's object, (M,), limited by the column's free levels.

    An object's side may have been seen only from near, where no beam reaches the upper edge that its front has shown.
    """
    n = key.shape[0]
    places = np.argwhere(index >= 0)
    highest = tops[:, 2].copy()
    for _ in range(_THING_CELLS):
        before = highest.copy()
        for a, b in places:
            at, x0, y0 = index[a, b], key[a, b, 0], key[a, b, 1]
            if tops[at, 1] >= top:
                continue
            for i in range(-1, 2):
                for j in range(-1, 2):
                    p, q = (x0 + i) & (n - 1), (y0 + j) & (n - 1)
                    beside = index[p, q]
                    if beside >= 0 and tops[beside, 1] < top and key[p, q, 0] == x0 + i and key[p, q, 1] == y0 + j:
                        highest[at] = max(highest[at], min(before[beside], tops[at, 1]))
    return highest


@njit(cache=True)
def _moments(key, sums, a, b, cell, around, total):  # type: ignore[no-untyped-def]
    """Compute mean x, y, variances xx, xy, yy and count of the points up to ``around`` cells around a column."""
    n = key.shape[0]
    x0, y0 = key[a, b, 0], key[a, b, 1]
    total[:] = 0
    for i in range(-around, around + 1):
        for j in range(-around, around + 1):
            p, q = (x0 + i) & (n - 1), (y0 + j) & (n - 1)
            c = sums[p, q, 0]
            if c == 0 or key[p, q, 0] != x0 + i or key[p, q, 1] != y0 + j:
                continue
            u, v = i * cell, j * cell
            total[0] += sums[p, q, 1] + c * u
            total[1] += sums[p, q, 2] + c * v
            total[2] += sums[p, q, 3] + 2 * u * sums[p, q, 1] + c * u * u
            total[3] += sums[p, q, 4] + u * sums[p, q, 2] + v * sums[p, q, 1] + c * u * v
            total[4] += sums[p, q, 5] + 2 * v * sums[p, q, 2] + c * v * v
            total[5] += c
    total[:5] /= total[5]
    total[2] -= total[0] * total[0]
    total[3] -= total[0] * total[1]
    total[4] -= total[1] * total[1]


@njit(cache=True)
def _set_face(key, sums, index, a, b, cell, face):  # type: ignore[no-untyped-def]
    """Set a column's surface to a plane, if the points around it lie on one, else to the mean of its points."""
    n = key.shape[0]
    x0, y0 = key[a, b, 0], key[a, b, 1]
    own, total = np.zeros(6), np.zeros(6)
    _moments(key, sums, a, b, cell, 0, own)
    for around in (2, 1):
        _moments(key, sums, a, b, cell, around, total)
        half = math.sqrt(0.25 * (total[2] - total[4]) ** 2 + total[3] * total[3])
        small, large = 0.5 * (total[2] + total[4]) - half, 0.5 * (total[2] + total[4]) + half
        if total[5] < 5 or small > 0.025**2 or large < 4 * small:
            continue
        angle = 0.5 * math.atan2(2 * total[3], total[2] - total[4])
        ux, uy = math.cos(angle), math.sin(angle)
        off_plane = abs((own[0] - total[0]) * uy - (own[1] - total[1]) * ux)
        if off_plane > 0.03 and own[5] > 0.04 * total[5]:  # fewer own points count as noise of the plane
            continue
        off = (own[0] - total[0]) * ux + (own[1] - total[1]) * uy
        face[0] = (x0 + 0.5) * cell + total[0] + off * ux
        face[1] = (y0 + 0.5) * cell + total[1] + off * uy
        face[2], face[3] = -uy, ux
        # Evenly spread points reach 1.73 standard deviations from their mean. The surface extends farther if one of the
        # next columns continues it.
        ends = 1.73 * math.sqrt(max(own[2] * ux * ux + 2 * own[3] * ux * uy + own[4] * uy * uy, 0.0)) + 0.006
        for side in range(2):
            face[4 + side] = ends
            for k in range(1, 4):
                x, y = x0 + round((1 - 2 * side) * k * ux), y0 + round((1 - 2 * side) * k * uy)
                p, q = x & (n - 1), y & (n - 1)
                if index[p, q] >= 0 and key[p, q, 0] == x and key[p, q, 1] == y:
                    face[4 + side] = (0.2 + k) * cell
                    break
        return
    face[0], face[1] = (x0 + 0.5) * cell + own[0], (y0 + 0.5) * cell + own[1]
    face[4:6] = min(0.75 * cell, 1.73 * math.sqrt(max(own[2] + own[4], 0.0)) + 0.006)


@njit(cache=True)
def _bridge(key, index, faces, cell):  # type: ignore[no-untyped-def]
    """Extend planes over columns without points, which occur far from the robot because beams diverge."""
    n = key.shape[0]
    bridged = []
    for a in range(n):
        for b in range(n):
            at = index[a, b]
            if at < 0 or (faces[at, 2] == 0 and faces[at, 3] == 0):
                continue
            ux, uy = faces[at, 3], -faces[at, 2]
            for side in range(2):
                gap = round(faces[at, 4 + side] / cell - 0.2)
                for k in range(1, gap):
                    x = key[a, b, 0] + round((1 - 2 * side) * k * ux)
                    y = key[a, b, 1] + round((1 - 2 * side) * k * uy)
                    if index[x & (n - 1), y & (n - 1)] < 0:
                        bridged.append((x, y, at))
    for x, y, at in bridged:
        key[x & (n - 1), y & (n - 1), 0], key[x & (n - 1), y & (n - 1), 1] = x, y
        index[x & (n - 1), y & (n - 1)] = at


@njit(cache=True)
def _fill_between(code, odds, below, above, ground):  # type: ignore[no-untyped-def]
    """Fill the gap below a measured voxel, from both ends up to the first free voxel; ``below`` -1 is the floor."""
    for level in range(above - 1, max(below, ground - 1), -1):
        if odds[level] <= FREE:
            break
        code[level] = DOWN if below < 0 else BETWEEN
    if below < 0:
        return
    for level in range(below + 1, above):
        if odds[level] <= FREE or code[level] != EMPTY:
            break
        code[level] = BETWEEN


@njit(cache=True)
def put_plates(key, odds, index, codes, faces, origin, cell, ground, behind, highest):  # type: ignore[no-untyped-def]
    """Continue the tops of low objects behind their measured faces, where nothing was measured.

    Args:
        key, odds: state of the model; ``key`` is updated for the new columns.
        index: result of ``solid_columns``; new columns get ``PLATE`` minus the level of the top.
        codes, faces, origin, cell, ground: as in ``cast_rays`` and ``solid_columns``.
        behind: distance to continue, in metres; highest: largest level of a top.
    """
    n, levels = key.shape[0], odds.shape[2]
    for a in range(n):
        for b in range(n):
            at = index[a, b]
            if at < 0:
                continue
            top = 0
            for level in range(ground, levels):
                if codes[at, level] != EMPTY:
                    top = level + 1
                elif top > 0:
                    break
            if codes[at, ground] == EMPTY or not ground + 1 < top <= highest:
                continue
            x, y = faces[at, 0], faces[at, 1]
            dx, dy = x - origin[0], y - origin[1]
            length = math.sqrt(dx * dx + dy * dy)
            inner = True  # outermost columns are not continued, because the object would become too wide
            for side in (-1, 1):
                found = False
                for far in (1, 2):
                    ix = math.floor((x - side * far * cell * dy / length) / cell)
                    iy = math.floor((y + side * far * cell * dx / length) / cell)
                    found = found or index[ix & (n - 1), iy & (n - 1)] >= 0
                inner = inner and found
            if not inner:
                continue
            for k in range(1, int(behind / cell * 2) + 1):
                ix = math.floor((x + dx / length * 0.5 * k * cell) / cell)
                iy = math.floor((y + dy / length * 0.5 * k * cell) / cell)
                p, q = ix & (n - 1), iy & (n - 1)
                if index[p, q] >= 0:
                    continue
                if key[p, q, 0] == ix and key[p, q, 1] == iy and odds[p, q, (ground + top) // 2] < 0:
                    break
                key[p, q, 0], key[p, q, 1] = ix, iy
                index[p, q] = min(index[p, q], PLATE - top)


@njit(cache=True)
def _meet_column(code, face, origin, dx, dy, dz, flat, t, leave, cell, low, pending):  # type: ignore[no-untyped-def]
    """Return length and kind of a ray's hit on a column between ``t`` and ``leave``, or ``pending`` if that is nearer.

    Args:
        code, face: codes and surface of the column, (L,) and (6,); origin: start of the ray, (3,).
        dx, dy, dz, flat: direction of the ray, and length of its horizontal part.
        pending: length and kind of the hit found in earlier columns.
    """
    levels = len(code)
    z0 = math.floor((origin[2] + t * dz - low) / cell)
    z1 = math.floor((origin[2] + leave * dz - low) / cell)
    if 0 <= z0 < levels and code[z0] != EMPTY:
        nx, ny = face[2], face[3]
        px, py = face[0] - origin[0], face[1] - origin[1]
        across = dx * nx + dy * ny
        if abs(across) > 0.02 * flat:
            hit = (px * nx + py * ny) / across
        elif nx == 0 and ny == 0:
            hit = min(max((px * dx + py * dy) / (flat * flat), t), leave)
        else:
            hit = np.inf
        if hit < t:
            hit = max(hit, t - 2 * cell / flat)
        if nx == 0 and ny == 0:
            nx, ny = dx / flat, dy / flat
        aside = (dx * hit - px) * ny - (dy * hit - py) * nx
        if aside > face[4] or -aside > face[5]:
            hit = np.inf
        if hit < pending[0] and hit - t < 0.6 / flat:
            return hit, np.int64(code[z0])
    elif z1 != z0:
        step = 1 if z1 > z0 else -1
        for level in range(z0 + step, z1 + step, step):
            if 0 <= level < levels and code[level] != EMPTY:
                height = low + (level + (1 if step < 0 else 0)) * cell
                return (height - origin[2]) / dz, np.int64(TOP)
    return pending


@njit(cache=True)
def _cast(key, index, codes, faces, origin, ray, cell, low, limit, reach, unseen):  # type: ignore[no-untyped-def]
    """Return length and kind of a ray's first hit, the length followed, and the part of it through unseen columns.

    Args:
        ray: unit direction, (3,); limit: length at which the ray meets floor or ceiling.
        key, index, codes, faces, origin, cell, low, reach, unseen: as in ``cast_rays``.
    """
    n = key.shape[0]
    dx, dy, dz = ray[0], ray[1], ray[2]
    flat = math.sqrt(dx * dx + dy * dy)
    end = min(limit, reach / max(flat, 1e-6))
    ix, iy, step_x, step_y, next_x, next_y, per_x, per_y = _walk(origin, dx, dy, 0.0, cell)
    t, missing = 0.0, 0.0
    pending = np.inf, np.int64(NOTHING)
    pane, hidden = np.inf, False  # length at the last pane, and whether the columns behind it are unknown
    while t < end:
        leave = min(next_x, next_y, end)
        a, b = ix & (n - 1), iy & (n - 1)
        at = index[a, b]
        if at == UNSEEN:
            missing += (leave - t) * flat
            hidden = pane < np.inf
            if missing > unseen or hidden:
                break
        else:
            missing = 0.0
            if at != OPEN:
                if key[a, b, 0] != ix or key[a, b, 1] != iy:
                    hidden = pane < np.inf
                    break
                if at <= PLATE:
                    height = low + (PLATE - at) * cell
                    if origin[2] + t * dz <= height:
                        pending = t, np.int64(BEHIND)
                    elif origin[2] + leave * dz <= height:
                        pending = (height - origin[2]) / dz, np.int64(TOP)
                else:
                    pending = _meet_column(
                        codes[at], faces[at], origin, dx, dy, dz, flat, t, leave, cell, low, pending
                    )  # fmt: skip
        if pending[0] <= leave:
            if pending[1] != PANE:
                break
            pane, pending = pending[0], (np.inf, pending[1])
        t = leave
        if next_x < next_y:
            ix += step_x
            next_x += per_x
        else:
            iy += step_y
            next_y += per_y
    if hidden:
        pending = pane, np.int64(PANE)
    return pending[0], pending[1], t, missing / max(flat, 1e-6)


@njit(cache=True)
def cast_rays(  # type: ignore[no-untyped-def]
    key, index, codes, faces, origin, rays, cell, low, ceiling, assumed, reach, unseen, depth, kind, free
):
    """Find the first surface on every ray.

    Args:
        key: state of the model; index, codes, faces: results of ``solid_columns``.
        origin: start of the rays, (3,); rays: unit directions in the model's frame, (M, 3).
        cell, low: as in ``add_revolution``.
        ceiling: height of the level ceiling, inf if unknown; assumed: true if the ceiling was not measured.
        reach: largest horizontal distance; unseen: largest distance of a ray through unseen columns, in metres.
        depth: result, (M,) float32; kind: result, (M,) uint8; both 0 for a ray without a hit.
        free: result, (M,) float32: length up to which a ray passes known free space or its hit.
    """
    for i in range(len(rays)):
        dz = rays[i, 2]
        depth[i], kind[i] = 0.0, NOTHING
        limit, limit_kind = np.inf, NOTHING
        if dz < -1e-6:
            limit, limit_kind = -origin[2] / dz, FLOOR
        elif dz > 1e-6 and ceiling < np.inf:
            limit, limit_kind = (ceiling - origin[2]) / dz, (ASSUMED if assumed else CEILING)
        met, met_kind, t, missing = _cast(
            key, index, codes, faces, origin, rays[i], cell, low, limit, reach, unseen
        )  # fmt: skip
        if met <= limit and met < np.inf:
            depth[i], kind[i] = met, met_kind
        elif t >= limit - 1e-9:
            depth[i], kind[i] = limit, limit_kind
        free[i] = depth[i] if kind[i] != NOTHING else max(t - missing, 0.0)
