"""PSNR and SSIM against scikit-image, and by hand."""

import math

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from instant_ic.geometry.image_quality import psnr_db, psnr_of_mse, ssim


def test_values_by_hand():
    black, grey = np.zeros((32, 32, 3), np.uint8), np.full((32, 32, 3), 51, np.uint8)
    assert psnr_db(black, grey) == pytest.approx(20 * math.log10(5))  # 255 / 51
    assert psnr_of_mse((51 / 255) ** 2) == pytest.approx(20 * math.log10(5))
    assert psnr_db(grey, grey) == math.inf
    assert (psnr_of_mse(0.0), math.isnan(psnr_of_mse(math.nan))) == (100.0, True)
    # Uniform images: (2 · 0 · 51 + C1) / (0² + 51² + C1), C1 = (0.01 · 255)²
    assert ssim(black, grey) == pytest.approx(6.5025 / (51**2 + 6.5025), rel=1e-4)


def test_values_of_scikit_image():
    rng = np.random.default_rng(0)
    a = rng.integers(0, 256, (24, 40, 3), np.uint8)
    b = np.clip(a + rng.normal(0, 20, a.shape), 0, 255).astype(np.uint8)
    assert psnr_db(a, b) == pytest.approx(peak_signal_noise_ratio(a, b))
    windowed = [
        structural_similarity(x, y, gaussian_weights=True, use_sample_covariance=False)
        for x, y in zip(np.moveaxis(a, 2, 0), np.moveaxis(b, 2, 0), strict=True)
    ]
    assert ssim(a, b) == pytest.approx(np.mean(windowed))
