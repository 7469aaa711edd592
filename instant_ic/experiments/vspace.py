"""Reconstruction away from the panorama: PSNR and SSIM by distance and training time (paper, V.A-C, Figs. 3-6)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.vspace_sources import (
    CAMERA_HEIGHT_M,
    Drawer,
    Picture,
    Shot,
    VspaceSettings,
    depth_figures,
    field_alone,
    make_source,
    make_space,
    take_shot,
    train,
)
from instant_ic.geometry.image_quality import psnr_db, ssim
from instant_ic.geometry.poses import pose_matrix

if TYPE_CHECKING:
    from instant_ic.sim.worlds import World
    from instant_ic.vspace import VirtualSpaceConfig

CLEARANCE_M = 0.3
_RADII_M = (2.5, 4.0, 6.0, 10.0, 16.0)
_STRIP_AT_M = (0.5, 1.0, 2.0, 3.0)


@dataclass(frozen=True)
class Row:
    """One image; ``seconds`` is the preparation time of its source, CPU seconds."""

    path: str
    source: str
    distance_m: float
    psnr_db: float
    ssim: float
    seconds: float
    confidence: float
    """Share of the image that a panorama has seen."""


@dataclass
class Report:
    """Result of ``evaluate``."""

    world: str
    start: tuple[float, float, float]
    settings: VspaceSettings
    depth: dict[str, Any]
    rows: list[Row] = field(default_factory=list)
    training: list[Row] = field(default_factory=list)
    """``ours`` and ``field`` at the panorama (distance 0) and 1 m ahead by training time, on the first path."""
    strips: dict[str, dict[float, dict[str, Picture]]] = field(default_factory=dict)
    """Path → distance → source → image; ``truth`` among the sources."""

    def figures(self) -> dict[str, Any]:
        """Figures for JSON."""
        return {
            "world": self.world,
            "start": list(self.start),
            "settings": asdict(self.settings),
            "metrics": "PSNR over all channels; SSIM of Wang et al.: Gaussian window, sigma 1.5, K 0.01 and 0.03, mean "
            "over channels; truth is supersampled 3 x 3",
            "depth": self.depth,
            "rows": [asdict(row) for row in self.rows],
            "training": [asdict(row) for row in self.training],
            "mean": self.means(),
            "verdict": self.verdict(),
        }

    def table(self, key: str) -> dict[str, dict[str, dict[float, float]]]:
        """Path → source → distance → value."""
        table: dict[str, dict[str, dict[float, float]]] = {}
        for row in self.rows:
            table.setdefault(row.path, {}).setdefault(row.source, {})[row.distance_m] = getattr(row, key)
        return table

    def means(self) -> dict[str, dict[str, dict[str, float]]]:
        """Path → source → mean of PSNR and SSIM from 0.25 m on (at the panorama itself every source is good)."""
        result: dict[str, dict[str, dict[str, float]]] = {}
        for key in ("psnr_db", "ssim"):
            for path, sources in self.table(key).items():
                for source, values in sources.items():
                    away = [value for distance, value in values.items() if distance > 0]
                    if away:
                        mean = round(float(np.mean(away)), 4)
                        result.setdefault(path, {}).setdefault(source, {})[key] = mean
        return result

    def verdict(self) -> dict[str, Any]:
        """Target check: ``ours`` against the simpler sources at every distance from 0.25 to 2 m, and the warps."""
        result: dict[str, Any] = {}
        simpler, warps = ("no-depth", "no-scale", "panorama"), ("depth-warp", "point-warp")
        for path in self.settings.paths:
            entry: dict[str, Any] = {}
            psnr, ssim = self.table("psnr_db").get(path, {}), self.table("ssim").get(path, {})
            if "ours" not in psnr:
                continue
            for other in (name for name in simpler if name in psnr):
                near = [d for d in psnr["ours"] if 0.25 <= d <= 2.0]
                worse = [d for d in near if not (psnr["ours"][d] > psnr[other][d] and ssim["ours"][d] > ssim[other][d])]
                entry[f"beats {other} from 0.25 to 2 m"] = {"met": bool(near) and not worse, "not at_m": worse}
            present = [name for name in warps if name in psnr]
            away = [d for d in psnr["ours"] if d > 0]
            if present and away:
                worst = min(psnr["ours"][d] - max(psnr[name][d] for name in present) for d in away)
                means = self.means()[path]
                gain, gain_ssim = (
                    means["ours"][key] - max(means[name][key] for name in present) for key in ("psnr_db", "ssim")
                )
                entry["against the better warp"] = {
                    "mean_db": round(gain, 2),
                    "worst_db": round(worst, 2),
                    "mean_ssim": round(gain_ssim, 4),
                    "met": bool(gain >= 0 and gain_ssim >= 0 and worst >= -1),
                }
            result[path] = entry
        return result


def path_poses(world: World, start: tuple[float, float, float], path: str, distances: Iterable[float]) -> list[Any]:
    """Camera poses (4, 4) at straight-line distances from the start, looking along the path; ends at an obstacle.

    ``curve`` is an arc: the tightest free one of the radii and sides tried, else the one that reaches furthest.
    Negative distances lie behind the start.
    """
    mask = world.occupied(0.03, 1.9, 0.05)
    clearance = mask.distance_m()

    def free(pose: NDArray[np.float64]) -> bool:
        row, column = mask.index(pose[None, :2, 3])[0]
        inside = 0 <= row < clearance.shape[0] and 0 <= column < clearance.shape[1]
        return bool(inside and clearance[row, column] >= CLEARANCE_M)

    x, y, yaw = start
    origin = pose_matrix(x, y, CAMERA_HEIGHT_M, yaw=yaw)
    wanted = list(distances)

    def along(curvature: float) -> list[Any]:
        poses: list[Any] = []
        for distance in wanted:
            if curvature and abs(distance * curvature) >= 2:
                break
            turn = 2 * math.asin(distance * curvature / 2)
            ahead = math.sin(turn) / curvature if curvature else distance
            aside = (1 - math.cos(turn)) / curvature if curvature else 0.0
            pose = origin @ pose_matrix(ahead, aside, yaw=turn)
            if not free(pose):
                break
            poses.append(pose)
        return poses

    if path == "straight":
        return along(0.0)
    return max((along(side / radius) for radius in _RADII_M for side in (1, -1)), key=len)


def start_pose(world: World, start: tuple[float, float, float] | None) -> tuple[float, float, float]:
    """The given start, or the world's own, rotated to where the straight path is longest.

    Raises:
        ValueError: the start is not free.
    """
    if start is not None:
        if not path_poses(world, start, "straight", [0.0]):
            raise ValueError(
                f"start {start[0]:g},{start[1]:g} is not {CLEARANCE_M} m clear of everything: choose another"
            )
        return start
    x, y, yaw = world.spawn
    candidates = [(x, y, yaw + k * math.pi / 4) for k in range(8)]
    steps = np.arange(0, 4.01, 0.25)
    best = max(candidates, key=lambda pose: len(path_poses(world, pose, "straight", steps)))
    if not path_poses(world, best, "straight", [0.0]):
        raise ValueError(f"the world's own start ({x:g}, {y:g}) is not free: give --start x,y,yaw")
    return best


def scores(picture: Picture, truth: Picture) -> tuple[float, float]:
    """PSNR (dB, at most 99) and SSIM of two images (H, W, 3) uint8."""
    return min(psnr_db(picture, truth), 99.0), ssim(picture, truth)


def evaluate(
    world: str,
    settings: VspaceSettings,
    start: tuple[float, float, float] | None = None,
    tell: Callable[[str, int, int], None] = lambda words, done, total: None,
    config: VirtualSpaceConfig | None = None,
) -> Report:
    """Run the evaluation.

    Args:
        world: as for ``sim.worlds.make_world``.
        start: (x, y, yaw) of the last panorama; None: the world's own start.
        tell: called with the current activity, the number of finished images and their total.
        config: of the virtual space.

    Raises:
        ValueError: world, start or a setting is invalid, or the depth of a panorama cannot be scaled.
    """
    from instant_ic import paths as places
    from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
    from instant_ic.sim.render import EquirectRenderer
    from instant_ic.sim.worlds import make_world
    from instant_ic.vspace import VirtualSpaceConfig
    from instant_ic.vspace.warm_up import warm_up

    tell(f"world {world}", 0, 1)
    made = make_world(world)
    renderer = EquirectRenderer(made)
    start = start_pose(made, start)
    config = config or VirtualSpaceConfig(device="cpu", panorama_width=max(settings.panorama_width, 64))
    config = replace(config, keyframes=settings.keyframes)
    model = DepthModel.load(places.shipped_file("models", DEFAULT_MODEL), threads=1)
    warm_up(config)
    width, height = settings.size
    fov = math.radians(settings.fov_deg)
    routes = {path: path_poses(made, start, path, settings.distances_m) for path in settings.paths}
    total = sum(len(poses) for poses in routes.values()) * len(settings.sources)
    report = Report(world, start, settings, {})
    shots_of: dict[str, list[Shot]] = {}
    for path in settings.paths:
        # The path must also be free behind the start; where it ends, fewer keyframes are taken, and the report states
        # it.
        back = path_poses(made, start, path, [-float(k) for k in range(settings.keyframes)])
        shots_of[path] = (
            next(iter(shots_of.values()))
            if settings.keyframes == 1 and shots_of
            else [take_shot(renderer, pose, settings, model) for pose in reversed(back)]
        )
        report.depth[path] = depth_figures(shots_of[path])

    def before() -> World:
        return make_world(world.replace("corridor", "corridor-free", 1)) if _has_obstacle(world) else made

    truths = {
        path: [renderer.render_perspective(pose, width, height, fov, supersample=3).rgb for pose in poses]
        for path, poses in routes.items()
    }
    ready: dict[str, tuple[Drawer, float]] = {}
    done = 0
    for source in settings.sources:
        for path, poses in routes.items():
            tell(f"{source}, {path}", done, total)
            if source not in ready or settings.keyframes > 1:
                ready[source] = make_source(source, shots_of[path], settings, config, before)
            draw, seconds = ready[source]
            for distance, pose, truth in zip(settings.distances_m, poses, truths[path], strict=False):
                picture, confidence = draw(pose, width, height, fov)
                report.rows.append(_row(path, source, distance, picture, truth, seconds, confidence))
                if distance in _STRIP_AT_M:
                    strip = report.strips.setdefault(path, {}).setdefault(distance, {"truth": truth})
                    strip[source] = picture
                done += 1
                tell(f"{source}, {path}, {distance:g} m", done, total)
        ready.pop(source, None)
    if settings.times:
        path = settings.paths[0]
        space = make_space(shots_of[path], "scaled", settings, config)
        spent = 0.0
        for seconds in sorted(settings.times):
            tell(f"ours after {seconds:g} s", done, total)
            train(space, seconds - spent)
            spent = seconds
            for distance, pose, truth in zip(settings.distances_m, routes[path], truths[path], strict=False):
                if distance in (0.0, 1.0):
                    for source, shown in (("ours", config), ("field", field_alone(config))):
                        space.config = shown
                        view = space.render(pose, width, height, fov)
                        confidence = float(view.confidence.mean())
                        report.training.append(_row(path, source, distance, view.rgb, truth, seconds, confidence))
            space.config = config
    return report


def _has_obstacle(world: str) -> bool:
    return world.partition(":")[0] == "corridor"


def _row(
    path: str, source: str, distance: float, picture: Picture, truth: Picture, seconds: float, confidence: float
) -> Row:
    psnr, ssim = scores(picture, truth)
    return Row(path, source, distance, round(psnr, 3), round(ssim, 4), round(seconds, 2), round(confidence, 3))
