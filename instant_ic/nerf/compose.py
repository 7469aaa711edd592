"""One picture of several keyframes: what each draws of a view, put together.

Colours of surfaces that several keyframes have seen are blended as in unstructured lumigraph rendering (Buehler et al.,
2001): by the angle between the view's ray and the keyframe's, and by the keyframe's distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import equirect_directions, equirect_pixels

from .field import Floats, Rays
from .prior import PanoramaPrior

SAME_SURFACE = 0.06
"""Depths within this share of each other are one surface."""
SAME_PLACE = 0.15
"""Surfaces within this share of the nearest are one that the keyframes' depths disagree about: the best seen counts."""
_SHARPNESS = 6.0
_LEAST_PENALTY = 0.05
_ASIDE_RAD = 0.02  # less is the keyframe's own view, whose edges are right
_EDGE = 0.25  # less confidence at an edge
_STEP_ROWS = 128  # of the pixels that an exposure is fitted on
_MIN_SAMPLES = 200
_MAX_GAIN = 2.5


@dataclass(frozen=True)
class Layer:
    """A view as one keyframe has it: ``colour`` (P, 3) in 0..1, ``depth`` (P,), ``confidence`` (P,), as a device draws;
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
    most alike (``SAME_PLACE``); one at an edge of its keyframe's depth, where colours of two
    surfaces mix, only where no keyframe has a plain one. What a newer keyframe has looked through is left out of the
    older: it has moved away since.
    """
    depth = np.stack([layer.depth for layer in layers])
    confidence = np.stack([layer.confidence for layer in layers])
    rank = confidence.copy()
    for number, layer in enumerate(layers):
        at = np.flatnonzero(confidence[number])
        points = rays.origin + depth[number, at, None] * rays.directions[at]
        # From the keyframe's own place its edges are as it saw them.
        aside = _angle(layer.prior, points, rays.directions[at]) > _ASIDE_RAD
        rank[number, at] -= _EDGE * (aside & _at_edge(layer.prior, points))
        for newer in layers[:number]:
            rank[number, at[looked_through(newer.prior, points, layer.prior)]] = 0
    best = rank.max(axis=0)
    candidate = (rank > 0) & (rank == best)
    met = best > 0
    nearest = np.where(candidate, depth, np.inf).min(axis=0)
    candidate &= depth <= nearest * np.float32(1 + SAME_PLACE)
    points = rays.origin + nearest[met, None] * rays.directions[met]
    penalty = np.full(depth.shape, np.inf, np.float32)
    for number, layer in enumerate(layers):
        angle = _angle(layer.prior, points, rays.directions[met])
        away = np.linalg.norm(points - layer.prior.map_from_camera[:3, 3].astype(np.float32), axis=1)
        penalty[number, met] = _LEAST_PENALTY + angle + np.maximum(0, away / nearest[met] - 1)
    penalty[~candidate] = np.inf
    surface = np.take_along_axis(depth, penalty.argmin(axis=0)[None], axis=0)[0]
    candidate &= np.abs(depth - surface) <= surface * np.float32(SAME_SURFACE)
    weight = np.where(candidate, penalty, np.inf) ** -_SHARPNESS
    weight[0, ~met] = 1  # nobody has seen it: as the newest has it
    weight /= weight.sum(axis=0)
    colour = sum(w[:, None] * layer.gain * layer.colour for w, layer in zip(weight, layers, strict=True))
    shown = np.where(candidate, confidence, 0).max(axis=0)
    return np.asarray(colour, np.float32), (weight * depth).sum(axis=0), shown


def _angle(prior: PanoramaPrior, points: Floats, directions: Floats) -> Floats:
    """Radians between a view's rays (N, 3) to points (N, 3) and the keyframe's."""
    seen = points - prior.map_from_camera[:3, 3].astype(np.float32)
    cosine = np.einsum("ij,ij->i", seen, directions) / np.maximum(np.linalg.norm(seen, axis=1), 1e-6)
    return np.asarray(np.arccos(np.clip(cosine, -1, 1)), np.float32)


def looked_through(prior: PanoramaPrior, points: Floats, theirs: PanoramaPrior) -> NDArray[np.bool_]:
    """Whether a keyframe has seen farther than points (N, 3) of the map frame in their directions: nothing is there.

    ``theirs``: the keyframe that the points are of; the depth errors of both leave room.
    """
    row, column, distance = _seen_from(prior, points)
    height, width = prior.inverse_depth.shape
    least = np.full(len(points), np.inf, np.float32)
    for v in (row, np.minimum(row + 1, height - 1)):  # at an edge the nearest of the neighbours counts
        for u in (column % width, (column + 1) % width):
            least = np.minimum(least, np.where(prior.known[v, u] == 1, 1 / prior.inverse_depth[v, u], 0))
    room = max(0.15, 3 * math.hypot(_sigma(prior), _sigma(theirs)))
    return distance * np.float32(1 + room) < least


def _at_edge(prior: PanoramaPrior, points: Floats) -> NDArray[np.bool_]:
    row, column, _ = _seen_from(prior, points)
    return prior.torn[row, column % prior.torn.shape[1]] > 0


def exposure_gain(newest: PanoramaPrior, older: PanoramaPrior) -> Floats:
    """Factors (3,) that bring an older keyframe's colours to the newest's: medians over places that both have seen.

    1 where too few places are seen by both.
    """
    height, width = older.inverse_depth.shape
    step = max(1, height // _STEP_ROWS)
    known = older.known[::step, ::step] == 1
    depth = 1 / older.inverse_depth[::step, ::step][known]
    directions = equirect_directions(width, height)[::step, ::step][known]
    points = depth[:, None] * (directions @ older.map_from_camera[:3, :3].T.astype(np.float32))
    points += older.map_from_camera[:3, 3].astype(np.float32)
    row, column, distance = _seen_from(newest, points)
    column %= newest.inverse_depth.shape[1]
    same = np.abs(newest.inverse_depth[row, column] * distance - 1) < SAME_SURFACE
    same &= (newest.known[row, column] == 1) & (newest.torn[row, column] == 0)
    theirs = _colours(older, directions)[same]
    turn = newest.map_from_camera[:3, :3].astype(np.float32)
    ours = _colours(newest, (points - newest.map_from_camera[:3, 3].astype(np.float32)) @ turn)[same]
    usable = np.all((theirs > 12) & (theirs < 243) & (ours > 12) & (ours < 243), axis=1)
    if np.count_nonzero(usable) < _MIN_SAMPLES:
        return np.ones(3, np.float32)
    gain = np.median(ours[usable] / theirs[usable], axis=0)
    return np.clip(gain, 1 / _MAX_GAIN, _MAX_GAIN).astype(np.float32)


def _seen_from(prior: PanoramaPrior, points: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Upper left pixels (row, column; the column may be −1) of points of the map frame, and their distances."""
    local = points - prior.map_from_camera[:3, 3].astype(np.float32)
    local = local @ prior.map_from_camera[:3, :3].astype(np.float32)
    height, width = prior.inverse_depth.shape
    u, v = equirect_pixels(local, width, height)
    row = np.clip(np.floor(v), 0, height - 1).astype(np.intp)
    return row, np.floor(u).astype(np.intp), np.linalg.norm(local, axis=1).astype(np.float32)


def _colours(prior: PanoramaPrior, directions: Floats) -> Floats:
    """Nearest pixels of a panorama, (N, 3) in 0..255."""
    height, width = prior.rgb.shape[:2]
    u, v = equirect_pixels(directions, width, height)
    row = np.clip(np.rint(v), 0, height - 1).astype(np.intp)
    return prior.rgb[row, np.rint(u).astype(np.intp) % width].astype(np.float32)


def _sigma(prior: PanoramaPrior) -> float:
    return float(np.median(prior.relative_sigma))
