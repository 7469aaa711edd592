"""Augmentation of a batch of panoramas (torch): what keeps the depth, and what a camera does to the colours."""

from __future__ import annotations

import torch
from torch import Tensor


def turn_and_mirror(rgb: Tensor, depth: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Turns every panorama by a random yaw and mirrors half of them; both are exact on equirect pictures.

    Args:
        rgb: (B, 3, H, W).
        depth: (B, H, W).
        generator: source of randomness.
    """
    count, _, _, width = rgb.shape
    shifts = torch.randint(0, width, (count,), generator=generator).tolist()
    mirrored = torch.rand(count, generator=generator) < 0.5
    pictures, depths = [], []
    for index, shift in enumerate(shifts):
        picture, distance = rgb[index].roll(shift, -1), depth[index].roll(shift, -1)
        if mirrored[index]:
            picture, distance = picture.flip(-1), distance.flip(-1)
        pictures.append(picture)
        depths.append(distance)
    return torch.stack(pictures), torch.stack(depths)


def camera_colours(rgb: Tensor, generator: torch.Generator) -> Tensor:
    """Exposure, contrast, white balance, saturation and sensor noise, a picture at a time; (B, 3, H, W) in 0..1."""
    count = rgb.shape[0]

    def uniform(low: float, high: float, channels: int = 1) -> Tensor:
        return low + (high - low) * torch.rand(count, channels, 1, 1, generator=generator)

    gamma = torch.exp(uniform(-0.35, 0.35))
    rgb = rgb.clamp_min(1e-4).pow(gamma) * torch.exp(uniform(-0.45, 0.3))
    rgb = rgb * torch.exp(uniform(-0.12, 0.12, 3))
    grey = rgb.mean(dim=1, keepdim=True)
    rgb = grey + (rgb - grey) * uniform(0.3, 1.4)
    rgb = rgb + torch.randn(rgb.shape, generator=generator) * uniform(0.0, 0.03)
    return rgb.clamp(0.0, 1.0)
