"""CPU kernels of rays: training samples from the panorama, and the march to the surface (numba).

The torch functions of the same names in ``reference.py`` do the same.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from .kernels import _OPTIONS, BLOCK, encode_block, layer_block, relu_block

FIRST_STEP = 0.7
"""Smallest step through empty cells, in cells."""
NOT_SEEN = np.float32(1e9)
"""Stands for "no distance known before"."""


@njit(**_OPTIONS)
def prior_inverse_depth(inverse, torn, u, v):  # type: ignore[no-untyped-def]
    """Inverse depth at index coordinates: bilinear on a surface, nearest at an edge."""
    height, width = inverse.shape
    v = min(max(v, np.float32(0)), np.float32(height - 1))
    u0, v0 = math.floor(u), math.floor(v)
    fu, fv = u - np.float32(u0), v - np.float32(v0)
    v1 = min(v0 + 1, height - 1)
    left, right = u0 % width, (u0 + 1) % width
    if torn[v0, left]:
        return inverse[v1 if fv >= 0.5 else v0, right if fu >= 0.5 else left]
    top = inverse[v0, left] * (np.float32(1) - fu) + inverse[v0, right] * fu
    bottom = inverse[v1, left] * (np.float32(1) - fu) + inverse[v1, right] * fu
    return top * (np.float32(1) - fv) + bottom * fv


@njit(**_OPTIONS)
def sample_rays(  # type: ignore[no-untyped-def]
    uniform, columns, rows, rgb, inverse, torn, map_from_camera, band, points, target
):
    """One ray in each of ``columns × rows`` strata of equal solid angle; two samples a ray.

    Args:
        uniform: (N, 3) in [0, 1): place in the stratum (azimuth, height) and in the band; N = columns · rows.
        rgb, inverse, torn, band: of the ``PanoramaPrior``.
        map_from_camera: (4, 4) float32.
        points: out, (2 N, 3). Rays go by tiles of 8 × 8 strata: 64 points on the surface, then 64 in the band.
        target: out, (2 N, 4): colour minus 0.5, the ray's for both; signed distance in units of the band (in front
            positive).
    """
    height, width = rgb.shape[:2]
    h, w = inverse.shape
    tiles = columns // 8
    for n in range(columns * rows):
        tile, inside = n // 64, n % 64
        column = (tile % tiles) * 8 + inside % 8
        row = (tile // tiles) * 8 + inside // 8
        turn = (np.float32(column) + uniform[n, 0]) / np.float32(columns)
        z = np.float32(1) - np.float32(2) * (np.float32(row) + uniform[n, 1]) / np.float32(rows)
        azimuth = np.float32(math.pi) * (np.float32(1) - np.float32(2) * turn)
        fall = np.float32(0.5) - np.float32(math.asin(z)) / np.float32(math.pi)
        u, v = turn * np.float32(width) - np.float32(0.5), fall * np.float32(height) - np.float32(0.5)
        v = min(max(v, np.float32(0)), np.float32(height - 1))
        u0, v0 = math.floor(u), math.floor(v)
        fu, fv = u - np.float32(u0), v - np.float32(v0)
        v1 = min(v0 + 1, height - 1)
        left, right = u0 % width, (u0 + 1) % width
        surface = tile * 128 + inside
        near = surface + 64
        for c in range(3):
            top = np.float32(rgb[v0, left, c]) * (np.float32(1) - fu) + np.float32(rgb[v0, right, c]) * fu
            bottom = np.float32(rgb[v1, left, c]) * (np.float32(1) - fu) + np.float32(rgb[v1, right, c]) * fu
            value = top * (np.float32(1) - fv) + bottom * fv
            target[surface, c] = value * np.float32(1 / 255) - np.float32(0.5)
            target[near, c] = target[surface, c]
        depth = np.float32(1) / prior_inverse_depth(
            inverse, torn, turn * np.float32(w) - np.float32(0.5), fall * np.float32(h) - np.float32(0.5)
        )
        offset = np.float32(2) * uniform[n, 2] - np.float32(1)
        target[surface, 3] = 0
        target[near, 3] = -offset
        length = depth * (np.float32(1) + band * offset)
        flat = np.float32(math.sqrt(max(np.float32(0), np.float32(1) - z * z)))
        dx, dy = flat * np.float32(math.cos(azimuth)), flat * np.float32(math.sin(azimuth))
        for c in range(3):
            direction = map_from_camera[c, 0] * dx + map_from_camera[c, 1] * dy + map_from_camera[c, 2] * z
            points[surface, c] = map_from_camera[c, 3] + depth * direction
            points[near, c] = map_from_camera[c, 3] + length * direction


@njit(**_OPTIONS)
def prior_agrees(x, y, z, inverse, torn, known, tolerance):  # type: ignore[no-untyped-def]
    """Whether a point of the camera frame lies on a surface of the prior: 0 no, 1 on filled depth, 2 on known depth.

    Returns the code as an int. ``tolerance`` is relative to the distance.
    """
    height, width = inverse.shape
    flat = math.sqrt(x * x + y * y)
    distance = math.sqrt(flat * flat + z * z)
    u = (math.pi - math.atan2(y, x)) * (width / (2 * math.pi)) - 0.5
    v = (math.pi / 2 - math.atan2(z, flat)) * (height / math.pi) - 0.5
    v = min(max(v, 0.0), height - 1.0)
    u0, v0 = math.floor(u), math.floor(v)
    v1 = min(v0 + 1, height - 1)
    left, right = u0 % width, (u0 + 1) % width
    seen = 1 + known[v1 if v - v0 >= 0.5 else v0, right if u - u0 >= 0.5 else left]
    a, b = inverse[v0, left] * distance, inverse[v0, right] * distance
    c, d = inverse[v1, left] * distance, inverse[v1, right] * distance
    low, high = 1 - tolerance, 1 + tolerance
    if torn[v0, left]:
        if low < a < high or low < b < high or low < c < high or low < d < high:
            return seen
        return 0
    if min(min(a, b), min(c, d)) < high and max(max(a, b), max(c, d)) > low:
        return seen
    return 0


@njit(**_OPTIONS)
def prior_distance(x, y, z, inverse, torn, band):  # type: ignore[no-untyped-def]
    """Signed distance of a point of the camera frame to the prior's surface in its direction, in units of the band."""
    height, width = inverse.shape
    flat = math.sqrt(x * x + y * y)
    u = np.float32((math.pi - math.atan2(y, x)) * (width / (2 * math.pi)) - 0.5)
    v = np.float32((math.pi / 2 - math.atan2(z, flat)) * (height / math.pi) - 0.5)
    away = math.sqrt(flat * flat + z * z)
    return (np.float32(1) - away * prior_inverse_depth(inverse, torn, u, v)) / band


@njit(**_OPTIONS)
def grid_span(origin, direction, low, cell, shape):  # type: ignore[no-untyped-def]
    """Where a ray enters and leaves the grid; entry > exit when it misses it."""
    enter, leave = 0.0, 1e9
    for axis in range(3):
        a, b = low[axis], low[axis] + cell * shape[axis]
        d = direction[axis]
        if abs(d) < 1e-9:
            if origin[axis] < a or origin[axis] >= b:
                return 1.0, 0.0
            continue
        t0, t1 = (a - origin[axis]) / d, (b - origin[axis]) / d
        enter, leave = max(enter, min(t0, t1)), min(leave, max(t0, t1))
    return enter, leave


@njit(**_OPTIONS)
def next_occupied(origin, direction, t, leave, grid, low, cell):  # type: ignore[no-untyped-def]
    """First place from ``t`` on in an occupied cell, or −1 past ``leave``."""
    nx, ny, nz = grid.shape
    per_cell = 1 / cell
    x, y, z = ((origin[0] - low[0]) * per_cell, (origin[1] - low[1]) * per_cell, (origin[2] - low[2]) * per_cell)
    dx, dy, dz = direction[0] * per_cell, direction[1] * per_cell, direction[2] * per_cell
    while t < leave:
        ix, iy, iz = math.floor(x + t * dx), math.floor(y + t * dy), math.floor(z + t * dz)
        ix, iy, iz = min(max(ix, 0), nx - 1), min(max(iy, 0), ny - 1), min(max(iz, 0), nz - 1)
        distance = grid[ix, iy, iz]
        if distance == 0:
            return t
        # City-block distance d: the nearest occupied cell is no nearer than (d − 1) / √3 edges, within the margin.
        t += cell * max(FIRST_STEP, 0.577 * (distance - 1))
    return -1.0


@njit(**_OPTIONS)
def along(target_from_source, origin, direction, t):  # type: ignore[no-untyped-def]
    """The place ``t`` along a ray, in another frame."""
    x, y, z = origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2]
    m = target_from_source
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@njit(**_OPTIONS)
def trace(  # type: ignore[no-untyped-def]
    table, w1, b1, w2, b2, cells_per_m, lattice_origin, focus, grid, low, cell,
    inverse, torn, known, camera_from_map, band, share, origin, directions, pixels, depth, confidence
):  # fmt: skip
    """Marches rays to the first zero of the signed distance that agrees with the keyframe's depth.

    The distance is the field's and the prior's own, mixed: a young field's surfaces are rough.

    Args:
        grid, low, cell: of the ``Occupancy``.
        inverse, torn, known, band: of the ``PanoramaPrior``; camera_from_map: (4, 4) float32.
        share: of the prior in the distance, 0..1; with 1 the field is not asked at all.
        origin: (3,); directions: (P, 3) unit vectors of all pixels, map frame.
        pixels: (N,) which of them to march.
        depth: out, (P,): metres along the ray, 0 where it meets nothing.
        confidence: out, (P,): 1 on a surface that the keyframe has seen from its front, 0.5 where its depth was filled.
    """
    count = pixels.shape[0]
    t = np.zeros(count, np.float32)
    leave = np.zeros(count, np.float32)
    last_t = np.zeros(count, np.float32)
    last_s = np.full(count, NOT_SEEN, np.float32)
    spare = np.zeros(count, np.float32)  # nearest to the surface so far, should the field show no crossing
    spare_s = np.full(count, NOT_SEEN, np.float32)
    active = np.zeros(count, np.int32)
    points = np.zeros((BLOCK, 3), np.float32)
    x = np.zeros((w1.shape[1], BLOCK), np.float32)
    h = np.zeros((w1.shape[0], BLOCK), np.float32)
    s = np.zeros((1, BLOCK), np.float32)
    head, bias = w2[3:4], b2[3:4]
    size = 0
    for n in range(count):
        pixel = pixels[n]
        depth[pixel] = 0
        confidence[pixel] = 0
        enter, out = grid_span(origin, directions[pixel], low, cell, grid.shape)
        if enter < out:
            t[n], leave[n] = enter, out
            active[size] = n
            size += 1
    while size > 0:
        queries = 0
        for k in range(size):
            n = active[k]
            found = next_occupied(origin, directions[pixels[n]], t[n], leave[n], grid, low, cell)
            if found >= 0:
                t[n] = found
                active[queries] = n
                queries += 1
            elif spare[n] > 0:
                depth[pixels[n]] = spare[n]
                confidence[pixels[n]] = 1
        size = 0
        for start in range(0, queries, BLOCK):
            block = min(BLOCK, queries - start)
            if share < 1:
                for i in range(block):
                    n = active[start + i]
                    for c in range(3):
                        points[i, c] = origin[c] + t[n] * directions[pixels[n], c]
                encode_block(table, cells_per_m, lattice_origin, focus, points, 0, block, x)
                layer_block(w1, b1, x, h)
                relu_block(h)
                layer_block(head, bias, h, s)
            for i in range(block):
                n = active[start + i]
                pixel = pixels[n]
                value, before = s[0, i], last_s[n]
                if share > 0:
                    px, py, pz = along(camera_from_map, origin, directions[pixel], t[n])
                    value += share * (prior_distance(px, py, pz, inverse, torn, band) - value)
                if t[n] - last_t[n] > 3 * cell:
                    before = NOT_SEEN
                hit = t[n]
                crossed = before != NOT_SEEN and (before > 0) != (value > 0)
                if crossed:
                    hit = last_t[n] + (t[n] - last_t[n]) * before / (before - value)
                px, py, pz = along(camera_from_map, origin, directions[pixel], hit)
                agrees = prior_agrees(px, py, pz, inverse, torn, known, band)
                if agrees > 0:
                    if value <= 0 or crossed:
                        depth[pixel] = hit
                        confidence[pixel] = 0.5 * agrees if before > 0 and value <= 0 else 0.0
                        continue
                    if agrees == 2 and value < spare_s[n]:
                        spare[n], spare_s[n] = hit, value
                px, py, pz = along(camera_from_map, origin, directions[pixel], t[n])
                reach = abs(value) * band * math.sqrt(px * px + py * py + pz * pz)
                last_t[n], last_s[n] = t[n], value
                t[n] += min(max(np.float32(0.9) * reach, np.float32(0.5) * cell), 2 * cell)
                active[size] = n
                size += 1


@njit(**_OPTIONS)
def mix_panorama(rgb, camera_from_map, origin, directions, depth, confidence, share, colour):  # type: ignore[no-untyped-def]
    """Mixes the panorama's colour into that of surfaces which the keyframe has seen.

    Args:
        rgb: panorama (H, W, 3) uint8.
        depth, confidence: (P,), of ``trace``; nothing happens where either is 0.
        share: of the panorama, 0..1.
        colour: in and out, (P, 3) in 0..1.
    """
    height, width = rgb.shape[:2]
    one = np.float32(1)
    for n in range(depth.shape[0]):
        if depth[n] <= 0 or confidence[n] <= 0:
            continue
        x, y, z = along(camera_from_map, origin, directions[n], depth[n])
        u = np.float32((math.pi - math.atan2(y, x)) * (width / (2 * math.pi)) - 0.5)
        v = np.float32((math.pi / 2 - math.atan2(z, math.sqrt(x * x + y * y))) * (height / math.pi) - 0.5)
        v = min(max(v, np.float32(0)), np.float32(height - 1))
        u0, v0 = math.floor(u), math.floor(v)
        fu, fv = u - np.float32(u0), v - np.float32(v0)
        v1 = min(v0 + 1, height - 1)
        left, right = u0 % width, (u0 + 1) % width
        for c in range(3):
            top = np.float32(rgb[v0, left, c]) * (one - fu) + np.float32(rgb[v0, right, c]) * fu
            bottom = np.float32(rgb[v1, left, c]) * (one - fu) + np.float32(rgb[v1, right, c]) * fu
            seen = (top * (one - fv) + bottom * fv) * np.float32(1 / 255)
            colour[n, c] += share * (seen - colour[n, c])


@njit(**_OPTIONS)
def interpolate_depth(depth, confidence, stride, tolerance, pixels):  # type: ignore[no-untyped-def]
    """Fills the pixels at multiples of ``stride`` from their traced neighbours at multiples of ``2·stride``.

    ``depth`` (H, W) is measured along the view's axis, so that its inverse is linear over a plane. Pixels whose
    neighbours differ by more than ``tolerance``, or meet nothing, are listed in ``pixels`` and have to be traced.

    Returns:
        How many are listed.
    """
    height, width = depth.shape
    count = 0
    double = 2 * stride
    for y in range(0, height, stride):
        for x in range(0, width, stride):
            if y % double == 0 and x % double == 0:
                continue
            y0, x0 = y - y % double, x - x % double
            y1, x1 = y0 if y % double == 0 else y0 + double, x0 if x % double == 0 else x0 + double
            if y1 >= height or x1 >= width:
                pixels[count] = y * width + x
                count += 1
                continue
            a, b, c, d = depth[y0, x0], depth[y0, x1], depth[y1, x0], depth[y1, x1]
            least, most = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
            trust = min(min(confidence[y0, x0], confidence[y0, x1]), min(confidence[y1, x0], confidence[y1, x1]))
            if least <= 0 or most > least * (1 + tolerance) or trust <= 0:
                pixels[count] = y * width + x
                count += 1
                continue
            one = np.float32(1)
            depth[y, x] = 4 / (one / a + one / b + one / c + one / d)
            confidence[y, x] = trust
    return count
