"""The network's depth corrected by what the LiDAR sees: the best of both, with an uncertainty for every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..ranges import Positive, check_ranges
from .lidar_depth import Origin

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class FusionConfig:
    """How network and LiDAR structure are brought together.

    Attributes:
        across_deg, along_deg: how far around a point, in azimuth and elevation, the network is corrected by it; a
            network is wrong by the same factor over the height of a wall rather than along it.
    """

    across_deg: Positive = 6.0
    along_deg: Positive = 25.0

    def __post_init__(self) -> None:
        check_ranges(self)


def ceiling_height(depth_m: Floats, rise: Floats, least_m: float = 0.3) -> tuple[float, float] | None:
    """Height of the ceiling over the camera that most of the upper part of a depth picture lies at.

    Args:
        depth_m: (H, W) radial metres, 0 = unknown.
        rise: (H, W) sine of each pixel's elevation over the horizon.
        least_m: what is lower is no ceiling.

    Returns:
        Height and its standard deviation over the ceiling's pixels, metres; None where there is no level surface.
    """
    upper = (rise > 0.35) & (depth_m > 0)
    height = (depth_m * rise)[upper]
    # A pixel's solid angle.
    weight = np.sqrt(1 - np.minimum(rise[upper], 1.0) ** 2)
    usable = (height > least_m) & (height < 12)
    height, weight = np.log(height[usable]), weight[usable]
    if len(height) < 100:
        return None
    bins = ((height - np.log(least_m)) / 0.04).astype(np.intp)
    near = np.convolve(np.bincount(bins, weight), np.ones(3), "same")
    best = int(near.argmax())
    if near[best] < 0.2 * weight.sum():
        return None
    inside = np.abs(bins - best) <= 2
    middle = float(np.average(height[inside], weights=weight[inside]))
    spread = float(np.sqrt(np.average((height[inside] - middle) ** 2, weights=weight[inside])))
    return float(np.exp(middle)), spread * float(np.exp(middle))


def correction(ratio: Floats, weight: Floats, config: FusionConfig, prior: float = 0.02) -> NDArray[np.float32]:
    """Smooth field (H, W) through log ratios (H, W) that count by ``weight`` (H, W); 0 far from any.

    Weighted mean over a Gaussian around each pixel, twice: the second time what is far from the first counts little.
    """
    height, width = ratio.shape
    small = (max(width // 4, 8), max(height // 4, 4))
    sigma = (config.across_deg * small[0] / 360, config.along_deg * small[1] / 180)
    pad = int(3 * sigma[0]) + 1

    def blurred(values: Floats) -> NDArray[np.float32]:
        coarse = cv2.resize(values.astype(np.float32), small, interpolation=cv2.INTER_AREA)
        wide = cv2.copyMakeBorder(coarse, 0, 0, pad, pad, cv2.BORDER_WRAP)
        smooth = cv2.GaussianBlur(wide, (0, 0), sigma[0], None, sigma[1], cv2.BORDER_REFLECT)[:, pad:-pad]
        wide = cv2.copyMakeBorder(smooth, 0, 0, 2, 2, cv2.BORDER_WRAP)
        grown = cv2.resize(wide, (width + 4 * width // small[0], height), interpolation=cv2.INTER_LINEAR)
        cut = (grown.shape[1] - width) // 2
        return np.asarray(grown[:, cut : cut + width], np.float32)

    field = np.zeros(ratio.shape, np.float32)
    for first in (True, False):
        robust = weight if first else weight / (1 + ((ratio - field) / 0.1) ** 2) ** 2
        field = blurred(robust * ratio) / (blurred(robust) + np.float32(prior))
    return field


#: How far off (log) structure of each ``Origin`` is typically, where it is not plainly wrong.
_STRUCTURE = np.array([9.0, 0.02, 0.03, 0.2, 0.08, 0.1, 0.02, 0.03, 0.08], np.float32)


@dataclass(frozen=True)
class Fused:
    """Depth (H, W) and relative standard deviation (H, W), float32; 0 and inf where unknown."""

    depth_m: NDArray[np.float32]
    sigma: NDArray[np.float32]


def fuse(
    network_m: Floats, network_sigma: float, structure_m: Floats, origin: NDArray[np.uint8], config: FusionConfig
) -> Fused:
    """Fuses scaled network depth (H, W) with LiDAR structure (H, W) and its ``Origin`` (H, W); 0 is unknown.

    ``network_sigma`` is the relative standard deviation of the network at the points.
    """
    known_n, known_s = network_m > 0, structure_m > 0
    both = known_n & known_s
    n = np.log(np.where(known_n, network_m, 1.0)).astype(np.float32)
    s = np.log(np.where(known_s, structure_m, 1.0)).astype(np.float32)
    seen = both & ((origin == Origin.BEAM) | (origin == Origin.BETWEEN))
    ratio = np.where(seen, np.clip(s - n, -0.7, 0.7), 0).astype(np.float32)
    n = n + np.where(known_n, correction(ratio, seen.astype(np.float32), config), 0)
    sigma_n = np.float32(max(network_sigma, 0.05))
    sigma_s = _STRUCTURE[origin]
    w_n = known_n / sigma_n**2
    off = np.where(both, (s - n) / np.hypot(sigma_s, sigma_n), 0)
    w_s = known_s / sigma_s**2
    w_s = np.where(both & (origin != Origin.BEAM) & (origin != Origin.BETWEEN), w_s / (1 + (off / 3) ** 4), w_s)
    total = w_n + w_s
    known = total > 0
    depth = np.where(known, np.exp((w_n * n + w_s * s) / np.maximum(total, 1e-9)), 0.0)
    sigma = np.where(known, 1 / np.sqrt(np.maximum(total, 1e-9)), np.inf)
    return Fused(depth.astype(np.float32), sigma.astype(np.float32))
