"""Density geometry, as in the paper: compositing of samples around the depth, and its gradient (numba).

The network's output 3 is the logarithm of the density per truncation distance of the newest keyframe. That distance
is ``band · distance to the camera``, so that near and far walls look alike to the network.
``tests/vspace/volume_reference.py`` computes the same in torch.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from instant_ic.vspace.nerf.field import RAW_LIMITS
from instant_ic.vspace.nerf.field import VOLUME_SAMPLES as SAMPLES
from instant_ic.vspace.nerf.kernels import (
    _OPTIONS,
    BLOCK,
    encode_backward_block,
    encode_block,
    layer_block,
    network_backward_block,
    relu_block,
)

_RAYS = BLOCK // SAMPLES


@njit(**_OPTIONS)
def band_samples(camera, surface, jitter, band, newest, newest_band, points, first, offset, span):  # type: ignore[no-untyped-def]
    """Place the samples of one ray within the truncation distance on both sides of its surface.

    Args:
        camera, surface: start and end of the ray in the map, (3,) each.
        jitter: position of the samples in their strata, 0 to 1.
        band: truncation distance as a share of the depth.
        newest: position of the newest keyframe's camera, (3,).
        newest_band: ``band`` of the newest keyframe.
        points: sampled points, (…, 3); rows from ``first`` on are written.
        offset: distance behind the surface, in truncation distances of the ray, (SAMPLES,); written.
        span: length of each sample's interval, in truncation distances of the newest keyframe, (SAMPLES,); written.
    """
    step = np.float32(2.0 / SAMPLES)
    depth = np.float32(0)
    for c in range(3):
        depth += (surface[c] - camera[c]) ** 2
    depth = np.float32(math.sqrt(depth))
    for s in range(SAMPLES):
        offset[s] = (np.float32(s) + jitter) * step - np.float32(1)
        away = np.float32(0)
        for c in range(3):
            points[first + s, c] = camera[c] + (surface[c] - camera[c]) * (np.float32(1) + band * offset[s])
            away += (points[first + s, c] - newest[c]) ** 2
        unit = newest_band * max(np.float32(math.sqrt(away)), np.float32(1e-3))
        span[s] = step * band * depth / unit


@njit(**_OPTIONS)
def ray_weights(raw, first, span, weight, left):  # type: ignore[no-untyped-def]
    """Write the weight of each sample of a ray, and the transmittance behind it to ``left``, (SAMPLES,) each.

    ``raw`` holds the logarithms of the density, from entry ``first`` on.
    """
    light = np.float32(1)
    for s in range(SAMPLES):
        value = min(max(raw[first + s], np.float32(RAW_LIMITS[0])), np.float32(RAW_LIMITS[1]))
        kept = np.float32(math.exp(-math.exp(value) * span[s]))
        weight[s] = light * (np.float32(1) - kept)
        light *= kept
        left[s] = light


@njit(**_OPTIONS)
def _ray_gradient(y, first, target, weight, w, left, offset, span, losses, each, pull, dy):  # type: ignore[no-untyped-def]
    """Write the gradient of one ray's loss with respect to the network's outputs; return colour and depth errors.

    Args:
        y, dy: outputs of the network and their gradient, (4, BLOCK); the ray's samples begin at ``first``.
        target: colour of the ray, in the first three entries.
        weight: weights of colour and depth, (2,).
        w, left, offset, span: results of ``ray_weights`` and ``band_samples``, (SAMPLES,) each.
        losses: weights of the losses, see ``volume_gradient``.
        each: weight of a ray.
        pull: scratch memory, (SAMPLES,).
    """
    step = np.float32(2.0 / SAMPLES)
    by_colour, by_depth = each * weight[0], each * weight[1] * losses[0]
    red, green, blue = -target[0], -target[1], -target[2]
    mean, opacity = np.float32(0), np.float32(0)
    for s in range(SAMPLES):
        red += w[s] * y[0, first + s]
        green += w[s] * y[1, first + s]
        blue += w[s] * y[2, first + s]
        mean += w[s] * offset[s]
        opacity += w[s]
    scale = np.float32(2.0 / 3.0) * by_colour
    for s in range(SAMPLES):
        i = first + s
        spread = np.float32(2.0 / 3.0) * step * w[s]
        for other in range(SAMPLES):
            spread += np.float32(2) * w[other] * abs(offset[s] - offset[other])
        pull[s] = (
            scale * (red * y[0, i] + green * y[1, i] + blue * y[2, i])
            + 2 * by_depth * mean * offset[s]
            + each * weight[0] * (losses[2] * spread - 2 * losses[1] * (np.float32(1) - opacity))
        )
        dy[0, i], dy[1, i], dy[2, i] = scale * w[s] * red, scale * w[s] * green, scale * w[s] * blue
    behind = np.float32(0)
    for s in range(SAMPLES - 1, -1, -1):
        raw = y[3, first + s]
        inside = RAW_LIMITS[0] < raw < RAW_LIMITS[1]
        thickness = np.float32(math.exp(raw)) * span[s] if inside else np.float32(0)
        dy[3, first + s] = thickness * (left[s] * pull[s] - behind)
        behind += w[s] * pull[s]
    return by_colour * (red * red + green * green + blue * blue) / 3, each * weight[1] * mean * mean


@njit(**_OPTIONS)
def volume_gradient(  # type: ignore[no-untyped-def]
    table, w1, b1, w2, b2, cells_per_m, origin, focus, points, target, weight, jitter, sources, cameras, band,
    losses, table_grad, touched, g1, gb1, g2, gb2
):  # fmt: skip
    """Add the gradient of the training loss of composited rays to the ``*_grad`` arrays.

    The loss is the weighted mean over the rays of ``|Σ w c − colour|² / 3 + losses[0] · depth + losses[1] · opacity +
    losses[2] · distortion`` with ``depth = (Σ w o)²``, ``opacity = (1 − Σ w)²`` and ``distortion =
    Σᵢⱼ wᵢ wⱼ |oᵢ − oⱼ| + ⅓ Σ wᵢ² · step`` (Barron et al., 2022), where o is ``offset`` of ``band_samples``.

    Args:
        points, target, weight: results of ``march.sample_rays``; the first 64 of each tile's 128 rows are used.
        jitter: position of each ray's samples in their strata, 0 to 1, (N,).
        sources: keyframe of each tile, (N / 64,).
        cameras: positions of the keyframes' cameras, (K, 3).
        band: truncation distances of the keyframes as shares of the depth, (K,).
        losses: weights of depth, opacity and distortion, (3,).

    Returns:
        Mean squared errors of colour (0 to 1) and depth (in truncation distances), not weighted by ``losses``.
    """
    x, dx = np.zeros((w1.shape[1], BLOCK), np.float32), np.zeros((w1.shape[1], BLOCK), np.float32)
    h, dh = np.zeros((w1.shape[0], BLOCK), np.float32), np.zeros((w1.shape[0], BLOCK), np.float32)
    y, dy = np.zeros((4, BLOCK), np.float32), np.zeros((4, BLOCK), np.float32)
    levels = table.shape[0]
    entries, corner_weights = np.empty((levels, 8, BLOCK), np.uint32), np.empty((levels, 8, BLOCK), np.float32)
    samples = np.empty((BLOCK, 3), np.float32)
    offset, span = np.empty((_RAYS, SAMPLES), np.float32), np.empty((_RAYS, SAMPLES), np.float32)
    w, left, pull = np.empty(SAMPLES, np.float32), np.empty(SAMPLES, np.float32), np.empty(SAMPLES, np.float32)
    rays = jitter.shape[0]
    each = np.float32(1.0 / rays)
    colour_error, depth_error = 0.0, 0.0
    for start in range(0, rays, _RAYS):
        tile = start // 64
        k = sources[tile]
        for r in range(_RAYS):
            n = tile * 128 + (start + r) % 64
            band_samples(
                cameras[k], points[n], jitter[start + r], band[k], cameras[0], band[0],
                samples, r * SAMPLES, offset[r], span[r],
            )  # fmt: skip
        encode_block(table, cells_per_m, origin, focus, samples, 0, BLOCK, entries, corner_weights, x)
        layer_block(w1, b1, x, h)
        relu_block(h)
        layer_block(w2, b2, h, y)
        for r in range(_RAYS):
            n, first = tile * 128 + (start + r) % 64, r * SAMPLES
            ray_weights(y[3], first, span[r], w, left)
            colour, squared_depth = _ray_gradient(
                y, first, target[n], weight[n], w, left, offset[r], span[r], losses, each, pull, dy
            )
            colour_error += colour
            depth_error += squared_depth
        network_backward_block(w1, w2, x, h, dy, g1, gb1, g2, gb2, dh, dx)
        encode_backward_block(table_grad, touched, entries, corner_weights, BLOCK, dx)
    return colour_error, depth_error


@njit(**_OPTIONS)
def _guided_samples(origin, direction, depth, newest, band, points, first, offset, span):  # type: ignore[no-untyped-def]
    """Place a view's samples around the depth of one ray, and return their truncation distance as a share of it.

    Args:
        origin, direction: position of the view and unit vector of the ray in the map, (3,) each.
        depth: metres along the ray.
        newest, points, first, offset, span: as in ``band_samples``.
        band: ``band`` of the newest keyframe.
    """
    half, away = np.float32(0.5), np.float32(0)
    surface = np.empty(3, np.float32)
    for c in range(3):
        surface[c] = origin[c] + depth * direction[c]
        away += (surface[c] - newest[c]) ** 2
    share = min(band * np.float32(math.sqrt(away)) / depth, half)
    band_samples(origin, surface, half, share, newest, band, points, first, offset, span)
    return share


@njit(**_OPTIONS)
def _composited(y, first, w, offset, colour):  # type: ignore[no-untyped-def]
    """Write the colour of a ray, and return the weighted mean of its samples' offsets.

    Args:
        y: outputs of the network, (4, BLOCK); the ray's samples begin at ``first``.
        w, offset: weights and offsets of the samples, (SAMPLES,) each.
        colour: colour of the ray, 0 to 1, (3,); written.
    """
    opacity, mean, half = np.float32(1e-6), np.float32(0), np.float32(0.5)
    red, green, blue = np.float32(0), np.float32(0), np.float32(0)
    for s in range(SAMPLES):
        red += w[s] * y[0, first + s]
        green += w[s] * y[1, first + s]
        blue += w[s] * y[2, first + s]
        mean += w[s] * offset[s]
        opacity += w[s]
    colour[0] = min(max(red + half, np.float32(0)), np.float32(1))
    colour[1] = min(max(green + half, np.float32(0)), np.float32(1))
    colour[2] = min(max(blue + half, np.float32(0)), np.float32(1))
    return mean / opacity


@njit(**_OPTIONS)
def composite(  # type: ignore[no-untyped-def]
    table, w1, b1, w2, b2, cells_per_m, lattice_origin, focus, band, depth_share, origin, directions, depth, colour
):
    """Render rays by compositing samples around the depth that the keyframes give.

    Args:
        band: truncation distance of the newest keyframe as a share of the depth; its camera is ``focus[0, :3]``.
        depth_share: weight of the given depth in the result; the mean over the samples has the remaining weight.
        origin: position of the view in the map, (3,).
        directions: unit vectors of the rays in the map, (P, 3).
        depth: metres along each ray, 0 where it hits nothing, (P,); updated in place.
        colour: RGB on mid-grey, as in training, 0 to 1, (P, 3); written where the ray hits a surface.
    """
    x = np.zeros((w1.shape[1], BLOCK), np.float32)
    h = np.zeros((w1.shape[0], BLOCK), np.float32)
    y = np.zeros((4, BLOCK), np.float32)
    entries, corner_weights = np.empty((1, 8, BLOCK), np.uint32), np.empty((1, 8, BLOCK), np.float32)
    samples = np.zeros((BLOCK, 3), np.float32)
    offset, span = np.empty((_RAYS, SAMPLES), np.float32), np.empty((_RAYS, SAMPLES), np.float32)
    share = np.empty(_RAYS, np.float32)
    w, left = np.empty(SAMPLES, np.float32), np.empty(SAMPLES, np.float32)
    pixels = np.empty(_RAYS, np.int64)
    newest = focus[0, :3]
    place, count = 0, depth.shape[0]
    while place < count:
        filled = 0
        while place < count and filled < _RAYS:
            if depth[place] > 0:
                pixels[filled] = place
                filled += 1
            place += 1
        for r in range(filled):
            share[r] = _guided_samples(
                origin, directions[pixels[r]], depth[pixels[r]], newest, band, samples, r * SAMPLES, offset[r], span[r]
            )  # fmt: skip
        encode_block(
            table, cells_per_m, lattice_origin, focus, samples, 0, filled * SAMPLES, entries, corner_weights, x
        )
        layer_block(w1, b1, x, h)
        relu_block(h)
        layer_block(w2, b2, h, y)
        for r in range(filled):
            ray_weights(y[3], r * SAMPLES, span[r], w, left)
            mean = _composited(y, r * SAMPLES, w, offset[r], colour[pixels[r]])
            depth[pixels[r]] *= np.float32(1) + (np.float32(1) - depth_share) * share[r] * mean
