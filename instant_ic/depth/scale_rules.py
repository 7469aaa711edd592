"""Rules that find the scale between estimated depth and LiDAR ranges (paper, section IV.C); needs only numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
MIN_VALUES = 20


class ScaleError(ValueError):
    """No scale can be found; the message says why."""


@dataclass(frozen=True)
class Consensus:
    """A scale on which many pairs of depth and range agree.

    Attributes:
        scale: metres per unit of depth.
        share: share of the pairs that agree with the scale, 0 to 1.
        rival_scale, rival_share: the best scale among the other pairs, and its share; 0 if there is none.
    """

    scale: float
    share: float
    rival_scale: float
    rival_share: float


def max_ratio_scale(depth: Floats, range_m: Floats, confidence: float = 0.995) -> float:
    """Return the scale that maps the largest depth to the largest range (paper, equation of section IV.C).

    Args:
        depth: estimated depth, any shape and unit; values that are not positive and finite are left out.
        range_m: LiDAR ranges in metres, any shape; values that are not positive and finite are left out.
        confidence: quantile used as the maximum, which keeps outliers out.

    Returns:
        Metres per unit of depth.

    Raises:
        ScaleError: fewer than ``MIN_VALUES`` usable values on either side.
    """
    usable = [_positive(values, name) for values, name in ((depth, "depth"), (range_m, "range"))]
    largest_depth, largest_range = (float(np.quantile(values, confidence)) for values in usable)
    return largest_range / largest_depth


def log_ratios(depth: Floats, range_m: Floats) -> NDArray[np.float64]:
    """Return log(range / depth) of pairs in the same direction, (N,) each; pairs that are not positive are left out.

    Raises:
        ScaleError: fewer than ``MIN_VALUES`` usable pairs.
    """
    usable = np.isfinite(depth) & (depth > 0) & np.isfinite(range_m) & (range_m > 0)
    ratios = range_m[usable].astype(np.float64) / depth[usable]
    return np.log(_positive(ratios, "pairs of range and depth"))


def consensus_scale(depth: Floats, range_m: Floats, tolerance: float = 0.15) -> Consensus:
    """Find the scale on which most pairs agree within a factor of 1 + ``tolerance``.

    This is RANSAC over all hypotheses, computed by sorting, and refined to the median of the agreeing pairs. Outliers,
    such as pairs through glass or a mirror, have no influence, however far off they are.

    Args:
        depth: estimated depth, (N,).
        range_m: LiDAR ranges in the same directions, (N,).
        tolerance: largest relative difference of agreeing pairs.

    Raises:
        ScaleError: fewer than ``MIN_VALUES`` usable pairs.
    """
    ratios = np.sort(log_ratios(depth, range_m))
    width = 2 * np.log1p(tolerance)
    low, high = _fullest(ratios, width)
    centre = float(np.median(ratios[low:high]))
    for _ in range(3):
        near = ratios[np.abs(ratios - centre) <= width / 2]
        centre = float(np.median(near))
    share = float((np.abs(ratios - centre) <= width / 2).mean())
    rival_scale, rival_share = np.exp(centre), 0.0
    # Only pairs more than a window away count, because the pairs beside a peak are not a second peak.
    for others in (ratios[ratios < centre - width], ratios[ratios > centre + width]):
        if len(others):
            low, high = _fullest(others, width)
            if (high - low) / len(ratios) > rival_share:
                rival_scale, rival_share = np.exp(np.median(others[low:high])), (high - low) / len(ratios)
    return Consensus(float(np.exp(centre)), share, float(rival_scale), float(rival_share))


def _fullest(values: NDArray[np.float64], width: float) -> tuple[int, int]:
    """Return the bounds of the window of ``width`` that contains most of the sorted values (N,), N >= 1."""
    ends = np.searchsorted(values, values + width, side="right")
    first = int(np.argmax(ends - np.arange(len(values))))
    return first, int(ends[first])


def sector_factors(
    azimuth_rad: Floats, log_ratio: Floats, sector_deg: float, trust_points: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a smooth correction factor of the scaled depth over azimuth.

    The logarithm of each sector's median is multiplied by n / (n + ``trust_points``), then smoothed around the circle
    with a Gaussian of half a sector's width. In sectors with few or no points the global scale remains.

    Args:
        azimuth_rad: azimuth of the pairs, (N,).
        log_ratio: log of range over scaled depth of the pairs, (N,).
        sector_deg: width of a sector, a divisor of 360.
        trust_points: number of points at which a sector's median has half weight.

    Returns:
        Azimuths (K,) of the sectors' centres, ascending in (-pi, pi), and log factors there (K,).
    """
    count = round(360.0 / sector_deg)
    sector = np.floor((np.asarray(azimuth_rad, np.float64) + np.pi) * (count / (2 * np.pi))).astype(np.intp) % count
    shrunk = np.zeros(count)
    for k in np.unique(sector):
        own = log_ratio[sector == k]
        shrunk[k] = np.median(own) * len(own) / (len(own) + trust_points)
    apart = np.minimum(np.arange(count), count - np.arange(count))
    kernel = np.exp(-0.5 * (apart / 0.5) ** 2)
    smooth = np.asarray(np.fft.ifft(np.fft.fft(shrunk) * np.fft.fft(kernel / kernel.sum())).real, np.float64)
    centres = np.asarray((np.arange(count) + 0.5) * (2 * np.pi / count) - np.pi, np.float64)
    return centres, smooth


def _positive(values: Floats, name: str) -> Floats:
    usable = values[np.isfinite(values) & (values > 0)]
    if len(usable) < MIN_VALUES:
        raise ScaleError(f"only {len(usable)} usable values of {name}; {MIN_VALUES} are needed")
    return usable
