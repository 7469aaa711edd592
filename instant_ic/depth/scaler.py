"""Scaling of estimated depth to metres by LiDAR ranges (paper, section IV.C); needs only numpy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import NotNegative, Positive, Range, Share, check_ranges
from instant_ic.depth.scale_rules import (
    MIN_VALUES,
    Floats,
    ScaleError,
    consensus_scale,
    max_ratio_scale,
    sector_factors,
)
from instant_ic.depth.visibility import azimuth_problem, hidden, nearest_points, on_depth_edge

METHODS = ("max_ratio", "ransac", "sector", "as_estimated")
OUTPUT_KINDS = ("metric", "scale_invariant")
"""``metric``: metres. ``scale_invariant``: metres up to one factor."""
AGREEMENT = 0.15
"""Largest difference, as a share of the range, at which a point agrees with the depth."""
_CONFIDENCE = 0.995  # quantile used as the maximum, as in the paper
_SECTOR_DEG, _SECTOR_POINTS = 15.0, 30.0  # width of a sector; number of points at which its correction has half weight
_SECTOR_REACH = 0.35  # points off by more than a factor e**0.35 do not count, such as glass, a doorway or an outlier


@dataclass(frozen=True)
class ScalerConfig:
    """Parameters of the scaling of depth.

    Attributes:
        method: sector, ransac, max_ratio (as in the paper) or as_estimated (not for driving).
        output_kind: kind of the model's output, as in its manifest: metric or scale_invariant.
        min_range_m: metres from the camera; nearer points (the robot itself) are left out.
        max_range_m: metres; farther points are left out, and larger depth is set to it.
        min_points: smallest number of points on known depth that gives a scale.
        min_quality: smallest share of points that agree within 15 %; a fit below it is not trusted.
        max_rival: largest number of points that agree with another scale, relative to those of the found scale; above
            it, two scales fit and none is trusted.
        min_scale, max_scale: smallest and largest scale of a trusted fit.
        assumed_sigma: relative standard deviation published for depth that is used as estimated.
    """

    method: str = "sector"
    output_kind: str = "metric"
    min_range_m: NotNegative = 0.4
    max_range_m: Positive = 16.0
    min_points: Annotated[int, Range(MIN_VALUES)] = 300
    min_quality: Share = 0.25
    max_rival: Annotated[float, Range(above=0, high=1)] = 0.7
    min_scale: Positive = 0.05
    max_scale: Positive = 20.0
    assumed_sigma: Annotated[float, Range(above=0, high=1)] = 0.2

    def __post_init__(self) -> None:
        for key, allowed in (("method", METHODS), ("output_kind", OUTPUT_KINDS)):
            if getattr(self, key) not in allowed:
                raise ValueError(f"{key} must be one of {', '.join(allowed)} (got {getattr(self, key)!r})")
        check_ranges(self)
        if not self.min_range_m < self.max_range_m:
            raise ValueError(f"min_range_m must be below max_range_m (got {self.min_range_m}, {self.max_range_m})")
        if not self.min_scale < self.max_scale:
            raise ValueError(f"min_scale must be below max_scale (got {self.min_scale}, {self.max_scale})")
        if self.method == "as_estimated" and self.output_kind != "metric":
            raise ValueError(f"method as_estimated needs output_kind metric (got {self.output_kind!r})")


@dataclass(frozen=True)
class ScaleFit:
    """Result of a fit.

    Attributes:
        ok: True if ``depth_m`` can be trusted; otherwise ``message`` says why not.
        scale: metres per unit of depth, for the whole image.
        depth_m: scaled radial depth in metres, (H, W) float32; 0 is unknown.
        quality: share of points whose range agrees with the scaled depth, 0 to 1.
        relative_sigma: robust standard deviation of (depth - range) / range; inf if nothing was compared.
        points: number of points compared.
        message: text for the operator.
    """

    ok: bool
    scale: float
    depth_m: NDArray[np.float32]
    quality: float
    relative_sigma: float
    points: int
    message: str


class DepthScaler:
    """Fit of estimated depth to simultaneous LiDAR points."""

    def __init__(self, config: ScalerConfig | None = None) -> None:
        self.config = config or ScalerConfig()

    def fit(self, depth: Floats, points: Floats) -> ScaleFit:
        """Scale one depth image.

        Args:
            depth: estimated radial depth, (H, W); 0 is unknown.
            points: LiDAR points in the camera's frame at the image's time in metres, (N, 3).

        Returns:
            The fit. If no scale is found, ``ok`` is false, ``scale`` is 1, and ``depth_m`` is the given depth
            (``metric``) or all unknown (``scale_invariant``).

        Raises:
            ValueError: the arrays have wrong shapes.
        """
        if depth.ndim != 2 or points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"depth must be (H, W) and points (N, 3) (got {depth.shape}, {points.shape})")
        if self.config.method == "as_estimated":
            return self.as_estimated(depth)
        try:
            return self._fit(depth, points)
        except ScaleError as error:
            return self.refuse(depth, str(error))

    def refuse(self, depth: Floats, message: str) -> ScaleFit:
        """Return a fit that is not ok, with the model's depth (H, W) if it is in metres, otherwise all unknown."""
        metric = self.config.output_kind == "metric"
        given = self._clean(depth) if metric else np.zeros(depth.shape, np.float32)
        return ScaleFit(False, 1.0, given, 0.0, float("inf"), 0, message)

    def as_estimated(self, depth: Floats) -> ScaleFit:
        """Return the depth (H, W) of a ``metric`` model as a fit that is ok, without comparing it to the LiDAR."""
        message = "metres as estimated, not compared with the LiDAR (method as_estimated)"
        return ScaleFit(True, 1.0, self._clean(depth), 0.0, self.config.assumed_sigma, 0, message)

    def _fit(self, depth: Floats, points: Floats) -> ScaleFit:
        config = self.config
        rows, columns, range_m = self._visible(points, *depth.shape)
        usable = _is_known(depth[rows, columns])
        self._check_points(int(np.count_nonzero(usable)), "fall on known depth")
        usable &= ~on_depth_edge(depth, rows, columns)
        self._check_points(int(np.count_nonzero(usable)), "fall off the depth's edges")
        rows, columns, range_m = rows[usable], columns[usable], range_m[usable]
        _check_azimuth(columns, depth.shape[1])
        at_points = depth[rows, columns]
        if config.method == "max_ratio":
            scale = max_ratio_scale(at_points, range_m, _CONFIDENCE)
        else:
            scale = consensus_scale(at_points, range_m, AGREEMENT).scale
        metres = np.where(_is_known(depth), scale * depth.astype(np.float64), np.nan)
        if config.method == "sector":
            metres = metres * self._field(metres, rows, columns, range_m)
        scaled = metres[rows, columns]
        error = np.where(np.isfinite(scaled), (scaled - range_m) / range_m, np.inf)
        quality = float((np.abs(error) <= AGREEMENT).mean())
        finite = error[np.isfinite(error)]
        sigma = 1.4826 * float(np.median(np.abs(finite))) if len(finite) else float("inf")
        message = f"scale {scale:.3f}: {quality:.0%} of {len(range_m)} points within {AGREEMENT:.0%}"
        behind = float((error < -1 / 3).mean())
        if behind > 0.15:
            message += f", {behind:.0%} far behind the depth (glass, a mirror, a doorway?)"
        problem = self._problem(scale, quality, scaled, range_m)
        if problem:
            message = f"{problem}; {message}"
        return ScaleFit(not problem, scale, self._clean(metres), quality, sigma, len(range_m), message)

    def _check_points(self, count: int, where: str) -> None:
        if count < self.config.min_points:
            raise ScaleError(f"{count} LiDAR points {where}; {self.config.min_points} are needed")

    def _visible(self, points: Floats, height: int, width: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
        config = self.config
        points = points[np.isfinite(points).all(axis=1)]
        distance = np.linalg.norm(points, axis=1)
        points = points[(distance >= config.min_range_m) & (distance <= config.max_range_m)]
        self._check_points(len(points), f"between {config.min_range_m} and {config.max_range_m} m")
        rows, columns, range_m = nearest_points(points[~hidden(points)], width, height)
        _check_azimuth(columns, width)
        return rows, columns, range_m

    def _field(
        self, metres: Floats, rows: NDArray[np.intp], columns: NDArray[np.intp], range_m: Floats
    ) -> NDArray[np.float32]:
        """Return the correction factor of each direction, (H, W), from points near the scale; it is 1 at the poles."""
        height, width = metres.shape
        ratio = np.log(range_m / metres[rows, columns])
        near = np.abs(ratio) <= _SECTOR_REACH
        azimuth = np.pi - (np.arange(width) + 0.5) * (2 * np.pi / width)
        centres, factors = sector_factors(azimuth[columns[near]], ratio[near], _SECTOR_DEG, _SECTOR_POINTS)
        of_columns = np.interp(azimuth, centres, factors, period=2 * np.pi)
        elevation = np.pi / 2 - (np.arange(height) + 0.5) * (np.pi / height)
        return np.exp(np.cos(elevation)[:, None] * of_columns[None, :]).astype(np.float32)

    def _problem(self, scale: float, quality: float, scaled: Floats, range_m: Floats) -> str:
        """Return the reason for not trusting the fit; empty if it is trusted."""
        config = self.config
        if not config.min_scale <= scale <= config.max_scale:
            return f"scale {scale:.3g} is outside {config.min_scale} to {config.max_scale}"
        if quality < config.min_quality:
            return f"only {quality:.0%} of the points agree; {config.min_quality:.0%} are needed"
        found = consensus_scale(scaled, range_m, AGREEMENT)
        if found.rival_share > config.max_rival * found.share:
            return (
                f"two scales fit: {found.share:.0%} of the points agree with {scale * found.scale:.3g}, "
                f"{found.rival_share:.0%} with {scale * found.rival_scale:.3g}"
            )
        return ""

    def _clean(self, depth: Floats) -> NDArray[np.float32]:
        known = np.isfinite(depth) & (depth > 0)
        return np.where(known, np.minimum(depth, self.config.max_range_m), 0.0).astype(np.float32)


def _check_azimuth(columns: NDArray[np.intp], width: int) -> None:
    if problem := azimuth_problem(columns, width):
        raise ScaleError(problem)


def _is_known(depth: Floats) -> NDArray[np.bool_]:
    return np.isfinite(depth) & (depth > 0)
