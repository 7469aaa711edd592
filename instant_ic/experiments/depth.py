"""Depth of panoramas against ground truth: each depth source as on the robot, before and after scaling."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.depth.metrics import DepthMetrics, depth_metrics, mean_metrics
from instant_ic.depth.scaler import ScalerConfig
from instant_ic.depth.sources import DepthSource, SourceConfig, complete
from instant_ic.experiments.depth_lidar import RangeErrors, measure

if TYPE_CHECKING:
    from instant_ic.depth.model import DepthModel

Floats = NDArray[np.floating]
_UP = np.array([0.0, 0.0, 1.0])


class DepthEvaluationError(ValueError):
    """An image cannot be scored, a file has no partner, or the settings contradict each other."""


@dataclass(frozen=True)
class LidarSettings(RangeErrors):
    """The simulated VLP-16 above or below the camera, with its errors.

    Attributes:
        height_m: height above the floor.
    """

    height_m: float = 0.6

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.height_m > 0:
            raise DepthEvaluationError(f"the LiDAR's height must be above 0 (got {self.height_m})")


@dataclass(frozen=True)
class DepthSettings:
    """Settings of an evaluation.

    Attributes:
        source: ``network``, ``lidar``, ``fused`` or ``completed``.
        lidar: simulated LiDAR that measures the ground truth; None: the network's metres are scored unscaled.
        camera_height_m: height above the floor.
    """

    source: str = "fused"
    lidar: LidarSettings | None = None
    camera_height_m: float = 1.2

    def __post_init__(self) -> None:
        if self.source != "network" and self.lidar is None:
            raise DepthEvaluationError(f"source {self.source} needs LiDAR points: give --depth and --lidar too")
        if not self.camera_height_m > 0:
            raise DepthEvaluationError(f"the camera's height must be above 0 (got {self.camera_height_m})")


@dataclass(frozen=True)
class Scored:
    """Result for one panorama.

    Attributes:
        name: label for the report.
        rgb: image, (H, W, 3) uint8.
        depth_m: result in metres (the model's unit if it was not scaled), (h, w) float32; 0 is unknown.
        truth_m: true depth, (H', W') float32; 0 is unknown; None without ground truth.
        before: metrics of the network's metres before scaling; None if its depth is relative, or without ground truth.
        after: metrics of the result; None without ground truth.
        within_sigma: share of pixels with an error within one sigma; None without LiDAR or truth.
        seconds: wall time of network, scaling and fusion.
        fit: ``ok``, ``message``, ``scale``, ``quality``, ``relative_sigma`` and ``points`` of the scaling;
            None without LiDAR.
    """

    name: str
    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    truth_m: NDArray[np.float32] | None
    before: DepthMetrics | None
    after: DepthMetrics | None
    within_sigma: float | None
    seconds: float
    fit: dict[str, Any] | None

    def as_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "name": self.name,
            "seconds": round(self.seconds, 4),
            "before": self.before.as_dict() if self.before else None,
            "after": self.after.as_dict() if self.after else None,
            "within_one_sigma": _rounded(self.within_sigma),
            "fit": self.fit,
        }


class Evaluator:
    """Depth source that is scored on panoramas one by one.

    Args:
        settings: settings of the evaluation.
        model: network that sees the image alone; None for source ``lidar``.
        completion: network of source ``completed``.

    Raises:
        DepthEvaluationError: the model is missing, or does not fit the settings.
    """

    def __init__(self, settings: DepthSettings, model: DepthModel | None, completion: DepthModel | None = None) -> None:
        self.settings, self.completion = settings, completion
        self.model = model if settings.source != "lidar" else None
        if self.model is None and settings.source != "lidar":
            raise DepthEvaluationError(f"source {settings.source} needs a model")
        if settings.source == "completed" and (completion is None or not completion.manifest.prior_input):
            raise DepthEvaluationError("source completed needs a completion: give a model of ic depth train")
        if self.model is not None and self.model.manifest.prior_input:
            raise DepthEvaluationError(f"{self.model.manifest.name} is a completion: use it with source completed")
        kind = self.model.manifest.output_kind if self.model else "metric"
        if kind != "metric" and settings.lidar is None:
            raise DepthEvaluationError(f"the model's depth is {kind}: metres come only from LiDAR, add --lidar")
        scaler = replace(ScalerConfig(), output_kind=kind)
        self.source = DepthSource(SourceConfig(source=settings.source, scaler=scaler))
        self._warm = False

    def score(self, name: str, rgb: NDArray[np.uint8], truth_m: Floats | None) -> Scored:
        """Score the depth of a level panorama.

        Metrics are computed at the pixels of the estimate, with the nearest pixels of the ground truth.

        Args:
            name: label for the report.
            rgb: panorama, (H, 2 H, 3).
            truth_m: true radial depth in metres, (H', 2 H'); 0 is unknown; None: no comparison.

        Raises:
            DepthEvaluationError: the image is not a panorama, no pixel can be compared, or the simulated LiDAR has no
                ground truth to measure.
        """
        _check_panorama(name, "image", rgb)
        truth = None if truth_m is None else _known_depth(name, truth_m)
        settings, points = self.settings, None
        if settings.lidar is not None:
            if truth is None:
                raise DepthEvaluationError(f"{name}: the simulated LiDAR needs ground-truth depth")
            points = measure(truth, settings.lidar.height_m, settings.camera_height_m, settings.lidar)
        if self.model is not None and not self._warm:
            self.model.estimate(rgb)  # the first run allocates memory
            self._warm = True
        begin = time.perf_counter()
        raw = self.model.estimate(rgb) if self.model is not None else None
        depth, sigma, fit = self._depth(rgb, raw, points)
        seconds = time.perf_counter() - begin
        before = after = share = None
        if truth is not None:
            own = nearest(truth, depth.shape)
            after = depth_metrics(depth, own, own > 0)
            if raw is not None and self.model is not None and self.model.manifest.output_kind == "metric":
                own_raw = nearest(truth, raw.shape)
                before = depth_metrics(raw, own_raw, own_raw > 0)
            if sigma is not None:
                share = _within_sigma(depth, sigma, own)
        return Scored(name, rgb, depth, truth, before, after, share, seconds, fit)

    def _depth(
        self, rgb: NDArray[np.uint8], raw: NDArray[np.float32] | None, points: Floats | None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None, dict[str, Any] | None]:
        """Return depth, sigma and fit of the source, from the network's depth and the LiDAR's points."""
        if points is None:
            assert raw is not None  # ensured by DepthSettings: only the network works without LiDAR
            return raw, None, None
        result = self.source.estimate(raw, points, _UP, self.settings.camera_height_m)
        if self.completion is not None:
            result = complete(result, partial(self.completion.complete, rgb))
        keys = ("ok", "message", "scale", "quality", "relative_sigma", "points")
        return result.depth_m, result.sigma, {key: _rounded(getattr(result, key)) for key in keys}


def _check_panorama(name: str, what: str, array: NDArray[Any]) -> None:
    height, width = array.shape[:2]
    if abs(width - 2 * height) > 0.02 * width:
        raise DepthEvaluationError(f"{name}: the {what} is {width} x {height}, a 360° panorama is 2:1")


def _known_depth(name: str, truth_m: Floats) -> NDArray[np.float32]:
    """Return true depth with 0 for unknown pixels."""
    _check_panorama(name, "true depth", truth_m)
    truth = np.where(np.isfinite(truth_m) & (truth_m > 0), truth_m, 0).astype(np.float32)
    if not truth.any():
        raise DepthEvaluationError(f"{name}: the ground truth has no valid pixel")
    return truth


def nearest(values: NDArray[Any], size: tuple[int, ...]) -> NDArray[Any]:
    """Resample an equirect array to (H, W) by the nearest pixel."""
    rows, columns = (
        ((np.arange(n) + 0.5) * old / n).astype(np.intp) for n, old in zip(size, values.shape, strict=True)
    )
    return values[np.ix_(rows, columns)]


def _within_sigma(depth: Floats, sigma: Floats, truth: Floats) -> float | None:
    known = (truth > 0) & (depth > 0) & np.isfinite(sigma)
    if not known.any():
        return None
    error = np.abs(depth[known] - truth[known])
    return float((error <= sigma[known] * truth[known]).mean())


def report(scored: Sequence[dict[str, Any]], settings: DepthSettings, model: DepthModel | None) -> dict[str, Any]:
    """Summarise ``Scored.as_dict`` of panoramas: means before and after scaling, and each image."""
    shares = [row["within_one_sigma"] for row in scored if row["within_one_sigma"] is not None]
    return {
        "model": model.manifest.name if model else None,
        "provider": model.provider if model else None,
        "source": settings.source,
        "lidar": asdict(settings.lidar) if settings.lidar else None,
        "camera_height_m": settings.camera_height_m,
        "count": len(scored),
        "fits_ok": sum(bool(row["fit"]["ok"]) for row in scored) if settings.lidar else None,
        "seconds": round(float(np.mean([row["seconds"] for row in scored])), 4) if scored else None,
        "before": _mean([row["before"] for row in scored if row["before"]]),
        "after": _mean([row["after"] for row in scored if row["after"]]),
        "within_one_sigma": _rounded(float(np.mean(shares))) if shares else None,
        "images": list(scored),
    }


def _mean(rows: Sequence[dict[str, Any]]) -> dict[str, float] | None:
    return mean_metrics([DepthMetrics(**row) for row in rows]).as_dict() if rows else None


def _rounded(value: Any) -> Any:
    """Round numbers for JSON to five decimals, and replace infinity by None."""
    if isinstance(value, float | np.floating):
        return round(float(value), 5) if np.isfinite(value) else None
    return value


def pair(images: Sequence[Path], truths: Sequence[Path]) -> list[tuple[Path, Path | None]]:
    """Pair images and depth files in their order, or each image with None.

    Raises:
        DepthEvaluationError: the numbers of files differ, or the stems of a pair (apart from ``_rgb`` and ``_depth``).
    """
    if not truths:
        return [(image, None) for image in images]
    if len(images) != len(truths):
        raise DepthEvaluationError(
            f"{len(images)} images and {len(truths)} depth files: give one for each image, in the same order"
        )
    for image, truth in zip(images, truths, strict=True):
        if len(images) > 1 and image.stem.removesuffix("_rgb") != truth.stem.removesuffix("_depth"):
            raise DepthEvaluationError(
                f"{image.name} and {truth.name} have different stems: are they in the same order?"
            )
    return list(zip(images, truths, strict=True))
