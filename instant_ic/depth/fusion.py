"""The network's depth corrected by what the LiDAR sees: the best of both, with an uncertainty for every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..ranges import Positive, check_ranges

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class FusionConfig:
    """How network and LiDAR structure are brought together.

    Attributes:
        network_sigma: relative standard deviation of the scaled network, at least.
    """

    network_sigma: Positive = 0.06

    def __post_init__(self) -> None:
        check_ranges(self)


def fuse(
    network_m: Floats, network_sigma: float, structure_m: Floats, structure_sigma: Floats, config: FusionConfig
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Fused depth and relative sigma, each (H, W), of scaled network depth and LiDAR structure (H, W); 0 is unknown."""
    sigma = max(network_sigma, config.network_sigma)
    known_n, known_s = network_m > 0, (structure_m > 0) & np.isfinite(structure_sigma)
    n = np.log(np.where(known_n, network_m, 1.0))
    s = np.log(np.where(known_s, structure_m, 1.0))
    w_n = known_n / sigma**2
    w_s = np.where(known_s, 1.0 / np.maximum(structure_sigma, 1e-3) ** 2, 0.0)
    # Where both are known and disagree, the structure's guess is the outlier.
    residual = np.where(known_n & known_s, (s - n) ** 2 / (sigma**2 + 0.02**2), 0.0)
    w_s = np.where(known_n, w_s / (1 + residual / 4) ** 2, w_s)
    total = w_n + w_s
    known = total > 0
    depth = np.where(known, np.exp((w_n * n + w_s * s) / np.maximum(total, 1e-9)), 0.0)
    return depth.astype(np.float32), np.where(known, 1 / np.sqrt(np.maximum(total, 1e-9)), np.inf).astype(np.float32)
