"""Agreement between keyframes: pixels that show moved objects, and factors that bring colours to one exposure.

1. ``moved``: each keyframe votes on the surfaces of the others: seen, looked through, or unknown. The majority counts.
2. ``exposure_gains``: robust ratio of the colours of surfaces that two keyframes have both seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import equirect_directions
from instant_ic.vspace.nerf.field import Floats
from instant_ic.vspace.prior import ROOM, PanoramaPrior


@dataclass(frozen=True)
class AgreementConfig:
    """Tuning of the comparison between keyframes.

    Attributes:
        same_surface: largest relative difference of two depths of one surface.
        same_colour: largest difference, in grey levels, between two images of an unchanged surface.
        vote_rows: rows of the grid of pixels on which the keyframes vote.
        fit_rows: rows of the grid of pixels to which an exposure is fitted.
        min_samples: smallest number of pixels to which an exposure is fitted.
        max_gain: largest factor of an exposure; its inverse is the smallest.
        min_log_gain: logarithm of the smallest factor that counts as different from 1.
        max_log_spread: largest width of the interval that holds half of the logarithmic ratios; a wider interval means
            that there is no common factor.
    """

    same_surface: float = 0.06
    same_colour: float = 30.0
    vote_rows: int = 256
    fit_rows: int = 64
    min_samples: int = 200
    max_gain: float = 2.5
    min_log_gain: float = 0.03
    max_log_spread: float = 0.35


CONFIG = AgreementConfig()


def moved(priors: Sequence[PanoramaPrior]) -> list[NDArray[np.bool_]]:
    """Mark the pixels of keyframes that show moved or moving objects, (h, w) each.

    Each keyframe that knows the depth towards a pixel's surface votes: it has seen the surface, or looked through it.
    The majority counts, and the newest keyframe decides a tie. A pixel of the newest keyframe stays if another keyframe
    shows the same colour there, because then the object is still there and only the depths disagree. Single pixels
    stay too.

    Args:
        priors: keyframes of one size, newest first.
    """
    from instant_ic.vspace.agreement_kernels import outvoted

    height, width = priors[0].inverse_depth.shape
    step = max(1, height // CONFIG.vote_rows)
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
    """Mark the pixels of a keyframe (h, w) whose surfaces no other keyframe shows in the same colour."""
    left = mask.copy()
    directions = equirect_directions(mask.shape[1], mask.shape[0])[mask]
    own, pose = prior.colours(directions), prior.map_from_camera.astype(np.float32)
    points = np.einsum("ij,kj->ik", directions / prior.inverse_depth[mask][:, None], pose[:3, :3]) + pose[:3, 3]
    for other in others:
        left[mask] &= np.abs(other.colours(other.in_camera(points)) - own).max(axis=1) > CONFIG.same_colour
    return left


def _opened(mask: NDArray[np.bool_], step: int) -> NDArray[np.bool_]:
    """Remove regions thinner than three cells of ``step`` pixels; dilate others by two, because edges are soft."""
    if not mask.any():
        return mask
    for grow, times in ((False, step), (True, 3 * step)):
        for _ in range(times):
            for axis in (0, 1):  # wraps columns; wrapping the rows too affects only a few pixels at the poles
                before, after = np.roll(mask, 1, axis), np.roll(mask, -1, axis)
                mask = mask | before | after if grow else mask & before & after
    return mask


def disagreement(first: PanoramaPrior, second: PanoramaPrior) -> float:
    """Return the largest relative difference of two keyframes' depths that still belong to one surface."""
    return max(0.15, 3 * math.hypot(first.relative_sigma, second.relative_sigma))


def exposure_gains(priors: Sequence[PanoramaPrior]) -> Floats:
    """Return the factors that bring each keyframe's colours to those of the newest (the first), (K, 3).

    A keyframe that shares too few surfaces with the newest is fitted to a keyframe between them.
    """
    gains = [np.ones(3, np.float32)]
    for number, older in enumerate(priors[1:], 1):
        fits = (
            found * gain
            for newer, gain in zip(priors[:number], gains, strict=True)
            if (found := exposure_gain(newer, older)) is not None
        )
        gains.append(
            np.clip(next(fits, np.ones(3, np.float32)), 1 / CONFIG.max_gain, CONFIG.max_gain).astype(np.float32)
        )
    return np.stack(gains)


def exposure_gain(newest: PanoramaPrior, older: PanoramaPrior) -> Floats | None:
    """Fit factors (3,) that bring an older keyframe's colours to the newest's on surfaces that both have seen.

    A factor is the middle of the shortest interval that holds half of a channel's ratios (the shorth). A change of less
    than half of the surfaces, such as a lamp or a shadow, does not affect it. If no factor differs from 1 by more than
    its interval's width, the evidence is weak, and all factors are 1.

    Returns:
        The factors; None if the keyframes share too few surfaces, or if the ratios have no common factor.
    """
    height, width = older.inverse_depth.shape
    step = max(1, height // CONFIG.fit_rows)
    known = ((older.known == 1) & (older.content == ROOM))[::step, ::step]
    depth = 1 / older.inverse_depth[::step, ::step][known]
    directions = equirect_directions(width, height)[::step, ::step][known]
    # einsum instead of matmul, because BLAS would start threads that wait for each other longer than they compute.
    points = depth[:, None] * np.einsum("ij,kj->ik", directions, older.map_from_camera[:3, :3].astype(np.float32))
    points += older.map_from_camera[:3, 3].astype(np.float32)
    local = newest.in_camera(points)
    same = newest.sees(local, np.linalg.norm(local, axis=1), CONFIG.same_surface)
    theirs, ours = older.colours(directions[same]), newest.colours(local[same])
    usable = np.all((theirs > 12) & (theirs < 243) & (ours > 12) & (ours < 243), axis=1)
    if np.count_nonzero(usable) < CONFIG.min_samples:
        return None
    ratios = np.sort(np.log(ours[usable] / theirs[usable]), axis=0)
    half = len(ratios) // 2
    widths = ratios[half:] - ratios[: len(ratios) - half]
    first = widths.argmin(axis=0)
    if widths.min(axis=0).max() > CONFIG.max_log_spread:
        return None
    ends = np.take_along_axis(ratios, np.stack([first, first + half]), axis=0)
    middle, width = ends.mean(axis=0), np.maximum(widths.min(axis=0), CONFIG.min_log_gain)
    if not np.any(np.abs(middle) > width):
        return np.ones(3, np.float32)
    return np.exp(middle).astype(np.float32)
