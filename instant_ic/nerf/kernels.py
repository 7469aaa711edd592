"""CPU kernels of the field: hash encoding, network, gradients by hand, Adam on touched entries (numba).

Each function has a plain torch reference of the same name in ``reference.py``. All run on one thread, release the
interpreter lock and give the same bits for the same input.

Layout: ``table`` (levels, size, features), ``w1`` (hidden, levels·features), ``b1`` (hidden,), ``w2`` (4, hidden),
``b2`` (4,). Outputs 0..2 are the colour minus 0.5, output 3 the signed distance. Points are handled in blocks of
``BLOCK`` with the point as the last axis, so that the compiler vectorises over points.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

BLOCK = 64
_P1 = 2654435761
_P2 = 805459861
_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}


@njit(**_OPTIONS)
def pixel_block(points, start, count, focus, pixel):  # type: ignore[no-untyped-def]
    """Width of a panorama's pixel at ``points[start:start + count]``, metres, of the keyframe that saw it finest.

    ``focus``: places of the keyframes' cameras and radians of a pixel, (K, 4).
    """
    for i in range(count):
        x, y, z = points[start + i, 0], points[start + i, 1], points[start + i, 2]
        finest = np.float32(1e9)
        for k in range(focus.shape[0]):
            dx, dy, dz = x - focus[k, 0], y - focus[k, 1], z - focus[k, 2]
            finest = min(finest, np.float32(math.sqrt(dx * dx + dy * dy + dz * dz)) * focus[k, 3])
        pixel[i] = finest


@njit(**_OPTIONS)
def corners(points, index, origin, scale, mask):  # type: ignore[no-untyped-def]
    """Table entries of the eight corners of a point's cell, and their trilinear weights."""
    px = (points[index, 0] - origin[0]) * scale
    py = (points[index, 1] - origin[1]) * scale
    pz = (points[index, 2] - origin[2]) * scale
    flx, fly, flz = math.floor(px), math.floor(py), math.floor(pz)
    fx, fy, fz = px - np.float32(flx), py - np.float32(fly), pz - np.float32(flz)
    x0, y0, z0 = np.int64(flx), np.int64(fly) * _P1, np.int64(flz) * _P2
    x1, y1, z1 = x0 + 1, y0 + _P1, z0 + _P2
    gx, gy, gz = np.float32(1) - fx, np.float32(1) - fy, np.float32(1) - fz
    w00, w10, w01, w11 = gy * gz, fy * gz, gy * fz, fy * fz
    return (
        ((x0 ^ y0 ^ z0) & mask, (x1 ^ y0 ^ z0) & mask, (x0 ^ y1 ^ z0) & mask, (x1 ^ y1 ^ z0) & mask,
         (x0 ^ y0 ^ z1) & mask, (x1 ^ y0 ^ z1) & mask, (x0 ^ y1 ^ z1) & mask, (x1 ^ y1 ^ z1) & mask),
        (gx * w00, fx * w00, gx * w10, fx * w10, gx * w01, fx * w01, gx * w11, fx * w11),
    )  # fmt: skip


@njit(**_OPTIONS)
def encode_block(table, cells_per_m, origin, focus, points, start, count, x):  # type: ignore[no-untyped-def]
    """Trilinear features of ``points[start:start + count]`` into ``x`` (levels·features, BLOCK).

    A level counts whole while its cells are wider than the keyframe's pixel there, not at all from half of it.
    """
    levels, size, features = table.shape
    mask = size - 1
    pixel = np.empty(BLOCK, np.float32)
    pixel_block(points, start, count, focus, pixel)
    for level in range(levels):
        scale = cells_per_m[level]
        row = level * features
        for i in range(count):
            share = min(max(np.float32(2) - pixel[i] * scale, np.float32(0)), np.float32(1))
            if share == 0:
                for f in range(features):
                    x[row + f, i] = 0
                continue
            (i0, i1, i2, i3, i4, i5, i6, i7), (w0, w1, w2, w3, w4, w5, w6, w7) = corners(
                points, start + i, origin, scale, mask
            )
            for f in range(features):
                x[row + f, i] = share * (
                    w0 * table[level, i0, f]
                    + w1 * table[level, i1, f]
                    + w2 * table[level, i2, f]
                    + w3 * table[level, i3, f]
                    + w4 * table[level, i4, f]
                    + w5 * table[level, i5, f]
                    + w6 * table[level, i6, f]
                    + w7 * table[level, i7, f]
                )


@njit(**_OPTIONS)
def encode_backward_block(  # type: ignore[no-untyped-def]
    table_grad, touched, cells_per_m, origin, focus, points, start, count, dx
):
    """Adds the gradient of a block's features ``dx`` to ``table_grad`` and marks the entries in ``touched``."""
    levels, size, features = table_grad.shape
    mask = size - 1
    pixel = np.empty(BLOCK, np.float32)
    pixel_block(points, start, count, focus, pixel)
    for level in range(levels):
        scale = cells_per_m[level]
        row = level * features
        for i in range(count):
            share = min(max(np.float32(2) - pixel[i] * scale, np.float32(0)), np.float32(1))
            if share == 0:
                continue
            (i0, i1, i2, i3, i4, i5, i6, i7), (w0, w1, w2, w3, w4, w5, w6, w7) = corners(
                points, start + i, origin, scale, mask
            )
            for f in range(features):
                d = share * dx[row + f, i]
                table_grad[level, i0, f] += w0 * d
                table_grad[level, i1, f] += w1 * d
                table_grad[level, i2, f] += w2 * d
                table_grad[level, i3, f] += w3 * d
                table_grad[level, i4, f] += w4 * d
                table_grad[level, i5, f] += w5 * d
                table_grad[level, i6, f] += w6 * d
                table_grad[level, i7, f] += w7 * d
            touched[level, i0] = 1
            touched[level, i1] = 1
            touched[level, i2] = 1
            touched[level, i3] = 1
            touched[level, i4] = 1
            touched[level, i5] = 1
            touched[level, i6] = 1
            touched[level, i7] = 1


@njit(**_OPTIONS)
def layer_block(w, b, x, y):  # type: ignore[no-untyped-def]
    """``y = w x + b`` for a block: w (m, k), x (k, BLOCK), y (m, BLOCK); k is a multiple of 4."""
    for j in range(w.shape[0]):
        out = y[j]
        bias = b[j]
        for i in range(BLOCK):
            out[i] = bias
        for k in range(0, w.shape[1], 4):
            a0, a1, a2, a3 = w[j, k], w[j, k + 1], w[j, k + 2], w[j, k + 3]
            r0, r1, r2, r3 = x[k], x[k + 1], x[k + 2], x[k + 3]
            for i in range(BLOCK):
                out[i] += a0 * r0[i] + a1 * r1[i] + a2 * r2[i] + a3 * r3[i]


@njit(**_OPTIONS)
def relu_block(y):  # type: ignore[no-untyped-def]
    for j in range(y.shape[0]):
        row = y[j]
        for i in range(BLOCK):
            row[i] = max(row[i], np.float32(0))


@njit(**_OPTIONS)
def layer_backward_block(w, x, dy, gw, gb, dx):  # type: ignore[no-untyped-def]
    """Gradients of ``layer_block``: adds to ``gw`` and ``gb``, writes ``dx`` (k, BLOCK)."""
    for k in range(w.shape[1]):
        out = dx[k]
        for i in range(BLOCK):
            out[i] = 0
        for j in range(0, w.shape[0], 4):
            a0, a1, a2, a3 = w[j, k], w[j + 1, k], w[j + 2, k], w[j + 3, k]
            r0, r1, r2, r3 = dy[j], dy[j + 1], dy[j + 2], dy[j + 3]
            for i in range(BLOCK):
                out[i] += a0 * r0[i] + a1 * r1[i] + a2 * r2[i] + a3 * r3[i]
    for j in range(w.shape[0]):
        row = dy[j]
        total = np.float32(0)
        for i in range(BLOCK):
            total += row[i]
        gb[j] += total
        for k in range(w.shape[1]):
            column = x[k]
            dot = np.float32(0)
            for i in range(BLOCK):
                dot += row[i] * column[i]
            gw[j, k] += dot


@njit(**_OPTIONS)
def query(table, w1, b1, w2, b2, cells_per_m, origin, focus, points, out):  # type: ignore[no-untyped-def]
    """The field at ``points`` (N, 3) into ``out`` (N, 4): colour minus 0.5, signed distance."""
    x = np.zeros((w1.shape[1], BLOCK), np.float32)
    h = np.zeros((w1.shape[0], BLOCK), np.float32)
    y = np.zeros((4, BLOCK), np.float32)
    for start in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - start)
        encode_block(table, cells_per_m, origin, focus, points, start, count, x)
        layer_block(w1, b1, x, h)
        relu_block(h)
        layer_block(w2, b2, h, y)
        for i in range(count):
            for c in range(4):
                out[start + i, c] = y[c, i]


@njit(**_OPTIONS)
def gradient(  # type: ignore[no-untyped-def]
    table, w1, b1, w2, b2, cells_per_m, origin, focus, points, target, colour_weight, distance_weight,
    table_grad, touched, g1, gb1, g2, gb2
):  # fmt: skip
    """Adds the gradient of the training loss to the ``*_grad`` arrays.

    Loss: ``Σ colour_weight[i] · |colour_i − target_i[:3]|² + distance_weight[i] · (distance_i − target_i[3])²``.

    Args:
        points: (N, 3); target: (N, 4), colour minus 0.5 and signed distance; both weights: (N,).

    Returns:
        Weighted squared colour error and weighted squared distance error, sums over the points.
    """
    x = np.zeros((w1.shape[1], BLOCK), np.float32)
    h = np.zeros((w1.shape[0], BLOCK), np.float32)
    y = np.zeros((4, BLOCK), np.float32)
    dy = np.zeros((4, BLOCK), np.float32)
    dh = np.zeros((w1.shape[0], BLOCK), np.float32)
    dx = np.zeros((w1.shape[1], BLOCK), np.float32)
    colour_error, distance_error = 0.0, 0.0
    for start in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - start)
        encode_block(table, cells_per_m, origin, focus, points, start, count, x)
        layer_block(w1, b1, x, h)
        relu_block(h)
        layer_block(w2, b2, h, y)
        dy[:] = 0
        for i in range(count):
            weight = colour_weight[start + i]
            for c in range(3):
                error = y[c, i] - target[start + i, c]
                colour_error += weight * error * error
                dy[c, i] = np.float32(2) * weight * error
            weight = distance_weight[start + i]
            error = y[3, i] - target[start + i, 3]
            distance_error += weight * error * error
            dy[3, i] = np.float32(2) * weight * error
        layer_backward_block(w2, h, dy, g2, gb2, dh)
        for j in range(h.shape[0]):
            for i in range(BLOCK):
                if h[j, i] <= 0:
                    dh[j, i] = 0
        layer_backward_block(w1, x, dh, g1, gb1, dx)
        encode_backward_block(table_grad, touched, cells_per_m, origin, focus, points, start, count, dx)
    return colour_error, distance_error


@njit(**_OPTIONS)
def adam_touched(  # type: ignore[no-untyped-def]
    table, table_grad, touched, m, v, step_size, beta1, beta2, epsilon
):
    """One Adam step on the touched entries; clears their gradient and mark.

    Untouched entries keep value and moments, as in ``torch.optim.SparseAdam``. ``step_size`` (levels,) already holds
    the bias correction of the step, ``lr · √(1 − β2ᵗ) / (1 − β1ᵗ)``.
    """
    levels, size, features = table.shape
    keep1, keep2 = np.float32(1) - beta1, np.float32(1) - beta2
    for level in range(levels):
        step = step_size[level]
        for entry in range(size):
            if touched[level, entry]:
                touched[level, entry] = 0
                for f in range(features):
                    g = table_grad[level, entry, f]
                    table_grad[level, entry, f] = 0
                    mean = beta1 * m[level, entry, f] + keep1 * g
                    square = beta2 * v[level, entry, f] + keep2 * g * g
                    m[level, entry, f] = mean
                    v[level, entry, f] = square
                    table[level, entry, f] -= step * mean / (math.sqrt(square) + epsilon)
