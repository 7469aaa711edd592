"""CPU kernels of several keyframes: composition of a view, and which surfaces each has seen (numba)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from instant_ic.vspace.nerf.kernels import _OPTIONS
from instant_ic.vspace.nerf.march import along, transformed

FOR, AGAINST, NO_OPINION = 1, 2, 0


@njit(**_OPTIONS)
def panorama_pixel(x, y, z, height, width):  # type: ignore[no-untyped-def]
    """Upper left pixel (row, column) of a point of the camera frame, and its distance."""
    flat = math.sqrt(x * x + y * y)
    u = (math.pi - math.atan2(y, x)) * (width / (2 * math.pi)) - 0.5
    v = (math.pi / 2 - math.atan2(z, flat)) * (height / math.pi) - 0.5
    row = min(max(math.floor(v), 0), height - 1)
    return row, math.floor(u) % width, np.float32(math.sqrt(flat * flat + z * z))


@njit(**_OPTIONS)
def blend(  # type: ignore[no-untyped-def]
    colours, depths, confidences, gains, depth_edge, inverse, beside, known, room, camera_from_map, places, origin,
    directions, edge, aside_rad, nearer, other_side_rad, same_place, same_surface, least_penalty, sharpness,
    colour, depth, confidence,
):  # fmt: skip
    """Compose the layers of a view by the rules of ``compose``.

    Args:
        colours: (K, P, 3); depths, confidences: (K, P); newest keyframe first.
        gains: (K, 3); depth_edge, inverse, known: of the keyframes' depth, (K, h, w); beside: near an edge of it,
            (K, h, w); room: as ``opinion`` takes it, (K, K).
        camera_from_map: (K, 4, 4); places: of the cameras, (K, 3).
        origin: (3,); directions: (P, 3).
        edge … sharpness: the constants of ``compose``.
        colour: out, (P, 3); depth, confidence: out, (P,).
    """
    count = depths.shape[0]
    height, width = depth_edge.shape[1:]
    one = np.float32(1)
    rank = np.zeros(count, np.float32)
    penalty = np.zeros(count, np.float32)
    weight = np.zeros(count, np.float32)
    for n in range(depths.shape[1]):
        best = np.float32(0)
        for k in range(count):
            rank[k] = confidences[k, n]
            if rank[k] <= 0:
                continue
            t = depths[k, n]
            px, py, pz = along(camera_from_map[k], origin, directions[n], t)
            away = math.sqrt(px * px + py * py + pz * pz)
            anew = k > 0 and _anew(places[k], places[0], origin, directions[n], t, nearer, other_side_rad)
            if _angle(places[k], origin, directions[n], t, away) > aside_rad:
                row, column, _ = panorama_pixel(px, py, pz, height, width)
                if (k == 0 or anew) and depth_edge[k, row, column]:
                    rank[k] -= edge
                elif k > 0 and not anew and beside[k, row, column]:
                    rank[k] = 0
            for newer in range(k):
                x, y, z = along(camera_from_map[newer], origin, directions[n], t)
                says = opinion(x, y, z, inverse[newer], known[newer], room[newer, k])
                drawn = confidences[newer, n] > 0 and abs(depths[newer, n] - t) <= same_place * t
                if says == AGAINST or (says == FOR and not drawn and not anew):
                    rank[k] = 0
            best = max(best, rank[k])
        if best <= 0:  # nobody has seen it: as the newest has it
            for c in range(3):
                colour[n, c] = colours[0, n, c] * gains[0, c]
            depth[n] = depths[0, n]
            confidence[n] = 0
            continue
        nearest = np.float32(1e9)
        for k in range(count):
            if rank[k] == best:
                nearest = min(nearest, depths[k, n])
        least, surface = np.float32(1e9), nearest
        for k in range(count):
            penalty[k] = np.float32(1e9)
            if rank[k] != best or depths[k, n] > nearest * (one + same_place):
                continue
            px, py, pz = along(camera_from_map[k], origin, directions[n], nearest)
            away = math.sqrt(px * px + py * py + pz * pz)
            angle = _angle(places[k], origin, directions[n], nearest, away)
            penalty[k] = least_penalty + angle + max(0.0, away / nearest - 1)
            if penalty[k] < least:
                least, surface = penalty[k], depths[k, n]
        total, sure = np.float32(0), np.float32(0)
        for k in range(count):
            weight[k] = 0
            if penalty[k] < 1e8 and abs(depths[k, n] - surface) <= surface * same_surface:
                weight[k] = (least / penalty[k]) ** sharpness
                total += weight[k]
                sure = max(sure, confidences[k, n])
        depth[n] = 0
        confidence[n] = sure
        for c in range(3):
            colour[n, c] = 0
        for k in range(count):
            share = weight[k] / total
            if share > 0:
                depth[n] += share * depths[k, n]
                for c in range(3):
                    colour[n, c] += share * gains[k, c] * colours[k, n, c]


@njit(**_OPTIONS)
def _angle(place, origin, direction, t, away):  # type: ignore[no-untyped-def]
    """Radians at a point ``t`` along a ray between the ways to the ray's origin and to a place ``away`` from it."""
    toward = t
    for c in range(3):
        toward += (origin[c] - place[c]) * direction[c]
    return math.acos(min(max(toward / max(away, 1e-6), -1.0), 1.0))


@njit(**_OPTIONS)
def _anew(place, newest, origin, direction, t, nearer, other_side_rad):  # type: ignore[no-untyped-def]
    """Whether a place sees a point ``t`` along a ray from nearer than the newest's place does, or from another side."""
    own, other, both = np.float32(0), np.float32(0), np.float32(0)
    for c in range(3):
        point = origin[c] + t * direction[c]
        own += (point - place[c]) ** 2
        other += (point - newest[c]) ** 2
        both += (point - place[c]) * (point - newest[c])
    return own < nearer * nearer * other or both < math.cos(other_side_rad) * math.sqrt(own * other)


@njit(**_OPTIONS)
def opinion(x, y, z, inverse, sure, room):  # type: ignore[no-untyped-def]
    """A keyframe's opinion on a point of its camera's frame: ``FOR`` (it has seen a surface there), ``AGAINST`` (it has
    looked through it) or ``NO_OPINION`` (it is hidden, or the depth is not known there).

    ``room``: share of the distance by which depths may differ.
    """
    height, width = inverse.shape
    row, column, away = panorama_pixel(x, y, z, height, width)
    below, right = min(row + 1, height - 1), (column + 1) % width
    if not (sure[row, column] and sure[row, right] and sure[below, column] and sure[below, right]):
        return NO_OPINION
    a, b = inverse[row, column] * away, inverse[row, right] * away
    c, d = inverse[below, column] * away, inverse[below, right] * away
    # At an edge the nearest of the neighbours counts: `a` is the point's distance over the surface's.
    if max(max(a, b), max(c, d)) * (1 + room) < 1:
        return AGAINST
    if min(min(a, b), min(c, d)) <= 1 + room:
        return FOR
    return NO_OPINION


@njit(**_OPTIONS)
def outvoted(directions, inverse, sure, map_from_camera, camera_from_map, room, own, step, out):  # type: ignore[no-untyped-def]
    """Pixels of keyframe ``own`` through which most of the keyframes with an opinion have looked.

    Args:
        directions: of the panorama's pixels, (h, w, 3), camera frame.
        inverse, sure: of all keyframes, newest first, (K, h, w); map_from_camera, camera_from_map: (K, 4, 4).
        room: (K,) of each against ``own``.
        step: every so many pixels are asked.
        out: (h, w) uint8; blocks of ``step`` × ``step`` are set to 1.
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
