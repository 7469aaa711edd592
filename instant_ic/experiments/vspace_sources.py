"""View sources of ``experiments.vspace``: render a place from a pose, using keyframes in a simulated world."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.scan import QUALITIES, ScanQuality, aged, scan_world

if TYPE_CHECKING:
    from instant_ic.depth.model import DepthModel
    from instant_ic.depth.sources import DepthResult
    from instant_ic.experiments.places import Walker
    from instant_ic.sim.render import EquirectRenderer
    from instant_ic.sim.worlds import World
    from instant_ic.vspace import VirtualSpaceConfig

PATHS = ("straight", "curve")
SOURCES = {
    "ours": "depth of the shipped model scaled by the LiDAR, field trained from it",
    "true-depth": "the same with the world's own depth: the ceiling",
    "no-depth": "field trained from colours alone (paper: -depth)",
    "no-scale": "the model's depth as it comes, not scaled (paper: -scale)",
    "older": "ours with two older keyframes behind it, a metre apart, for what is hidden from the newest",
    "fill": "ours (or paper), and the truth where no keyframe has seen the place",
    "exact-fill": "true depth, and the truth where no keyframe has seen the place",
    "slam-pose": "ours (or paper), seen from the poses that SLAM estimates on the way",
    "still": "ours (or paper) against the world in which nobody has moved since the panorama",
    "paper": "the paper's choices: density field alone, six cube faces, depth scaled by the 99.5 % maxima",
    "paper-no-scale": "the same, depth not scaled",
    "panorama": "the panorama turned, without depth",
    "depth-warp": "the panorama warped by the depth of `ours`, as a mesh",
    "point-warp": "the same as points",
    "mesh": "conventional IC with a perfect scan: exact geometry, obstacle not there yet, colours fitted",
    **{name: f"conventional IC with a real scan: {name}" for name in QUALITIES},
}
DERIVED = ("fill", "slam-pose", "still")
"""Other uses of the views of ``VspaceSettings.method``."""
KEYFRAMES = {"older": 3}
"""Number of panoramas of the sources that have several."""
Picture = NDArray[np.uint8]
CAMERA_HEIGHT_M, LIDAR_HEIGHT_M = 1.2, 0.6
FOV_RAD = math.pi / 2
"""Horizontal field of view of the views."""
Drawer: TypeAlias = Callable[[NDArray[np.float64], int, int, float], tuple[Picture, Any]]
"""Renders the place from a pose (4, 4) at width, height, field of view; returns image and confidence, (H, W) or one for
all pixels: 0 where no panorama has seen the place."""


@dataclass(frozen=True)
class VspaceSettings:
    """VspaceSettings of one evaluation.

    Attributes:
        paths: of ``PATHS``; sources: of ``SOURCES``.
        seconds: CPU seconds of training.
        size: width and height of the views.
        panorama_width: of the keyframes, pixels.
        step_m, reach_m: distances from the last panorama are multiples of ``step_m`` up to ``reach_m``.
        seed: of LiDAR noise, training, scans and changed colours.
        start_seed: above 0: of a random start instead of the world's own.
        method: ``ours`` or ``paper``: of the sources in ``DERIVED``.
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
    """A keyframe: panorama, its ground-truth depth, the model's depth, and the depth that ``ours`` uses."""

    pose: NDArray[np.float64]
    rgb: Picture
    true_depth_m: NDArray[np.float32]
    raw: NDArray[np.float32]
    result: DepthResult
    paper_depth_m: NDArray[np.float32]
    """The model's depth scaled by the 99.5 % maxima, over the LiDAR's directions."""


@dataclass(frozen=True)
class Place:
    """A world, the world before the obstacle came, and what the sources share."""

    world: World
    before: World
    renderer: EquirectRenderer
    start: tuple[float, float, float]
    config: VirtualSpaceConfig
    model: Any
    walkers: tuple[Walker, ...] = ()


def take_shot(renderer: EquirectRenderer, pose: NDArray[np.float64], settings: VspaceSettings, model: Any) -> Shot:
    """Take a panorama from a pose with its depth: the model's, and the depth scaled by a simulated VLP-16."""
    from instant_ic.depth.scaler import ScalerConfig
    from instant_ic.depth.sources import DepthSource, SourceConfig, complete
    from instant_ic.experiments.depth_lidar import RangeErrors, measure_world

    width = settings.panorama_width
    rgb = renderer.render(pose, width, width // 2, supersample=2).rgb
    true = renderer.render(pose, min(width, 1024), min(width, 1024) // 2).depth_m
    raw = model.estimate(rgb)
    points = measure_world(renderer, pose, LIDAR_HEIGHT_M, CAMERA_HEIGHT_M, RangeErrors(seed=settings.seed), True)
    scaler = ScalerConfig(output_kind=model.manifest.output_kind)
    source = DepthSource(SourceConfig("completed", scaler))
    fused = source.estimate(raw, points, np.array([0.0, 0.0, 1.0]), CAMERA_HEIGHT_M)
    result = complete(fused, partial(_completion().complete, rgb))
    if not result.ok:
        raise ValueError(
            f"depth of the panorama at ({pose[0, 3]:.2f}, {pose[1, 3]:.2f}) cannot be scaled: {result.message}"
        )
    maxima = DepthSource(SourceConfig("network", replace(scaler, method="max_ratio")))
    paper = maxima.estimate(raw, points, np.array([0.0, 0.0, 1.0]), CAMERA_HEIGHT_M)
    return Shot(pose, rgb, true, raw, result, paper.depth_m)


@lru_cache(maxsize=1)
def _completion() -> DepthModel:
    from instant_ic.depth.model import DEFAULT_COMPLETION, DepthModel

    return DepthModel.find(DEFAULT_COMPLETION, threads=1)


def train(space: Any, cpu_seconds: float) -> None:
    """Train until this process has spent the CPU time, or the schedule has ended."""
    start = time.process_time()
    while not space.status.converged and time.process_time() - start < cpu_seconds:
        space.train(iterations=5)


def point_warp(
    rgb: Picture, depth_m: NDArray[np.floating], pose: NDArray[np.float64], view: NDArray[np.float64],
    width: int, height: int, fov: float,
) -> tuple[Picture, float]:  # fmt: skip
    """Panorama pixels rendered as points with a z-buffer, holes filled from their surroundings.

    Returns the image and the share of pixels that are not holes.
    """
    import cv2

    from instant_ic.geometry.projections import equirect_directions
    from instant_ic.vspace.prior import fill_holes

    size = (rgb.shape[1], rgb.shape[0])
    depth = cv2.resize(np.asarray(depth_m, np.float32), size, interpolation=cv2.INTER_NEAREST)
    points = (equirect_directions(*size) * depth[..., None])[depth > 0]
    view_from_camera = np.linalg.inv(view) @ pose
    x, y, z = (points @ view_from_camera[:3, :3].T + view_from_camera[:3, 3]).T
    focal = 0.5 * width / math.tan(fov / 2)
    ahead = x > 0.02
    u, v = (np.rint(0.5 * (n - 1) - focal * a[ahead] / x[ahead]).astype(int) for n, a in ((width, y), (height, z)))
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    at, far = (v * width + u)[inside], x[ahead][inside]
    order = np.argsort(-far, kind="stable")  # the nearest is written last
    image, seen = np.zeros((height * width, 3), np.float32), np.zeros(height * width, bool)
    image[at[order]] = rgb[depth > 0][ahead][inside][order]
    seen[at] = True
    filled = fill_holes(image.reshape(height, width, 3), seen.reshape(height, width))
    return np.clip(np.rint(filled), 0, 255).astype(np.uint8), float(seen.mean())


def paper_config(config: VirtualSpaceConfig) -> VirtualSpaceConfig:
    """The paper's field: a density, shown alone."""
    return field_alone(replace(config, field=replace(config.field, geometry="density"), keyframes=1, older=0))


def through_cube(rgb: Picture) -> Picture:
    """A panorama (H, 2 H, 3) as six perspective images of 90° show it, a quarter of its width each."""
    import cv2

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


def make_space(shots: list[Shot], source: str, settings: VspaceSettings, config: VirtualSpaceConfig) -> Any:
    """A virtual space with the keyframes, oldest first, with the images and depth of a source.

    The last keyframe is untrained. The others are trained until they are ready, as during a drive (at most
    ``settings.seconds``).
    """
    from instant_ic.vspace import VirtualSpace

    space = VirtualSpace(config)
    for number, shot in enumerate(shots):
        rgb = through_cube(shot.rgb) if source.startswith("paper") else shot.rgb
        if source in ("no-scale", "paper-no-scale"):
            space.set_keyframe(rgb, shot.raw, shot.pose, shot.result.relative_sigma)
        elif source == "paper":
            space.set_keyframe(rgb, shot.paper_depth_m, shot.pose, shot.result.relative_sigma)
        elif source == "true-depth":
            space.set_keyframe(rgb, shot.true_depth_m, shot.pose, 0.02)
        else:
            space.set_keyframe(rgb, shot.result.depth_m, shot.pose, shot.result.sigma)
        if number < len(shots) - 1:
            start = time.process_time()
            while not space.status.ready_iterations and time.process_time() - start < settings.seconds:
                space.train(iterations=5)
    return space


def field_alone(config: VirtualSpaceConfig) -> VirtualSpaceConfig:
    """The same configuration, but rendering the field however little it is trained."""
    return replace(config, source="field", picture=replace(config.picture, field_alone=True))


def base_of(source: str, method: str) -> str:
    """Source that renders the views of a source."""
    return "true-depth" if source == "exact-fill" else method if source in DERIVED else source


def make_source(name: str, shots: list[Shot], settings: VspaceSettings, place: Place) -> tuple[Drawer, float]:
    """Prepare a source from keyframes, oldest first; return its renderer and the CPU seconds spent."""
    if name not in SOURCES:
        raise ValueError(f"unknown source {name!r}")
    from instant_ic.vspace.config import GeometryConfig
    from instant_ic.vspace.prior import prepare
    from instant_ic.vspace.warp import PanoramaWarp

    last, config = shots[-1], place.config
    start = time.process_time()

    def of_view(drawer: Any) -> Drawer:
        def draw(pose: Any, width: int, height: int, fov: float) -> tuple[Picture, float]:
            view = drawer.render(pose, width, height, fov)
            return view.rgb, view.confidence

        return draw

    if name in ("ours", "no-scale", "true-depth", "older", "paper", "paper-no-scale"):
        count = KEYFRAMES.get(name, 1)
        own = paper_config(config) if name.startswith("paper") else config
        space = make_space(shots[-count:], name, settings, own)
        train(space, settings.seconds)
        return of_view(space), time.process_time() - start
    if name == "no-depth":
        from instant_ic.experiments.colour_only import ColourOnlyField

        colours = ColourOnlyField(last.rgb, last.pose, config)
        colours.train(settings.seconds)
        return of_view(colours), time.process_time() - start
    if name in QUALITIES:
        return of_view(_scanned_space(QUALITIES[name], last, settings, place)), time.process_time() - start
    if name == "mesh":
        from instant_ic.sim.render import EquirectRenderer

        quality = replace(QUALITIES["tripod"], older=0.0)
        renderer = EquirectRenderer(aged(place.before, quality, np.random.default_rng([73, settings.seed])))
        theirs, seen = (one.render(last.pose, 256, 128).rgb / 255 + 1e-3 for one in (place.renderer, renderer))
        gain = np.median(theirs / seen, axis=(0, 1))  # as ``MeshSpace`` fits its colours

        def draw_mesh(pose: Any, width: int, height: int, fov: float) -> tuple[Picture, float]:
            rgb = renderer.render_perspective(pose, width, height, fov, supersample=2).rgb
            return np.clip(np.rint(rgb * gain), 0, 255).astype(np.uint8), 1.0

        return draw_mesh, 0.0
    if name == "point-warp":

        def draw_points(pose: Any, width: int, height: int, fov: float) -> tuple[Picture, float]:
            return point_warp(last.rgb, last.result.depth_m, last.pose, pose, width, height, fov)

        return draw_points, 0.0
    warp = PanoramaWarp(prepare(last.rgb, last.result.depth_m, last.pose, 0.0, GeometryConfig(), 4096))
    if name != "panorama":
        return of_view(warp), time.process_time() - start

    def draw_turned(pose: Any, width: int, height: int, fov: float) -> tuple[Picture, float]:
        turned = pose.copy()
        turned[:3, 3] = last.pose[:3, 3]
        return warp.render(turned, width, height, fov).rgb, 1.0

    return draw_turned, 0.0


def _scanned_space(quality: ScanQuality, last: Shot, settings: VspaceSettings, place: Place) -> Any:
    """The stack's own space of a scanned mesh, its colours fitted to the newest keyframe."""
    import tempfile
    from pathlib import Path

    from instant_ic.vspace.mesh_space import MeshSpace

    quality = replace(quality, width=min(quality.width, 4 * settings.panorama_width))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scan.glb"
        scan_world(place.before, place.start, quality, settings.seed, file)
        space = MeshSpace(replace(place.config, source="mesh", mesh=str(file)))
    space.set_keyframe(last.rgb, last.result.depth_m, last.pose, last.result.sigma)
    return space


def depth_figures(shots: list[Shot]) -> dict[str, Any]:
    """How the last panorama's depth was determined, and its error (median and mean, by solid angle)."""
    import cv2

    last = shots[-1]
    height, width = last.result.depth_m.shape
    true = cv2.resize(last.true_depth_m, (width, height), interpolation=cv2.INTER_NEAREST)
    known = (true > 0) & (last.result.depth_m > 0)
    raw_known = (true > 0) & (last.raw > 0)
    error = np.abs(last.result.depth_m[known] / true[known] - 1)
    return {
        "panoramas": len(shots),
        "source": last.result.source,
        "message": last.result.message,
        "scale": round(last.result.scale, 4),
        "relative_sigma": round(last.result.relative_sigma, 4),
        "median_relative_error": round(float(np.median(error)), 4),
        "mean_relative_error": round(float(np.mean(error)), 4),
        "unscaled_median_ratio": round(float(np.median(last.raw[raw_known] / true[raw_known])), 4),
    }
