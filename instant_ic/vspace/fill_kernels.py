"""CPU kernels of ``prior`` in numba: hole filling, and cutting of assumed tops of objects."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.vspace.nerf.kernels import _OPTIONS


def fill(values: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill pixels of ``values`` (H, W, C) whose ``weight`` (H, W) is 0 from around them; see ``prior.fill_holes``."""
    sizes = [weight.shape]
    while min(sizes[-1]) > 1:
        sizes.append(((sizes[-1][0] + 1) // 2, (sizes[-1][1] + 1) // 2))
    count = sum(height * width for height, width in sizes)
    filled = np.array(values, np.float32, order="C")
    weight = np.ascontiguousarray(weight)  # numba would compile the kernel again for another memory order
    pull_push(filled, weight, np.array(sizes, np.int64), np.zeros((count, filled.shape[2] + 1), np.float32))
    return filled


@njit(**_OPTIONS)
def pull_push(values, weight, sizes, levels):  # type: ignore[no-untyped-def]
    """Fill ``values`` in place. ``levels``, initially zeros, receives the weighted sums and weights of all levels."""
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
                # Bilinear with weights 3/4 and 1/4 per axis, divided by 4, because a coarse pixel sums four fine ones.
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


@njit(**_OPTIONS)
def cut_tops(inverse, sigma, rgb, room, reach, step, assumed, contrast, share):  # type: ignore[no-untyped-def]
    """Cut the assumed tops of objects at the upper edge that the image shows.

    A top is assumed if its depth is less certain than that of the object below it. From above, its rows belong to the
    surface above the object as long as they have that surface's colour, and they then get that surface's depth.

    Args:
        inverse, sigma: inverse depth and its relative standard deviation, (h, w) float32; updated in place.
        rgb: panorama, (h, w, 3) float32.
        room: mask of pixels that show surfaces of the room, (h, w).
        reach: largest number of rows of a top.
        step: smallest ratio of inverse depth from the surface above to the object.
        assumed: smallest sigma of an assumed depth, which must also be at least twice the object's sigma.
        contrast: smallest difference between the colours of object and surface.
        share: share of the object's colour above which a pixel belongs to the object.
    """
    height, width = inverse.shape
    above, thing = np.zeros(3, np.float32), np.zeros(3, np.float32)
    for u in range(width):
        for v in range(3, height - reach - 2):
            if sigma[v, u] < assumed or inverse[v, u] < step * inverse[v - 1, u]:
                continue
            if not (room[v, u] and room[v - 1, u] and room[v - 2, u]):
                continue
            end = v + 1
            while end < v + reach and sigma[end, u] >= assumed:
                low, high = min(inverse[end, u], inverse[end - 1, u]), max(inverse[end, u], inverse[end - 1, u])
                if high > step * low:
                    break
                end += 1
            square = np.float32(0)
            for c in range(3):
                above[c] = np.float32(0.5) * (rgb[v - 2, u, c] + rgb[v - 3, u, c])
                thing[c] = np.float32(0.5) * (rgb[end, u, c] + rgb[end + 1, u, c])
                square += (thing[c] - above[c]) ** 2
            if 2 * sigma[end, u] > sigma[v, u] or square < contrast * contrast:
                continue
            slope = inverse[v - 1, u] - inverse[v - 2, u]
            if abs(slope) > np.float32(0.1) * inverse[v - 1, u]:
                slope = np.float32(0)
            for row in range(v, end):
                along = np.float32(0)
                for c in range(3):
                    along += (rgb[row, u, c] - above[c]) * (thing[c] - above[c])
                if along > share * square:
                    break
                inverse[row, u] = inverse[row - 1, u] + slope
                sigma[row, u] = sigma[row - 1, u]
