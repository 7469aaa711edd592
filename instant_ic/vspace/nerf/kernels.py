"""CPU kernels of the field in numba: hash encoding, network, their analytic gradients, and Adam on touched entries.

Tests compare the kernels with plain torch in ``reference.py``. All run on one thread, release the interpreter lock and
give the same bits for the same input.

Layout: ``table`` (levels, size, features), ``w1`` (hidden, levels·features), ``b1`` (hidden,), ``w2`` (4, hidden),
``b2`` (4,). Outputs 0..2 are the colour minus 0.5, output 3 the signed distance. Points are handled in blocks of
``BLOCK`` with the point as the last axis, so that the compiler vectorises over points. Every module of kernels imports
its options from here, so that stale machine code is deleted before any of it is loaded.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from instant_ic.vspace.nerf.numba_cache import forget_stale
from instant_ic.vspace.nerf.vectors import adam, gather, scatter

BLOCK = 64
MARKED = 4
"""Number of table entries that share a mark, because together they fill a cache line of 64 bytes."""
_P1 = 2654435761
_P2 = 805459861
_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": True, "error_model": "numpy"}
forget_stale(Path(__file__).parent)


def no_marks(table: np.ndarray) -> np.ndarray:
    """Allocate the marks of a table's touched entries, (levels, size / MARKED) uint8, all 0."""
    return np.zeros((table.shape[0], table.shape[1] // MARKED), np.uint8)


@njit(**_OPTIONS)
def pixel_block(points, start, count, focus, pixel):  # type: ignore[no-untyped-def]
    """Write the pixel width at each point of ``points[start:start + count]``, of the keyframe that shows it finest.

    Args:
        focus: position of each keyframe's camera in metres, and angle of its pixels in radians, (K, 4).
        pixel: width of the pixel at the point in metres, (BLOCK,); written.
    """
    for i in range(count):
        x, y, z = points[start + i, 0], points[start + i, 1], points[start + i, 2]
        finest = np.float32(1e9)
        for k in range(focus.shape[0]):
            dx, dy, dz = x - focus[k, 0], y - focus[k, 1], z - focus[k, 2]
            finest = min(finest, np.float32(math.sqrt(dx * dx + dy * dy + dz * dz)) * focus[k, 3])
        pixel[i] = finest


@njit(**_OPTIONS)
def cells_block(points, start, count, origin, scale, size, pixel, entries, weights):  # type: ignore[no-untyped-def]
    """Find table entries and trilinear weights at the corners of the cells that contain a block's points, in one level.

    A level has full weight if its cells are wider than a keyframe's pixel at the point, and none below half a pixel.

    Args:
        size: number of entries of a level, a power of two.
        pixel: result of ``pixel_block``, (BLOCK,).
        entries: table entries, (8, BLOCK) uint32; written.
        weights: trilinear weights, (8, BLOCK) float32; written.
    """
    one = np.float32(1)
    p1, p2, mask = np.uint32(_P1), np.uint32(_P2), np.uint32(size - 1)
    ox, oy, oz = origin[0], origin[1], origin[2]
    for i in range(count):
        share = min(max(np.float32(2) - pixel[i] * scale, np.float32(0)), one)
        px = (points[start + i, 0] - ox) * scale
        py = (points[start + i, 1] - oy) * scale
        pz = (points[start + i, 2] - oz) * scale
        flx, fly, flz = np.floor(px), np.floor(py), np.floor(pz)
        x0 = np.uint32(np.int32(flx))
        y0, z0 = np.uint32(np.uint32(np.int32(fly)) * p1), np.uint32(np.uint32(np.int32(flz)) * p2)
        x1, y1, z1 = np.uint32(x0 + np.uint32(1)), np.uint32(y0 + p1), np.uint32(z0 + p2)
        entries[0, i], entries[1, i] = (x0 ^ y0 ^ z0) & mask, (x1 ^ y0 ^ z0) & mask
        entries[2, i], entries[3, i] = (x0 ^ y1 ^ z0) & mask, (x1 ^ y1 ^ z0) & mask
        entries[4, i], entries[5, i] = (x0 ^ y0 ^ z1) & mask, (x1 ^ y0 ^ z1) & mask
        entries[6, i], entries[7, i] = (x0 ^ y1 ^ z1) & mask, (x1 ^ y1 ^ z1) & mask
        fx, fy, fz = px - flx, py - fly, pz - flz
        gx, gy, gz = one - fx, one - fy, share * (one - fz)
        fz *= share
        w00, w10, w01, w11 = gy * gz, fy * gz, gy * fz, fy * fz
        weights[0, i], weights[1, i], weights[2, i], weights[3, i] = gx * w00, fx * w00, gx * w10, fx * w10
        weights[4, i], weights[5, i], weights[6, i], weights[7, i] = gx * w01, fx * w01, gx * w11, fx * w11


@njit(**_OPTIONS)
def of_point(corners, i):  # type: ignore[no-untyped-def]
    """Return the values (8, BLOCK) of one point's eight corners as a tuple."""
    return (
        corners[0, i], corners[1, i], corners[2, i], corners[3, i],
        corners[4, i], corners[5, i], corners[6, i], corners[7, i],
    )  # fmt: skip


@njit(**_OPTIONS)
def encode_block(  # type: ignore[no-untyped-def]
    table, cells_per_m, origin, focus, points, start, count, entries, weights, x
):
    """Write the trilinear features of ``points[start:start + count]`` to ``x`` (levels·features, BLOCK).

    Args:
        entries, weights: results of ``cells_block`` for ``encode_backward_block``, (levels, 8, BLOCK); written. Without
            a gradient (1, 8, BLOCK) is enough: each level then overwrites the one before.
    """
    levels, size, features = table.shape
    pixel = np.empty(BLOCK, np.float32)
    pixel_block(points, start, count, focus, pixel)
    for level in range(levels):
        kept = min(level, entries.shape[0] - 1)
        at, by, values = entries[kept], weights[kept], table[level]
        cells_block(points, start, count, origin, cells_per_m[level], size, pixel, at, by)
        rows = x[level * features : (level + 1) * features]
        for i in range(count):
            rows[0, i], rows[1, i], rows[2, i], rows[3, i] = gather(values, of_point(at, i), of_point(by, i))


@njit(**_OPTIONS)
def encode_backward_block(table_grad, touched, entries, weights, count, dx):  # type: ignore[no-untyped-def]
    """Add the gradient of a block's features ``dx`` to ``table_grad``, and mark the entries in ``touched``.

    ``entries`` and ``weights`` come from ``encode_block``, ``touched`` from ``no_marks``.
    """
    levels, _, features = table_grad.shape
    for level in range(levels):
        at, by, grad, marks = entries[level], weights[level], table_grad[level], touched[level]
        d = dx[level * features : (level + 1) * features]
        for i in range(count):
            scatter(grad, of_point(at, i), of_point(by, i), (d[0, i], d[1, i], d[2, i], d[3, i]))
        for corner in range(8):
            for i in range(count):
                marks[at[corner, i] // np.uint32(MARKED)] = 1


@njit(**_OPTIONS)
def layer_block(w, b, x, y):  # type: ignore[no-untyped-def]
    """Compute ``y = w x + b`` for a block: w (m, k), x (k, BLOCK), y (m, BLOCK); k is a multiple of 4."""
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
    """Add the gradients of ``layer_block`` to ``gw`` and ``gb``; write ``dx`` (k, BLOCK). 4 must divide k and m."""
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
        for k in range(0, w.shape[1], 4):
            c0, c1, c2, c3 = x[k], x[k + 1], x[k + 2], x[k + 3]
            d0, d1, d2, d3 = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for i in range(BLOCK):
                d0 += row[i] * c0[i]
                d1 += row[i] * c1[i]
                d2 += row[i] * c2[i]
                d3 += row[i] * c3[i]
            gw[j, k] += d0
            gw[j, k + 1] += d1
            gw[j, k + 2] += d2
            gw[j, k + 3] += d3


@njit(**_OPTIONS)
def network_backward_block(w1, w2, x, h, dy, g1, gb1, g2, gb2, dh, dx):  # type: ignore[no-untyped-def]
    """Add the network's gradients to ``g1`` … ``gb2``; write ``dh`` and ``dx``. ``h`` is the output of the ReLU."""
    layer_backward_block(w2, h, dy, g2, gb2, dh)
    for j in range(h.shape[0]):
        for i in range(BLOCK):
            if h[j, i] <= 0:
                dh[j, i] = 0
    layer_backward_block(w1, x, dh, g1, gb1, dx)


@njit(**_OPTIONS)
def query(table, w1, b1, w2, b2, cells_per_m, origin, focus, points, out):  # type: ignore[no-untyped-def]
    """Write the field at ``points`` (N, 3) to ``out`` (N, 4): colour minus 0.5, signed distance."""
    x = np.zeros((w1.shape[1], BLOCK), np.float32)
    h = np.zeros((w1.shape[0], BLOCK), np.float32)
    y = np.zeros((4, BLOCK), np.float32)
    entries, weights = np.empty((1, 8, BLOCK), np.uint32), np.empty((1, 8, BLOCK), np.float32)
    for start in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - start)
        encode_block(table, cells_per_m, origin, focus, points, start, count, entries, weights, x)
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
    """Add the gradient of the training loss to the ``*_grad`` arrays.

    Loss: ``Σ colour_weight[i] · |colour_i − target_i[:3]|² + distance_weight[i] · (distance_i − target_i[3])²``.

    Args:
        points: points in the map in metres, (N, 3).
        target: colour minus 0.5 and signed distance, (N, 4).
        colour_weight, distance_weight: weights of the points in the loss, (N,) each.

    Returns:
        Weighted squared colour error and weighted squared distance error, sums over the points.
    """
    x = np.zeros((w1.shape[1], BLOCK), np.float32)
    h = np.zeros((w1.shape[0], BLOCK), np.float32)
    y = np.zeros((4, BLOCK), np.float32)
    dy = np.zeros((4, BLOCK), np.float32)
    dh = np.zeros((w1.shape[0], BLOCK), np.float32)
    dx = np.zeros((w1.shape[1], BLOCK), np.float32)
    levels = table.shape[0]
    entries, weights = np.empty((levels, 8, BLOCK), np.uint32), np.empty((levels, 8, BLOCK), np.float32)
    colour_error, distance_error = 0.0, 0.0
    for start in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - start)
        encode_block(table, cells_per_m, origin, focus, points, start, count, entries, weights, x)
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
        network_backward_block(w1, w2, x, h, dy, g1, gb1, g2, gb2, dh, dx)
        encode_backward_block(table_grad, touched, entries, weights, count, dx)
    return colour_error, distance_error


@njit(**_OPTIONS)
def adam_touched(  # type: ignore[no-untyped-def]
    table, table_grad, touched, m, v, step_size, beta1, beta2, epsilon
):
    """Update the entries that have a gradient by one Adam step; clear gradients and marks.

    Entries that ``encode_backward_block`` has not marked in ``touched`` keep value and moments, as in
    ``torch.optim.SparseAdam``. ``step_size`` (levels,) includes the bias correction, ``lr · √(1 − β2ᵗ) / (1 − β1ᵗ)``.
    """
    levels, size, _ = table.shape
    for level in range(levels):
        step, marks = step_size[level], touched[level]
        rows, grad, mean, square = table[level], table_grad[level], m[level], v[level]
        for group in range(size // MARKED):
            if marks[group] == 0:
                continue
            marks[group] = 0
            for entry in range(group * MARKED, (group + 1) * MARKED):
                if grad[entry, 0] != 0 or grad[entry, 1] != 0 or grad[entry, 2] != 0 or grad[entry, 3] != 0:
                    adam(rows, grad, mean, square, np.uint32(entry), step, beta1, beta2, epsilon)
