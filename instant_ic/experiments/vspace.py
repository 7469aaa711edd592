"""Reconstruction away from the panorama: PSNR and SSIM by distance and training time (paper, V.A-C, Figs. 3-6)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.vspace_sources import (
    CAMERA_HEIGHT_M,
    FOV_RAD,
    KEYFRAMES,
    Drawer,
    Picture,
    Place,
    Shot,
    VspaceSettings,
    base_of,
    depth_figures,
    field_alone,
    make_source,
    make_space,
    paper_config,
    take_shot,
    train,
)
from instant_ic.geometry.image_quality import psnr_db, ssim
from instant_ic.geometry.poses import pose_matrix, relative2

if TYPE_CHECKING:
    from instant_ic.sim.render import EquirectRenderer
    from instant_ic.sim.worlds import World
    from instant_ic.vspace import VirtualSpaceConfig

CLEARANCE_M = 0.3
_RADII_M = (2.5, 4.0, 6.0, 10.0, 16.0)
STRIP_AT_M = (0.5, 1.0, 2.0, 3.0)
FILLED = ("fill", "exact-fill")
CRUISE_M_S = 0.4
"""Speed of the robot, from which the time at each pose follows."""


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
class Comparison:
    """Result of ``compare``: the rows, and images by path, distance and source (``truth`` among the sources)."""

    start: tuple[float, float, float]
    depth: dict[str, Any] = field(default_factory=dict)
    slam_error_m: dict[str, float] = field(default_factory=dict)
    """Largest position error of the SLAM along each path."""
    rows: list[Row] = field(default_factory=list)
    strips: dict[str, dict[float, dict[str, Picture]]] = field(default_factory=dict)


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


def start_pose(world: World, seed: int = 0) -> tuple[float, float, float]:
    """The world's own start; with a seed above 0 a random free one; rotated to the longest straight path.

    Raises:
        ValueError: the start is not free.
    """
    places = [world.spawn]
    if seed:
        places = [tuple(pose) for pose in world.sample_free_poses(np.random.default_rng([79, seed]), 4, 0.5).tolist()]
    candidates = [(x, y, yaw + k * math.pi / 4) for x, y, yaw in places for k in range(8)]
    steps = np.arange(0, 4.01, 0.25)
    best = max(candidates, key=lambda pose: len(path_poses(world, pose, "straight", steps)))
    if not path_poses(world, best, "straight", [0.0]):
        raise ValueError(f"the world's own start ({best[0]:g}, {best[1]:g}) is not free: choose another world")
    return best


def make_place(world: str, settings: VspaceSettings, config: VirtualSpaceConfig | None = None) -> Place:
    """Make what the sources need.

    Raises:
        ValueError: no such world, or its start is not free.
    """
    from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
    from instant_ic.experiments.places import make_place_world
    from instant_ic.sim.render import EquirectRenderer
    from instant_ic.sim.worlds import make_world
    from instant_ic.util import paths
    from instant_ic.vspace import VirtualSpaceConfig
    from instant_ic.vspace.warm_up import warm_up

    made, walkers = make_place_world(world)
    config = config or VirtualSpaceConfig(source="auto", panorama_width=settings.panorama_width)
    warm_up(config)
    model = DepthModel.load(paths.shipped_file("models", DEFAULT_MODEL), threads=1)
    # When the place was scanned, the obstacle was not there yet.
    before = (
        made if world.partition(":")[0] != "corridor" else make_world(world.replace("corridor", "corridor-free", 1))
    )
    start = start_pose(made, settings.start_seed)
    return Place(made, before, EquirectRenderer(made), start, config, model, walkers)


def scores(picture: Picture, truth: Picture) -> tuple[float, float]:
    """PSNR (dB, at most 99) and SSIM of two images (H, W, 3) uint8."""
    return min(psnr_db(picture, truth), 99.0), ssim(picture, truth)


def compare(world: str, settings: VspaceSettings, config: VirtualSpaceConfig | None = None) -> Comparison:
    """Compare the views of each source with the world's own along each path.

    Raises:
        ValueError: no such world, its start is not free, or the depth of a panorama cannot be scaled.
    """
    place = make_place(world, settings, config)
    comparison = Comparison(place.start)
    width, height = settings.size
    fov = FOV_RAD
    ready: dict[str, tuple[Drawer, float]] = {}
    for path in settings.paths:
        # The path must also be free behind the start; where it ends, fewer keyframes are taken.
        keyframes = max(KEYFRAMES.get(source, 1) for source in settings.sources)
        back = path_poses(place.world, place.start, path, [-float(k) for k in range(keyframes)])
        shots = [take_shot(place.renderer, pose, settings, place.model) for pose in reversed(back)]
        if keyframes > 1:  # the last panorama alone is the same on all paths
            ready = {}
        comparison.depth[path] = depth_figures(shots)
        poses = path_poses(place.world, place.start, path, settings.distances_m)
        seconds = [distance / CRUISE_M_S for distance in settings.distances_m[: len(poses)]]
        errors = slam_errors(place.world, poses, settings) if "slam-pose" in settings.sources else None
        if errors is not None:
            comparison.slam_error_m[path] = float(np.linalg.norm(errors[:, :2], axis=1).max())
        renderers = [renderer_after(place, passed) for passed in seconds]
        truths = [
            renderer.render_perspective(pose, width, height, fov, supersample=3).rgb
            for renderer, pose in zip(renderers, poses, strict=True)
        ]
        for source in settings.sources:
            if (source == "slam-pose" and errors is None) or (source == "still" and not place.walkers):
                continue
            base = base_of(source, settings.method)
            if base not in ready:
                ready[base] = make_source(base, shots, settings, place)
            draw, spent = ready[base]
            for number, (distance, pose, truth) in enumerate(zip(settings.distances_m, poses, truths, strict=False)):
                seen_from = pose
                if source == "slam-pose" and errors is not None:
                    x, y, yaw = errors[number]
                    seen_from = pose @ pose_matrix(x, y, yaw=yaw)
                picture, confidence = draw(seen_from, width, height, fov)
                if source in FILLED:
                    picture = filled(picture, confidence, truth)
                against = truth
                if source == "still":
                    against = place.renderer.render_perspective(pose, width, height, fov, supersample=3).rgb
                comparison.rows.append(
                    _row(path, source, distance, picture, against, spent, float(np.mean(confidence)))
                )
                if distance in STRIP_AT_M:
                    strip = comparison.strips.setdefault(path, {}).setdefault(distance, {"truth": truth})
                    strip[source] = picture
    return comparison


def filled(picture: Picture, confidence: Any, truth: Picture) -> Picture:
    """The image (H, W, 3) with the truth where no keyframe has seen the place."""
    return np.where(np.broadcast_to(confidence, truth.shape[:2])[..., None] > 0, picture, truth)


def renderer_after(place: Place, seconds: float) -> EquirectRenderer:
    """Renderer of the place some time after the panorama, when people have walked on."""
    from instant_ic.experiments.places import world_after
    from instant_ic.sim.render import EquirectRenderer

    return EquirectRenderer(world_after(place.world, place.walkers, seconds)) if place.walkers else place.renderer


def slam_errors(world: World, poses: Sequence[Any], settings: VspaceSettings) -> NDArray[np.float64] | None:
    """Error (x, y, yaw) of the SLAM's pose at each camera pose (4, 4) of a path, (N, 3), in the robot's true frame.

    The robot drives along the path on slipping tracks and is localised by the stack's SLAM. None where the robot
    cannot drive there.
    """
    from instant_ic.experiments.slam import run_log
    from instant_ic.experiments.slam_sim import round_trip

    places = [(float(pose[0, 3]), float(pose[1, 3])) for pose in poses]
    if len(places) < 2:
        return None
    try:
        trip = round_trip(world, seed=settings.seed, rounds=1, route=places)
    except ValueError:  # it touches something
        return None
    estimates = run_log(trip.entries).online[:, 1:]
    begin = np.array([*places[0], math.atan2(places[1][1] - places[0][1], places[1][0] - places[0][0])])
    found = []
    for place in places:
        local = relative2(begin, np.array([*place, 0.0]))[:2]
        nearest = int(np.argmin(np.linalg.norm(trip.truth[:, :2] - local, axis=1)))
        found.append(relative2(trip.truth[nearest], estimates[nearest]))
    return np.array(found)


def converge(
    world: str, settings: VspaceSettings, times_s: Sequence[float], config: VirtualSpaceConfig | None = None
) -> list[Row]:
    """Views at the panorama and 1 m ahead by training time: ``ours`` as shown, its ``field`` alone, and ``paper``.

    Args: as ``compare``; ``times_s`` are CPU seconds.
    """
    place = make_place(world, settings, config)
    width, height = settings.size
    poses = path_poses(place.world, place.start, "straight", (0.0, 1.0))
    views = [
        (distance, pose, place.renderer.render_perspective(pose, width, height, FOV_RAD, 3).rgb)
        for distance, pose in zip((0.0, 1.0), poses, strict=False)
    ]
    shot = take_shot(place.renderer, poses[0], settings, place.model)
    return converge_on(shot, views, settings, place.config, times_s)


def converge_on(
    shot: Shot,
    views: Sequence[tuple[float, NDArray[np.float64], Picture]],
    settings: VspaceSettings,
    config: VirtualSpaceConfig,
    times_s: Sequence[float],
) -> list[Row]:
    """As ``converge``, from a keyframe and views: distance in metres, camera pose (4, 4), and true image."""
    width, height = settings.size
    rows = []
    trained = replace(config, source="field")
    for name, shown_as in (("ours", ("ours", "field")), ("paper", ("paper",))):
        own = paper_config(trained) if name == "paper" else trained
        space, spent = make_space([shot], name, settings, own), 0.0
        for seconds in sorted(times_s):
            train(space, seconds - spent)
            spent = seconds
            for source in shown_as:
                space.config = field_alone(own) if source == "field" else own
                for distance, pose, truth in views:
                    view = space.render(pose, width, height, FOV_RAD)
                    confidence = float(view.confidence.mean())
                    rows.append(_row("straight", source, distance, view.rgb, truth, seconds, confidence))
            space.config = own
    return rows


def _row(
    path: str, source: str, distance: float, picture: Picture, truth: Picture, seconds: float, confidence: float
) -> Row:
    psnr, ssim = scores(picture, truth)
    return Row(path, source, distance, round(psnr, 3), round(ssim, 4), round(seconds, 2), round(confidence, 3))
