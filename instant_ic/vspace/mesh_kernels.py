"""Colours of a mesh under the rays of an image (numba)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from instant_ic.vspace.nerf.kernels import _OPTIONS


@njit(**_OPTIONS)
def _add_bilinear(texels, start, height, width, u, v, weight, rgb):  # type: ignore[no-untyped-def]
    """Add ``weight`` × the bilinear colour at (u, v) of the repeated image to ``rgb``."""
    x, y = (u - math.floor(u)) * width - 0.5, (v - math.floor(v)) * height - 0.5
    x0, y0 = math.floor(x), math.floor(y)
    fx, fy = x - x0, y - y0
    left, right, top, bottom = x0 % width, (x0 + 1) % width, y0 % height, (y0 + 1) % height
    a, b = start + top * width + left, start + top * width + right
    c, d = start + bottom * width + left, start + bottom * width + right
    for k in range(3):
        upper = texels[a, k] * (1 - fx) + texels[b, k] * fx
        lower = texels[c, k] * (1 - fx) + texels[d, k] * fx
        rgb[k] += weight * (upper * (1 - fy) + lower * fy)


@njit(**_OPTIONS)
def shade(  # type: ignore[no-untyped-def]
    triangles, corner_uv, corner_rgb, texture, texel_per_m, texels, start, sizes, levels,
    origin, directions, range_m, face, pixel_rad, colour
):  # fmt: skip
    """Shade the hits of rays with the texture, filtered over the pixel's footprint, or with the corners' colours.

    Args:
        triangles, corner_uv, corner_rgb, texture: as in ``ColouredMesh``.
        texel_per_m, texels, start, sizes, levels: as in ``texel_pyramids``.
        origin, directions: origin of the rays, (3,), and their directions, (P, 3).
        range_m, face: distance and triangle of each hit, (P,); face is −1 if a ray hits nothing.
        pixel_rad: angle of a pixel in radians.
        colour: RGB, 0 to 1, (P, 3); written; 0 if a ray hits nothing.
    """
    rgb = np.zeros(3, np.float64)
    for n in range(face.shape[0]):
        f = face[n]
        if f < 0:
            colour[n, 0] = colour[n, 1] = colour[n, 2] = 0
            continue
        t = triangles[f]
        ax, ay, az = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
        bx, by, bz = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
        px = origin[0] + range_m[n] * directions[n, 0] - t[0, 0]
        py = origin[1] + range_m[n] * directions[n, 1] - t[0, 1]
        pz = origin[2] + range_m[n] * directions[n, 2] - t[0, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        area = math.sqrt(nx * nx + ny * ny + nz * nz)  # twice the area of the triangle
        # Barycentric weights: areas of the triangles in which the hit replaces one corner.
        w1 = ((py * bz - pz * by) * nx + (pz * bx - px * bz) * ny + (px * by - py * bx) * nz) / (area * area)
        w2 = ((ay * pz - az * py) * nx + (az * px - ax * pz) * ny + (ax * py - ay * px) * nz) / (area * area)
        w1 = min(max(w1, 0.0), 1.0)
        w2 = min(max(w2, 0.0), 1.0 - w1)
        w0 = 1 - w1 - w2
        rgb[:] = 0
        picture = texture[f]
        if picture < 0:
            for k in range(3):
                rgb[k] = w0 * corner_rgb[f, 0, k] + w1 * corner_rgb[f, 1, k] + w2 * corner_rgb[f, 2, k]
        else:
            u = w0 * corner_uv[f, 0, 0] + w1 * corner_uv[f, 1, 0] + w2 * corner_uv[f, 2, 0]
            v = w0 * corner_uv[f, 0, 1] + w1 * corner_uv[f, 1, 1] + w2 * corner_uv[f, 2, 1]
            facing = abs(nx * directions[n, 0] + ny * directions[n, 1] + nz * directions[n, 2]) / area
            # The geometric mean of the footprint's two sides blurs slanted floors less than the longer side would.
            footprint = pixel_rad * range_m[n] / math.sqrt(max(facing, 0.05))
            level = math.log2(max(texel_per_m[f] * footprint, 1.0))
            level = min(level, levels[picture] - 1.0)
            low = int(level)
            mix = level - low
            high = min(low + 1, levels[picture] - 1)
            for at, weight in ((low, 1 - mix), (high, mix)):
                if weight > 0:
                    _add_bilinear(
                        texels, start[picture, at], sizes[picture, at, 0], sizes[picture, at, 1], u, v, weight, rgb
                    )
        for k in range(3):
            colour[n, k] = rgb[k] * (1 / 255)
