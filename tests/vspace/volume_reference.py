"""Plain torch versions of ``volume.py``; differentiable in table and network."""

from __future__ import annotations

import torch
from torch import Tensor

from instant_ic.vspace.nerf.field import RAW_LIMITS
from instant_ic.vspace.nerf.field import VOLUME_SAMPLES as SAMPLES
from instant_ic.vspace.nerf.reference import TorchField, TorchPrior, query


def band_samples(
    camera: Tensor, surface: Tensor, jitter: Tensor, band: Tensor, newest: TorchPrior
) -> tuple[Tensor, Tensor, Tensor]:
    """Sample rays from ``camera`` (N, 3) to ``surface`` (N, 3): points (N, S, 3), offsets (N, S), spans (N, S)."""
    step = 2.0 / SAMPLES
    offset = (torch.arange(SAMPLES, device=surface.device) + jitter[:, None]) * step - 1
    along = surface - camera
    points = camera[:, None] + along[:, None] * (1 + band[:, None] * offset)[..., None]
    unit = newest.band * (points - newest.map_from_camera[:3, 3]).norm(dim=2).clamp(min=1e-3)
    return points, offset, step * (band * along.norm(dim=1))[:, None] / unit


def ray_weights(raw: Tensor, span: Tensor) -> Tensor:
    """Return the weights of samples (N, S) from the logarithms of the density (N, S)."""
    thickness = raw.clamp(*RAW_LIMITS).exp() * span
    light = torch.exp(-thickness.cumsum(dim=1))
    before = torch.cat([torch.ones_like(light[:, :1]), light[:, :-1]], dim=1)
    return before - light


def volume_loss(
    output: Tensor, offset: Tensor, span: Tensor, target: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the mean errors of colour, depth, opacity and distortion; see ``volume.volume_gradient``.

    Args:
        output: output of ``query``, (N, S, 4).
        offset: places of the samples, in bands behind the surface, (N, S).
        span: lengths that the samples stand for, (N, S).
        target: colours of the rays, (N, 3).
        weight: weights of colour and depth, (N, 2).
    """
    w = ray_weights(output[..., 3], span)
    colour = ((w[..., None] * output[..., :3]).sum(dim=1) - target) ** 2
    depth = (w * offset).sum(dim=1) ** 2
    opacity = (1 - w.sum(dim=1)) ** 2
    apart = (offset[:, :, None] - offset[:, None]).abs()
    distortion = (w[:, :, None] * w[:, None] * apart).sum(dim=(1, 2)) + (w * w).sum(dim=1) * (2.0 / SAMPLES) / 3
    return (
        (weight[:, 0] * colour.mean(dim=1)).mean(),
        (weight[:, 1] * depth).mean(),
        (weight[:, 0] * opacity).mean(),
        (weight[:, 0] * distortion).mean(),
    )


@torch.no_grad()
def composite(
    field: TorchField, newest: TorchPrior, depth_share: float, origin: Tensor, directions: Tensor, depth: Tensor
) -> tuple[Tensor, Tensor]:
    """Composite rays guided to ``depth`` (P,); return colours (P, 3) and depth (P,); see ``volume.composite``."""
    met = torch.nonzero(depth)[:, 0]
    surface = origin + depth[met, None] * directions[met]
    away = (surface - newest.map_from_camera[:3, 3]).norm(dim=1)
    share = (newest.band * away / depth[met]).clamp(max=0.5)
    points, offset, span = band_samples(origin.expand_as(surface), surface, torch.full_like(share, 0.5), share, newest)
    output = query(field, points.reshape(-1, 3)).reshape(*offset.shape, 4)
    w = ray_weights(output[..., 3], span)
    opacity = w.sum(dim=1) + 1e-6
    colour = torch.zeros_like(directions)
    colour[met] = ((w[..., None] * output[..., :3]).sum(dim=1) + 0.5).clamp(0, 1)
    rendered = depth.clone()
    rendered[met] *= 1 + (1 - depth_share) * share * (w * offset).sum(dim=1) / opacity
    return colour, rendered
