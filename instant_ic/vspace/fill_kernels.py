"""CPU kernel of ``prior.fill_holes`` (numba): reads each pixel once and computes holes only."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.vspace.nerf.kernels import _OPTIONS


def fill(values: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """``values`` (H, W, C) with the pixels of ``weight`` (H, W) 0 filled from around; see ``prior.fill_holes``."""
    sizes = [weight.shape]
    while min(sizes[-1]) > 1:
        sizes.append(((sizes[-1][0] + 1) // 2, (sizes[-1][1] + 1) // 2))
    count = sum(height * width for height, width in sizes)
    filled = np.array(values, np.float32, order="C")
    weight = np.ascontiguousarray(weight)  # numba would compile the kernel once more for another order
    pull_push(filled, weight, np.array(sizes, np.int64), np.zeros((count, filled.shape[2] + 1), np.float32))
    return filled


@njit(**_OPTIONS)
def pull_push(values, weight, sizes, levels):  # type: ignore[no-untyped-def]
    """In place; ``levels`` holds weighted sums and weights of all levels, one after another, and comes as zeros."""
    channels = values.shape[2]
    height, width = weight.shape
    holes = 0
    for y in range(height):
        for x in range(width):
            w = weight[y, x]
            if w > 0:
                n = y * width + x
                for c in range(channels):
                    levels[n, c] = w * values[y, x, c]
                levels[n, channels] = w
            else:
                holes += 1
    if holes == 0:
        return
    start = 0
    for level in range(sizes.shape[0] - 1):
        h, w1 = sizes[level]
        below, coarse = start + h * w1, sizes[level + 1, 1]
        for y in range(h):
            for x in range(w1):
                n = start + y * w1 + x
                if levels[n, channels] > 0:
                    m = below + (y // 2) * coarse + x // 2
                    for c in range(channels + 1):
                        levels[m, c] += levels[n, c]
        start = below
    for level in range(sizes.shape[0] - 2, -1, -1):
        h, w1 = sizes[level]
        hc, wc = sizes[level + 1]
        below, start = start, start - h * w1
        for y in range(h):
            y0 = y // 2
            y1 = max(y0 - 1, 0) if y % 2 == 0 else min(y0 + 1, hc - 1)
            for x in range(w1):
                n = start + y * w1 + x
                if levels[n, channels] > 0:
                    continue
                x0 = x // 2
                x1 = max(x0 - 1, 0) if x % 2 == 0 else min(x0 + 1, wc - 1)
                # Bilinear, weights 3/4 and 1/4 an axis; a quarter of it, as one pixel is a quarter of the coarser.
                a, b, c0, d = below + y0 * wc + x0, below + y0 * wc + x1, below + y1 * wc + x0, below + y1 * wc + x1
                for c in range(channels + 1):
                    value = np.float32(9) * levels[a, c] + np.float32(3) * (levels[b, c] + levels[c0, c]) + levels[d, c]
                    levels[n, c] = value * np.float32(1 / 64)
    for y in range(height):
        for x in range(width):
            if weight[y, x] <= 0:
                n = y * width + x
                total = max(levels[n, channels], np.float32(1e-30))
                for c in range(channels):
                    values[y, x, c] = levels[n, c] / total
