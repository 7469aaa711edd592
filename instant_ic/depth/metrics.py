"""The usual error measures of depth maps, over valid pixels only (numpy)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class DepthMetrics:
    """Errors of a depth map, or their mean over several maps.

    Attributes:
        mre: mean of |d - t| / t.
        mae_m: mean of |d - t|, metres.
        rmse_m: root of the mean of (d - t)², metres.
        delta1: share of pixels with max(d/t, t/d) < 1.25; ``delta2`` with 1.25², ``delta3`` with 1.25³.
        scale_error_median: |median of d / t - 1|, the error of the whole map's scale.
        pixels: number of valid pixels.
    """

    mre: float
    mae_m: float
    rmse_m: float
    delta1: float
    delta2: float
    delta3: float
    scale_error_median: float
    pixels: int

    def as_dict(self) -> dict[str, float]:
        """Return rounded plain values for records and printing."""
        return {key: round(value, 5) for key, value in asdict(self).items()}


def depth_metrics(
    predicted: Floats,
    truth: Floats,
    valid: NDArray[np.bool_] | None = None,
    weights: Floats | None = None,
) -> DepthMetrics:
    """Compare two depth maps of the same shape, in metres.

    A pixel counts if its truth is finite and positive, and if it is ``valid``. A prediction that is not positive or not
    finite counts as 0 m, which gives a relative error of 1 and no hit in any delta.

    Args:
        predicted: predicted depth, usually (H, W).
        truth: true depth, in the same shape.
        valid: mask of the pixels that count, in the same shape; None if all count.
        weights: weights of the pixels, broadcast to their shape; None weights all equally. For an equirect image by
            solid angle: ``solid_angle_weights(height)[:, None]``.

    Raises:
        ValueError: the shapes differ or no pixel is valid.
    """
    if predicted.shape != truth.shape:
        raise ValueError(f"shapes differ: predicted {predicted.shape}, truth {truth.shape}")
    usable = np.isfinite(truth) & (truth > 0)
    if valid is not None:
        usable &= valid
    w = np.broadcast_to(1.0 if weights is None else weights, truth.shape)[usable].astype(np.float64)
    count = len(w)
    if count == 0 or not w.sum() > 0:
        raise ValueError("no valid pixel in the truth")
    w = w / w.sum()
    t = truth[usable].astype(np.float64)
    d = predicted[usable].astype(np.float64)
    d = np.where(np.isfinite(d) & (d > 0), d, 0.0)
    error = np.abs(d - t)
    ratio = np.maximum(d / t, t / np.maximum(d, 1e-9))
    return DepthMetrics(
        mre=float(w @ (error / t)),
        mae_m=float(w @ error),
        rmse_m=float(np.sqrt(w @ error**2)),
        delta1=float(w @ (ratio < 1.25)),
        delta2=float(w @ (ratio < 1.25**2)),
        delta3=float(w @ (ratio < 1.25**3)),
        scale_error_median=abs(_median(d / t, w) - 1),
        pixels=count,
    )


def _median(values: Floats, weights: Floats) -> float:
    """Return the weighted median: the mean of the two values around half of the cumulative weight."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    half = 0.5 * total[-1]
    tie = 1e-9 * total[-1]
    low, high = np.searchsorted(total, half - tie), np.searchsorted(total, half + tie)
    return 0.5 * float(values[order[low]] + values[order[min(high, len(order) - 1)]])


def mean_metrics(each: Sequence[DepthMetrics]) -> DepthMetrics:
    """Return the mean over maps, in which every map has the same weight; ``pixels`` is the sum.

    Raises:
        ValueError: there are no metrics.
    """
    if not each:
        raise ValueError("no metrics to average")
    columns = {key: np.array([getattr(one, key) for one in each]) for key in asdict(each[0])}
    means = {key: float(values.mean()) for key, values in columns.items() if key != "pixels"}
    return DepthMetrics(**means, pixels=int(columns["pixels"].sum()))


def solid_angle_weights(height: int) -> NDArray[np.float32]:
    """Return the weight of each row of an equirect image, (height,), with a mean of 1.

    The solid angle of a pixel is proportional to the difference of the sines of its edges' elevations. Without these
    weights, the poles, which have many pixels but little solid angle, would dominate a mean.
    """
    edges = np.pi / 2 - np.arange(height + 1) * (np.pi / height)
    weights = np.sin(edges[:-1]) - np.sin(edges[1:])
    return (weights / weights.mean()).astype(np.float32)
