"""Fusion of the network's depth with the LiDAR's, with an uncertainty for every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import Positive, check_ranges
from instant_ic.depth.lidar_depth import LEAST_SIGMA, LidarDepth, Origin

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class FusionConfig:
    """Parameters of the fusion of network and LiDAR structure.

    Attributes:
        across_deg, along_deg: how far around a point, in azimuth and elevation, the network is corrected by it; a
            network is wrong by the same factor over the height of a wall rather than along it.
    """

    across_deg: Positive = 6.0
    along_deg: Positive = 25.0

    def __post_init__(self) -> None:
        check_ranges(self)


def ceiling_height(depth_m: Floats, rise: Floats, least_m: float = 0.3) -> float | None:
    """Height over the camera, metres, at which most of the upper part of a depth image lies.

    Args:
        depth_m: (H, W) radial metres, 0 = unknown.
        rise: (H, W) sine of each pixel's elevation over the horizon.
        least_m: what is lower is no ceiling.

    Returns:
        None where no level surface stands out.
    """
    upper = (rise > 0.35) & (depth_m > 0)
    sine = np.minimum(rise[upper], 1.0)
    height, weight = depth_m[upper] * sine, np.sqrt(1 - sine**2)  # a pixel's solid angle
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
        depth_m: (H, W) metres, 0 = unknown.
        wrong: (H, W) share of the points around each pixel that are still plainly off.
        sigma: relative standard deviation at the points that are not.
        before_m: (H, W) what was corrected, metres.
    """

    depth_m: NDArray[np.float32]
    wrong: NDArray[np.float32]
    sigma: float
    before_m: NDArray[np.float32]


def correct(network_m: Floats, measured_m: Floats, config: FusionConfig) -> Corrected:
    """Corrects scaled network depth (H, W) by ranges (H, W) at some pixels, 0 elsewhere: a smooth field of factors.

    The field is the weighted mean of the log ratios over a Gaussian around each pixel, 1 far from any point; the
    second time what is far from the first counts little.
    """
    height, width = network_m.shape
    seen = (measured_m > 0) & (network_m > 0)
    ratio = np.zeros((height, width), np.float32)
    ratio[seen] = np.clip(np.log(measured_m[seen]) - np.log(network_m[seen]), -0.7, 0.7)
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
    return Corrected(depth, wrong, max(spread, 0.02), np.asarray(network_m, np.float32))


#: What is known beforehand of structure of each ``Origin``: its relative standard deviation where it is right, and the
#: share of its pixels where what is there is plainly nearer, and plainly farther.
_TRUST = np.array(
    [
        (9.0, 0.5, 0.5),  # UNKNOWN
        (0.012, 0.001, 0.001),  # BEAM
        (0.012, 0.001, 0.001),  # BETWEEN
        (0.05, 0.02, 0.3),  # EDGE
        (0.02, 0.001, 0.03),  # UP
        (0.02, 0.001, 0.03),  # DOWN
        (0.005, 0.001, 0.001),  # FLOOR
        (0.01, 0.01, 0.001),  # CEILING
        (0.02, 0.01, 0.001),  # ASSUMED
    ],
    np.float32,
)

#: A thing that is nearer than this is met by the highest ring below a table's height (0.92 m, LiDAR at 0.6 m). It is
#: likelier a box that ends there than a wall where the network sees something this many times as far over it, and where
#: it takes no more of the circle than this share.
_LOW_WITHIN_M, _OVER_IT, _BOX_SHARE = 1.2, 1.5, 0.2

#: Relative standard deviation of fused depth for each ``Origin`` of the structure: at a point, its growth with the log
#: ratio of network and structure, with the angle (1/rad) to the next point, and with ``Corrected.wrong``.
#: Fitted so that 68 % of the errors are smaller: benchmarks/depth_sigma.py.
_SIGMA = np.array(
    [
        (0.5767, 0.0, 0.0001, 0.0001),  # UNKNOWN
        (0.0122, 0.0173, 0.0, 0.0097),  # BEAM
        (0.0009, 0.0001, 0.6475, 0.0001),  # BETWEEN
        (0.1370, 0.0188, 2.4074, 0.6396),  # EDGE
        (0.0066, 0.4521, 0.0165, 0.0101),  # UP
        (0.0089, 0.4220, 0.1347, 0.1642),  # DOWN
        (0.0008, 0.0001, 0.0001, 0.0001),  # FLOOR
        (0.0040, 0.0895, 0.0006, 0.0359),  # CEILING
        (0.0296, 0.0733, 0.0167, 0.2437),  # ASSUMED
    ],
    np.float32,
)


def likely_ceiling(seen_m: float, network: Corrected, usual_m: float) -> float:
    """Height of a ceiling over the camera in metres, from the network's depth and the usual height.

    Ceilings vary by a fifth around the usual one; a network's is off by about as much as it is at the points, and by
    a third of the share that is plainly wrong there (measured on the worlds of benchmarks/depth_sigma.py).
    """
    variance = 0.02**2 + network.sigma**2 + (0.3 * float(network.wrong.mean())) ** 2
    share = variance / (variance + 0.22**2)
    return float(np.exp((1 - share) * np.log(seen_m) + share * np.log(usual_m)))


def fused_sigma(origin: NDArray[np.uint8], gap_rad: Floats, off: Floats, wrong: Floats) -> NDArray[np.float32]:
    """Relative standard deviation (H, W) of fused depth; all of (H, W), see ``_SIGMA``."""
    base, by_off, by_gap, by_wrong = (np.ascontiguousarray(column)[origin] for column in _SIGMA.T)
    sigma = np.sqrt(base**2 + (by_off * off) ** 2 + (by_gap * gap_rad) ** 2 + (by_wrong * wrong) ** 2)
    return np.asarray(np.maximum(sigma, LEAST_SIGMA), np.float32)


def narrow(columns: NDArray[np.bool_], most: float) -> NDArray[np.bool_]:
    """Of ``columns`` (W,) round the circle those whose run is no longer than the share ``most`` of it."""
    if columns.all() or not columns.any():
        return np.zeros_like(columns)
    first = int(np.argmin(columns))  # no run goes through it
    edges = np.diff(np.roll(columns, -first).astype(np.int8), prepend=0, append=0)
    kept = np.zeros_like(columns)
    for start, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        kept[start:end] = end - start <= most * len(columns)
    return np.roll(kept, first)


def fuse(network: Corrected, structure: LidarDepth) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Fuses corrected network depth with LiDAR structure, pixel by pixel.

    Where both agree the mean counts by precision; where they do not, one of the two is taken: the structure, unless
    it is likelier wrong in this way than the network is wrong at all.

    Returns:
        Depth (H, W) in metres, 0 where both are unknown, and the log ratio (H, W) of network and structure, 0 where
        one is unknown.
    """
    sigma_s, nearer, farther = (np.ascontiguousarray(column)[structure.origin] for column in _TRUST.T)
    sigma_n = np.float32(network.sigma)
    known_n, known_s = network.depth_m > 0, structure.depth_m > 0
    both = known_n & known_s
    n = np.log(np.where(known_n, network.depth_m, np.float32(1)))
    s = np.log(np.where(known_s, structure.depth_m, np.float32(1)))
    up = both & (structure.origin == Origin.UP)
    near = up & (structure.depth_m < _LOW_WITHIN_M)
    over = near & narrow(near.any(axis=0), _BOX_SHARE) & (network.before_m > _OVER_IT * structure.depth_m)
    over = up & np.maximum.accumulate(over[::-1])[::-1]  # and all above it
    n = np.where(over, np.log(np.where(over, network.before_m, np.float32(1))), n)
    off = np.where(both, n - s, np.float32(0))
    conflict = both & (off * off > 9 * (sigma_s**2 + sigma_n**2))
    likely = np.where(off > 0, farther, nearer) * (1 - network.wrong)
    takes_network = over | (conflict & (likely > network.wrong * (1 - nearer - farther)))
    w_n = (known_n & (~conflict | takes_network)) / sigma_n**2
    w_s = (known_s & ~takes_network) / sigma_s**2
    total = np.maximum(w_n + w_s, np.float32(1e-9))
    depth = np.where(known_n | known_s, np.exp((w_n * n + w_s * s) / total), 0)
    return depth.astype(np.float32), off
