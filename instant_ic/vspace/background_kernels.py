"""CPU kernels of the background behind a keyframe's surfaces (numba)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from instant_ic.vspace.nerf.kernels import _OPTIONS
from instant_ic.vspace.nerf.march import along, panorama_pixels
from instant_ic.vspace.warp_kernels import NEAR_M, beyond, rasterize_triangle

SAME_THING = np.float32(2)
"""Factor above which a surface nearer than an object's edge is the ground on which the object stands."""


@njit(**_OPTIONS)
def in_front(inverse, depth_edge, level, reach, steps):  # type: ignore[no-untyped-def]
    """Write the distance from a depth edge for the pixels of the surface on its near side.

    The near surface is followed from each edge while it remains nearer than the middle between the edge's two sides.

    Args:
        inverse, depth_edge: arrays of the ``PanoramaPrior``, (h, w).
        level: positive on floor and ceiling, which hide nothing, (h, w).
        reach: largest distance from an edge in pixels.
        steps: pixels from the edge, counted from 1, (h, w) int32; written; 0 on the far side and far from any edge.
    """
    height, width = inverse.shape
    queue = np.empty(height * width, np.int64)
    limit = np.zeros((height, width), np.float32)
    near = np.zeros((height, width), np.float32)
    size = 0
    for v in range(height - 1):
        for u in range(width):
            if not depth_edge[v, u]:
                continue
            right = (u + 1) % width
            a, b, c, d = inverse[v, u], inverse[v, right], inverse[v + 1, u], inverse[v + 1, right]
            middle = math.sqrt(min(min(a, b), min(c, d)) * max(max(a, b), max(c, d)))
            for corner in range(4):
                y, x = v + corner // 2, right if corner % 2 else u
                if inverse[y, x] > middle and steps[y, x] == 0 and level[y, x] == 0:
                    steps[y, x], limit[y, x], near[y, x] = 1, middle, inverse[y, x]
                    queue[size] = y * width + x
                    size += 1
    first = 0
    while first < size:
        y, x = queue[first] // width, queue[first] % width
        first += 1
        if steps[y, x] >= reach:
            continue
        for way in range(4):
            ny = y + (1 if way == 0 else -1 if way == 1 else 0)
            nx = (x + (1 if way == 2 else -1 if way == 3 else 0)) % width
            if not 0 <= ny < height or steps[ny, nx] > 0 or level[ny, nx] > 0:
                continue
            if limit[y, x] < inverse[ny, nx] < SAME_THING * near[y, x]:
                steps[ny, nx], limit[ny, nx], near[ny, nx] = steps[y, x] + 1, limit[y, x], near[y, x]
                queue[size] = ny * width + nx
                size += 1


@njit(**_OPTIONS)
def render_quads(  # type: ignore[no-untyped-def]
    quads, mark, inverse, directions, view_from_camera, half, nearness, marks
):
    """Render some quads of a panorama's mesh into a z-buffer.

    Args:
        quads: upper left pixels (row, column), (N, 2).
        mark: value that is written to ``marks``.
        inverse: inverse depth, (h, w).
        directions: directions of the pixels, (h, w, 3).
        view_from_camera, half, nearness, marks: as in ``warp_kernels.render_mesh``.
    """
    width = inverse.shape[1]
    aspect = np.float32(nearness.shape[0]) / np.float32(nearness.shape[1])
    origin = np.zeros(3, np.float32)
    patch = np.zeros((4, 3), np.float32)
    for n in range(quads.shape[0]):
        tangled, common = False, 31
        for corner in range(4):
            v, u = quads[n, 0] + corner // 2, (quads[n, 1] + corner % 2) % width
            x, y, z = along(view_from_camera, origin, directions[v, u], np.float32(1) / inverse[v, u])
            patch[corner, 0], patch[corner, 1], patch[corner, 2] = x, y, z
            tangled = tangled or x < NEAR_M
            common &= beyond(x, y, z, half, half * aspect)
        if common == 0:
            rasterize_triangle(patch[0], patch[1], patch[2], tangled, mark, half, nearness, marks)
            rasterize_triangle(patch[1], patch[3], patch[2], tangled, mark, half, nearness, marks)


@njit(**_OPTIONS)
def colour_pixels(  # type: ignore[no-untyped-def]
    rgb, shares, camera_from_map, origin, directions, wanted, depth, colour, share
):
    """Write a panorama's bilinear colours (P, 3) and weights ``share`` (P,), 0 to 1, to the ``wanted`` pixels (P,).

    Args:
        rgb: the panorama, (h, w, 3) uint8.
        shares: weights of the panorama's pixels, 0 to 255, (h, w) uint8.
        depth: metres along the rays, (P,).
    """
    height, width = rgb.shape[:2]
    one = np.float32(1)
    for n in range(depth.shape[0]):
        if not wanted[n]:
            continue
        x, y, z = along(camera_from_map, origin, directions[n], depth[n])
        v0, v1, fv, left, right, fu = panorama_pixels(x, y, z, height, width)
        wa, wb, wc, wd = (one - fu) * (one - fv), fu * (one - fv), (one - fu) * fv, fu * fv
        for c in range(3):
            value = wa * np.float32(rgb[v0, left, c]) + wb * np.float32(rgb[v0, right, c])
            value += wc * np.float32(rgb[v1, left, c]) + wd * np.float32(rgb[v1, right, c])
            colour[n, c] = value * np.float32(1 / 255)
        value = wa * np.float32(shares[v0, left]) + wb * np.float32(shares[v0, right])
        value += wc * np.float32(shares[v1, left]) + wd * np.float32(shares[v1, right])
        share[n] = value * np.float32(1 / 255)
