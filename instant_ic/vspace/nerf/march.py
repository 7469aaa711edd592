"""CPU kernels for rays in numba: training samples from the panorama, and the march to the surface.

Functions of the same names in ``reference.py`` compute the same in torch.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from instant_ic.vspace.nerf.kernels import _OPTIONS, BLOCK, encode_block, layer_block, relu_block

FIRST_STEP = 0.7
"""Smallest step through empty cells, in cells."""
NOT_SEEN = np.float32(1e9)
"""Value that stands for an unknown signed distance at the previous sample."""
LOOKED_THROUGH = 3.0
"""Truncation distances from a point to a keyframe's surface behind it above which the point is free space."""


@njit(**_OPTIONS)
def prior_inverse_depth(inverse, depth_edge, u, v):  # type: ignore[no-untyped-def]
    """Return the inverse depth at index coordinates: bilinear on a surface, nearest pixel at a depth edge."""
    height, width = inverse.shape
    v = min(max(v, np.float32(0)), np.float32(height - 1))
    u0, v0 = math.floor(u), math.floor(v)
    fu, fv = u - np.float32(u0), v - np.float32(v0)
    v1 = min(v0 + 1, height - 1)
    left, right = u0 % width, (u0 + 1) % width
    if depth_edge[v0, left]:
        return inverse[v1 if fv >= 0.5 else v0, right if fu >= 0.5 else left]
    top = inverse[v0, left] * (np.float32(1) - fu) + inverse[v0, right] * fu
    bottom = inverse[v1, left] * (np.float32(1) - fu) + inverse[v1, right] * fu
    return top * (np.float32(1) - fv) + bottom * fv


@njit(**_OPTIONS)
def _bilinear_colour(rgb, gain, turn, fall, target, surface, near):  # type: ignore[no-untyped-def]
    """Write a panorama's colour, in the newest keyframe's exposure and minus 0.5, to two samples.

    Args:
        rgb: panorama, (H, W, 3).
        gain: colour factors to the newest keyframe's exposure, (3,).
        turn, fall: position in the panorama as shares of its width and height.
        target: training targets, (2 N, 4); rows ``surface`` and ``near`` are written.
    """
    height, width = rgb.shape[:2]
    one, half = np.float32(1), np.float32(0.5)
    u, v = turn * np.float32(width) - half, fall * np.float32(height) - half
    v = min(max(v, np.float32(0)), np.float32(height - 1))
    u0, v0 = math.floor(u), math.floor(v)
    fu, fv = u - np.float32(u0), v - np.float32(v0)
    v1 = min(v0 + 1, height - 1)
    left, right = u0 % width, (u0 + 1) % width
    for c in range(3):
        top = np.float32(rgb[v0, left, c]) * (one - fu) + np.float32(rgb[v0, right, c]) * fu
        bottom = np.float32(rgb[v1, left, c]) * (one - fu) + np.float32(rgb[v1, right, c]) * fu
        value = (top * (one - fv) + bottom * fv) * gain[c]
        target[surface, c] = min(value * np.float32(1 / 255), one) - half
        target[near, c] = target[surface, c]


@njit(**_OPTIONS)
def sample_rays(  # type: ignore[no-untyped-def]
    uniform, columns, rows, sources, rgb, inverse, depth_edge, usable, trust, map_from_camera, gains, band,
    points, target, weight
):  # fmt: skip
    """Sample one ray in each of ``columns × rows`` strata of equal solid angle, with two points per ray.

    Args:
        uniform: random numbers in [0, 1), (N, 3), N = columns · rows: position in the stratum (azimuth, height), and
            of the second point within the truncation distance.
        sources: keyframe of each tile of 8 × 8 strata, (N / 64,).
        rgb, inverse, depth_edge, usable, band: arrays of the ``PanoramaPrior``s, newest first, stacked: (K, …).
        trust: weight of the depth by its uncertainty, 0 to 1, (K, h, w).
        map_from_camera: poses of the cameras, (K, 4, 4) float32.
        gains: colour factors to the newest keyframe's exposure, (K, 3).
        points: sampled points, (2 N, 3); written. Each tile has 64 points on the surface, then 64 beside it.
        target: colour of the ray minus 0.5, and signed distance in the newest keyframe's truncation distances, positive
            in front of the surface, (2 N, 4); written.
        weight: weights of colour and distance, (2 N, 2); written; 0 where no ray may be sampled.
    """
    h, w = inverse.shape[1:]
    tiles = columns // 8
    one, half = np.float32(1), np.float32(0.5)
    for n in range(columns * rows):
        tile, inside = n // 64, n % 64
        k = sources[tile]
        column = (tile % tiles) * 8 + inside % 8
        row = (tile // tiles) * 8 + inside // 8
        turn = (np.float32(column) + uniform[n, 0]) / np.float32(columns)
        z = one - np.float32(2) * (np.float32(row) + uniform[n, 1]) / np.float32(rows)
        azimuth = np.float32(math.pi) * (one - np.float32(2) * turn)
        fall = half - np.float32(math.asin(z)) / np.float32(math.pi)
        surface = tile * 128 + inside
        near = surface + 64
        _bilinear_colour(rgb[k], gains[k], turn, fall, target, surface, near)
        depth = one / prior_inverse_depth(
            inverse[k], depth_edge[k], turn * np.float32(w) - half, fall * np.float32(h) - half
        )
        offset = np.float32(2) * uniform[n, 2] - one
        length = depth * (one + band[k] * offset)
        flat = np.float32(math.sqrt(max(np.float32(0), one - z * z)))
        dx, dy = flat * np.float32(math.cos(azimuth)), flat * np.float32(math.sin(azimuth))
        away = np.float32(0)
        for c in range(3):
            direction = map_from_camera[k, c, 0] * dx + map_from_camera[k, c, 1] * dy + map_from_camera[k, c, 2] * z
            points[surface, c] = map_from_camera[k, c, 3] + depth * direction
            points[near, c] = map_from_camera[k, c, 3] + length * direction
            away += (points[surface, c] - map_from_camera[0, c, 3]) ** 2
        target[surface, 3] = 0
        target[near, 3] = -offset
        if k > 0:
            target[near, 3] *= band[k] * depth / (band[0] * max(np.float32(math.sqrt(away)), depth * half))
        at = min(int(fall * np.float32(h)), h - 1), min(int(turn * np.float32(w)), w - 1)
        weight[surface, 0] = weight[near, 0] = usable[k, at[0], at[1]]
        weight[surface, 1] = weight[near, 1] = usable[k, at[0], at[1]] * trust[k, at[0], at[1]]


@njit(**_OPTIONS)
def prior_agrees(x, y, z, inverse, depth_edge, known, tolerance):  # type: ignore[no-untyped-def]
    """Return 2 for a point in the camera's frame on a surface of known depth, 1 for one on filled depth, 0 otherwise.

    ``tolerance`` is relative to the distance.
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
    if depth_edge[v0, left]:
        if low < a < high or low < b < high or low < c < high or low < d < high:
            return seen
        return 0
    if min(min(a, b), min(c, d)) < high and max(max(a, b), max(c, d)) > low:
        return seen
    return 0


@njit(**_OPTIONS)
def prior_distance(x, y, z, inverse, depth_edge, band):  # type: ignore[no-untyped-def]
    """Return a camera-frame point's signed distance to the surface on its ray, in truncation distances."""
    height, width = inverse.shape
    flat = math.sqrt(x * x + y * y)
    u = np.float32((math.pi - math.atan2(y, x)) * (width / (2 * math.pi)) - 0.5)
    v = np.float32((math.pi / 2 - math.atan2(z, flat)) * (height / math.pi) - 0.5)
    away = math.sqrt(flat * flat + z * z)
    return (np.float32(1) - away * prior_inverse_depth(inverse, depth_edge, u, v)) / band


@njit(**_OPTIONS)
def nearest_prior(x, y, z, inverse, depth_edge, known, camera_from_map, band, all_agree):  # type: ignore[no-untyped-def]
    """Find the keyframes' surface nearest to a point of the map. Surfaces that a newer keyframe refutes do not count.

    A newer keyframe refutes them if it has looked through the point. The arguments are those of ``trace``; without
    ``all_agree`` the agreement is not computed and is 0.

    Returns:
        Signed distance in truncation distances of the newest keyframe, and the best agreement (``prior_agrees``).
    """
    best, best_agrees, unit = np.float32(NOT_SEEN), 0, np.float32(1)
    seen_through = False
    for k in range(inverse.shape[0]):
        px, py, pz = transformed(camera_from_map[k], x, y, z)
        value = np.float32(prior_distance(px, py, pz, inverse[k], depth_edge[k], band[k]))
        away = np.float32(math.sqrt(px * px + py * py + pz * pz)) * band[k]
        if k == 0:
            best, unit = value, away
        elif not seen_through and abs(value) * away < abs(best) * unit:
            best = value * away / unit
        if all_agree and not seen_through:
            best_agrees = max(best_agrees, prior_agrees(px, py, pz, inverse[k], depth_edge[k], known[k], band[k]))
        if value > LOOKED_THROUGH and prior_known(px, py, pz, known[k]):
            seen_through = True
    return best, best_agrees


@njit(**_OPTIONS)
def prior_known(x, y, z, known):  # type: ignore[no-untyped-def]
    """Return whether the depth is known in the direction of a point in the camera's frame."""
    height, width = known.shape
    u = (math.pi - math.atan2(y, x)) * (width / (2 * math.pi))
    v = (math.pi / 2 - math.atan2(z, math.sqrt(x * x + y * y))) * (height / math.pi)
    return known[min(int(v), height - 1), min(int(u), width - 1)] != 0


@njit(**_OPTIONS)
def grid_span(origin, direction, low, cell, shape):  # type: ignore[no-untyped-def]
    """Return the lengths at which a ray enters and leaves the grid; for a ray that misses it, entry > exit."""
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
    """Return the first length along a ray, from ``t`` on, that lies in an occupied cell; −1 if it is past ``leave``."""
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
        # At city-block distance d the nearest occupied cell is at least (d − 1) / √3 edges away, within the margin.
        t += cell * max(FIRST_STEP, 0.577 * (distance - 1))
    return -1.0


@njit(**_OPTIONS)
def at_length(origin, direction, t):  # type: ignore[no-untyped-def]
    """Return the point at length ``t`` of a ray."""
    return origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2]


@njit(**_OPTIONS)
def along(target_from_source, origin, direction, t):  # type: ignore[no-untyped-def]
    """Return the point at length ``t`` of a ray, in another frame."""
    x, y, z = at_length(origin, direction, t)
    return transformed(target_from_source, x, y, z)


@njit(**_OPTIONS)
def transformed(target_from_source, x, y, z):  # type: ignore[no-untyped-def]
    """Transform a point to another frame."""
    m = target_from_source
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )


@njit(**_OPTIONS)
def _enter_grid(origin, directions, pixels, grid, low, cell, state, active):  # type: ignore[no-untyped-def]
    """Start the rays of ``pixels`` that cross the grid; return their number and write their indices to ``active``."""
    t, leave = state[0], state[1]
    size = 0
    for n in range(pixels.shape[0]):
        enter, out = grid_span(origin, directions[pixels[n]], low, cell, grid.shape)
        if enter < out:
            t[n], leave[n] = enter, out
            active[size] = n
            size += 1
    return size


@njit(**_OPTIONS)
def _skip_empty_cells(  # type: ignore[no-untyped-def]
    origin, directions, pixels, grid, low, cell, state, active, size, depth, confidence
):
    """Move each active ray to its next occupied cell and return the number of rays that have one. Other rays end."""
    t, leave, _, _, spare, _ = state
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
    return queries


@njit(**_OPTIONS)
def _ends_here(n, value, cell, keyframes, share, origin, direction, state, pixel, depth, confidence):  # type: ignore[no-untyped-def]
    """Test a ray at its present sample; return True if it ends on a surface, otherwise advance it.

    Args:
        n: index of the ray.
        value: signed distance of the field at the sample, in truncation distances.
        keyframes: arrays ``inverse``, ``depth_edge``, ``known``, ``camera_from_map`` and ``band`` of ``trace``.
        state: the rays' state, see ``trace``.
        pixel: index of the ray in ``depth`` and ``confidence``, which are written if the ray ends.
    """
    t, _, last_t, last_s, spare, spare_s = state
    inverse, depth_edge, known, camera_from_map, band = keyframes
    before = last_s[n]
    if share > 0:
        px, py, pz = at_length(origin, direction, t[n])
        seen, _ = nearest_prior(px, py, pz, inverse, depth_edge, known, camera_from_map, band, False)
        value += share * (seen - value)
    if t[n] - last_t[n] > 3 * cell:
        before = NOT_SEEN
    hit = t[n]
    crossed = before != NOT_SEEN and (before > 0) != (value > 0)
    if crossed:
        hit = last_t[n] + (t[n] - last_t[n]) * before / (before - value)
    px, py, pz = at_length(origin, direction, hit)
    _, agrees = nearest_prior(px, py, pz, inverse, depth_edge, known, camera_from_map, band, True)
    if agrees > 0:
        if value <= 0 or crossed:
            depth[pixel] = hit
            confidence[pixel] = 0.5 * agrees if before > 0 and value <= 0 else 0.0
            return True
        if agrees == 2 and value < spare_s[n]:
            spare[n], spare_s[n] = hit, value
    px, py, pz = along(camera_from_map[0], origin, direction, t[n])
    reach = abs(value) * band[0] * math.sqrt(px * px + py * py + pz * pz)
    last_t[n], last_s[n] = t[n], value
    t[n] += min(max(np.float32(0.9) * reach, np.float32(0.5) * cell), 2 * cell)
    return False


@njit(**_OPTIONS)
def trace(  # type: ignore[no-untyped-def]
    table, w1, b1, w2, b2, cells_per_m, lattice_origin, focus, grid, low, cell,
    inverse, depth_edge, known, camera_from_map, band, share, origin, directions, pixels, depth, confidence
):  # fmt: skip
    """March rays to the first zero of the signed distance that agrees with a keyframe's depth.

    The signed distance is a mix of the field's and the keyframes', because the surfaces of a young field are rough.

    Args:
        grid, low, cell: grid, lowest corner and cell size of the ``Occupancy``.
        inverse, depth_edge, known, band: arrays of the ``PanoramaPrior``s, newest first, stacked: (K, …).
        camera_from_map: (K, 4, 4) float32.
        share: weight of the keyframes' depth in the distance, 0 to 1; with 1 the field is not queried.
        origin, directions: position of the view, (3,), and unit vectors of its pixels, (P, 3), in the map's frame.
        pixels: indices of the pixels to march, (N,).
        depth: metres along the ray, 0 where it hits nothing, (P,); written.
        confidence: 1 on the front of a surface that a keyframe has seen, 0.5 where its depth was filled, (P,); written.
    """
    count = pixels.shape[0]
    # Per ray: t and its end, t and distance of the last sample, and t and distance of the sample nearest to a surface,
    # at which the ray ends if the distance never changes its sign.
    state = (
        np.zeros(count, np.float32), np.zeros(count, np.float32), np.zeros(count, np.float32),
        np.full(count, NOT_SEEN, np.float32), np.zeros(count, np.float32), np.full(count, NOT_SEEN, np.float32),
    )  # fmt: skip
    keyframes = inverse, depth_edge, known, camera_from_map, band
    active = np.zeros(count, np.int32)
    points = np.zeros((BLOCK, 3), np.float32)
    x = np.zeros((w1.shape[1], BLOCK), np.float32)
    h = np.zeros((w1.shape[0], BLOCK), np.float32)
    s = np.zeros((1, BLOCK), np.float32)
    entries, weights = np.empty((1, 8, BLOCK), np.uint32), np.empty((1, 8, BLOCK), np.float32)
    head, bias = w2[3:4], b2[3:4]
    for n in range(count):
        depth[pixels[n]] = confidence[pixels[n]] = 0
    size = _enter_grid(origin, directions, pixels, grid, low, cell, state, active)
    while size > 0:
        queries = _skip_empty_cells(
            origin, directions, pixels, grid, low, cell, state, active, size, depth, confidence
        )  # fmt: skip
        size = 0
        for start in range(0, queries, BLOCK):
            block = min(BLOCK, queries - start)
            if share < 1:
                for i in range(block):
                    n = active[start + i]
                    for c in range(3):
                        points[i, c] = origin[c] + state[0][n] * directions[pixels[n], c]
                encode_block(table, cells_per_m, lattice_origin, focus, points, 0, block, entries, weights, x)
                layer_block(w1, b1, x, h)
                relu_block(h)
                layer_block(head, bias, h, s)
            for i in range(block):
                n = active[start + i]
                pixel = pixels[n]
                if not _ends_here(
                    n, s[0, i], cell, keyframes, share, origin, directions[pixel], state, pixel, depth, confidence
                ):
                    active[size] = n
                    size += 1


@njit(**_OPTIONS)
def panorama_pixels(x, y, z, height, width):  # type: ignore[no-untyped-def]
    """Return the pixels around a direction: two rows and the lower one's weight, two columns and the right's weight."""
    u = np.float32((math.pi - math.atan2(y, x)) * (width / (2 * math.pi)) - 0.5)
    v = np.float32((math.pi / 2 - math.atan2(z, math.sqrt(x * x + y * y))) * (height / math.pi) - 0.5)
    v = min(max(v, np.float32(0)), np.float32(height - 1))
    u0, v0 = math.floor(u), math.floor(v)
    return v0, min(v0 + 1, height - 1), v - np.float32(v0), u0 % width, (u0 + 1) % width, u - np.float32(u0)


@njit(**_OPTIONS)
def mix_panorama(  # type: ignore[no-untyped-def]
    rgb, inverse, depth_edge, known, camera_from_map, gains, band, origin, directions, depth, confidence, share, colour
):
    """Mix in the panorama's colour of the newest keyframe that has seen each surface.

    Args:
        rgb, inverse, depth_edge, known, band: arrays of the ``PanoramaPrior``s, newest first, stacked: (K, …).
        camera_from_map: poses of the map in the cameras' frames, (K, 4, 4).
        gains: colour factors to the newest keyframe's exposure, (K, 3).
        depth, confidence: results of ``trace``, (P,); where either is 0, the colour does not change.
        share: weight of the panorama, 0 to 1.
        colour: RGB of the view, 0 to 1, (P, 3); updated in place.
    """
    count, height, width = rgb.shape[:3]
    one = np.float32(1)
    for n in range(depth.shape[0]):
        if depth[n] <= 0 or confidence[n] <= 0:
            continue
        for k in range(count):
            x, y, z = along(camera_from_map[k], origin, directions[n], depth[n])
            if k == count - 1 or prior_agrees(x, y, z, inverse[k], depth_edge[k], known[k], band[k]) > 0:
                break
        v0, v1, fv, left, right, fu = panorama_pixels(x, y, z, height, width)
        for c in range(3):
            top = np.float32(rgb[k, v0, left, c]) * (one - fu) + np.float32(rgb[k, v0, right, c]) * fu
            bottom = np.float32(rgb[k, v1, left, c]) * (one - fu) + np.float32(rgb[k, v1, right, c]) * fu
            seen = min((top * (one - fv) + bottom * fv) * np.float32(1 / 255) * gains[k, c], one)
            colour[n, c] += share * (seen - colour[n, c])


@njit(**_OPTIONS)
def interpolate_depth(depth, confidence, stride, tolerance, pixels):  # type: ignore[no-untyped-def]
    """Fill the pixels at multiples of ``stride`` from their traced neighbours at multiples of ``2·stride``.

    ``depth`` (H, W) is measured along the view's axis, so that its inverse is linear over a plane. Pixels whose
    neighbours differ by more than ``tolerance``, or hit nothing, are listed in ``pixels`` and must be traced.

    Returns:
        Number of listed pixels.
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
