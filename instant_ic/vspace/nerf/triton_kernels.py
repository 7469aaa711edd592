"""The field's Triton kernels for NVIDIA GPUs: training samples, gradient, Adam on touched entries, and views.

Each kernel's docstring names the torch functions of ``reference.py`` that compute the same. Only ``triton_device``
imports this module. With ``TRITON_INTERPRET=1`` it runs on the CPU, for the tests.

Kernels read a float16 copy of the table; Adam updates the float32 master. Sums are float32. Gradients are added
atomically, so two runs differ in the last bits. Sizes from the configuration are compile-time constants. Sizes that
change with scenes and views are arguments, so nothing is compiled after start-up.
"""

# mypy: disable-error-code="no-untyped-def"
# Triton compiles these functions by its own types.

from __future__ import annotations

import triton
import triton.language as tl

_P1 = tl.constexpr(2654435761 - (1 << 32))  # hash factors as int32: products wrap, and the low bits are the same
_P2 = tl.constexpr(805459861)
_PI = tl.constexpr(3.141592653589793)
_NOT_SEEN = tl.constexpr(1e9)
_FIRST_STEP = tl.constexpr(0.7)
_LOOKED_THROUGH = tl.constexpr(3.0)


@triton.jit
def _atan2(y, x):
    """Return the angle of (x, y), −π to π, within 1e−6; Triton's interpreter has no ``atan2``."""
    ax, ay = tl.abs(x), tl.abs(y)
    ratio = tl.minimum(ax, ay) / tl.maximum(tl.maximum(ax, ay), 1e-20)
    wide = ratio > 0.4142135624  # tan(π/8); larger ratios are rotated by −π/4
    a = tl.where(wide, (ratio - 1) / (ratio + 1), ratio)
    z = a * a
    # Least squares of atan(a) / a on Chebyshev nodes of z in 0..tan²(π/8); error 7e−9.
    angle = a * (((0.07984963 * z - 0.13851478) * z + 0.19974405) * z - 0.33332797) * z + a
    angle = tl.where(wide, angle + 0.25 * _PI, angle)
    angle = tl.where(ay > ax, 0.5 * _PI - angle, angle)
    angle = tl.where(x < 0, _PI - angle, angle)
    return tl.where(y < 0, -angle, angle)


@triton.jit
def _corner(ix, iy, iz, fx, fy, fz, size, corner: tl.constexpr):
    """Return the table entry and the trilinear weight of one of a cell's eight corners."""
    bx: tl.constexpr = corner & 1
    by: tl.constexpr = (corner >> 1) & 1
    bz: tl.constexpr = corner >> 2
    entry = ((ix + bx) ^ ((iy + by) * _P1) ^ ((iz + bz) * _P2)) & (size - 1)
    weight = (fx if bx else 1 - fx) * (fy if by else 1 - fy) * (fz if bz else 1 - fz)
    return entry, weight


@triton.jit
def _cells(cells_per_m, origin, focus, keyframes, px, py, pz, LEVELS: tl.constexpr, LP: tl.constexpr):
    """Return the cells of points in each level, the positions in the cells (0 to 1), and the level's weights.

    Each result is (B, LP).
    """
    level = tl.arange(0, LP)
    scale = tl.load(cells_per_m + level, mask=level < LEVELS, other=0.0)[None, :]
    pixel = px * 0 + 1e9
    for k in range(keyframes):
        dx, dy, dz = px - tl.load(focus + 4 * k), py - tl.load(focus + 4 * k + 1), pz - tl.load(focus + 4 * k + 2)
        pixel = tl.minimum(pixel, tl.sqrt(dx * dx + dy * dy + dz * dz) * tl.load(focus + 4 * k + 3))
    share = tl.minimum(tl.maximum(2 - pixel[:, None] * scale, 0.0), 1.0)
    share = tl.where((level < LEVELS)[None, :], share, 0.0)
    sx = (px - tl.load(origin))[:, None] * scale
    sy = (py - tl.load(origin + 1))[:, None] * scale
    sz = (pz - tl.load(origin + 2))[:, None] * scale
    lx, ly, lz = tl.floor(sx), tl.floor(sy), tl.floor(sz)
    return lx.to(tl.int32), ly.to(tl.int32), lz.to(tl.int32), sx - lx, sy - ly, sz - lz, share


@triton.jit
def _encode(
    table, size, cells_per_m, origin, focus, keyframes, px, py, pz, wanted,
    LEVELS: tl.constexpr, LP: tl.constexpr, F: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Return the features of points, (B, LP · F), like ``reference.encode``."""
    ix, iy, iz, fx, fy, fz, share = _cells(cells_per_m, origin, focus, keyframes, px, py, pz, LEVELS, LP)
    first = tl.arange(0, LP)[None, :] * size
    feature = tl.arange(0, F)[None, None, :]
    read = ((share > 0) & wanted[:, None])[:, :, None]
    total = tl.zeros((B, LP, F), tl.float32)
    for corner in tl.static_range(8):
        entry, weight = _corner(ix, iy, iz, fx, fy, fz, size, corner)
        value = tl.load(table + (first + entry)[:, :, None] * F + feature, mask=read, other=0.0)
        total += (weight * share)[:, :, None] * value.to(tl.float32)
    return tl.reshape(total, (B, LP * F))


@triton.jit
def _first_layer(network, IN: tl.constexpr, HIDDEN: tl.constexpr, LP: tl.constexpr, F: tl.constexpr, HP: tl.constexpr):
    """Load weights (HP, LP · F) and biases (HP,) of the first layer, padded with zeros."""
    j, i = tl.arange(0, HP), tl.arange(0, LP * F)
    inside = (j[:, None] < HIDDEN) & (i[None, :] < IN)
    w1 = tl.load(network + j[:, None] * IN + i[None, :], mask=inside, other=0.0)
    return w1, tl.load(network + HIDDEN * IN + j, mask=j < HIDDEN, other=0.0)


@triton.jit
def _output(network, h, channel: tl.constexpr, IN: tl.constexpr, HIDDEN: tl.constexpr, HP: tl.constexpr):
    """Return one of the network's four outputs, (B,), and its weights, (HP,)."""
    j = tl.arange(0, HP)
    start: tl.constexpr = HIDDEN * IN + HIDDEN
    w = tl.load(network + start + channel * HIDDEN + j, mask=j < HIDDEN, other=0.0)
    return tl.sum(h * w[None, :], axis=1) + tl.load(network + start + 4 * HIDDEN + channel), w


@triton.jit
def _bilinear_corners(u, v, width, height):
    v = tl.minimum(tl.maximum(v, 0.0), height - 1.0)
    u0, v0 = tl.floor(u), tl.floor(v)
    left, top = u0.to(tl.int32), v0.to(tl.int32)
    left = tl.where(left < 0, left + width, left)
    left = tl.where(left >= width, left - width, left)
    right = tl.where(left + 1 >= width, 0, left + 1)
    return left, right, top, tl.minimum(top + 1, height - 1), u - u0, v - v0


@triton.jit
def _panorama_pixel(x, y, z, width, height):
    """Return the index coordinates of points in the camera's frame in an equirect image."""
    u = (_PI - _atan2(y, x)) * (width / (2 * _PI)) - 0.5
    v = (0.5 * _PI - _atan2(z, tl.sqrt(x * x + y * y))) * (height / _PI) - 0.5
    return u, v


@triton.jit
def _panorama_colour(rgb, gain, k, u, v, width, height, wanted, channel: tl.constexpr):
    """Return a colour channel (0 to 1) of keyframe ``k``'s panorama, bilinear, in the newest one's exposure."""
    left, right, top, bottom, fu, fv = _bilinear_corners(u, v, width, height)
    start = rgb + k * height * width * 3 + channel
    a = tl.load(start + (top * width + left) * 3, mask=wanted, other=0).to(tl.float32)
    b = tl.load(start + (top * width + right) * 3, mask=wanted, other=0).to(tl.float32)
    c = tl.load(start + (bottom * width + left) * 3, mask=wanted, other=0).to(tl.float32)
    d = tl.load(start + (bottom * width + right) * 3, mask=wanted, other=0).to(tl.float32)
    value = (a * (1 - fu) + b * fu) * (1 - fv) + (c * (1 - fu) + d * fu) * fv
    return tl.minimum(value * tl.load(gain + 3 * k + channel) / 255, 1.0)


@triton.jit
def _inverse_depth(inverse, depth_edge, k, u, v, width, height, wanted):
    """Return keyframe ``k``'s inverse depth: bilinear on a surface, nearest pixel at a depth edge.

    Also return the four values around the position, the mark of a depth edge, and the index of the nearest pixel.
    """
    left, right, top, bottom, fu, fv = _bilinear_corners(u, v, width, height)
    start = k * height * width
    a = tl.load(inverse + start + top * width + left, mask=wanted, other=1.0)
    b = tl.load(inverse + start + top * width + right, mask=wanted, other=1.0)
    c = tl.load(inverse + start + bottom * width + left, mask=wanted, other=1.0)
    d = tl.load(inverse + start + bottom * width + right, mask=wanted, other=1.0)
    edge = tl.load(depth_edge + start + top * width + left, mask=wanted, other=0) != 0
    nearest = tl.where(fv >= 0.5, tl.where(fu >= 0.5, d, c), tl.where(fu >= 0.5, b, a))
    plain = (a * (1 - fu) + b * fu) * (1 - fv) + (c * (1 - fu) + d * fu) * fv
    at = start + tl.where(fv >= 0.5, bottom, top) * width + tl.where(fu >= 0.5, right, left)
    return tl.where(edge, nearest, plain), a, b, c, d, edge, at


@triton.jit
def _against(inverse, depth_edge, known, poses, band, k, px, py, pz, width, height, wanted):
    """Compare map points with keyframe ``k``, like ``reference.prior_distance`` and ``reference.prior_agrees``.

    Return signed distance in truncation distances, agreement (0, 1, 2), truncation distance in metres, and a mark of
    known depth.
    """
    m = poses + 16 * k
    x = tl.load(m) * px + tl.load(m + 1) * py + tl.load(m + 2) * pz + tl.load(m + 3)
    y = tl.load(m + 4) * px + tl.load(m + 5) * py + tl.load(m + 6) * pz + tl.load(m + 7)
    z = tl.load(m + 8) * px + tl.load(m + 9) * py + tl.load(m + 10) * pz + tl.load(m + 11)
    u, v = _panorama_pixel(x, y, z, width, height)
    nearness, a, b, c, d, edge, at = _inverse_depth(inverse, depth_edge, k, u, v, width, height, wanted)
    away = tl.sqrt(x * x + y * y + z * z)
    half = tl.load(band + k)
    value = (1 - away * nearness) / half
    seen = tl.load(known + at, mask=wanted, other=0) != 0
    a, b, c, d = a * away, b * away, c * away, d * away
    low, high = 1 - half, 1 + half
    near = ((a > low) & (a < high)) | ((b > low) & (b < high)) | ((c > low) & (c < high)) | ((d > low) & (d < high))
    least, most = tl.minimum(tl.minimum(a, b), tl.minimum(c, d)), tl.maximum(tl.maximum(a, b), tl.maximum(c, d))
    between = (least < high) & (most > low)
    agrees = tl.where((edge & near) | (~edge & between), tl.where(seen, 2, 1), 0)
    return value, agrees, away * half, seen


@triton.jit
def _nearest_prior(inverse, depth_edge, known, poses, band, keyframes, px, py, pz, width, height, wanted):
    """Return signed distance to the nearest keyframe's surface and agreement, like ``reference.nearest_prior``."""
    best, unit = px * 0 + _NOT_SEEN, px * 0 + 1
    agrees, through = (px * 0).to(tl.int32), px * 0 > 1
    for k in range(keyframes):
        value, agree, away, seen = _against(
            inverse, depth_edge, known, poses, band, k, px, py, pz, width, height, wanted
        )
        unit = tl.where(k == 0, away, unit)
        closer = ~through & (tl.abs(value) * away < tl.abs(best) * unit)
        best = tl.where(closer, value * away / unit, best)
        agrees = tl.where(through, agrees, tl.maximum(agrees, agree))
        through = through | ((value > _LOOKED_THROUGH) & seen)
    return best, agrees


@triton.jit(do_not_specialize=["columns", "rows", "width", "height", "w", "h"])
def sample_rays(
    uniform, sources, rgb, inverse, depth_edge, usable, trust, map_poses, band, gain,
    columns, rows, width, height, w, h, points, target, weight, B: tl.constexpr,
):  # fmt: skip
    """Sample a ray per stratum and two points per ray, like ``reference.sample_rays``. One program per 64 rays."""
    tile = tl.program_id(0)
    inside = tl.arange(0, B)
    n = tile * B + inside
    k = tl.load(sources + tile)
    across = columns // 8
    column = (tile % across) * 8 + inside % 8
    row = (tile // across) * 8 + inside // 8
    turn = (column + tl.load(uniform + 3 * n)) / columns
    z = 1 - 2 * (row + tl.load(uniform + 3 * n + 1)) / rows
    flat = tl.sqrt(tl.maximum(1 - z * z, 0.0))
    fall = _atan2(flat, z) / _PI
    azimuth = _PI * (1 - 2 * turn)
    every = n >= 0
    nearness, _, _, _, _, _, _ = _inverse_depth(inverse, depth_edge, k, turn * w - 0.5, fall * h - 0.5, w, h, every)
    depth = 1 / nearness
    offset = 2 * tl.load(uniform + 3 * n + 2) - 1
    half = tl.load(band + k)
    length = depth * (1 + half * offset)
    dx, dy = flat * tl.cos(azimuth), flat * tl.sin(azimuth)
    surface = tile * 2 * B + inside
    near = surface + B
    away = depth * 0
    for c in tl.static_range(3):
        m = map_poses + 16 * k + 4 * c
        direction = tl.load(m) * dx + tl.load(m + 1) * dy + tl.load(m + 2) * z
        camera = tl.load(m + 3)
        place = camera + depth * direction
        tl.store(points + 3 * surface + c, place)
        tl.store(points + 3 * near + c, camera + length * direction)
        gap = place - tl.load(map_poses + 4 * c + 3)
        away += gap * gap
        u, v = turn * width - 0.5, fall * height - 0.5
        colour = _panorama_colour(rgb, gain, k, u, v, width, height, every, c) - 0.5
        tl.store(target + 4 * surface + c, colour)
        tl.store(target + 4 * near + c, colour)
    # Distances are in truncation distances of the newest keyframe.
    other = half * depth / (tl.load(band) * tl.maximum(tl.sqrt(away), 0.5 * depth))
    tl.store(target + 4 * surface + 3, depth * 0)
    tl.store(target + 4 * near + 3, -offset * tl.where(k > 0, other, 1.0))
    at_row = tl.minimum((fall * h).to(tl.int32), h - 1)
    at_column = tl.minimum((turn * w).to(tl.int32), w - 1)
    at = (k * h + at_row) * w + at_column
    use = tl.load(usable + at).to(tl.float32)
    sure = use * tl.load(trust + at)
    for where in tl.static_range(2):
        tl.store(weight + 2 * (surface + where * B), use)
        tl.store(weight + 2 * (surface + where * B) + 1, sure)


@triton.jit(do_not_specialize=["size", "keyframes", "count"])
def gradient(
    table, size, network, cells_per_m, origin, focus, keyframes, points, target, weight, colour_weight, distance_weight,
    count, table_grad, network_grad, sums,
    LEVELS: tl.constexpr, LP: tl.constexpr, F: tl.constexpr,
    HIDDEN: tl.constexpr, HP: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Add the gradient of ``reference.loss(reference.query(…))`` to ``table_grad`` and ``network_grad``.

    Also add the weighted squared errors of colour and distance, and the sums of their weights, to ``sums`` (4,).
    """
    IN: tl.constexpr = LEVELS * F
    n = tl.program_id(0) * B + tl.arange(0, B)
    inside = n < count
    px = tl.load(points + 3 * n, mask=inside, other=0.0)
    py = tl.load(points + 3 * n + 1, mask=inside, other=0.0)
    pz = tl.load(points + 3 * n + 2, mask=inside, other=0.0)
    x = _encode(table, size, cells_per_m, origin, focus, keyframes, px, py, pz, inside, LEVELS, LP, F, B)
    w1, b1 = _first_layer(network, IN, HIDDEN, LP, F, HP)
    h = tl.maximum(tl.dot(x, tl.trans(w1)) + b1[None, :], 0.0)
    shown = tl.load(weight + 2 * n, mask=inside, other=0.0)
    sure = tl.load(weight + 2 * n + 1, mask=inside, other=0.0)
    colour_share = shown * tl.load(colour_weight + n, mask=inside, other=0.0)
    distance_share = sure * tl.load(distance_weight + n, mask=inside, other=0.0)
    j, i = tl.arange(0, HP), tl.arange(0, LP * F)
    start: tl.constexpr = HIDDEN * IN + HIDDEN
    dh = tl.zeros((B, HP), tl.float32)
    colour_error = tl.zeros((B,), tl.float32)
    for c in tl.static_range(4):
        y, w2 = _output(network, h, c, IN, HIDDEN, HP)
        error = y - tl.load(target + 4 * n + c, mask=inside, other=0.0)
        share = colour_share if c < 3 else distance_share
        if c < 3:
            colour_error += share * error * error
        else:
            tl.atomic_add(sums + 1, tl.sum(share * error * error, axis=0))
        dy = 2 * share * error
        dh += dy[:, None] * w2[None, :]
        of_weights = tl.sum(dy[:, None] * h, axis=0)
        tl.atomic_add(network_grad + start + c * HIDDEN + j, of_weights, mask=j < HIDDEN, sem="relaxed")
        tl.atomic_add(network_grad + start + 4 * HIDDEN + c, tl.sum(dy, axis=0), sem="relaxed")
    tl.atomic_add(sums, tl.sum(colour_error, axis=0))
    tl.atomic_add(sums + 2, tl.sum(shown, axis=0))
    tl.atomic_add(sums + 3, tl.sum(sure, axis=0))
    dh = tl.where(h > 0, dh, 0.0)
    of_first = tl.dot(tl.trans(dh), x)
    real = (j[:, None] < HIDDEN) & (i[None, :] < IN)
    tl.atomic_add(network_grad + j[:, None] * IN + i[None, :], of_first, mask=real, sem="relaxed")
    tl.atomic_add(network_grad + HIDDEN * IN + j, tl.sum(dh, axis=0), mask=j < HIDDEN, sem="relaxed")
    dx = tl.reshape(tl.dot(dh, w1), (B, LP, F))
    ix, iy, iz, fx, fy, fz, share = _cells(cells_per_m, origin, focus, keyframes, px, py, pz, LEVELS, LP)
    first = tl.arange(0, LP)[None, :] * size
    feature = tl.arange(0, F)[None, None, :]
    written = ((share > 0) & inside[:, None])[:, :, None] & (feature >= 0)
    for corner in tl.static_range(8):
        entry, part = _corner(ix, iy, iz, fx, fy, fz, size, corner)
        where = table_grad + (first + entry)[:, :, None] * F + feature
        tl.atomic_add(where, (part * share)[:, :, None] * dx, mask=written, sem="relaxed")


@triton.jit(do_not_specialize=["size"])
def adam_table(
    table, half_table, table_grad, m, v, step_size, size, beta1, beta2, epsilon, F: tl.constexpr, B: tl.constexpr
):
    """Update entries that have a gradient by one Adam step, like ``reference.adam_touched``, and clear the gradient.

    The new values are also written to ``half_table`` as float16. One program per ``B`` entries of one level.
    """
    entry = tl.program_id(0).to(tl.int64) * B + tl.arange(0, B)
    at = entry[:, None] * F + tl.arange(0, F)[None, :]
    g = tl.load(table_grad + at)
    touched = (tl.max(tl.abs(g), axis=1) > 0)[:, None] & (at >= 0)
    mean = beta1 * tl.load(m + at, mask=touched, other=0.0) + (1 - beta1) * g
    square = beta2 * tl.load(v + at, mask=touched, other=0.0) + (1 - beta2) * g * g
    step = tl.load(step_size + tl.program_id(0) * B // size)
    value = tl.load(table + at, mask=touched, other=0.0) - step * mean / (tl.sqrt(square) + epsilon)
    tl.store(m + at, mean, mask=touched)
    tl.store(v + at, square, mask=touched)
    tl.store(table + at, value, mask=touched)
    tl.store(half_table + at, value.to(tl.float16), mask=touched)
    tl.store(table_grad + at, g * 0, mask=touched)


@triton.jit
def adam_network(network, network_grad, m, v, step_size, beta1, beta2, epsilon, COUNT: tl.constexpr, B: tl.constexpr):
    """Update the whole network by one Adam step, and clear its gradient. Runs as one program."""
    at = tl.arange(0, B)
    inside = at < COUNT
    g = tl.load(network_grad + at, mask=inside, other=0.0)
    mean = beta1 * tl.load(m + at, mask=inside, other=0.0) + (1 - beta1) * g
    square = beta2 * tl.load(v + at, mask=inside, other=0.0) + (1 - beta2) * g * g
    value = tl.load(network + at, mask=inside, other=0.0)
    tl.store(network + at, value - tl.load(step_size) * mean / (tl.sqrt(square) + epsilon), mask=inside)
    tl.store(m + at, mean, mask=inside)
    tl.store(v + at, square, mask=inside)
    tl.store(network_grad + at, g * 0, mask=inside)


@triton.jit
def _span(o, d, low, size, enter, leave):
    """Clip the part of a ray inside the grid, from ``enter`` to ``leave``, along one axis."""
    safe = tl.where(tl.abs(d) < 1e-9, 1e-9, d)
    a, b = (low - o) / safe, (low + size - o) / safe
    return tl.maximum(enter, tl.minimum(a, b)), tl.minimum(leave, tl.maximum(a, b))


@triton.jit
def _cell(o, t, d, low, cell, count):
    place = tl.floor((o + t * d - low) / cell).to(tl.int32)
    return tl.minimum(tl.maximum(place, 0), count - 1)


@triton.jit
def _turned_ray(directions, turn, at, inside):
    """Load the directions of pixels and rotate them into the map's frame."""
    vx = tl.load(directions + 3 * at, mask=inside, other=1.0)
    vy = tl.load(directions + 3 * at + 1, mask=inside, other=0.0)
    vz = tl.load(directions + 3 * at + 2, mask=inside, other=0.0)
    dx = tl.load(turn) * vx + tl.load(turn + 1) * vy + tl.load(turn + 2) * vz
    dy = tl.load(turn + 3) * vx + tl.load(turn + 4) * vy + tl.load(turn + 5) * vz
    dz = tl.load(turn + 6) * vx + tl.load(turn + 7) * vy + tl.load(turn + 8) * vz
    return dx, dy, dz


@triton.jit
def _skip_free(grid, ox, oy, oz, dx, dy, dz, gx, gy, gz, nx, ny, nz, cell, t, leave, active):
    """Advance active rays to their next occupied cell; deactivate those that leave the grid."""
    seeking = active
    while tl.max(seeking.to(tl.int32), axis=0) > 0:
        seeking = seeking & (t < leave)
        active = active & (t < leave)
        cx, cy, cz = _cell(ox, t, dx, gx, cell, nx), _cell(oy, t, dy, gy, cell, ny), _cell(oz, t, dz, gz, cell, nz)
        free = tl.load(grid + (cx * ny + cy) * nz + cz, mask=seeking, other=0).to(tl.float32)
        seeking = seeking & (free > 0)
        t = tl.where(seeking, t + cell * tl.maximum(_FIRST_STEP, 0.577 * (free - 1)), t)
    return t, active


@triton.jit
def _distance(
    table, size, network, w1, b1, cells_per_m, origin, focus, inverse, depth_edge, known, poses, band, keyframes,
    px, py, pz, w, h, active, depth_share,
    LEVELS: tl.constexpr, LP: tl.constexpr, F: tl.constexpr,
    HIDDEN: tl.constexpr, HP: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Return the signed distance of points, mixed from the keyframes' (weight ``depth_share``) and the field's."""
    value = px * 0
    if depth_share > 0:
        of_prior, _ = _nearest_prior(inverse, depth_edge, known, poses, band, keyframes, px, py, pz, w, h, active)
        value = depth_share * of_prior
    if depth_share < 1:
        x = _encode(table, size, cells_per_m, origin, focus, keyframes, px, py, pz, active, LEVELS, LP, F, B)
        hidden = tl.maximum(tl.dot(x, tl.trans(w1)) + b1[None, :], 0.0)
        of_field, _ = _output(network, hidden, 3, LEVELS * F, HIDDEN, HP)
        value += (1 - depth_share) * of_field
    return value


@triton.jit
def _channel(network, hidden, shown, c: tl.constexpr, IN: tl.constexpr, HIDDEN: tl.constexpr, HP: tl.constexpr):
    """Return a colour channel of the field, 0 to 1; 0 where not ``shown``."""
    value, _ = _output(network, hidden, c, IN, HIDDEN, HP)
    return tl.where(shown, tl.minimum(tl.maximum(value + 0.5, 0.0), 1.0), 0.0)


@triton.jit
def _mix_panorama(
    red, green, blue, rgb, gain, inverse, depth_edge, known, poses, band, keyframes, px, py, pz, width, height, w, h,
    waiting, panorama_share,
):  # fmt: skip
    """Mix in the colour of the newest keyframe that shows each point, like ``reference.mix_panorama``."""
    for k in range(keyframes):
        m = poses + 16 * k
        x0 = tl.load(m) * px + tl.load(m + 1) * py + tl.load(m + 2) * pz + tl.load(m + 3)
        y0 = tl.load(m + 4) * px + tl.load(m + 5) * py + tl.load(m + 6) * pz + tl.load(m + 7)
        z0 = tl.load(m + 8) * px + tl.load(m + 9) * py + tl.load(m + 10) * pz + tl.load(m + 11)
        _, agrees, _, _ = _against(inverse, depth_edge, known, poses, band, k, px, py, pz, w, h, waiting)
        mine = waiting & (tl.where(k == keyframes - 1, 1, agrees) > 0)
        waiting = waiting & ~mine
        u, v = _panorama_pixel(x0, y0, z0, width, height)
        share = tl.where(mine, panorama_share, 0.0)
        red += share * (_panorama_colour(rgb, gain, k, u, v, width, height, mine, 0) - red)
        green += share * (_panorama_colour(rgb, gain, k, u, v, width, height, mine, 1) - green)
        blue += share * (_panorama_colour(rgb, gain, k, u, v, width, height, mine, 2) - blue)
    return red, green, blue


@triton.jit
def _march(
    table, size, network, w1, b1, cells_per_m, origin, focus, grid, inverse, depth_edge, known, poses, camera, band,
    keyframes, ox, oy, oz, dx, dy, dz, gx, gy, gz, nx, ny, nz, cell, w, h, inside, depth_share,
    LEVELS: tl.constexpr, LP: tl.constexpr, F: tl.constexpr,
    HIDDEN: tl.constexpr, HP: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """March rays to the surface and return depth and confidence, like ``reference.trace``."""
    near_band = tl.load(band)
    t, leave = _span(ox, dx, gx, nx * cell, dx * 0, dx * 0 + 1e9)
    t, leave = _span(oy, dy, gy, ny * cell, t, leave)
    t, leave = _span(oz, dz, gz, nz * cell, t, leave)
    active = inside & (t < leave)
    last_t, last_s = t * 0, t * 0 + _NOT_SEEN
    spare, spare_s = t * 0, t * 0 + _NOT_SEEN
    met, trust = t * 0, t * 0
    while tl.max(active.to(tl.int32), axis=0) > 0:
        t, active = _skip_free(grid, ox, oy, oz, dx, dy, dz, gx, gy, gz, nx, ny, nz, cell, t, leave, active)
        px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
        value = _distance(
            table, size, network, w1, b1, cells_per_m, origin, focus, inverse, depth_edge, known, poses, band,
            keyframes, px, py, pz, w, h, active, depth_share, LEVELS, LP, F, HIDDEN, HP, B,
        )  # fmt: skip
        before = tl.where(t - last_t > 3 * cell, _NOT_SEEN, last_s)
        crossed = (before != _NOT_SEEN) & ((before > 0) != (value > 0))
        step = tl.where(crossed, before - value, 1.0)
        hit = tl.where(crossed, last_t + (t - last_t) * before / step, t)
        hx, hy, hz = ox + hit * dx, oy + hit * dy, oz + hit * dz
        _, agrees = _nearest_prior(inverse, depth_edge, known, poses, band, keyframes, hx, hy, hz, w, h, active)
        closer = active & (agrees == 2) & (value > 0) & ~crossed & (value < spare_s)
        spare, spare_s = tl.where(closer, hit, spare), tl.where(closer, value, spare_s)
        found = active & ((value <= 0) | crossed) & (agrees > 0)
        met = tl.where(found, hit, met)
        trust = tl.where(found & (value <= 0) & (before > 0), 0.5 * agrees.to(tl.float32), trust)
        last_t, last_s = tl.where(active, t, last_t), tl.where(active, value, last_s)
        ax, ay, az = px - tl.load(camera), py - tl.load(camera + 1), pz - tl.load(camera + 2)
        reach = 0.9 * tl.abs(value) * near_band * tl.sqrt(ax * ax + ay * ay + az * az)
        t = tl.where(active, t + tl.minimum(tl.maximum(reach, 0.5 * cell), 2 * cell), t)
        active = active & ~found
    without = (met == 0) & (spare > 0)
    return tl.where(without, spare, met), tl.where(without, 1.0, trust)


@triton.jit(do_not_specialize=["size", "keyframes", "columns", "rows", "width", "height", "w", "h", "nx", "ny", "nz"])
def render_rays(
    table, size, network, cells_per_m, origin, focus, grid, grid_low, rgb, inverse, depth_edge, known, poses, camera,
    band, gain, keyframes, eye, turn, directions, columns, rows, width, height, w, h, nx, ny, nz, cell,
    panorama_share, depth_share, colour, depth, confidence,
    LEVELS: tl.constexpr, LP: tl.constexpr, F: tl.constexpr,
    HIDDEN: tl.constexpr, HP: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Render a view: march to the surface, query the field's colour there, and mix in the panorama's colour.

    Combines ``reference.trace``, ``reference.query`` and ``reference.mix_panorama``. One program per 8 × 8 pixels.

    Args:
        camera: position of the newest keyframe's camera, (3,).
        eye: position of the view, (3,).
        turn: map_from_view rotation, (3, 3).
        directions: unit rays in the view's frame, (P, 3).
        colour: result, 0 to 1, (P, 3).
        depth: result in metres along each ray, (P,); 0 where it hits nothing.
        confidence: result, (P,).
    """
    IN: tl.constexpr = LEVELS * F
    lane = tl.arange(0, B)
    across = (columns + 7) // 8
    column = (tl.program_id(0) % across) * 8 + lane % 8
    row = (tl.program_id(0) // across) * 8 + lane // 8
    inside = (column < columns) & (row < rows)
    at = row * columns + column
    dx, dy, dz = _turned_ray(directions, turn, at, inside)
    ox, oy, oz = tl.load(eye), tl.load(eye + 1), tl.load(eye + 2)
    gx, gy, gz = tl.load(grid_low), tl.load(grid_low + 1), tl.load(grid_low + 2)
    w1, b1 = _first_layer(network, IN, HIDDEN, LP, F, HP)
    met, trust = _march(
        table, size, network, w1, b1, cells_per_m, origin, focus, grid, inverse, depth_edge, known, poses, camera, band,
        keyframes, ox, oy, oz, dx, dy, dz, gx, gy, gz, nx, ny, nz, cell, w, h, inside, depth_share,
        LEVELS, LP, F, HIDDEN, HP, B,
    )  # fmt: skip
    tl.store(depth + at, met, mask=inside)
    tl.store(confidence + at, trust, mask=inside)
    shown = inside & (met > 0)
    px, py, pz = ox + met * dx, oy + met * dy, oz + met * dz
    red, green, blue = met * 0, met * 0, met * 0
    if panorama_share < 1:
        x = _encode(table, size, cells_per_m, origin, focus, keyframes, px, py, pz, shown, LEVELS, LP, F, B)
        hidden = tl.maximum(tl.dot(x, tl.trans(w1)) + b1[None, :], 0.0)
        red = _channel(network, hidden, shown, 0, IN, HIDDEN, HP)
        green = _channel(network, hidden, shown, 1, IN, HIDDEN, HP)
        blue = _channel(network, hidden, shown, 2, IN, HIDDEN, HP)
    if panorama_share > 0:
        red, green, blue = _mix_panorama(
            red, green, blue, rgb, gain, inverse, depth_edge, known, poses, band, keyframes, px, py, pz, width, height,
            w, h, shown & (trust > 0), panorama_share,
        )  # fmt: skip
    tl.store(colour + 3 * at, red, mask=inside)
    tl.store(colour + 3 * at + 1, green, mask=inside)
    tl.store(colour + 3 * at + 2, blue, mask=inside)
