"""Colour images of depth."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def coloured_depth(
    depth: NDArray[np.floating], near: float | None = None, far: float | None = None
) -> NDArray[np.uint8]:
    """Colour depth (H, W) on a logarithmic scale, near bright, far dark, unknown black; return RGB, (H, W, 3).

    ``near`` and ``far`` are the ends of the scale; by default the 1 % and 99 % quantiles of the known depth.
    """
    known = np.isfinite(depth) & (depth > 0)
    if not known.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    low, high = np.percentile(depth[known], (1, 99))
    near = float(low) if near is None else near
    far = float(high) if far is None else far
    span = max(np.log(far / near), 1e-6)
    share = np.log(np.where(known, depth, near) / near) / span
    levels = np.uint8(np.clip(1 - share, 0, 1) * 255)
    coloured = np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_TURBO))[..., ::-1].copy()
    coloured[~known] = 0
    return coloured
