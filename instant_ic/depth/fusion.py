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


@dataclass(frozen=True)
class Corrected:
    """A network's depth, corrected by points.

    Attributes:
        depth_m: (H, W) metres, 0 = unknown.
        wrong: (H, W) share of the points around each pixel that are still plainly off.
        sigma: relative standard deviation at the points that are not.
    """

    depth_m: NDArray[np.float32]
    wrong: NDArray[np.float32]
    sigma: float


def correct(network_m: Floats, measured_m: Floats, config: FusionConfig) -> Corrected:
    """Corrects scaled network depth (H, W) by ranges (H, W) at some pixels, 0 elsewhere: a smooth field of factors.

    The field is the weighted mean of the log ratios over a Gaussian around each pixel, 1 far from any point; the
    second time what is far from the first counts little.
    """
    height, width = network_m.shape
    seen = (measured_m > 0) & (network_m > 0)
    ratio = np.zeros((height, width), np.float32)
    ratio[seen] = np.clip(np.log(measured_m[seen] / network_m[seen]), -0.7, 0.7)
    small = (width // 4, height // 4)
    sigma = (config.across_deg * small[0] / 360, config.along_deg * small[1] / 180)
    pad = int(3 * sigma[0]) + 1

    def blurred(values: Floats) -> NDArray[np.float32]:
        """At a quarter of the resolution."""
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


@dataclass(frozen=True)
class Trust:
    """What is known beforehand of structure of one ``Origin``.

    Attributes:
        sigma: relative standard deviation where it is right.
        nearer, farther: share of the pixels where what is there is plainly nearer, or farther, than the structure.
    """

    sigma: float
    nearer: float
    farther: float


TRUST = {
    Origin.UNKNOWN: Trust(9.0, 0.5, 0.5),
    Origin.BEAM: Trust(0.012, 0.001, 0.001),
    Origin.BETWEEN: Trust(0.012, 0.001, 0.001),
    Origin.EDGE: Trust(0.05, 0.02, 0.3),
    Origin.UP: Trust(0.02, 0.001, 0.03),
    Origin.DOWN: Trust(0.02, 0.001, 0.03),
    Origin.FLOOR: Trust(0.005, 0.001, 0.001),
    Origin.CEILING: Trust(0.01, 0.01, 0.001),
    Origin.ASSUMED: Trust(0.02, 0.01, 0.001),
}


@dataclass(frozen=True)
class Fused:
    """Depth (H, W) and relative standard deviation (H, W), float32; 0 and inf where unknown."""

    depth_m: NDArray[np.float32]
    sigma: NDArray[np.float32]


def fuse(
    network_m: Floats,
    wrong: Floats,
    network_sigma: float,
    structure_m: Floats,
    origin: NDArray[np.uint8],
) -> Fused:
    """Fuses corrected network depth with LiDAR structure, pixel by pixel.

    Where both agree the mean counts by precision; where they do not, one of the two is taken: the structure, unless
    it is likelier wrong in this way than the network is wrong at all.

    Args:
        network_m: (H, W) metres, corrected by the points; 0 is unknown.
        wrong: (H, W) share of the points around each pixel at which the network is plainly wrong.
        network_sigma: relative standard deviation of the network where it is not.
        structure_m: (H, W) metres; 0 is unknown.
        origin: (H, W) how the structure came about.
    """
    sigma_s, nearer, farther = (
        np.array([getattr(TRUST[each], name) for each in Origin], np.float32)[origin]
        for name in ("sigma", "nearer", "farther")
    )
    known_n, known_s = network_m > 0, structure_m > 0
    both = known_n & known_s
    n = np.log(np.where(known_n, network_m, 1.0)).astype(np.float32)
    s = np.log(np.where(known_s, structure_m, 1.0)).astype(np.float32)
    off = np.where(both, n - s, 0)
    conflict = both & (np.abs(off) > 3 * np.hypot(sigma_s, np.float32(network_sigma)))
    likely = np.where(off > 0, farther, nearer) * (1 - wrong)
    takes_network = conflict & (likely > wrong * (1 - nearer - farther))
    w_n = (known_n & (~conflict | takes_network)) / np.float32(network_sigma) ** 2
    w_s = (known_s & ~takes_network) / sigma_s**2
    total = w_n + w_s
    known = total > 0
    total = np.maximum(total, 1e-9)
    depth = np.where(known, np.exp((w_n * n + w_s * s) / total), 0.0)
    sigma = np.where(known, 1 / np.sqrt(total), np.inf)
    return Fused(depth.astype(np.float32), sigma.astype(np.float32))
