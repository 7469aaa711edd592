"""CPU kernels that find which surfaces each keyframe has seen (numba)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from instant_ic.vspace.nerf.kernels import _OPTIONS
from instant_ic.vspace.nerf.march import along, transformed

FOR, AGAINST, NO_OPINION = 1, 2, 0


@njit(**_OPTIONS)
def panorama_pixel(x, y, z, height, width):  # type: ignore[no-untyped-def]
    """Return the upper left pixel (row, column) of the four around a point in the camera's frame, and its distance."""
    flat = math.sqrt(x * x + y * y)
    u = (math.pi - math.atan2(y, x)) * (width / (2 * math.pi)) - 0.5
    v = (math.pi / 2 - math.atan2(z, flat)) * (height / math.pi) - 0.5
    row = min(max(math.floor(v), 0), height - 1)
    return row, math.floor(u) % width, np.float32(math.sqrt(flat * flat + z * z))


@njit(**_OPTIONS)
def opinion(x, y, z, inverse, sure, room):  # type: ignore[no-untyped-def]
    """Return a keyframe's vote on whether a point in its camera's frame is on a surface.

    ``FOR``: the keyframe has seen a surface at the point. ``AGAINST``: it has looked through the point. ``NO_OPINION``:
    the point is hidden, or the depth in its direction is unknown.

    ``room`` is the share of the distance by which depths may differ.
    """
    height, width = inverse.shape
    row, column, away = panorama_pixel(x, y, z, height, width)
    below, right = min(row + 1, height - 1), (column + 1) % width
    if not (sure[row, column] and sure[row, right] and sure[below, column] and sure[below, right]):
        return NO_OPINION
    a, b = inverse[row, column] * away, inverse[row, right] * away
    c, d = inverse[below, column] * away, inverse[below, right] * away
    # At an edge, the nearest of the four pixels counts. `a` is the ratio of the point's distance to the surface's.
    if max(max(a, b), max(c, d)) * (1 + room) < 1:
        return AGAINST
    if min(min(a, b), min(c, d)) <= 1 + room:
        return FOR
    return NO_OPINION


@njit(**_OPTIONS)
def outvoted(directions, inverse, sure, map_from_camera, camera_from_map, room, own, step, out):  # type: ignore[no-untyped-def]
    """Mark the pixels of keyframe ``own`` whose points most of the voting keyframes have looked through.

    Args:
        directions: unit vectors of the panorama's pixels in the camera's frame, (h, w, 3).
        inverse, sure: inverse depth and known pixels of all keyframes, newest first, (K, h, w).
        map_from_camera, camera_from_map: poses and their inverses, (K, 4, 4).
        room: tolerance of each keyframe's depth against ``own``, relative to the distance, (K,).
        step: distance in pixels between the pixels on which the keyframes vote.
        out: the mask, (h, w) uint8; blocks of ``step`` × ``step`` pixels are set to 1.
    """
    count, height, width = inverse.shape
    middle = step // 2
    nothing = np.zeros(3, np.float32)
    for v0 in range(0, height, step):
        for u0 in range(0, width, step):
            v, u = min(v0 + middle, height - 1), min(u0 + middle, width - 1)
            if not sure[own, v, u]:
                continue
            x, y, z = along(map_from_camera[own], nothing, directions[v, u], np.float32(1) / inverse[own, v, u])
            balance, newest = 0, 0
            for k in range(count):
                says = FOR
                if k != own:
                    px, py, pz = transformed(camera_from_map[k], x, y, z)
                    says = opinion(px, py, pz, inverse[k], sure[k], room[k])
                if says != NO_OPINION:
                    value = 1 if says == FOR else -1
                    balance += value
                    newest = value if newest == 0 else newest
            if balance < 0 or (balance == 0 and newest < 0):
                out[v0 : v0 + step, u0 : u0 + step] = 1
