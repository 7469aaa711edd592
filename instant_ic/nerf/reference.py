"""Plain torch versions of the kernels: what the tests hold the fast ones against, and what runs on CUDA.

Differentiable: ``encode``, ``query`` and ``loss`` in table and network (not in the points). Nothing else is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

_P1 = 2654435761
_P2 = 805459861
NOT_SEEN = 1e9
FIRST_STEP = 0.7


@dataclass
class TorchField:
    """Parameters and lattice as tensors; shapes as in ``field.FieldParameters``, ``field.Lattice``, ``field.Scene``."""

    table: Tensor
    w1: Tensor
    b1: Tensor
    w2: Tensor
    b2: Tensor
    cells_per_m: Tensor
    origin: Tensor
    focus: Tensor

    def parameters(self) -> list[Tensor]:
        return [self.table, self.w1, self.b1, self.w2, self.b2]


@dataclass
class TorchPrior:
    """A ``prior.PanoramaPrior`` as tensors; ``rgb`` float32 in 0..255, ``known`` and ``torn`` bool."""

    rgb: Tensor
    inverse_depth: Tensor
    known: Tensor
    torn: Tensor
    map_from_camera: Tensor
    camera_from_map: Tensor
    band: float


@dataclass
class TorchGrid:
    """An ``occupancy.Occupancy`` as tensors."""

    distance: Tensor
    origin: Tensor
    cell_m: float


def encode(table: Tensor, cells_per_m: Tensor, origin: Tensor, focus: Tensor, points: Tensor) -> Tensor:
    """Trilinear hash-grid features.

    Args:
        table: (levels, size, features); size is a power of two.
        cells_per_m: (levels,).
        origin: (3,).
        focus: place of the keyframe's camera and radians of a picture's pixel, (4,): levels whose cells are narrower
            than a pixel count less, from half a pixel on not at all.
        points: (N, 3).

    Returns:
        (N, levels · features).
    """
    levels, size, _ = table.shape
    pixel = (points - focus[:3]).norm(dim=1) * focus[3]
    features = []
    for level in range(levels):
        place = (points - origin) * cells_per_m[level]
        low = place.floor()
        share = place - low
        cell = low.long()
        total = torch.zeros(points.shape[0], table.shape[2], device=table.device, dtype=table.dtype)
        for corner in range(8):
            offset = [(corner >> axis) & 1 for axis in range(3)]
            weight = torch.ones_like(share[:, 0])
            for axis in range(3):
                weight = weight * (share[:, axis] if offset[axis] else 1 - share[:, axis])
            x, y, z = (cell[:, axis] + offset[axis] for axis in range(3))
            index = (x ^ (y * _P1) ^ (z * _P2)) & (size - 1)
            total = total + weight[:, None] * table[level][index]
        features.append(total * (2 - pixel * cells_per_m[level]).clamp(0, 1)[:, None])
    return torch.cat(features, dim=1)


def query(field: TorchField, points: Tensor) -> Tensor:
    """Colour minus 0.5 and signed distance, (N, 4)."""
    features = encode(field.table, field.cells_per_m, field.origin, field.focus, points)
    hidden = torch.relu(features @ field.w1.T + field.b1)
    return hidden @ field.w2.T + field.b2


def loss(output: Tensor, target: Tensor, colour_weight: Tensor, distance_weight: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted squared colour error and weighted squared distance error; training minimises their sum."""
    colour = (colour_weight[:, None] * (output[:, :3] - target[:, :3]) ** 2).sum()
    distance = (distance_weight * (output[:, 3] - target[:, 3]) ** 2).sum()
    return colour, distance


def adam_touched(
    value: Tensor,
    grad: Tensor,
    m: Tensor,
    v: Tensor,
    step_size: float | Tensor,
    beta1: float,
    beta2: float,
    epsilon: float,
) -> None:
    """One Adam step in place on the entries (last axis) with any gradient; the others keep value and moments.

    ``step_size``: one for all, or a tensor that broadcasts to ``value``.
    """
    touched = (grad != 0).any(dim=-1, keepdim=True)
    m.copy_(torch.where(touched, beta1 * m + (1 - beta1) * grad, m))
    v.copy_(torch.where(touched, beta2 * v + (1 - beta2) * grad * grad, v))
    value.sub_(torch.where(touched, step_size * m / (v.sqrt() + epsilon), torch.zeros_like(m)))


def _corners(u: Tensor, v: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    v = v.clamp(0, height - 1)
    u0, v0 = u.floor(), v.floor()
    left = u0.long() % width
    return (left, (left + 1) % width, v0.long(), (v0.long() + 1).clamp(max=height - 1), u - u0, v - v0)


def _bilinear(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    left, right, top, bottom, fu, fv = _corners(u, v, image.shape[1], image.shape[0])
    if image.ndim == 3:
        fu, fv = fu[:, None], fv[:, None]
    upper = image[top, left] * (1 - fu) + image[top, right] * fu
    lower = image[bottom, left] * (1 - fu) + image[bottom, right] * fu
    return upper * (1 - fv) + lower * fv


def prior_inverse_depth(prior: TorchPrior, u: Tensor, v: Tensor) -> Tensor:
    """Inverse depth at index coordinates (N,): bilinear on a surface, nearest at an edge."""
    inverse = prior.inverse_depth
    left, right, top, bottom, fu, fv = _corners(u, v, inverse.shape[1], inverse.shape[0])
    nearest = inverse[torch.where(fv >= 0.5, bottom, top), torch.where(fu >= 0.5, right, left)]
    return torch.where(prior.torn[top, left], nearest, _bilinear(inverse, u, v))


def sample_rays(uniform: Tensor, columns: int, rows: int, prior: TorchPrior) -> tuple[Tensor, Tensor]:
    """Points (2 N, 3) and targets (2 N, 4) of one ray in each stratum; see ``march.sample_rays``."""
    height, width = prior.rgb.shape[:2]
    h, w = prior.inverse_depth.shape
    n = torch.arange(columns * rows, device=uniform.device)
    tile, inside = n // 64, n % 64
    tiles = columns // 8
    column, row = (tile % tiles) * 8 + inside % 8, (tile // tiles) * 8 + inside // 8
    turn = (column + uniform[:, 0]) / columns
    z = 1 - 2 * (row + uniform[:, 1]) / rows
    azimuth = math.pi * (1 - 2 * turn)
    fall = 0.5 - torch.asin(z) / math.pi
    colour = _bilinear(prior.rgb, turn * width - 0.5, fall * height - 0.5) / 255 - 0.5
    depth = 1 / prior_inverse_depth(prior, turn * w - 0.5, fall * h - 0.5)
    offset = 2 * uniform[:, 2] - 1
    flat = (1 - z * z).clamp(min=0).sqrt()
    direction = torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), z], dim=1) @ prior.map_from_camera[:3, :3].T
    camera = prior.map_from_camera[:3, 3]
    surface = camera + depth[:, None] * direction
    near = camera + (depth * (1 + prior.band * offset))[:, None] * direction
    zero = torch.zeros_like(offset)[:, None]
    surface_target = torch.cat([colour, zero], dim=1)
    near_target = torch.cat([colour, -offset[:, None]], dim=1)
    points = torch.stack([surface.view(-1, 64, 3), near.view(-1, 64, 3)], dim=1).reshape(-1, 3)
    target = torch.stack([surface_target.view(-1, 64, 4), near_target.view(-1, 64, 4)], dim=1).reshape(-1, 4)
    return points, target


def prior_agrees(prior: TorchPrior, points: Tensor) -> Tensor:
    """0, 1 or 2 for points (N, 3) of the camera frame; see ``march.prior_agrees``."""
    inverse = prior.inverse_depth
    height, width = inverse.shape
    x, y, z = points.unbind(1)
    flat = torch.hypot(x, y)
    distance = torch.hypot(flat, z)
    u = (math.pi - torch.atan2(y, x)) * (width / (2 * math.pi)) - 0.5
    v = (math.pi / 2 - torch.atan2(z, flat)) * (height / math.pi) - 0.5
    left, right, top, bottom, fu, fv = _corners(u, v, width, height)
    seen = 1 + prior.known[torch.where(fv >= 0.5, bottom, top), torch.where(fu >= 0.5, right, left)].long()
    ratios = torch.stack([inverse[r, c] for r in (top, bottom) for c in (left, right)]) * distance
    low, high = 1 - prior.band, 1 + prior.band
    any_near = ((ratios > low) & (ratios < high)).any(dim=0)
    between = (ratios.amin(dim=0) < high) & (ratios.amax(dim=0) > low)
    return torch.where(torch.where(prior.torn[top, left], any_near, between), seen, torch.zeros_like(seen))


def prior_distance(prior: TorchPrior, points: Tensor) -> Tensor:
    """Signed distance of points (N, 3) of the camera frame to the prior's surface, in bands; as in ``march``."""
    height, width = prior.inverse_depth.shape
    x, y, z = points.unbind(1)
    u = (math.pi - torch.atan2(y, x)) * (width / (2 * math.pi)) - 0.5
    v = (math.pi / 2 - torch.atan2(z, torch.hypot(x, y))) * (height / math.pi) - 0.5
    return (1 - points.norm(dim=1) * prior_inverse_depth(prior, u, v)) / prior.band


@torch.no_grad()
def mix_panorama(
    prior: TorchPrior,
    origin: Tensor,
    directions: Tensor,
    depth: Tensor,
    confidence: Tensor,
    share: float,
    colour: Tensor,
) -> None:
    """Mixes the panorama's colour into ``colour`` (P, 3) in place; see ``march.mix_panorama``."""
    at = torch.nonzero((depth > 0) & (confidence > 0))[:, 0]
    points = origin + depth[at, None] * directions[at]
    x, y, z = (points @ prior.camera_from_map[:3, :3].T + prior.camera_from_map[:3, 3]).unbind(1)
    height, width = prior.rgb.shape[:2]
    u = (math.pi - torch.atan2(y, x)) * (width / (2 * math.pi)) - 0.5
    v = (math.pi / 2 - torch.atan2(z, torch.hypot(x, y))) * (height / math.pi) - 0.5
    colour[at] += share * (_bilinear(prior.rgb, u, v) / 255 - colour[at])


@torch.no_grad()
def trace(
    field: TorchField, grid: TorchGrid, prior: TorchPrior, share: float, origin: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor]:
    """Depth along each ray, 0 where it meets nothing, and confidence, both (N,); see ``march.trace``."""
    count = directions.shape[0]
    depth = torch.zeros(count, device=directions.device)
    confidence = torch.zeros(count, device=directions.device)
    t, leave = _grid_span(origin, directions, grid)
    active = torch.nonzero(t < leave)[:, 0]
    last_t = torch.zeros_like(t)
    last_s = torch.full_like(t, NOT_SEEN)
    spare = torch.zeros_like(t)
    spare_s = torch.full_like(t, NOT_SEEN)
    camera = prior.map_from_camera[:3, 3]
    while active.numel():
        t[active] = _next_occupied(origin, directions[active], t[active], leave[active], grid)
        active = active[t[active] >= 0]
        here = t[active]
        points = origin + here[:, None] * directions[active]
        local = points @ prior.camera_from_map[:3, :3].T + prior.camera_from_map[:3, 3]
        value = share * prior_distance(prior, local)
        if share < 1:
            value = value + (1 - share) * query(field, points)[:, 3]
        gap = here - last_t[active] > 3 * grid.cell_m
        before = torch.where(gap, torch.full_like(value, NOT_SEEN), last_s[active])
        crossing = last_t[active] + (here - last_t[active]) * before / (before - value)
        crossed = (before != NOT_SEEN) & ((before > 0) != (value > 0))
        hit = torch.where(crossed, crossing, here)
        places = origin + hit[:, None] * directions[active]
        places = places @ prior.camera_from_map[:3, :3].T + prior.camera_from_map[:3, 3]
        front = (value <= 0) & (before > 0)
        agrees = prior_agrees(prior, places)
        closer = (agrees == 2) & (value > 0) & ~crossed & (value < spare_s[active])
        spare[active[closer]], spare_s[active[closer]] = hit[closer], value[closer]
        met = ((value <= 0) | crossed) & (agrees > 0)
        depth[active[met]] = hit[met]
        confidence[active[met]] = torch.where(front, 0.5 * agrees, torch.zeros_like(value))[met]
        last_t[active], last_s[active] = here, value
        reach = 0.9 * value.abs() * prior.band * (points - camera).norm(dim=1)
        t[active] = here + reach.clamp(0.5 * grid.cell_m, 2 * grid.cell_m)
        active = active[~met]
    without = (depth == 0) & (spare > 0)
    depth[without] = spare[without]
    confidence[without] = 1
    return depth, confidence


def _grid_span(origin: Tensor, directions: Tensor, grid: TorchGrid) -> tuple[Tensor, Tensor]:
    size = torch.tensor(grid.distance.shape, device=directions.device) * grid.cell_m
    safe = torch.where(directions.abs() < 1e-9, torch.full_like(directions, 1e-9), directions)
    a, b = (grid.origin - origin) / safe, (grid.origin + size - origin) / safe
    enter = torch.minimum(a, b).amax(dim=1).clamp(min=0)
    return enter, torch.maximum(a, b).amin(dim=1)


def _next_occupied(origin: Tensor, directions: Tensor, t: Tensor, leave: Tensor, grid: TorchGrid) -> Tensor:
    """First place from ``t`` on in an occupied cell, −1 past ``leave``, (N,)."""
    t = t.clone()
    shape = grid.distance.shape
    limit = torch.tensor(shape, device=t.device) - 1
    moving = torch.arange(t.numel(), device=t.device)
    while moving.numel():
        outside = t[moving] >= leave[moving]
        t[moving[outside]] = -1
        moving = moving[~outside]
        place = (origin + t[moving, None] * directions[moving] - grid.origin) / grid.cell_m
        cell = torch.minimum(place.floor().long().clamp(min=0), limit)
        distance = grid.distance[cell[:, 0], cell[:, 1], cell[:, 2]].float()
        step = grid.cell_m * (0.577 * (distance - 1)).clamp(min=FIRST_STEP)
        t[moving] = torch.where(distance > 0, t[moving] + step, t[moving])
        moving = moving[distance > 0]
    return t
