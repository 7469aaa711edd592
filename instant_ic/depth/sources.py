"""Sources of depth: the network scaled by the LiDAR, the LiDAR alone, or the fusion of both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import check_ranges
from instant_ic.depth.completion import prior_channels
from instant_ic.depth.fusion import Corrected, ceiling_height, correct, likely_ceiling
from instant_ic.depth.lidar_depth import LidarDepth, LidarDepthConfig, LidarStructure, Origin
from instant_ic.depth.manifest import InferenceError
from instant_ic.depth.scaler import AGREEMENT, DepthScaler, ScaleFit, ScalerConfig
from instant_ic.depth.visibility import nearest_points
from instant_ic.geometry.projections import rays_of
from instant_ic.mapping import kernels
from instant_ic.mapping.mapper import LocalView

Floats = NDArray[np.floating]
Complete = Callable[[NDArray[np.float32]], tuple[NDArray[np.float32], NDArray[np.float32]]]
"""Completion of an image's depth: channels of ``depth.completion``, (6, H, W) → depth in metres and relative sigma."""
SOURCES = ("network", "lidar", "fused", "completed")
# Surfaces that count as measured by the LiDAR, including continued upright surfaces and a level ceiling.
_MEASURED = (Origin.BEAM, Origin.BETWEEN, Origin.UP, Origin.DOWN, Origin.CEILING)
_MEASURED_KINDS = (kernels.MEASURED, kernels.BETWEEN, kernels.UP, kernels.DOWN, kernels.CEILING)


@dataclass(frozen=True)
class FusionTuning:
    """Tuning of the fusion.

    Attributes:
        floor_sigma: relative standard deviation of the floor's depth under the robot, because the camera's height is
            known to centimetres.
        network_sigma: relative standard deviation of the network's depth where nothing was measured, fitted on
            simulated rooms.
        moved: share of the depth by which a point must be nearer than the local model to belong to a new object.
        least_change: smallest relative change that a completion may make; smaller changes bend flat surfaces.
        least_area: smallest width and height of such a change, in pixels; narrower changes are blur along edges.
    """

    floor_sigma: float = 0.02
    network_sigma: float = 0.58
    moved: float = 0.15
    least_change: float = 0.1
    least_area: int = 7


TUNING = FusionTuning()


@dataclass(frozen=True)
class SourceConfig:
    """Source of depth and its parameters.

    Attributes:
        source: ``fused``: LiDAR and network; ``lidar``: LiDAR only; ``network``: network scaled by the LiDAR;
            ``completed``: ``fused``, corrected by a completion model.
        scaler: parameters of the scaling of the network's depth.
        lidar: parameters of depth from points alone.
    """

    source: str = "fused"
    scaler: ScalerConfig = field(default_factory=ScalerConfig)
    lidar: LidarDepthConfig = field(default_factory=LidarDepthConfig)

    def __post_init__(self) -> None:
        if self.source not in SOURCES:
            raise ValueError(f"source must be one of {', '.join(SOURCES)} (got {self.source!r})")
        check_ranges(self)


@dataclass(frozen=True)
class Prior:
    """Input of a completion, and the pixels that the completion may not change.

    Attributes:
        channels: result of ``depth.completion.prior_channels``, (6, H, W).
        free_m: distance in metres up to which space is free, (H, W).
        measured: pixels whose depth the LiDAR has measured, (H, W).
        robot: pixels that show the robot itself, (H, W).
    """

    channels: NDArray[np.float32]
    free_m: NDArray[np.float32]
    measured: NDArray[np.bool_]
    robot: NDArray[np.bool_]


@dataclass(frozen=True)
class DepthResult(ScaleFit):
    """Depth of one image.

    ``scale`` is the network's, and 1 for ``lidar``. ``quality`` is the share of points whose range agrees with the
    scaled network before the fusion, and shows how well image and LiDAR match. For ``lidar`` the points are compared
    with ``depth_m``, which has no isolated points. ``relative_sigma`` is the median of ``sigma`` where it is known.

    Attributes:
        sigma: relative standard deviation, (H, W) float32; inf is unknown.
        source: source of ``depth_m``.
        prior: input of :func:`complete`; None unless the source is ``completed`` and the result is ok.
    """

    sigma: NDArray[np.float32]
    source: str
    prior: Prior | None = None

    def figures(self) -> dict[str, float | str]:
        """Return rounded values for a diagnosis."""
        return {
            "scale": round(self.scale, 4),
            "quality": round(self.quality, 3),
            "points": self.points,
            "source": self.source,
            "sigma": round(self.relative_sigma, 4),
        }


@dataclass(frozen=True)
class _Built:
    """Depth without a network.

    ``free_m`` is the distance up to which unknown pixels are free. ``structure`` is that of the revolution, and
    ``ceiling_m`` that of the local model.
    """

    depth_m: NDArray[np.float32]
    sigma: NDArray[np.float32]
    free_m: NDArray[np.float32]
    measured: NDArray[np.bool_]
    structure: LidarDepth
    ceiling_m: float | None


class DepthSource:
    """Computation of depth from the network's estimate, simultaneous LiDAR points and the local model."""

    def __init__(self, config: SourceConfig | None = None) -> None:
        self.configure(config or SourceConfig())

    def configure(self, config: SourceConfig) -> None:
        """Apply new parameters."""
        self.config = config
        self.scaler = DepthScaler(config.scaler)
        self.structure = LidarStructure(config.lidar)

    def estimate(
        self,
        raw: Floats | None,
        points: Floats,
        up: Floats,
        camera_height_m: float | None,
        size: tuple[int, int] = (256, 512),
        local: LocalView | None = None,
    ) -> DepthResult:
        """Compute the depth of one image.

        ``fused`` and ``lidar`` use the local model first, then the structure of this revolution. In ``fused`` the
        network fills only pixels that both leave unknown.

        Args:
            raw: the network's depth in its own unit, (H, W); 0 is unknown. None only for ``lidar``.
            points: LiDAR points in the camera's frame at the image's time in metres, (N, 3).
            up: up direction (against gravity) in the camera's frame, (3,).
            camera_height_m: height of the camera over the floor; None if unknown.
            size: height and width of the result if ``raw`` is None; otherwise the result has the size of ``raw``.
            local: the local model, seen from the camera.

        Raises:
            ValueError: arrays have wrong shapes, or ``raw`` is None and the source needs it.
        """
        config = self.config
        if config.source == "lidar":
            size = raw.shape if raw is not None else size
            return self._lidar(points, up, camera_height_m, size, local)
        if raw is None:
            raise ValueError(f"source {config.source} needs the network's depth")
        fit = self.scaler.fit(raw, points)
        if config.source == "network" or config.scaler.method == "as_estimated":
            return _of_fit(fit)
        network, top = self.network(fit, points, up, camera_height_m)
        built = self._built(points, up, camera_height_m, fit.depth_m.shape, local, top)
        if not fit.ok or built.structure.message:
            return self._unfit(fit, built)
        result = self._fused(fit, network, built)
        if config.source != "completed":
            return result
        ranges = self.structure.ranges(points, result.depth_m.shape)
        channels = prior_channels(result.depth_m, result.sigma, ranges, up, camera_height_m, network.depth_m)
        robot = np.zeros(result.depth_m.shape, bool)
        return replace(result, prior=Prior(channels, built.free_m, built.measured, robot))

    def _unfit(self, fit: ScaleFit, built: _Built) -> DepthResult:
        """Return the LiDAR's depth as unfit, because LiDAR and network disagree and the LiDAR is more often right."""
        result, known = _of_fit(fit), built.depth_m > 0
        return replace(
            result,
            depth_m=np.where(known, built.depth_m, fit.depth_m),
            sigma=np.where(known, built.sigma, result.sigma),
            ok=False,
            message=built.structure.message if fit.ok else fit.message,
            source=self.config.source,
        )

    def _fused(self, fit: ScaleFit, network: Corrected, built: _Built) -> DepthResult:
        """Fill pixels that the LiDAR leaves unknown with the network's depth, but never nearer than free space."""
        known = built.depth_m > 0
        guess = np.maximum(network.depth_m, built.free_m)
        depth = np.where(known, built.depth_m, guess)
        sigma = np.where(known, built.sigma, np.where(guess > 0, np.float32(TUNING.network_sigma), np.float32(np.inf)))
        message = f"{fit.message}; {_surfaces(built)}"
        return replace(
            _of_fit(fit), depth_m=depth, sigma=sigma, relative_sigma=_median(sigma), message=message,
            source=self.config.source,
        )  # fmt: skip

    def refuse(self, raw: Floats | None, message: str, size: tuple[int, int] = (256, 512)) -> DepthResult:
        """Return an unfit result for an image without points: ``raw`` if it is in metres, otherwise all unknown."""
        if raw is not None:
            return replace(_of_fit(self.scaler.refuse(raw, message)), source=self.config.source)
        fit = ScaleFit(False, 1.0, np.zeros(size, np.float32), 0.0, float("inf"), 0, message)
        return DepthResult(**vars(fit), sigma=np.full(size, np.inf, np.float32), source=self.config.source)

    def network(
        self, fit: ScaleFit, points: Floats, up: Floats, camera_height_m: float | None
    ) -> tuple[Corrected, float | None]:
        """Correct the scaled network by the points. Return it with the height of its ceiling over the camera."""
        size = fit.depth_m.shape
        network = correct(fit.depth_m, self.structure.ranges(points, size))
        top = ceiling_height(network.depth_m, rays_of(size) @ np.asarray(up, np.float32))
        if top is not None and camera_height_m is not None:
            usual = max(self.config.lidar.ceiling_height_m - camera_height_m, 0.3)
            top = likely_ceiling(top, network, usual)
        return network, top

    def _built(
        self, points: Floats, up: Floats, camera_height_m: float | None, size: tuple[int, int],
        local: LocalView | None, top: float | None,
    ) -> _Built:  # fmt: skip
        """Build depth without a network: local model, then this revolution's structure with a ceiling at ``top``."""
        seen = None if local is None else local.ceiling_m
        structure = self.structure.estimate(points, up, camera_height_m, size, top if seen is None else seen)
        depth, sigma, free = structure.depth_m, structure.sigma, np.zeros(size, np.float32)
        measured = np.isin(structure.origin, _MEASURED)
        if local is not None and not structure.message:
            ceiling = structure.ceiling_height_m if structure.ceiling_height_m is not None else top
            if ceiling is None and camera_height_m is not None:
                ceiling = self.config.lidar.ceiling_height_m - camera_height_m
            modelled = local.render(size, ceiling)
            # Points of this revolution that are clearly nearer than the local model belong to new objects.
            hit = (structure.origin == Origin.BEAM) | (structure.origin == Origin.BETWEEN)
            come = hit & (depth < (1 - TUNING.moved) * modelled.depth_m)
            known = (modelled.depth_m > 0) & ~come
            # Discard surfaces that the structure assumes in space through which beams have passed.
            refuted = ~known & ~hit & (depth < modelled.free_m)
            depth = np.where(known, modelled.depth_m, np.where(refuted, np.float32(0), depth))
            sigma = np.where(known, modelled.sigma, np.where(refuted, np.float32(np.inf), sigma))
            free = np.where(refuted, modelled.free_m, free)
            measured = np.where(known, np.isin(modelled.kind, _MEASURED_KINDS), measured & ~refuted)
        return _Built(depth, sigma, free, measured, structure, seen)

    def _lidar(
        self, points: Floats, up: Floats, camera_height_m: float | None, size: tuple[int, int], local: LocalView | None
    ) -> DepthResult:
        built = self._built(points, up, camera_height_m, size, local, None)
        quality = agreement(built.depth_m, points, self.config.scaler)
        message = f"LiDAR only: {quality:.0%} of {built.structure.points} points on the surfaces; {_surfaces(built)}"
        return DepthResult(
            depth_m=built.depth_m,
            sigma=built.sigma,
            ok=not built.structure.message,
            scale=1.0,
            quality=quality,
            relative_sigma=_median(built.sigma),
            points=built.structure.points,
            message=built.structure.message or message,
            source="lidar",
        )


def complete(result: DepthResult, completion: Complete) -> DepthResult:
    """Correct a result of the source ``completed``. The function has no other state, so any thread may call it.

    The completion changes the floor and assumed or estimated surfaces where it clearly contradicts them over an area,
    but never to nearer than free space. Measured surfaces do not change, because the LiDAR is better there and the
    completion bends pillars and lowers bare ceilings. Without a prior, or if the completion fails, the result does not
    change. The message then gives the reason.
    """
    prior = result.prior
    if prior is None:
        return result
    result = replace(result, prior=None)
    try:
        found_m, found_sigma = completion(prior.channels)
        if found_m.shape != result.depth_m.shape:
            raise ValueError(f"the completion is {found_m.shape}, the depth {result.depth_m.shape}")
    except (InferenceError, ValueError) as error:
        return replace(result, message=f"{result.message}; not completed ({error})")
    taken = np.isfinite(found_m) & (found_m > 0) & np.isfinite(found_sigma) & ~prior.measured & ~prior.robot
    taken = _areas(taken & _contradicts(found_m, prior.channels[0]))
    depth = np.where(taken, np.maximum(found_m, prior.free_m), result.depth_m).astype(np.float32)
    sigma = np.where(taken, found_sigma, result.sigma).astype(np.float32)
    message = f"{result.message}; completed"
    return replace(result, depth_m=depth, sigma=sigma, relative_sigma=_median(sigma), message=message)


def _contradicts(found_m: Floats, prior_m: Floats) -> NDArray[np.bool_]:
    """Return the pixels at which two depths (H, W) clearly differ, or the prior is unknown."""
    known = (prior_m > 0) & (found_m > 0)
    change = np.abs(np.log(np.where(known, found_m, 1) / np.where(known, prior_m, 1)))
    return ~known | (change > TUNING.least_change)


def _areas(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a panorama's mask (H, W) without its narrow parts."""
    width = TUNING.least_area
    around = np.pad(mask.astype(np.uint8), ((0, 0), (width, width)), mode="wrap")
    return cv2.morphologyEx(around, cv2.MORPH_OPEN, np.ones((width, width), np.uint8))[:, width:-width] > 0


def without_body(result: DepthResult, up: Floats, camera_height_m: float | None, elevation_deg: float) -> DepthResult:
    """Replace the robot itself, which the image shows below an elevation, by floor.

    Args:
        result: depth of the image.
        up: up direction (against gravity) in the camera's frame, (3,).
        camera_height_m: height of the camera over the floor; None leaves masked pixels unknown.
        elevation_deg: elevation below which the image shows the robot; -90 masks nothing.
    """
    rise = rays_of(result.depth_m.shape) @ np.asarray(up, np.float32)
    body = rise < np.sin(np.radians(elevation_deg))
    if elevation_deg <= -90 or not body.any():
        return result
    depth, sigma = result.depth_m.copy(), result.sigma.copy()
    depth[body] = 0 if camera_height_m is None else -camera_height_m / rise[body]
    sigma[body] = np.inf if camera_height_m is None else TUNING.floor_sigma
    prior = None if result.prior is None else replace(result.prior, robot=body)
    return replace(result, depth_m=depth, sigma=sigma, prior=prior)


def agreement(depth_m: Floats, points: Floats, config: ScalerConfig) -> float:
    """Return the share of points (N, 3) that agree with the depth (H, W) at their pixels within ``AGREEMENT``."""
    points = points[np.isfinite(points).all(axis=1)]
    rows, columns, range_m = nearest_points(points, depth_m.shape[1], depth_m.shape[0])
    inside = (range_m >= config.min_range_m) & (range_m <= config.max_range_m)
    rows, columns, range_m = rows[inside], columns[inside], range_m[inside]
    if len(rows) == 0:
        return 0.0
    return float((np.abs(depth_m[rows, columns] - range_m) <= AGREEMENT * range_m).mean())


def _surfaces(built: _Built) -> str:
    ceiling = built.structure.ceiling_height_m if built.ceiling_m is None else built.ceiling_m
    return f"floor {_metres(built.structure.camera_height_m)}, ceiling {_metres(ceiling)}"


def _metres(height: float | None) -> str:
    return "not seen" if height is None else f"{height:.2f} m"


def _median(sigma: Floats) -> float:
    known = sigma[np.isfinite(sigma)]
    return float(np.median(known)) if len(known) else float("inf")


def _of_fit(fit: ScaleFit) -> DepthResult:
    sigma = np.where(fit.depth_m > 0, np.float32(fit.relative_sigma), np.float32(np.inf)).astype(np.float32)
    return DepthResult(**vars(fit), sigma=sigma, source="network")
