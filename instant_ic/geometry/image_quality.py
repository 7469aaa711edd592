"""PSNR and SSIM of images."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def psnr_db(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """Return the peak signal-to-noise ratio in dB of two 8-bit images of the same shape; inf if they are equal."""
    error = float(np.mean((a.astype(np.float64) - b.astype(np.float64)) ** 2))
    return float("inf") if error == 0 else 10 * float(np.log10(255.0**2 / error))


def psnr_of_mse(mse: float) -> float:
    """Return the PSNR in dB of a mean squared error of colours in 0..1, at most 100; NaN stays NaN."""
    return -10 * math.log10(max(mse, 1e-10))


def ssim(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """Return the structural similarity of two 8-bit images (H, W, 3) (Wang et al. 2004; Gaussian window, sigma 1.5)."""
    from skimage.metrics import structural_similarity

    return float(
        structural_similarity(
            a, b, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255
        )
    )
