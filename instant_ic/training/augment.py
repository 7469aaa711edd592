"""Augmentation of a batch of panoramas (torch): depth-preserving transforms, and the effects of a real camera."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

# Luminance quantisation of JPEG at quality 50 (ITU-T T.81, table K.1).
_QUANTISATION = (
    (16, 11, 10, 16, 24, 40, 51, 61), (12, 12, 14, 19, 26, 58, 60, 55), (14, 13, 16, 24, 40, 57, 69, 56),
    (14, 17, 22, 29, 51, 87, 80, 62), (18, 22, 37, 56, 68, 109, 103, 77), (24, 35, 55, 64, 81, 104, 113, 92),
    (49, 64, 78, 87, 103, 121, 120, 101), (72, 92, 95, 98, 112, 100, 103, 99),
)  # fmt: skip
_MAX_GAIN = 2.5
ALONE_SIGMA = 0.3
"""Relative sigma of a prior that is the network's depth alone."""


def to_brightness(rgb: Tensor, brightness: float) -> Tensor:
    """Scale the mean byte of images (B, 3, H, W) in 0..1, as inference does; 0: leave them unchanged."""
    if not brightness:
        return rgb
    mean = rgb.mean(dim=(1, 2, 3), keepdim=True).clamp_min(1 / 255)
    return (rgb * (brightness / 255 / mean).clamp(1 / _MAX_GAIN, _MAX_GAIN)).clamp(0.0, 1.0)


def turn_and_mirror(generator: torch.Generator, *maps: Tensor) -> list[Tensor]:
    """Rotate every panorama by a random yaw and mirror half of them; both are exact on equirect images.

    All ``maps`` of the panoramas, (B, ..., H, W) each, change in the same way.
    """
    count, width = len(maps[0]), maps[0].shape[-1]
    shifts = torch.randint(0, width, (count,), generator=generator).tolist()
    mirrored = torch.rand(count, generator=generator) < 0.5
    turned = [[part[index].roll(shift, -1) for index, shift in enumerate(shifts)] for part in maps]
    return [torch.stack([p.flip(-1) if m else p for p, m in zip(part, mirrored, strict=True)]) for part in turned]


def photograph(rgb: Tensor, depth: Tensor, generator: torch.Generator) -> Tensor:
    """Add the effects of a real panorama camera on a robot to images (B, 3, H, W) in 0..1; each effect on some images.

    Four in ten images change in colour only, so that the network keeps its accuracy on images of a good camera. The
    others get the effects in physical order: reflections in the floor, the robot or its stand at the bottom, lens
    (vignetting, blur), sensor (exposure, colours, noise), JPEG. The depth (B, H, W) is unchanged: below the robot it is
    the floor's depth, so that the network learns to continue the floor there.
    """
    degraded = torch.rand(len(rgb), generator=generator) < 0.6

    def some(rgb: Tensor, share: float, effect: Callable[..., Tensor], *maps: Tensor) -> Tensor:
        """Apply an effect to a share of the degraded images; it costs nothing on the others."""
        chosen = ((torch.rand(len(rgb), generator=generator) < share) & degraded).to(rgb.device)
        if not chosen.any():
            return rgb
        rgb = rgb.clone()
        rgb[chosen] = effect(rgb[chosen], *(part[chosen] for part in maps), generator)
        return rgb

    rgb = some(rgb, 0.2, floor_reflection, depth)
    rgb = some(rgb, 0.4, robot_body)
    rgb = some(rgb, 0.4, vignetting)
    rgb = camera_colours(some(rgb, 0.25, blur), generator)
    return some(rgb, 0.4, jpeg)


def without_lidar(prior: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Replace a share of the priors (B, 6, H, W) by the network's depth with a large sigma, as without a LiDAR."""
    chosen = (torch.rand(len(prior), generator=generator) < share).to(prior.device)
    alone = prior.clone()
    alone[:, 0], alone[:, 2] = prior[:, 5], 0
    alone[:, 1] = torch.where(prior[:, 5] > 0, ALONE_SIGMA, 0.0)
    return torch.where(chosen[:, None, None, None], alone, prior)


def _on(device: torch.device, generator: torch.Generator) -> torch.Generator:
    """Return a generator on the device, seeded by another, because a CPU takes 0.2 s for the noise of 64 images."""
    if device == generator.device:
        return generator
    seed = int(torch.randint(2**62, (), generator=generator))
    return torch.Generator(device).manual_seed(seed)


def _uniform(like: Tensor, generator: torch.Generator, low: float, high: float, channels: int = 1) -> Tensor:
    values = torch.rand(like.shape[0], channels, 1, 1, generator=generator)
    return (low + (high - low) * values).to(like.device)


def camera_colours(rgb: Tensor, generator: torch.Generator) -> Tensor:
    """Change exposure, contrast, white balance and saturation, and add sensor noise; (B, 3, H, W) in 0..1.

    Some images change strongly, others hardly, so that accuracy on images of a good camera does not drop.
    """
    strength = _uniform(rgb, generator, 0.0, 1.0)
    gamma = torch.exp(strength * _uniform(rgb, generator, -0.4, 0.5))
    rgb = rgb.clamp_min(1e-4).pow(gamma) * torch.exp(strength * _uniform(rgb, generator, -0.6, 0.45))
    rgb = rgb * torch.exp(strength * _uniform(rgb, generator, -0.15, 0.15, 3))
    grey = rgb.mean(dim=1, keepdim=True)
    rgb = grey + (rgb - grey) * (1 + strength * _uniform(rgb, generator, -0.8, 0.4))
    noise = torch.randn(rgb.shape, generator=_on(rgb.device, generator), device=rgb.device)
    return (rgb + strength * noise * _uniform(rgb, generator, 0.0, 0.035)).clamp(0.0, 1.0)


def vignetting(rgb: Tensor, generator: torch.Generator) -> Tensor:
    """Darken towards the seam of the two lenses, which face a random yaw and its opposite."""
    height, width = rgb.shape[-2:]
    yaw = torch.linspace(-math.pi, math.pi, width + 1)[:-1] + math.pi / width
    elevation = math.pi / 2 - (torch.arange(height) + 0.5) * math.pi / height
    turn = 2 * math.pi * torch.rand(rgb.shape[0], 1, 1, generator=generator)
    across = (torch.cos(elevation)[None, :, None] * torch.cos(yaw[None, None, :] + turn)).abs()  # 1 at a lens centre
    return rgb * (1 - _uniform(rgb, generator, 0.1, 0.45) * ((1 - across) ** 2)[:, None].to(rgb.device))


def robot_body(rgb: Tensor, generator: torch.Generator) -> Tensor:
    """Add a dark body with an uneven rim, up to some elevation below the horizon (a stand's foot, a robot's deck)."""
    count, _, height, width = rgb.shape
    yaw = torch.arange(width)[None] * (2 * math.pi / width)
    rim = 4 + 26 * torch.rand(count, 1, generator=generator)  # degrees above the nadir
    for wave in (1, 2, 3, 5):
        phase = 2 * math.pi * torch.rand(count, 1, generator=generator)
        rim = rim + 8 / wave * torch.rand(count, 1, generator=generator) * torch.cos(wave * yaw + phase)
    bump = torch.rand(count, 1, generator=generator) * 2 * math.pi
    away = torch.remainder(yaw - bump + math.pi, 2 * math.pi) - math.pi
    rim = rim + (25 * torch.rand(count, 1, generator=generator) - 5).clamp_min(0) * torch.exp(-((away / 0.15) ** 2))
    from_nadir = 180 - (torch.arange(height) + 0.5) * (180 / height)
    inside = from_nadir[None, :, None] < rim[:, None, :]  # (B, H, W)
    shade = _uniform(rgb, generator, 0.0, 0.2) + _uniform(rgb, generator, 0.0, 0.05, 3)
    relief = 1 + 0.3 * torch.randn(count, 1, height // 16, width // 16, generator=generator).to(rgb.device)
    body = shade * functional.interpolate(relief, size=(height, width), mode="bilinear").clamp_min(0)
    return torch.where(inside[:, None].to(rgb.device), body, rgb)


def floor_reflection(rgb: Tensor, depth: Tensor, generator: torch.Generator) -> Tensor:
    """Add reflections of everything above the horizon to the floor, stronger at grazing angles.

    Pixels as low as the lowest known pixel count as floor. The reflection is read at the same elevation above the
    horizon, which is exact for distant surfaces only.
    """
    height = rgb.shape[-2]
    elevation = math.pi / 2 - (torch.arange(height, device=rgb.device) + 0.5) * math.pi / height
    drop = -depth * torch.sin(elevation)[None, :, None]  # metres below the camera
    lowest = torch.quantile(drop[:, height // 2 :].flatten(1)[:, ::7], 0.9, dim=1)
    floor = (drop > 0.9 * lowest[:, None, None]) & (depth > 0) & (lowest[:, None, None] > 0.2)
    mirrored = functional.avg_pool2d(rgb.flip(-2), (5, 3), stride=1, padding=(2, 1))
    grazing = torch.cos(elevation).clamp(0, 1) ** 3
    share = _uniform(rgb, generator, 0.1, 0.6) * grazing[None, None, :, None]
    return torch.where(floor[:, None], rgb + share * (mirrored - rgb), rgb)


def blur(rgb: Tensor, generator: torch.Generator) -> Tensor:
    """Blend in a 3 × 3 mean by a random share, like a soft lens or slight motion; circular in width."""
    padded = functional.pad(functional.pad(rgb, (1, 1, 0, 0), mode="circular"), (0, 0, 1, 1), mode="replicate")
    return rgb + _uniform(rgb, generator, 0.3, 1.0) * (functional.avg_pool2d(padded, 3, stride=1) - rgb)


def jpeg(rgb: Tensor, generator: torch.Generator, quality: tuple[float, float] = (20.0, 85.0)) -> Tensor:
    """Round the cosine coefficients of 8 × 8 blocks as JPEG of a random quality does; colour twice as coarsely.

    Height and width must be multiples of 8.
    """
    count, _, height, width = rgb.shape
    k = torch.arange(8, dtype=rgb.dtype, device=rgb.device)
    basis = torch.cos((2 * k[None] + 1) * k[:, None] * math.pi / 16) * 0.5
    basis[0] /= math.sqrt(2)
    red, green, blue = rgb.unbind(1)
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    planes = torch.stack((luma - 128 / 255, (blue - luma) * 0.564, (red - luma) * 0.713), dim=1) * 255
    blocks = planes.view(count, 3, height // 8, 8, width // 8, 8).transpose(3, 4)
    coefficients = basis @ blocks @ basis.T
    q = _uniform(rgb, generator, *quality)
    factor = torch.where(q < 50, 50 / q, 2 - q / 50)
    steps = (torch.tensor(_QUANTISATION, dtype=rgb.dtype, device=rgb.device) * factor[..., None, None]).clamp_min(1)
    steps = steps * torch.tensor([1.0, 2.0, 2.0], device=rgb.device).view(1, 3, 1, 1, 1, 1)
    blocks = basis.T @ (torch.round(coefficients / steps) * steps) @ basis
    luma, cb, cr = (blocks.transpose(3, 4).reshape(count, 3, height, width) / 255).unbind(1)
    luma = luma + 128 / 255
    red, blue = luma + cr / 0.713, luma + cb / 0.564
    green = (luma - 0.299 * red - 0.114 * blue) / 0.587
    return torch.stack((red, green, blue), dim=1).clamp(0.0, 1.0)
