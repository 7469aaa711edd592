"""The field in plain torch: the reference for the fast kernels, in the order of a training step and of a view.

A training step is ``sample_rays`` → ``query`` → ``loss`` → ``adam_touched`` (``train_step``). A view is ``trace`` →
``query`` → ``mix_panorama``. The fast kernels have the same names (numba: ``march.py``, ``kernels.py``; Triton:
``triton_kernels.py``). Tests compare them with these functions.

``encode``, ``query`` and ``loss`` are differentiable in the table and the network, but not in the points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from instant_ic.vspace.config import TrainConfig
from instant_ic.vspace.nerf.field import (
    BAND_COLOUR_WEIGHT,
    BETA1,
    BETA2,
    DISTANCE_WEIGHT,
    EPSILON,
    adam_step_size,
    ray_sources,
)

_P1 = 2654435761
_P2 = 805459861
NOT_SEEN = 1e9
FIRST_STEP = 0.7
LOOKED_THROUGH = 3.0


@dataclass
class TorchField:
    """Parameters of a field, its lattice and its keyframes' cameras, in the shapes of ``field``'s dataclasses."""

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
    """A ``prior.PanoramaPrior`` as tensors. ``known``, ``depth_edge`` and ``usable`` are bool.

    Attributes:
        rgb: colours, 0 to 255, float32.
        trust: weight of each pixel's depth in the loss, (h, w).
        gain: colour factors that bring the keyframe to the newest one's exposure, (3,).
    """

    rgb: Tensor
    inverse_depth: Tensor
    known: Tensor
    depth_edge: Tensor
    usable: Tensor
    trust: Tensor
    map_from_camera: Tensor
    camera_from_map: Tensor
    band: float
    gain: Tensor


@dataclass
class TorchGrid:
    """An ``occupancy.Occupancy`` as tensors."""

    distance: Tensor
    origin: Tensor
    cell_m: float


@dataclass
class TrainState:
    """State of training between steps.

    Attributes:
        moments: two moments of Adam for each parameter.
        level_rates: learning rate of each level relative to the coarsest, (levels, 1, 1).
        steps: number of steps so far.
    """

    moments: list[tuple[Tensor, Tensor]]
    level_rates: Tensor
    steps: int = 0


def train_step(
    field: TorchField,
    priors: list[TorchPrior],
    state: TrainState,
    config: TrainConfig,
    uniform: Tensor,
    rates: tuple[float, float],
    weights: tuple[Tensor, Tensor],
) -> tuple[float, float]:
    """Train a field with distance geometry for one step; update ``field`` and ``state`` in place.

    Args:
        field: parameters and lattice.
        priors: the keyframes, newest first.
        state: state of the optimiser.
        config: size of the batch and weights.
        uniform: random numbers in [0, 1), one row per ray, (N, 3).
        rates: learning rates of table and network.
        weights: weights of the samples' colours and distances in the loss, (2 N,) each (``field.sample_weights``).

    Returns:
        Mean squared colour error (colours 0 to 1) and mean squared distance error (in truncation distances).
    """
    state.steps += 1
    columns, rows = config.ray_columns, config.ray_rows
    sources = torch.from_numpy(ray_sources(len(priors), columns * rows // 64, state.steps)).to(uniform.device)
    points, target, weight = sample_rays(uniform, columns, rows, priors, sources)
    output = query(field, points)
    colour, distance = loss(output, target, weights[0] * weight[:, 0], weights[1] * weight[:, 1])
    adam_step(field, state, torch.autograd.grad(colour + distance, field.parameters()), rates)
    share = weight.mean(dim=0).clamp(min=1e-3)  # mean weight, for errors per counted sample
    colour = colour / share[0] / (1 + BAND_COLOUR_WEIGHT)
    return float(colour.detach()), float((distance / share[1] / DISTANCE_WEIGHT).detach())


@torch.no_grad()
def adam_step(field: TorchField, state: TrainState, grads: tuple[Tensor, ...], rates: tuple[float, float]) -> None:
    """Update table and network by one Adam step, in place."""
    for index, (value, grad) in enumerate(zip(field.parameters(), grads, strict=True)):
        step_size: float | Tensor = adam_step_size(rates[min(index, 1)], state.steps)
        if index == 0:
            step_size = step_size * state.level_rates
        # Rows of the network without a gradient keep value and moments here; the fast kernels update them too.
        adam_touched(value, grad, *state.moments[index], step_size, BETA1, BETA2, EPSILON)


def encode(table: Tensor, cells_per_m: Tensor, origin: Tensor, focus: Tensor, points: Tensor) -> Tensor:
    """Interpolate the hash grid's features trilinearly.

    A level counts less where its cells are narrower than a pixel of the keyframe that shows the point finest, and not
    at all below half a pixel.

    Args:
        table: features of all entries, (levels, size, features); size is a power of two.
        cells_per_m: cells per metre of each level, (levels,).
        origin: corner of a cell in the map, (3,).
        focus: position of each keyframe's camera in metres, and angle of a pixel of its panorama in radians, (K, 4).
        points: points in the map in metres, (N, 3).

    Returns:
        Features of all levels, (N, levels · features).
    """
    levels, size, _ = table.shape
    pixel = ((points[:, None] - focus[:, :3]).norm(dim=2) * focus[:, 3]).amin(dim=1)
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
    """Return colour minus 0.5 and signed distance of points (N, 3), (N, 4)."""
    features = encode(field.table, field.cells_per_m, field.origin, field.focus, points)
    hidden = torch.relu(features @ field.w1.T + field.b1)
    return hidden @ field.w2.T + field.b2


def loss(output: Tensor, target: Tensor, colour_weight: Tensor, distance_weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weighted squared errors of colour and distance; training minimises their sum."""
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
    """Update the entries (last axis) that have a gradient by one Adam step; the others keep value and moments.

    Args:
        value: parameters, updated in place.
        grad: their gradient, of the same shape.
        m: first moments, updated in place.
        v: second moments, updated in place.
        step_size: step size; a number, or a tensor that broadcasts to ``value``.
        beta1: decay of the first moments.
        beta2: decay of the second moments.
        epsilon: lower limit of the denominator.
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


def bilinear(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Interpolate a panorama, (h, w) or (h, w, C), at index coordinates (N,)."""
    left, right, top, bottom, fu, fv = _corners(u, v, image.shape[1], image.shape[0])
    if image.ndim == 3:
        fu, fv = fu[:, None], fv[:, None]
    upper = image[top, left] * (1 - fu) + image[top, right] * fu
    lower = image[bottom, left] * (1 - fu) + image[bottom, right] * fu
    return upper * (1 - fv) + lower * fv


def prior_inverse_depth(prior: TorchPrior, u: Tensor, v: Tensor) -> Tensor:
    """Return the inverse depth at index coordinates (N,): bilinear on a surface, nearest pixel at a depth edge."""
    inverse = prior.inverse_depth
    left, right, top, bottom, fu, fv = _corners(u, v, inverse.shape[1], inverse.shape[0])
    nearest = inverse[torch.where(fv >= 0.5, bottom, top), torch.where(fu >= 0.5, right, left)]
    return torch.where(prior.depth_edge[top, left], nearest, bilinear(inverse, u, v))


def sample_rays(
    uniform: Tensor, columns: int, rows: int, priors: list[TorchPrior], sources: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Sample one ray per stratum; return points (2 N, 3), targets (2 N, 4) and weights (2 N, 2).

    Args: as ``march.sample_rays``.
    """
    points = torch.zeros(2 * columns * rows, 3, device=uniform.device)
    target = torch.zeros(2 * columns * rows, 4, device=uniform.device)
    weight = torch.zeros(2 * columns * rows, 2, device=uniform.device)
    for k, prior in enumerate(priors):
        tiles = torch.nonzero(sources == k)[:, 0]
        n = (tiles[:, None] * 64 + torch.arange(64, device=uniform.device)).reshape(-1)
        at = (tiles[:, None] * 128 + torch.arange(128, device=uniform.device)).reshape(-1)
        points[at], target[at], weight[at] = _sample_rays(uniform[n], n, columns, rows, prior, priors[0])
    return points, target, weight


def _sample_rays(
    uniform: Tensor, n: Tensor, columns: int, rows: int, prior: TorchPrior, newest: TorchPrior
) -> tuple[Tensor, Tensor, Tensor]:
    """Sample the rays with the numbers ``n`` (N,) in the batch, all from one keyframe."""
    height, width = prior.rgb.shape[:2]
    h, w = prior.inverse_depth.shape
    tile, inside = n // 64, n % 64
    tiles = columns // 8
    column, row = (tile % tiles) * 8 + inside % 8, (tile // tiles) * 8 + inside // 8
    turn = (column + uniform[:, 0]) / columns
    z = 1 - 2 * (row + uniform[:, 1]) / rows
    azimuth = math.pi * (1 - 2 * turn)
    fall = 0.5 - torch.asin(z) / math.pi
    colour = bilinear(prior.rgb, turn * width - 0.5, fall * height - 0.5) * prior.gain
    colour = (colour / 255).clamp(max=1) - 0.5
    depth = 1 / prior_inverse_depth(prior, turn * w - 0.5, fall * h - 0.5)
    offset = 2 * uniform[:, 2] - 1
    flat = (1 - z * z).clamp(min=0).sqrt()
    direction = torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), z], dim=1) @ prior.map_from_camera[:3, :3].T
    camera = prior.map_from_camera[:3, 3]
    surface = camera + depth[:, None] * direction
    near = camera + (depth * (1 + prior.band * offset))[:, None] * direction
    distance = -offset
    if prior is not newest:
        away = (surface - newest.map_from_camera[:3, 3]).norm(dim=1)
        distance = distance * prior.band * depth / (newest.band * torch.maximum(away, 0.5 * depth))
    surface_target = torch.cat([colour, torch.zeros_like(offset)[:, None]], dim=1)
    near_target = torch.cat([colour, distance[:, None]], dim=1)
    at = (fall * h).long().clamp(max=h - 1), (turn * w).long().clamp(max=w - 1)
    usable = prior.usable[at].float()
    weight = torch.stack([usable, usable * prior.trust[at]], dim=1)

    def by_tiles(on_surface: Tensor, in_band: Tensor) -> Tensor:
        parts = on_surface.view(-1, 64, on_surface.shape[1]), in_band.view(-1, 64, in_band.shape[1])
        return torch.stack(parts, dim=1).reshape(-1, on_surface.shape[1])

    return by_tiles(surface, near), by_tiles(surface_target, near_target), by_tiles(weight, weight)


def prior_agrees(prior: TorchPrior, points: Tensor) -> Tensor:
    """Return 2 for points (N, 3) in the camera's frame on a surface of known depth, 1 on filled depth, 0 elsewhere."""
    inverse = prior.inverse_depth
    height, width = inverse.shape
    distance = points.norm(dim=1)
    u, v = _pixels(points, inverse)
    left, right, top, bottom, fu, fv = _corners(u, v, width, height)
    seen = 1 + prior.known[torch.where(fv >= 0.5, bottom, top), torch.where(fu >= 0.5, right, left)].long()
    ratios = torch.stack([inverse[r, c] for r in (top, bottom) for c in (left, right)]) * distance
    low, high = 1 - prior.band, 1 + prior.band
    any_near = ((ratios > low) & (ratios < high)).any(dim=0)
    between = (ratios.amin(dim=0) < high) & (ratios.amax(dim=0) > low)
    return torch.where(torch.where(prior.depth_edge[top, left], any_near, between), seen, torch.zeros_like(seen))


def prior_distance(prior: TorchPrior, points: Tensor) -> Tensor:
    """Return signed distances (N,) of points in the camera's frame to the surface on their ray, as in ``march``."""
    nearness = prior_inverse_depth(prior, *_pixels(points, prior.inverse_depth))
    return (1 - points.norm(dim=1) * nearness) / prior.band


def _camera_frame(prior: TorchPrior, points: Tensor) -> Tensor:
    return points @ prior.camera_from_map[:3, :3].T + prior.camera_from_map[:3, 3]


def nearest_prior(priors: list[TorchPrior], points: Tensor) -> tuple[Tensor, Tensor]:
    """Return signed distance to the nearest keyframe's surface and agreement of points (N, 3) in the map, (N,) each.

    If a keyframe sees known depth far behind a point, the point is free space and older keyframes do not count there.
    """
    seen_through = torch.zeros(points.shape[0], dtype=torch.bool, device=points.device)
    for k, prior in enumerate(priors):
        local = _camera_frame(prior, points)
        value = prior_distance(prior, local)
        away = local.norm(dim=1) * prior.band
        if k == 0:
            best, unit, agrees = value, away, prior_agrees(prior, local)
        else:
            closer = ~seen_through & (value.abs() * away < best.abs() * unit)
            best = torch.where(closer, value * away / unit, best)
            agrees = torch.where(seen_through, agrees, torch.maximum(agrees, prior_agrees(prior, local)))
        u, v = _pixels(local, prior.known)
        row, column = (v + 0.5).long().clamp(0, prior.known.shape[0] - 1), (u + 0.5).long() % prior.known.shape[1]
        seen_through |= (value > LOOKED_THROUGH) & prior.known[row, column]
    return best, agrees


def _pixels(points: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the index coordinates (u, v) of points (N, 3) of the camera's frame in an equirect image, (N,) each."""
    height, width = image.shape[:2]
    x, y, z = points.unbind(1)
    u = (math.pi - torch.atan2(y, x)) * (width / (2 * math.pi)) - 0.5
    v = (math.pi / 2 - torch.atan2(z, torch.hypot(x, y))) * (height / math.pi) - 0.5
    return u, v


@torch.no_grad()
def mix_panorama(
    priors: list[TorchPrior],
    origin: Tensor,
    directions: Tensor,
    depth: Tensor,
    confidence: Tensor,
    share: float,
    colour: Tensor,
) -> None:
    """Mix the colour of the newest keyframe that shows each point into ``colour`` (P, 3), in place.

    Args: as ``march.mix_panorama``.
    """
    at = torch.nonzero((depth > 0) & (confidence > 0))[:, 0]
    for k, prior in enumerate(priors):
        points = _camera_frame(prior, origin + depth[at, None] * directions[at])
        here = prior_agrees(prior, points) > 0 if k < len(priors) - 1 else torch.ones_like(at, dtype=torch.bool)
        seen = (bilinear(prior.rgb, *_pixels(points[here], prior.rgb)) * prior.gain / 255).clamp(max=1)
        colour[at[here]] += share * (seen - colour[at[here]])
        at = at[~here]


@torch.no_grad()
def trace(
    field: TorchField, grid: TorchGrid, priors: list[TorchPrior], share: float, origin: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor]:
    """March rays to the surface; return depth along each ray, 0 where it hits nothing, and confidence, (N,) each.

    Args: as ``march.trace``.
    """
    count = directions.shape[0]
    depth = torch.zeros(count, device=directions.device)
    confidence = torch.zeros(count, device=directions.device)
    t, leave = _grid_span(origin, directions, grid)
    active = torch.nonzero(t < leave)[:, 0]
    last_t = torch.zeros_like(t)
    last_s = torch.full_like(t, NOT_SEEN)
    spare = torch.zeros_like(t)
    spare_s = torch.full_like(t, NOT_SEEN)
    camera = priors[0].map_from_camera[:3, 3]
    while active.numel():
        t[active] = _next_occupied(origin, directions[active], t[active], leave[active], grid)
        active = active[t[active] >= 0]
        here = t[active]
        points = origin + here[:, None] * directions[active]
        value = share * nearest_prior(priors, points)[0]
        if share < 1:
            value = value + (1 - share) * query(field, points)[:, 3]
        gap = here - last_t[active] > 3 * grid.cell_m
        before = torch.where(gap, torch.full_like(value, NOT_SEEN), last_s[active])
        crossing = last_t[active] + (here - last_t[active]) * before / (before - value)
        crossed = (before != NOT_SEEN) & ((before > 0) != (value > 0))
        hit = torch.where(crossed, crossing, here)
        front = (value <= 0) & (before > 0)
        agrees = nearest_prior(priors, origin + hit[:, None] * directions[active])[1]
        closer = (agrees == 2) & (value > 0) & ~crossed & (value < spare_s[active])
        spare[active[closer]], spare_s[active[closer]] = hit[closer], value[closer]
        met = ((value <= 0) | crossed) & (agrees > 0)
        depth[active[met]] = hit[met]
        confidence[active[met]] = torch.where(front, 0.5 * agrees, torch.zeros_like(value))[met]
        last_t[active], last_s[active] = here, value
        reach = 0.9 * value.abs() * priors[0].band * (points - camera).norm(dim=1)
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
    """Return each ray's first length from ``t`` on that lies in an occupied cell, (N,); −1 if it is past ``leave``."""
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
