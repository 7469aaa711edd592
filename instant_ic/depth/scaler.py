"""Scales estimated depth to metres by LiDAR ranges (paper, section IV.C). numpy only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import equirect_pixels

from ..ranges import NotNegative, Positive, Range, Share, check_ranges

Floats = NDArray[np.floating]
MIN_VALUES = 20
METHODS = ("max_ratio", "median_ratio", "as_estimated")
MAXIMA = ("lidar", "image")
OUTPUT_KINDS = ("metric", "scale_invariant", "relative", "disparity")


class ScaleError(ValueError):
    """No scale can be found; the text says why."""


@dataclass(frozen=True)
class ScalerConfig:
    """How depth is scaled.

    Attributes:
        method: ``median_ratio`` (median of range over depth at the points) or ``max_ratio`` (the paper's rule).
            Only for ``metric`` and ``scale_invariant`` depth; the others get a robust line. ``as_estimated`` takes
            the metres of a ``metric`` model unseen, for pictures and LiDAR from different places; never for driving.
        maxima: where ``max_ratio`` takes the depth's maximum: ``lidar``, over the directions that the LiDAR sees, or
            ``image``, over the whole picture by solid angle.
        confidence: quantile that stands for the maximum (paper: 99.5 %).
        output_kind: of the depth model, as in its manifest.
        min_range_m: nearer points are left out (the robot itself).
        max_range_m: farther points are left out, and scaled depth is cut there.
        min_points: fewer points in the picture give no scale.
        min_azimuth_deg: points in fewer degrees of azimuth give no scale.
        agreement: a point agrees when scaled depth and range differ by no more than this share of the range.
        min_quality: a smaller share of agreeing points makes the fit not ok.
        min_scale, max_scale: a scale outside makes the fit not ok (``metric`` and ``scale_invariant``).
        assumed_sigma: relative standard deviation that is told of depth taken ``as_estimated``, which nobody measured.
    """

    method: str = "median_ratio"
    maxima: str = "lidar"
    confidence: Annotated[float, Range(0.5, 1)] = 0.995
    output_kind: str = "metric"
    min_range_m: NotNegative = 0.4
    max_range_m: Positive = 16.0
    min_points: Annotated[int, Range(MIN_VALUES)] = 300
    min_azimuth_deg: Annotated[float, Range(0, 360)] = 90.0
    agreement: Annotated[float, Range(above=0, below=1)] = 0.15
    min_quality: Share = 0.25
    min_scale: Positive = 0.05
    max_scale: Positive = 20.0
    assumed_sigma: Annotated[float, Range(above=0, high=1)] = 0.2

    def __post_init__(self) -> None:
        for key, allowed in (("method", METHODS), ("maxima", MAXIMA), ("output_kind", OUTPUT_KINDS)):
            if getattr(self, key) not in allowed:
                raise ValueError(f"{key} must be one of {', '.join(allowed)} (got {getattr(self, key)!r})")
        check_ranges(self)
        if not self.min_range_m < self.max_range_m:
            raise ValueError(f"min_range_m must be under max_range_m (got {self.min_range_m}, {self.max_range_m})")
        if not self.min_scale < self.max_scale:
            raise ValueError(f"min_scale must be under max_scale (got {self.min_scale}, {self.max_scale})")
        if self.method == "as_estimated" and self.output_kind != "metric":
            raise ValueError(f"method as_estimated needs output_kind metric (got {self.output_kind!r})")


@dataclass(frozen=True)
class ScaleFit:
    """Result of a fit.

    Attributes:
        ok: false: do not trust ``depth_m``; ``message`` says why.
        scale: metres per unit of depth; for ``disparity``, inverse metres per unit.
        shift: metres (``relative``) or inverse metres (``disparity``) added after scaling; else 0.
        depth_m: (H, W) float32 scaled radial depth, 0 = unknown.
        quality: share of points whose range agrees with the scaled depth, 0..1.
        relative_sigma: one standard deviation of (depth - range) / range, robust; inf where nothing was compared.
        points: number of points compared.
        message: for people.
    """

    ok: bool
    scale: float
    shift: float
    depth_m: NDArray[np.float32]
    quality: float
    relative_sigma: float
    points: int
    message: str


def project_points(points: Floats, width: int, height: int) -> tuple[Floats, Floats, Floats]:
    """Projects points (N, 3) in the camera's frame onto an equirect picture.

    Returns:
        ``u, v`` index coordinates (see ``geometry.projections.equirect_pixels``) and the range in metres, each (N,).
    """
    u, v = equirect_pixels(points, width, height)
    return u, v, np.linalg.norm(points, axis=-1)


def nearest_points(points: Floats, width: int, height: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Rows, columns and ranges of the nearest point in each pixel that has one.

    The LiDAR hangs elsewhere than the camera and sees behind things; of two points in one pixel the nearer is the
    one that the camera sees.
    """
    u, v, range_m = project_points(points, width, height)
    rows = np.clip(np.rint(v).astype(np.intp), 0, height - 1)
    columns = np.rint(u).astype(np.intp) % width
    pixel = rows * width + columns
    order = np.lexsort((range_m, pixel))
    first = np.ones(len(order), bool)
    first[1:] = pixel[order[1:]] != pixel[order[:-1]]
    kept = order[first]
    return rows[kept], columns[kept], range_m[kept]


def max_ratio_scale(depth: Floats, range_m: Floats, confidence: float = 0.995) -> float:
    """Scale that brings the largest depth to the largest range (paper, equation of section IV.C).

    Args:
        depth: estimated depth, any shape and unit; values that are not positive and finite are left out.
        range_m: LiDAR ranges in metres, any shape; likewise.
        confidence: quantile that stands for the maximum, which keeps outliers out.

    Returns:
        Metres per unit of depth.

    Raises:
        ScaleError: fewer than ``MIN_VALUES`` usable values on either side.
    """
    usable = [_positive(values, name) for values, name in ((depth, "depth"), (range_m, "range"))]
    largest_depth, largest_range = (float(np.quantile(values, confidence)) for values in usable)
    return largest_range / largest_depth


def median_ratio_scale(depth: Floats, range_m: Floats) -> float:
    """Median of range over depth, pairs of the same direction, both (N,).

    Raises:
        ScaleError: fewer than ``MIN_VALUES`` usable pairs.
    """
    usable = np.isfinite(depth) & (depth > 0) & np.isfinite(range_m) & (range_m > 0)
    return float(np.median(_positive(range_m[usable] / depth[usable], "pairs of range and depth")))


def robust_line(x: Floats, y: Floats, iterations: int = 20) -> tuple[float, float]:
    """Slope and offset of y = slope x + offset with Huber weights, both (N,).

    Raises:
        ScaleError: too few values, or x does not vary.
    """
    if len(x) < MIN_VALUES:
        raise ScaleError(f"only {len(x)} values, {MIN_VALUES} are needed")
    x, y = x.astype(np.float64), y.astype(np.float64)
    if np.ptp(x) < 1e-9:
        raise ScaleError("the estimated depth is the same everywhere")
    weights = np.ones_like(x)
    slope = offset = 0.0
    for _ in range(iterations):
        mean_x, mean_y = np.average(x, weights=weights), np.average(y, weights=weights)
        spread = float((weights * (x - mean_x) ** 2).sum())
        if spread < 1e-12:
            raise ScaleError("the estimated depth is the same at every point that agrees")
        slope = float((weights * (x - mean_x) * (y - mean_y)).sum()) / spread
        offset = float(mean_y - slope * mean_x)
        residual = np.abs(y - slope * x - offset)
        cut = max(1.345 * 1.4826 * float(np.median(residual)), 1e-9)
        weights = np.minimum(1.0, cut / np.maximum(residual, 1e-12))
    return slope, offset


def solid_angle_quantile(depth: Floats, confidence: float) -> float:
    """Quantile of the known depth of an equirect picture (H, W), each pixel counted by its solid angle.

    Raises:
        ScaleError: fewer than ``MIN_VALUES`` known pixels.
    """
    height, width = depth.shape
    elevation = np.pi / 2 - (np.arange(height) + 0.5) * (np.pi / height)
    weights = np.broadcast_to(np.cos(elevation)[:, None], (height, width))
    known = np.isfinite(depth) & (depth > 0)
    if int(known.sum()) < MIN_VALUES:
        raise ScaleError(f"only {int(known.sum())} usable values of depth, {MIN_VALUES} are needed")
    values, counts = depth[known], weights[known]
    order = np.argsort(values, kind="stable")
    total = np.cumsum(counts[order])
    place = int(np.searchsorted(total, confidence * total[-1]))
    return float(values[order[min(place, len(order) - 1)]])


def _positive(values: Floats, name: str) -> Floats:
    usable = values[np.isfinite(values) & (values > 0)]
    if len(usable) < MIN_VALUES:
        raise ScaleError(f"only {len(usable)} usable values of {name}, {MIN_VALUES} are needed")
    return usable


class DepthScaler:
    """Fits estimated depth to LiDAR points of the same moment."""

    def __init__(self, config: ScalerConfig | None = None) -> None:
        self.config = config or ScalerConfig()

    def fit(self, depth: Floats, points: Floats) -> ScaleFit:
        """Scales one depth picture.

        Args:
            depth: (H, W) estimated radial depth (or disparity), 0 = unknown.
            points: (N, 3) LiDAR points in the camera's frame at the picture's time, metres.

        Returns:
            The fit; where no scale can be found ``ok`` is false, ``scale`` 1 and ``depth_m`` the depth as given
            (``metric``) or all unknown (other kinds).

        Raises:
            ValueError: the arrays have other shapes.
        """
        if depth.ndim != 2 or points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"depth must be (H, W), points (N, 3) (got {depth.shape}, {points.shape})")
        if self.config.method == "as_estimated":
            return self.as_estimated(depth)
        try:
            return self._fit(depth, points)
        except ScaleError as error:
            return self.refuse(depth, str(error))

    def refuse(self, depth: Floats, message: str) -> ScaleFit:
        """The fit that is not ok: depth (H, W) as the model gave it where that is metres, else all unknown."""
        metric = self.config.output_kind == "metric"
        given = self._clean(depth) if metric else np.zeros(depth.shape, np.float32)
        return ScaleFit(False, 1.0, 0.0, given, 0.0, float("inf"), 0, message)

    def as_estimated(self, depth: Floats) -> ScaleFit:
        """Depth (H, W) in the metres of a ``metric`` model, compared with nothing: ok, and the message says so."""
        message = "metres as estimated: the LiDAR was not asked (method as_estimated)"
        return ScaleFit(True, 1.0, 0.0, self._clean(depth), 0.0, self.config.assumed_sigma, 0, message)

    def _fit(self, depth: Floats, points: Floats) -> ScaleFit:
        config = self.config
        rows, columns, range_m = self._visible(points, *depth.shape)
        at_points = depth[rows, columns]
        known = np.isfinite(at_points) & (at_points > 0)
        if int(known.sum()) < config.min_points:
            raise ScaleError(f"{int(known.sum())} LiDAR points fall on known depth, {config.min_points} are needed")
        at_points, range_m = at_points[known], range_m[known]
        scale, shift, apply = self._line(depth, at_points, range_m)
        scaled = apply(at_points)
        error = np.where(np.isfinite(scaled), (scaled - range_m) / range_m, np.inf)
        quality = float((np.abs(error) <= config.agreement).mean())
        finite = error[np.isfinite(error)]
        sigma = 1.4826 * float(np.median(np.abs(finite))) if len(finite) else float("inf")
        problem = self._problem(scale, quality)
        line = f"scale {scale:.3f}" + (f", shift {shift:.3f}" if shift else "")
        message = f"{line}: {quality:.0%} of {len(range_m)} points within {config.agreement:.0%}"
        return ScaleFit(
            ok=not problem,
            scale=scale,
            shift=shift,
            depth_m=self._clean(apply(depth)),
            quality=quality,
            relative_sigma=sigma,
            points=len(range_m),
            message=f"{problem}; {message}" if problem else message,
        )

    def _visible(self, points: Floats, height: int, width: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
        config = self.config
        points = points[np.isfinite(points).all(axis=1)]
        distance = np.linalg.norm(points, axis=1)
        points = points[(distance >= config.min_range_m) & (distance <= config.max_range_m)]
        if len(points) < config.min_points:
            raise ScaleError(
                f"{len(points)} LiDAR points between {config.min_range_m} and {config.max_range_m} m, "
                f"{config.min_points} are needed"
            )
        rows, columns, range_m = nearest_points(points, width, height)
        covered = len(np.unique(columns * 120 // width)) * 3.0
        if covered < config.min_azimuth_deg:
            raise ScaleError(
                f"LiDAR points cover {covered:.0f} deg of azimuth, {config.min_azimuth_deg:.0f} are needed"
            )
        return rows, columns, range_m

    def _line(
        self, depth: Floats, at_points: Floats, range_m: Floats
    ) -> tuple[float, float, Callable[[Floats], Floats]]:
        """Scale, shift and the function from the model's unit to metres (not finite where there is none)."""
        config = self.config
        if config.output_kind == "relative":
            slope, offset = robust_line(at_points, range_m)
            return slope, offset, lambda d: np.where(_is_known(d), slope * d + offset, np.nan)
        if config.output_kind == "disparity":
            slope, offset = robust_line(at_points, 1.0 / range_m)

            def to_metres(d: Floats) -> Floats:
                inverse = np.where(_is_known(d), slope * d + offset, np.nan)
                # Beyond the longest range the line's offset says nothing any more.
                return 1.0 / np.maximum(inverse, 1.0 / config.max_range_m)

            return slope, offset, to_metres
        if config.method == "median_ratio":
            scale = median_ratio_scale(at_points, range_m)
        elif config.maxima == "lidar":
            scale = max_ratio_scale(at_points, range_m, config.confidence)
        else:
            largest = float(np.quantile(range_m, config.confidence))
            scale = largest / solid_angle_quantile(depth, config.confidence)
        return scale, 0.0, lambda d: np.where(_is_known(d), scale * d, np.nan)

    def _problem(self, scale: float, quality: float) -> str:
        config = self.config
        if config.output_kind in ("metric", "scale_invariant"):
            if not config.min_scale <= scale <= config.max_scale:
                return f"scale {scale:.3g} is outside {config.min_scale} to {config.max_scale}"
        elif scale <= 0:
            return f"depth falls where the range grows (slope {scale:.3g})"
        if quality < config.min_quality:
            return f"only {quality:.0%} of the points agree, {config.min_quality:.0%} are needed"
        return ""

    def _clean(self, depth: Floats) -> NDArray[np.float32]:
        known = np.isfinite(depth) & (depth > 0)
        return np.where(known, np.minimum(depth, self.config.max_range_m), 0.0).astype(np.float32)


def _is_known(depth: Floats) -> NDArray[np.bool_]:
    return np.isfinite(depth) & (depth > 0)
