"""Correction of the network's depth by LiDAR points, and the ceiling's height from the network."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]


_ACROSS_DEG, _ALONG_DEG = 6.0, 25.0
"""Standard deviations of a point's influence on the network, in azimuth and elevation. The larger one is vertical,
because the network's error factor varies less over the height of a wall than along it."""


def ceiling_height(depth_m: Floats, rise: Floats, least_m: float = 0.3) -> float | None:
    """Return the ceiling's height over the camera: the most frequent height in the upper part of a depth image.

    Args:
        depth_m: radial depth in metres, (H, W); 0 is unknown.
        rise: sine of each pixel's elevation over the horizon, (H, W).
        least_m: lowest height of a ceiling.

    Returns:
        The height in metres; None if no level surface stands out.
    """
    upper = (rise > 0.35) & (depth_m > 0)
    sine = np.minimum(rise[upper], 1.0)
    height, weight = depth_m[upper] * sine, np.sqrt(1 - sine**2)  # weight by the pixel's solid angle
    usable = (height > least_m) & (height < 12)
    if usable.sum() < 100:
        return None
    height, weight = np.log(height[usable]), weight[usable]
    bins = ((height - np.log(least_m)) / 0.04).astype(np.intp)
    near = np.convolve(np.bincount(bins, weight), np.ones(3), "same")
    best = int(near.argmax())
    if near[best] < 0.2 * weight.sum():
        return None
    inside = np.abs(bins - best) <= 2
    return float(np.exp(np.average(height[inside], weights=weight[inside])))


@dataclass(frozen=True)
class Corrected:
    """A network's depth, corrected by points.

    Attributes:
        depth_m: radial depth in metres, (H, W); 0 is unknown.
        wrong: share of the points around each pixel at which the depth is still grossly wrong, (H, W).
        sigma: relative standard deviation of the depth at the other points.
    """

    depth_m: NDArray[np.float32]
    wrong: NDArray[np.float32]
    sigma: float


def correct(network_m: Floats, measured_m: Floats) -> Corrected:
    """Correct scaled network depth (H, W) by a smooth field of factors from ranges (H, W), which are 0 without a point.

    The logarithm of the field is the mean of the log ratios, weighted by a Gaussian around each pixel. Far from any
    point the factor is 1. In a second pass, ratios that differ much from the first field have little weight.
    """
    height, width = network_m.shape
    seen = (measured_m > 0) & (network_m > 0)
    ratio = np.zeros((height, width), np.float32)
    ratio[seen] = np.clip(np.log(measured_m[seen]) - np.log(network_m[seen]), -0.7, 0.7)
    small = (width // 4, height // 4)
    sigma = (_ACROSS_DEG * small[0] / 360, _ALONG_DEG * small[1] / 180)
    pad = int(3 * sigma[0]) + 1

    def blurred(values: Floats) -> NDArray[np.float32]:
        """Blur at a quarter of the resolution."""
        coarse = cv2.resize(values.astype(np.float32), small, interpolation=cv2.INTER_AREA)
        wide = cv2.copyMakeBorder(coarse, 0, 0, pad, pad, cv2.BORDER_WRAP)
        return cv2.GaussianBlur(wide, (0, 0), sigma[0], None, sigma[1], cv2.BORDER_REFLECT)[:, pad:-pad]

    def grown(coarse: Floats) -> NDArray[np.float32]:
        wide = cv2.copyMakeBorder(coarse, 0, 0, 1, 1, cv2.BORDER_WRAP)
        return cv2.resize(wide, (width + 8, height), interpolation=cv2.INTER_LINEAR)[:, 4:-4]

    weight = seen.astype(np.float32)
    near = blurred(weight)
    field = grown(blurred(ratio) / (near + np.float32(0.005)))
    robust = weight / (1 + ((ratio - field) / 0.1) ** 2) ** 2
    field = grown(blurred(robust * ratio) / (blurred(robust) + np.float32(0.005)))
    left = np.abs(ratio - field)[seen]
    inside = left[left < 0.25]
    spread = 1.4826 * float(np.median(inside)) if len(inside) else 0.25
    bad = np.zeros((height, width), np.float32)
    bad[seen] = left > 0.25
    share = float((left > 0.25).mean()) if len(left) else 1.0
    wrong = grown((blurred(bad) + np.float32(0.01) * share) / (near + np.float32(0.01)))
    depth = np.where(network_m > 0, network_m * np.exp(field), 0).astype(np.float32)
    return Corrected(depth, wrong, max(spread, 0.02))


def likely_ceiling(seen_m: float, network: Corrected, usual_m: float) -> float:
    """Estimate a ceiling's height over the camera in metres from the network's depth and the usual height.

    Ceilings vary by a fifth around the usual height. The network's ceiling has about the same relative error as its
    depth at the points, plus a third of the share of grossly wrong points (measured on simulated rooms).
    """
    variance = 0.02**2 + network.sigma**2 + (0.3 * float(network.wrong.mean())) ** 2
    share = variance / (variance + 0.22**2)
    return float(np.exp((1 - share) * np.log(seen_m) + share * np.log(usual_m)))
