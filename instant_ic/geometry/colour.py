"""Conversion between sRGB values and linear light (IEC 61966-2-1)."""

import numpy as np
from numpy.typing import NDArray


def srgb_to_linear(value: NDArray[np.floating]) -> NDArray[np.float32]:
    """Convert sRGB values in 0..1 to linear light."""
    value = np.asarray(value, np.float32)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(value: NDArray[np.floating]) -> NDArray[np.float32]:
    """Convert linear light in 0..1 to sRGB values."""
    value = np.clip(np.asarray(value, np.float32), 0.0, None)
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055).astype(np.float32)
