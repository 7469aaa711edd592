"""Compose one view from several keyframes; find what has moved; bring them to one exposure.

Colours of surfaces that several keyframes have seen are blended as in unstructured lumigraph rendering (Buehler et al.,
2001): by the angle between the view's ray and the keyframe's, and by the keyframe's distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import equirect_directions
from instant_ic.vspace.nerf.field import Floats, Rays
from instant_ic.vspace.prior import ROOM, PanoramaPrior

SAME_SURFACE = 0.06
"""Depths within this share of each other belong to one surface."""
SAME_PLACE = 0.15
"""Surfaces within this share of the nearest are one surface with disagreeing depths: the one seen best counts."""
SHARPNESS = 6.0
LEAST_PENALTY = 0.05
ASIDE_RAD = 0.02
"""Closer views are the keyframe's own, whose edges are correct."""
EDGE = 0.25
"""Reduction of the confidence at an edge."""
NEARER = 0.9
"""An older keyframe at less than this share of the newest's distance from a surface shows it better,"""
OTHER_SIDE_RAD = 0.8
"""and one at more than this angle beside the newest shows another side of it."""
SAME_COLOUR = 30.0
"""Grey levels in which two keyframes' images of a place that stands still may differ."""
_VOTE_ROWS = 256  # of the pixels that are asked whether they have moved
_STEP_ROWS = 64  # of the pixels that an exposure is fitted on
_MIN_SAMPLES = 200
_MAX_GAIN = 2.5
_LEAST_GAIN = 0.03  # logarithm of a gain that differs from none
_MAX_SPREAD = 0.35  # of the logarithms of the ratios: more is no common factor


@dataclass(frozen=True)
class Layer:
    """One keyframe's view: ``colour`` (P, 3) in 0..1, ``depth`` (P,), ``confidence`` (P,), as a backend renders it;
    ``gain`` (3,) brings its colours to the newest keyframe's exposure.
    """

    prior: PanoramaPrior
    gain: Floats
    colour: Floats
    depth: Floats
    confidence: Floats


def compose(layers: Sequence[Layer], rays: Rays) -> tuple[Floats, Floats, Floats]:
    """Colours (P, 3), depth (P,) and confidence (P,) of the layers together, newest first.

    Of surfaces at different depths the nearest counts, of those that depths only disagree about the one that is seen
    most alike (``SAME_PLACE``); one at an edge of its keyframe's depth, where colours of two surfaces mix, only where
    no keyframe has a plain one. An older keyframe shows nothing that a newer one has looked through: it has moved, or
    is an error of its depth. Nor does it show what is beside its own edges, where its depth may be of either side, or
    what a newer one has seen itself and renders elsewhere: that would stand there twice. These two do not hold for what
    it sees from nearer than the newest (``NEARER``) or from another side (``OTHER_SIDE_RAD``): its edges count there as
    the newest's do. What nobody has seen is as the newest has it.
    """
    from instant_ic.vspace.compose_kernels import blend

    poses = np.array([layer.prior.map_from_camera for layer in layers])
    room = np.array([[disagreement(a.prior, b.prior) for b in layers] for a in layers], np.float32)
    colour = np.empty_like(layers[0].colour)
    depth, confidence = np.empty_like(layers[0].depth), np.empty_like(layers[0].confidence)
    blend(
        *(np.stack([getattr(layer, key) for layer in layers]) for key in ("colour", "depth", "confidence", "gain")),
        *(np.stack([getattr(layer.prior, key) for layer in layers]) for key in ("depth_edge", "inverse_depth")),
        # Of the newest it is never asked.
        np.stack([layer.prior.beside_edge if older else layer.prior.depth_edge for older, layer in enumerate(layers)]),
        np.stack([layer.prior.known == 1 for layer in layers]), room, np.linalg.inv(poses).astype(np.float32),
        np.ascontiguousarray(poses[:, :3, 3], np.float32), rays.origin, rays.directions,
        *(np.float32(value) for value in (EDGE, ASIDE_RAD, NEARER, OTHER_SIDE_RAD)),
        *(np.float32(value) for value in (SAME_PLACE, SAME_SURFACE, LEAST_PENALTY, SHARPNESS)),
        colour, depth, confidence,
    )  # fmt: skip
    return colour, depth, confidence


def moved(priors: Sequence[PanoramaPrior]) -> list[NDArray[np.bool_]]:
    """Pixels of each keyframe (newest first, all of one size) that show moved or moving objects, (h, w) each.

    Each keyframe that knows says whether there is a surface at a pixel's place or whether it has looked through it; the
    majority counts, and where there is none the newest: of two keyframes the newer wins. What of the newest another's
    image shows in the same colour at that place still stands there, and only the depths disagree: it is left in, and
    so are single pixels.
    """
    from instant_ic.vspace.compose_kernels import outvoted

    height, width = priors[0].inverse_depth.shape
    step = max(1, height // _VOTE_ROWS)
    inverse = np.stack([prior.inverse_depth for prior in priors])
    sure = np.stack([(prior.known == 1) & (prior.content == ROOM) for prior in priors]).astype(np.uint8)
    poses = np.array([prior.map_from_camera for prior in priors])
    matrices = poses.astype(np.float32), np.linalg.inv(poses).astype(np.float32)
    found = []
    for own, prior in enumerate(priors):
        room = np.array([disagreement(prior, other) for other in priors], np.float32)
        out = np.zeros((height, width), np.uint8)
        outvoted(equirect_directions(width, height), inverse, sure, *matrices, room, own, step, out)
        gone = out > 0 if own else _looks_different(out > 0, prior, priors[1:])
        found.append(_opened(gone, step))
    return found


def _looks_different(
    mask: NDArray[np.bool_], prior: PanoramaPrior, others: Sequence[PanoramaPrior]
) -> NDArray[np.bool_]:
    """Those of a keyframe's pixels (h, w) whose places no other keyframe shows in the same colour."""
    left = mask.copy()
    directions = equirect_directions(mask.shape[1], mask.shape[0])[mask]
    own, pose = prior.colours(directions), prior.map_from_camera.astype(np.float32)
    points = np.einsum("ij,kj->ik", directions / prior.inverse_depth[mask][:, None], pose[:3, :3]) + pose[:3, 3]
    for other in others:
        left[mask] &= np.abs(other.colours(other.in_camera(points)) - own).max(axis=1) > SAME_COLOUR
    return left


def _opened(mask: NDArray[np.bool_], step: int) -> NDArray[np.bool_]:
    """Remove regions thinner than three cells of ``step`` pixels; dilate the others by two, as edges are soft."""
    if not mask.any():
        return mask
    for grow, times in ((False, step), (True, 3 * step)):
        for _ in range(times):
            for axis in (0, 1):  # columns wrap; so do the rows, where the poles' few pixels do not matter
                before, after = np.roll(mask, 1, axis), np.roll(mask, -1, axis)
                mask = mask | before | after if grow else mask & before & after
    return mask


def disagreement(first: PanoramaPrior, second: PanoramaPrior) -> float:
    """Share of a distance by which the depths of two keyframes may differ and still be of one surface."""
    return max(0.15, 3 * math.hypot(first.relative_sigma, second.relative_sigma))


def exposure_gains(priors: Sequence[PanoramaPrior]) -> Floats:
    """Factors that bring each keyframe's colours to the newest's (the first), (K, 3).

    A keyframe that has too little in common with the newest is fitted to those between them.
    """
    gains = [np.ones(3, np.float32)]
    for number, older in enumerate(priors[1:], 1):
        fits = (
            fit * gain
            for newer, gain in zip(priors[:number], gains, strict=True)
            if (fit := exposure_gain(newer, older)) is not None
        )
        gains.append(np.clip(next(fits, np.ones(3, np.float32)), 1 / _MAX_GAIN, _MAX_GAIN).astype(np.float32))
    return np.stack(gains)


def exposure_gain(newest: PanoramaPrior, older: PanoramaPrior) -> Floats | None:
    """Factors (3,) that bring an older keyframe's colours to the newest's, from places that both have seen.

    The middle of the shortest interval that holds half of the ratios, a colour (the shorth): what has changed between
    the two, such as a lamp or a shadow, does not move it as long as it is less than half. Where no factor differs from
    1 by more than the interval is wide, the evidence is weak, and all are 1.

    Returns:
        None where too few places are seen by both, or where their ratios have no common factor.
    """
    height, width = older.inverse_depth.shape
    step = max(1, height // _STEP_ROWS)
    known = ((older.known == 1) & (older.content == ROOM))[::step, ::step]
    depth = 1 / older.inverse_depth[::step, ::step][known]
    directions = equirect_directions(width, height)[::step, ::step][known]
    # Not by matmul: BLAS would start threads for it, which wait for each other longer than they compute.
    points = depth[:, None] * np.einsum("ij,kj->ik", directions, older.map_from_camera[:3, :3].astype(np.float32))
    points += older.map_from_camera[:3, 3].astype(np.float32)
    local = newest.in_camera(points)
    same = newest.sees(local, np.linalg.norm(local, axis=1), SAME_SURFACE)
    theirs, ours = older.colours(directions[same]), newest.colours(local[same])
    usable = np.all((theirs > 12) & (theirs < 243) & (ours > 12) & (ours < 243), axis=1)
    if np.count_nonzero(usable) < _MIN_SAMPLES:
        return None
    ratios = np.sort(np.log(ours[usable] / theirs[usable]), axis=0)
    half = len(ratios) // 2
    widths = ratios[half:] - ratios[: len(ratios) - half]
    first = widths.argmin(axis=0)
    if widths.min(axis=0).max() > _MAX_SPREAD:
        return None
    ends = np.take_along_axis(ratios, np.stack([first, first + half]), axis=0)
    middle, width = ends.mean(axis=0), np.maximum(widths.min(axis=0), _LEAST_GAIN)
    if not np.any(np.abs(middle) > width):
        return np.ones(3, np.float32)
    return np.exp(middle).astype(np.float32)
