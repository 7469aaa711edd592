"""Depth of panoramas against ground truth: each depth source as on the robot, before and after scaling."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.depth.metrics import DepthMetrics, depth_metrics, mean_metrics, solid_angle_weights
from instant_ic.depth.scaler import ScalerConfig
from instant_ic.depth.sources import DepthSource, SourceConfig, complete
from instant_ic.experiments.depth_lidar import Errors, measure
from instant_ic.geometry.projections import equirect_directions, sample_equirect

if TYPE_CHECKING:
    from instant_ic.depth.model import DepthModel

Floats = NDArray[np.floating]
_EDGE = 0.2
"""Relative difference of neighbours above which interpolated depth would lie between two surfaces."""
_UP = np.array([0.0, 0.0, 1.0])


class DepthEvaluationError(ValueError):
    """An image cannot be scored, or the settings contradict each other."""


@dataclass(frozen=True)
class LidarSettings(Errors):
    """The simulated VLP-16 above or below the camera, with its errors; see ``depth_lidar``."""

    height_m: float = 0.6

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.height_m > 0:
            raise DepthEvaluationError(f"the LiDAR's height must be above 0 (got {self.height_m})")


@dataclass(frozen=True)
class DepthSettings:
    """Evaluation settings.

    Attributes:
        source: ``network``, ``lidar``, ``fused`` or ``completed``.
        lidar: simulated LiDAR that measures the ground truth; None: the network's metres are scored unscaled.
        camera_height_m: above the floor.
        method: of the scaler; empty for its default.
    """

    source: str = "fused"
    lidar: LidarSettings | None = None
    camera_height_m: float = 1.2
    method: str = ""

    def __post_init__(self) -> None:
        if self.source != "network" and self.lidar is None:
            raise DepthEvaluationError(f"source {self.source} needs LiDAR points: add --lidar (and --depth)")
        if self.method and self.lidar is None:
            raise DepthEvaluationError("a scaling method needs LiDAR points: add --lidar (and --depth)")
        if self.method and self.source == "lidar":
            raise DepthEvaluationError("source lidar does not scale a network: omit the method")
        if not self.camera_height_m > 0:
            raise DepthEvaluationError(f"the camera's height must be above 0 (got {self.camera_height_m})")


@dataclass(frozen=True)
class Scored:
    """Result for one panorama.

    Attributes:
        name: label for the report.
        rgb: (H, W, 3) uint8 image.
        depth_m: (h, w) float32 result, metres (the model's unit if it was not scaled), 0 = unknown.
        truth_m: (H', W') float32, 0 = unknown; None without ground truth.
        points: (N, 3) LiDAR points in the camera's frame; None without LiDAR.
        before: metrics of the network's metres before scaling; None if the network outputs none, or without ground
            truth.
        after: metrics of the result; None without ground truth. ``weighted`` counts pixels by solid angle; ``shape``
            divides the result by its median ratio to the truth first, which shows the error that no scale can remove.
        sigma_shares: shares of pixels whose error is within one, two and three sigma; None without LiDAR or ground
            truth.
        seconds_model, seconds_source: wall time of the network, and of scaling and fusion; ``cpu_source_s``: CPU time
            of scaling and fusion.
        fit: ``ok``, ``message``, ``scale``, ``shift``, ``quality``, ``relative_sigma``, ``points``; None without LiDAR.
    """

    name: str
    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    truth_m: NDArray[np.float32] | None
    points: NDArray[np.float32] | None
    before: DepthMetrics | None
    after: DepthMetrics | None
    weighted: DepthMetrics | None
    shape: DepthMetrics | None
    sigma_shares: tuple[float, float, float] | None
    seconds_model: float
    seconds_source: float
    cpu_source_s: float
    fit: dict[str, Any] | None

    @property
    def seconds(self) -> float:
        """Time from image (and points) to depth."""
        return self.seconds_model + self.seconds_source

    def as_dict(self) -> dict[str, Any]:
        """Plain values; the metrics after scaling are repeated at the top level."""
        row: dict[str, Any] = {"name": self.name}
        if self.after is not None:
            row |= self.after.as_dict()
        row |= {
            "seconds": round(self.seconds, 4),
            "seconds_model": round(self.seconds_model, 4),
            "seconds_source": round(self.seconds_source, 4),
            "cpu_source_s": round(self.cpu_source_s, 4),
        }
        for key in ("before", "after", "weighted", "shape"):
            metrics: DepthMetrics | None = getattr(self, key)
            row[_KEYS[key]] = metrics.as_dict() if metrics is not None else None
        for index, name in enumerate(("one", "two", "three")):
            row[f"within_{name}_sigma"] = _rounded(self.sigma_shares[index]) if self.sigma_shares else None
        row["fit"] = self.fit
        return row


_KEYS = {"before": "before", "after": "after", "weighted": "after_by_solid_angle", "shape": "after_best_scale"}


class Evaluator:
    """Scores panoramas one by one with the same settings.

    Args:
        settings: of the evaluation.
        model: the network that sees the image alone; None for ``lidar``.
        completion: of ``completed``.

    Raises:
        DepthEvaluationError: the settings need a model, or a different one.
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
        if settings.method:
            scaler = replace(scaler, method=settings.method)
        self.source = DepthSource(SourceConfig(source=settings.source, scaler=scaler))
        self._warm = False

    def score(self, name: str, rgb: NDArray[np.uint8], truth_m: Floats | None, points: Floats | None = None) -> Scored:
        """Score the depth of a level panorama against ground truth.

        ``rgb`` is (H, W, 3) uint8; ``truth_m`` is the radial depth (H', W') in metres, 0 = unknown. Scores are computed
        at the ground truth's pixels. A result of another size is interpolated there, bilinear in inverse depth and with
        the nearest pixel at edges. ``points`` (N, 3) in the camera's frame replace the simulated LiDAR measurement.

        Raises:
            DepthEvaluationError: not a panorama, nothing to compare, or LiDAR without ground truth to measure.
        """
        settings = self.settings
        for what, array in (("picture", rgb), ("true depth", truth_m)):
            if array is not None and abs(array.shape[1] - 2 * array.shape[0]) > 0.02 * array.shape[1]:
                raise DepthEvaluationError(
                    f"{name}: the {what} is {array.shape[1]} x {array.shape[0]}, a 360° panorama is 2:1"
                )
        truth = None
        if truth_m is not None:
            known = np.isfinite(truth_m) & (truth_m > 0)
            truth = np.where(known, truth_m, 0).astype(np.float32)
            if not known.any():
                raise DepthEvaluationError(f"{name}: the ground truth has no valid pixel")
        if settings.lidar is not None and points is None:
            if truth is None:
                raise DepthEvaluationError(f"{name}: the simulated LiDAR needs ground-truth depth")
            points = measure(truth, settings.lidar.height_m, settings.camera_height_m, settings.lidar)
        if self.model is not None and not self._warm:
            self.model.estimate(rgb)  # warm-up: the first run allocates memory
            self._warm = True
        begin = time.perf_counter()
        raw = self.model.estimate(rgb) if self.model is not None else None
        between, cpu_s = time.perf_counter(), time.process_time()
        sigma = fit = None
        if settings.lidar is None:
            assert raw is not None  # ensured by __init__ and DepthSettings: only the network works without LiDAR
            depth = raw
        else:
            assert points is not None
            result = self.source.estimate(raw, points, _UP, settings.camera_height_m)
            if self.completion is not None:
                result = complete(result, partial(self.completion.complete, rgb))
            depth, sigma = result.depth_m, result.sigma
            keys = ("ok", "message", "scale", "shift", "quality", "relative_sigma", "points")
            fit = {key: _rounded(getattr(result, key)) for key in keys}
        end, cpu_s = time.perf_counter(), time.process_time() - cpu_s
        before = after = weighted = shape = shares = None
        if truth is not None:
            at_truth = look_up(depth, truth.shape)
            after = depth_metrics(at_truth, truth, known)
            weighted = depth_metrics(at_truth, truth, known, solid_angle_weights(len(truth))[:, None])
            ratio = at_truth[known & (at_truth > 0)] / truth[known & (at_truth > 0)]
            shape = depth_metrics(at_truth / np.median(ratio) if len(ratio) else at_truth, truth, known)
            if raw is not None and self.model is not None and self.model.manifest.output_kind == "metric":
                before = depth_metrics(look_up(raw, truth.shape), truth, known)
            if sigma is not None:
                shares = _within_sigma(depth, sigma, nearest(truth, depth.shape))
        return Scored(
            name, rgb, depth, truth, None if points is None else points.astype(np.float32), before, after, weighted,
            shape, shares, between - begin, end - between, cpu_s, fit,
        )  # fmt: skip


def look_up(depth: Floats, size: tuple[int, ...]) -> NDArray[np.float32]:
    """Resample equirect depth to (H, W): planes stay planes, and edges stay sharp."""
    if depth.shape == size:
        return depth.astype(np.float32)
    inverse = np.where(depth > 0, 1.0 / np.where(depth > 0, depth, 1.0), 0.0)
    around = np.pad(inverse, 1, mode="edge")
    around[1:-1, 0], around[1:-1, -1] = inverse[:, -1], inverse[:, 0]
    views = np.lib.stride_tricks.sliding_window_view(around, (3, 3))
    smooth = views.min(axis=(2, 3)) > (1 - _EDGE) * views.max(axis=(2, 3))
    between = sample_equirect(inverse, equirect_directions(size[1], size[0]))
    use = nearest(smooth, size)
    return np.where(use, 1.0 / np.where(use, between, 1.0), nearest(depth, size)).astype(np.float32)


def nearest(values: NDArray[Any], size: tuple[int, ...]) -> NDArray[Any]:
    """Resample an equirect array to (H, W) by the nearest pixel."""
    rows, columns = (
        ((np.arange(n) + 0.5) * old / n).astype(np.intp) for n, old in zip(size, values.shape, strict=True)
    )
    return values[np.ix_(rows, columns)]


def _within_sigma(depth: Floats, sigma: Floats, truth: Floats) -> tuple[float, float, float] | None:
    known = (truth > 0) & (depth > 0) & np.isfinite(sigma)
    if not known.any():
        return None
    ratio = np.abs(depth[known] - truth[known]) / (sigma[known] * truth[known])
    return float((ratio <= 1).mean()), float((ratio <= 2).mean()), float((ratio <= 3).mean())


def report(scored: Sequence[dict[str, Any]], settings: DepthSettings, model: DepthModel | None) -> dict[str, Any]:
    """``Scored.as_dict`` of panoramas with their means: ``mean`` (after scaling), ``before`` and ``after``."""
    means = {key: _mean([row[key] for row in scored if row.get(key)]) for key in _KEYS.values()}
    mean: dict[str, Any] = dict(means["after"] or {})
    for key in ("seconds", "seconds_model", "seconds_source"):
        if scored:
            mean[key] = round(float(np.mean([row[key] for row in scored])), 4)
    errors = [row["scale_error_median"] for row in scored if "scale_error_median" in row]
    shares = [row["within_one_sigma"] for row in scored if row["within_one_sigma"] is not None]
    return {
        "model": model.manifest.name if model else None,
        "provider": model.provider if model else None,
        "source": settings.source,
        "method": settings.method or (ScalerConfig().method if settings.lidar and model else None),
        "lidar": asdict(settings.lidar) if settings.lidar else None,
        "camera_height_m": settings.camera_height_m,
        "count": len(scored),
        "fits_ok": sum(bool(row["fit"]["ok"]) for row in scored) if settings.lidar else None,
        "mean": mean,
        **means,
        "scale_error": {
            "median": _rounded(float(np.median(errors))), "p95": _rounded(float(np.quantile(errors, 0.95)))
        } if errors else None,
        "within_one_sigma": _rounded(float(np.mean(shares))) if shares else None,
        "images": list(scored),
    }  # fmt: skip


def _mean(rows: Sequence[dict[str, Any]]) -> dict[str, float] | None:
    return mean_metrics([DepthMetrics(**row) for row in rows]).as_dict() if rows else None


def _rounded(value: Any) -> Any:
    """Round numbers for JSON to five decimals, and replace infinity."""
    if isinstance(value, float | np.floating):
        return round(float(value), 5) if np.isfinite(value) else None
    return value
