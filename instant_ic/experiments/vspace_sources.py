"""Sources of views: each renders a place from any pose, prepared from one keyframe."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.scan import ScanQuality, aged, scan_world
from instant_ic.experiments.worlds import CAMERA_HEIGHT_M, LIDAR_HEIGHT_M

if TYPE_CHECKING:
    from instant_ic.depth.model import DepthModel
    from instant_ic.depth.sources import DepthResult
    from instant_ic.sim.render import EquirectRenderer
    from instant_ic.sim.worlds import World
    from instant_ic.vspace import VirtualSpaceConfig

PATHS = ("straight", "curve")
SOURCES = {
    "ours": "depth of the shipped model scaled by the LiDAR, field trained from it",
    "true-depth": "the same with the world's own depth: the ceiling",
    "no-depth": "field trained from colours alone (paper: -depth)",
    "no-scale": "the model's depth as it comes, not scaled (paper: -scale)",
    "fill": "ours (or paper), and the truth where no keyframe has seen the place",
    "exact-fill": "true depth, and the truth where no keyframe has seen the place",
    "slam-pose": "ours (or paper), seen from the poses that SLAM estimates on the way",
    "paper": "the paper's choices: density field alone, six cube faces, depth scaled by the 99.5 % maxima",
    "paper-no-scale": "the same, depth not scaled",
    "panorama": "the panorama turned, without depth",
    "depth-warp": "the panorama warped by the depth of `ours`, as a mesh",
    "mesh": "conventional IC with a perfect scan: exact geometry, obstacle not there yet, colours fitted",
    "tripod": "conventional IC with a real scan of a tripod scanner",
}
FILLED = ("fill", "exact-fill")
"""Sources that show the truth where no keyframe has seen the place."""
RECORDED = ("ours", "no-depth", "depth-warp", "panorama", "fill")
"""Sources that need no simulated world."""
RgbImage: TypeAlias = NDArray[np.uint8]
RenderView: TypeAlias = Callable[[NDArray[np.float64], int, int, float], tuple[RgbImage, Any]]
"""Renders the place from a pose (4, 4) at width, height and field of view. It returns the image, and the confidence as
(H, W) or one number: 0 where the panorama has not seen the place."""


@dataclass(frozen=True)
class VspaceSettings:
    """Settings of one evaluation.

    Attributes:
        paths: names of ``PATHS``.
        sources: names of ``SOURCES``.
        seconds: CPU seconds of training.
        size: width and height of the views.
        panorama_width: width of the keyframe, pixels.
        step_m: distance between the views.
        reach_m: largest distance from the panorama.
        seed: seed of LiDAR noise, training, scans and changed colours.
        start_seed: seed of a random start; 0: the world's own start.
        method: ``ours`` or ``paper``, shown by the sources fill and slam-pose.
    """

    paths: tuple[str, ...] = PATHS
    sources: tuple[str, ...] = ("ours", "no-depth", "no-scale", "panorama", "depth-warp", "mesh")
    seconds: float = 8.0
    size: tuple[int, int] = (640, 360)
    panorama_width: int = 2048
    step_m: float = 0.25
    reach_m: float = 4.0
    seed: int = 0
    start_seed: int = 0
    method: str = "ours"

    @property
    def distances_m(self) -> list[float]:
        return [round(i * self.step_m, 6) for i in range(int(self.reach_m / self.step_m + 1e-6) + 1)]


@dataclass(frozen=True)
class Shot:
    """A keyframe with its depths in metres.

    Attributes:
        pose: map_from_camera, (4, 4).
        rgb: panorama, (H, 2 H, 3).
        true_depth_m: ground truth.
        raw: the model's depth, not scaled.
        result: depth that ``ours`` uses.
        paper_depth_m: the model's depth scaled by the 99.5 % maxima, over the LiDAR's directions.
    """

    pose: NDArray[np.float64]
    rgb: RgbImage
    true_depth_m: NDArray[np.float32]
    raw: NDArray[np.float32]
    result: DepthResult
    paper_depth_m: NDArray[np.float32]


@dataclass(frozen=True)
class Place:
    """A world with its renderer, and the world at the time of its scan, before the obstacle came."""

    world: World
    before: World
    renderer: EquirectRenderer
    start: tuple[float, float, float]


def take_shot(renderer: EquirectRenderer, pose: NDArray[np.float64], width: int, seed: int) -> Shot:
    """Take a panorama from a pose, estimate its depth, and scale it by a simulated VLP-16.

    Raises:
        ValueError: the depth cannot be scaled.
    """
    from instant_ic.depth.scaler import ScalerConfig
    from instant_ic.depth.sources import DepthSource, SourceConfig, complete
    from instant_ic.experiments.depth_lidar import RangeErrors, measure_world

    model, completion = _models()
    rgb = renderer.render(pose, width, width // 2, supersample=2).rgb
    true = renderer.render(pose, min(width, 1024), min(width, 1024) // 2).depth_m
    raw = model.estimate(rgb)
    points = measure_world(renderer, pose, LIDAR_HEIGHT_M, CAMERA_HEIGHT_M, RangeErrors(seed=seed), True)
    scaler, up = ScalerConfig(output_kind=model.manifest.output_kind), np.array([0.0, 0.0, 1.0])
    fused = DepthSource(SourceConfig("completed", scaler)).estimate(raw, points, up, CAMERA_HEIGHT_M)
    result = complete(fused, partial(completion.complete, rgb))
    if not result.ok:
        x, y = pose[:2, 3]
        raise ValueError(f"depth of the panorama at ({x:.2f}, {y:.2f}) cannot be scaled: {result.message}")
    maxima = DepthSource(SourceConfig("network", replace(scaler, method="max_ratio")))
    paper = maxima.estimate(raw, points, up, CAMERA_HEIGHT_M)
    return Shot(pose, rgb, true, raw, result, paper.depth_m)


@lru_cache(maxsize=1)
def _models() -> tuple[DepthModel, DepthModel]:
    from instant_ic.depth.model import DEFAULT_COMPLETION, DEFAULT_MODEL, DepthModel

    return DepthModel.find(DEFAULT_MODEL, threads=1), DepthModel.find(DEFAULT_COMPLETION, threads=1)


def depth_figures(shot: Shot) -> dict[str, Any]:
    """Return the source and scale of a panorama's depth, and its relative error."""
    height, width = shot.result.depth_m.shape
    true = cv2.resize(shot.true_depth_m, (width, height), interpolation=cv2.INTER_NEAREST)
    known = (true > 0) & (shot.result.depth_m > 0)
    error = np.abs(shot.result.depth_m[known] / true[known] - 1)
    return {
        "source": shot.result.source,
        "scale": round(shot.result.scale, 4),
        "median_relative_error": round(float(np.median(error)), 4),
        "mean_relative_error": round(float(np.mean(error)), 4),
    }


def base_of(source: str, method: str) -> str:
    """Return the source that renders the views of a source."""
    return "true-depth" if source == "exact-fill" else method if source in ("fill", "slam-pose") else source


def make_source(
    name: str, shot: Shot, settings: VspaceSettings, config: VirtualSpaceConfig, place: Place | None
) -> tuple[RenderView, float]:
    """Prepare a source from a keyframe; return its renderer and the CPU seconds spent.

    Raises:
        ValueError: an unknown source.
    """
    start = time.process_time()
    render: RenderView
    if name in ("ours", "no-scale", "true-depth", "paper", "paper-no-scale"):
        space = make_space(shot, name, paper_config(config) if name.startswith("paper") else config)
        train(space, settings.seconds)
        render = _view_of(space)
    elif name == "no-depth":
        from instant_ic.experiments.colour_only import ColourOnlyField

        colours = ColourOnlyField(shot.rgb, shot.pose, config)
        colours.train(settings.seconds)
        render = _view_of(colours)
    elif name == "tripod" and place is not None:
        render = _view_of(_scanned_space(shot, settings, config, place))
    elif name == "mesh" and place is not None:
        render = _perfect_mesh(shot, settings, place)
    elif name in ("panorama", "depth-warp"):
        render = _warp(shot, turned_only=name == "panorama")
    else:
        raise ValueError(f"unknown source {name!r}")
    return render, time.process_time() - start


def _view_of(space: Any) -> RenderView:
    """Return the renderer of a virtual space, or of anything else that renders a ``View``."""

    def render(pose: Any, width: int, height: int, fov: float) -> tuple[RgbImage, Any]:
        view = space.render(pose, width, height, fov)
        return view.rgb, view.confidence

    return render


def make_space(shot: Shot, source: str, config: VirtualSpaceConfig) -> Any:
    """Create a virtual space, untrained, from a keyframe with the image and depth of a source."""
    from instant_ic.vspace import VirtualSpace

    space = VirtualSpace(config)
    rgb = through_cube(shot.rgb) if source.startswith("paper") else shot.rgb
    if source.endswith("no-scale"):
        space.set_keyframe(rgb, shot.raw, shot.pose, shot.result.relative_sigma)
    elif source == "paper":
        space.set_keyframe(rgb, shot.paper_depth_m, shot.pose, shot.result.relative_sigma)
    elif source == "true-depth":
        space.set_keyframe(rgb, shot.true_depth_m, shot.pose, 0.02)
    else:
        space.set_keyframe(rgb, shot.result.depth_m, shot.pose, shot.result.sigma)
    return space


def train(space: Any, cpu_seconds: float) -> None:
    """Train until this process has spent the CPU time, or the schedule has ended."""
    start = time.process_time()
    while not space.status.converged and time.process_time() - start < cpu_seconds:
        space.train(iterations=5)


def field_alone(config: VirtualSpaceConfig) -> VirtualSpaceConfig:
    """Return the configuration changed so that the field is always shown, even if it is hardly trained."""
    return replace(config, source="field", view=replace(config.view, field_alone=True))


def paper_config(config: VirtualSpaceConfig) -> VirtualSpaceConfig:
    """Return the configuration with the paper's field: a density, shown alone."""
    return field_alone(replace(config, field=replace(config.field, geometry="density"), keyframes=1, older=0))


def through_cube(rgb: RgbImage) -> RgbImage:
    """Resample a panorama (H, 2 H, 3) through six perspective images of 90°, a quarter of its width each."""
    from instant_ic.geometry.projections import CUBE_FACES, equirect_directions, equirect_to_cube

    size = rgb.shape[1] // 4
    directions, image = equirect_directions(rgb.shape[1], rgb.shape[0]), np.zeros_like(rgb)
    for face, rotation in zip(equirect_to_cube(rgb, size), CUBE_FACES.values(), strict=True):
        x, y, z = np.moveaxis(directions @ rotation.astype(np.float32), -1, 0)
        here = x >= np.maximum(np.abs(y), np.abs(z)) - 1e-6
        ahead = np.where(here, x, 1)
        u, v = ((0.5 * size * (1 - side / ahead) - 0.5).astype(np.float32) for side in (y, z))
        sampled = cv2.remap(face, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        image[here] = np.clip(np.rint(sampled), 0, 255)[here]
    return image


def _warp(shot: Shot, turned_only: bool) -> RenderView:
    """Return the panorama warped by its depth, or only turned."""
    from instant_ic.vspace.config import GeometryConfig
    from instant_ic.vspace.prior import prepare
    from instant_ic.vspace.warp import PanoramaWarp

    warp = PanoramaWarp(prepare(shot.rgb, shot.result.depth_m, shot.pose, 0.0, GeometryConfig(), 4096))
    if not turned_only:
        return _view_of(warp)

    def render(pose: Any, width: int, height: int, fov: float) -> tuple[RgbImage, Any]:
        turned = pose.copy()
        turned[:3, 3] = shot.pose[:3, 3]
        return warp.render(turned, width, height, fov).rgb, 1.0

    return render


def _perfect_mesh(shot: Shot, settings: VspaceSettings, place: Place) -> RenderView:
    """Return the world's own geometry in other colours, which are fitted to the keyframe as ``MeshSpace`` does."""
    from instant_ic.sim.render import EquirectRenderer

    quality = ScanQuality(older=0.0)
    renderer = EquirectRenderer(aged(place.before, quality, np.random.default_rng([73, settings.seed])))
    theirs, seen = (one.render(shot.pose, 256, 128).rgb / 255 + 1e-3 for one in (place.renderer, renderer))
    gain = np.median(theirs / seen, axis=(0, 1))

    def render(pose: Any, width: int, height: int, fov: float) -> tuple[RgbImage, Any]:
        rgb = renderer.render_perspective(pose, width, height, fov, supersample=2).rgb
        return np.clip(np.rint(rgb * gain), 0, 255).astype(np.uint8), 1.0

    return render


def _scanned_space(shot: Shot, settings: VspaceSettings, config: VirtualSpaceConfig, place: Place) -> Any:
    """Return the stack's own space of a scanned mesh, its colours fitted to the keyframe."""
    from instant_ic.vspace.mesh_space import MeshSpace

    quality = ScanQuality(width=min(ScanQuality.width, 4 * settings.panorama_width))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scan.glb"
        scan_world(place.before, place.start, quality, settings.seed, file)
        space = MeshSpace(replace(config, source="mesh", mesh=str(file)))
    space.set_keyframe(shot.rgb, shot.result.depth_m, shot.pose, shot.result.sigma)
    return space
