"""One image of several keyframes in plain torch, on a GPU: the same as ``compose.compose``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from instant_ic.vspace.compose import (
    ASIDE_RAD,
    EDGE,
    LEAST_PENALTY,
    NEARER,
    OTHER_SIDE_RAD,
    SAME_PLACE,
    SAME_SURFACE,
    SHARPNESS,
)

_FAR = 1e9


@dataclass(frozen=True)
class TorchLayer:
    """A ``compose.Layer`` on the device, and what its keyframe knows.

    Attributes:
        colour, depth, confidence: of the view, (P, 3), (P,), (P,); gain: (3,).
        inverse, depth_edge, beside, sure: of the ``PanoramaPrior``, (h, w); ``beside``: near an edge of its depth;
            ``sure``: where the depth is known.
        camera_from_view: (4, 4).
        camera: the keyframe's place in the view's frame, (3,).
    """

    colour: Tensor
    depth: Tensor
    confidence: Tensor
    gain: Tensor
    inverse: Tensor
    depth_edge: Tensor
    beside: Tensor
    sure: Tensor
    camera_from_view: Tensor
    camera: Tensor


def compose(
    layers: Sequence[TorchLayer], room: Sequence[Sequence[float]], directions: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Colours (P, 3), depth (P,) and confidence (P,) of the layers together, newest first.

    Args:
        layers: newest first.
        room: of each layer against each, as ``compose.disagreement`` says.
        directions: of the view's pixels in its own frame, (P, 3).
    """
    ranks = [_rank(k, layers, room, directions) for k in range(len(layers))]
    best = torch.stack(ranks).amax(dim=0)
    first = [rank == best for rank in ranks]
    far = torch.full_like(best, _FAR)
    nearest = far
    for layer, mine in zip(layers, first, strict=True):
        nearest = torch.where(mine, torch.minimum(nearest, layer.depth), nearest)
    penalties, least, surface = [], far, nearest
    for layer, mine in zip(layers, first, strict=True):
        away = points(layer.camera_from_view, directions, nearest).norm(dim=1)
        penalty = LEAST_PENALTY + _angle(layer, directions, nearest, away) + (away / nearest - 1).clamp(min=0)
        penalty = torch.where(mine & (layer.depth <= nearest * (1 + SAME_PLACE)), penalty, far)
        surface = torch.where(penalty < least, layer.depth, surface)
        least = torch.minimum(least, penalty)
        penalties.append(penalty)
    weights = [
        torch.where((layer.depth - surface).abs() <= surface * SAME_SURFACE, (least / penalty) ** SHARPNESS, 0.0)
        * (penalty < 0.1 * _FAR)
        for layer, penalty in zip(layers, penalties, strict=True)
    ]
    total = torch.stack(weights).sum(dim=0)
    colour, depth, confidence = torch.zeros_like(layers[0].colour), torch.zeros_like(best), torch.zeros_like(best)
    for layer, weight in zip(layers, weights, strict=True):
        share = weight / total
        colour += share[:, None] * layer.gain * layer.colour
        depth += share * layer.depth
        confidence = torch.where(weight > 0, torch.maximum(confidence, layer.confidence), confidence)
    seen, newest = best > 0, layers[0]  # what nobody has seen is as the newest has it
    return (
        torch.where(seen[:, None], colour, newest.colour * newest.gain),
        torch.where(seen, depth, newest.depth),
        torch.where(seen, confidence, 0.0),
    )


def points(camera_from_view: Tensor, directions: Tensor, depth: Tensor) -> Tensor:
    """Places along the view's rays in a camera's frame, (P, 3)."""
    # Not by matmul: a GPU may multiply with fewer bits.
    at = depth[:, None] * directions
    return (at[:, None] * camera_from_view[:3, :3]).sum(dim=2) + camera_from_view[:3, 3]


def panorama_places(local: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Index coordinates (u, v) in a panorama (height, width) of places (P, 3) of its camera's frame."""
    x, y, z = local.unbind(1)
    u = (math.pi - torch.atan2(y, x)) * (size[1] / (2 * math.pi)) - 0.5
    return u, (math.pi / 2 - torch.atan2(z, torch.hypot(x, y))) * (size[0] / math.pi) - 0.5


def _rank(k: int, layers: Sequence[TorchLayer], room: Sequence[Sequence[float]], directions: Tensor) -> Tensor:
    """Confidence of layer ``k``, less at an edge of its depth; of an older one 0 where a newer one has looked through
    it and, unless it sees the place again, beside its own edges and where a newer one has seen it and renders it
    elsewhere.
    """
    own = layers[k]
    local = points(own.camera_from_view, directions, own.depth)
    row, column = _upper_left(local, own.inverse)
    aside = _angle(own, directions, own.depth, local.norm(dim=1)) > ASIDE_RAD
    rank = own.confidence - torch.where(aside & own.depth_edge[row, column] & (own.confidence > 0), EDGE, 0.0)
    if k == 0:
        return rank
    anew = _anew(own, layers[0], directions)
    rank = torch.where(anew, rank, torch.where(aside & own.beside[row, column], 0.0, own.confidence))
    for newer in range(k):
        one = layers[newer]
        through, seen = _opinion(one, own.depth, room[newer][k], directions)
        drawn = (one.confidence > 0) & ((one.depth - own.depth).abs() <= SAME_PLACE * own.depth)
        rank = torch.where(through | (seen & ~drawn & ~anew), 0.0, rank)
    return rank


def _angle(layer: TorchLayer, directions: Tensor, t: Tensor, away: Tensor) -> Tensor:
    """Radians at places ``t`` along the rays between the ways to the view and to the keyframe, ``away`` from it."""
    toward = t - (directions * layer.camera).sum(dim=1)
    return (toward / away.clamp(min=1e-6)).clamp(-1, 1).acos()


def _anew(layer: TorchLayer, newest: TorchLayer, directions: Tensor) -> Tensor:
    """Whether a keyframe sees what it renders from nearer than the newest does, or from another side, (P,)."""
    ends = layer.depth[:, None] * directions
    own, other = ends - layer.camera, ends - newest.camera
    near, far = own.norm(dim=1), other.norm(dim=1)
    return (near < NEARER * far) | ((own * other).sum(dim=1) < math.cos(OTHER_SIDE_RAD) * near * far)


def _opinion(layer: TorchLayer, depth: Tensor, room: float, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Where a keyframe has looked through places along the rays, and where it has seen a surface there, (P,) each;
    ``compose_kernels.opinion`` is AGAINST, and FOR.
    """
    local = points(layer.camera_from_view, directions, depth)
    row, column = _upper_left(local, layer.inverse)
    height, width = layer.inverse.shape
    below, right = (row + 1).clamp(max=height - 1), (column + 1) % width
    corners = [(row, column), (row, right), (below, column), (below, right)]
    sure = torch.stack([layer.sure[at] for at in corners]).all(dim=0)
    ratios = torch.stack([layer.inverse[at] for at in corners]) * local.norm(dim=1)
    through = sure & (ratios.amax(dim=0) * (1 + room) < 1)
    return through, sure & ~through & (ratios.amin(dim=0) <= 1 + room)


def _upper_left(local: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
    height, width = image.shape
    u, v = panorama_places(local, (height, width))
    return v.floor().clamp(0, height - 1).long(), u.floor().long() % width
