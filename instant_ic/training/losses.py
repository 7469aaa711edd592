"""Training losses (torch): pixels are weighted by solid angle; pixels without ground truth are ignored."""

from __future__ import annotations

import torch
from torch import Tensor

MIN_DEPTH_M = 0.1
ONE_SIGMA = 0.68
"""Share of the pixels whose relative error is within sigma, as everywhere in ``instant_ic.depth``."""


def berhu(error: Tensor, threshold: float) -> Tensor:
    """Return the reverse Huber loss: |e| up to the threshold c, (e² + c²) / 2c above it; the slope is continuous."""
    magnitude = error.abs()
    return torch.where(magnitude <= threshold, magnitude, (error**2 + threshold**2) / (2 * threshold))


def weighted_mean(values: Tensor, valid: Tensor, row_weights: Tensor) -> Tensor:
    """Return the mean of values (B, H, W) over valid pixels, weighted by row (H,); 0 if no pixel is valid."""
    weights = valid.to(values.dtype) * row_weights[:, None]
    return (values * weights).sum() / weights.sum().clamp_min(1e-9)


def depth_loss(predicted: Tensor, truth: Tensor, row_weights: Tensor, metres_share: float = 0.1) -> Tensor:
    """Return the mean of |log d - log t| plus a small share of berHu; (B, H, W) in metres, truth 0 is unknown.

    The logarithm measures relative error, the criterion for scaled depth. It is clipped at ``MIN_DEPTH_M``; the term in
    metres keeps a gradient there.
    """
    valid = truth > 0
    safe = torch.where(valid, truth, torch.ones_like(truth))
    log_error = (predicted.clamp_min(MIN_DEPTH_M).log() - safe.clamp_min(MIN_DEPTH_M).log()).abs()
    return weighted_mean(log_error + metres_share * berhu(predicted - safe, 1.0), valid, row_weights)


def edge_loss(predicted: Tensor, truth: Tensor, row_weights: Tensor) -> Tensor:
    """Return the mean of |∇ log d - ∇ log t| between neighbours in both directions, across the panorama's seam too.

    This keeps walls flat and depth discontinuities sharp, which a per-pixel loss does not enforce.
    """
    valid = truth > 0
    log_ratio = predicted.clamp_min(MIN_DEPTH_M).log() - torch.where(valid, truth, 1.0).clamp_min(MIN_DEPTH_M).log()
    across = weighted_mean((log_ratio - log_ratio.roll(1, -1)).abs(), valid & valid.roll(1, -1), row_weights)
    down = weighted_mean((log_ratio[:, 1:] - log_ratio[:, :-1]).abs(), valid[:, 1:] & valid[:, :-1], row_weights[1:])
    return across + down


def sigma_loss(predicted: Tensor, sigma: Tensor, truth: Tensor, row_weights: Tensor) -> Tensor:
    """Return the quantile loss (Koenker and Bassett, 1978) of log sigma, smallest if 68 % of the errors are within it.

    A likelihood would give the mean error instead, which a few outliers multiply, so it would not be comparable to the
    sigma of the fused depth. The depth gets no gradient, because it would be trained least where it is worst.
    """
    valid = truth > 0
    safe = torch.where(valid, truth, torch.ones_like(truth)).clamp_min(MIN_DEPTH_M)
    error = (predicted.detach().clamp_min(MIN_DEPTH_M).log() - safe.log()).abs()
    above = error.clamp_min(1e-3).log() - sigma.clamp_min(1e-4).log()
    return weighted_mean(torch.maximum(ONE_SIGMA * above, (ONE_SIGMA - 1) * above), valid, row_weights)
