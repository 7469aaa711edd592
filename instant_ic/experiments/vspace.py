"""Reconstruction away from the panorama: PSNR and SSIM by distance and training time (paper, V.A-C, Figs. 3-6).

1. A keyframe is taken at the start (``take_shot``), or read from a recording (``read_keyframes``).
2. True views come from the world along a path (``true_views``), or from later keyframes (``later_views``).
3. Each source renders the same poses and is compared with the true views (``compare``, ``compare_recorded``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.recorded import later_keyframes, read_keyframes
from instant_ic.experiments.vspace_sources import (
    FILLED,
    Place,
    RenderView,
    RgbImage,
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
from instant_ic.experiments.worlds import named_world, path_poses, start_pose
from instant_ic.geometry.image_quality import psnr_db, ssim
from instant_ic.geometry.poses import pose_matrix, relative2
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.worlds import World, make_world
from instant_ic.vspace import VirtualSpaceConfig
from instant_ic.vspace.warm_up import warm_up

STRIP_AT_M = (0.5, 1.0, 2.0, 3.0)
"""Distances of the views that are kept as images."""
FOV_RAD = math.pi / 2
"""Horizontal field of view of the views."""
Pose = NDArray[np.float64]


@dataclass(frozen=True)
class ViewRow:
    """Figures of one view.

    Attributes:
        path: path, or ``recorded``.
        source: source of the view.
        distance_m: distance from the panorama.
        psnr_db: PSNR against the true view, at most 99.
        ssim: SSIM against the true view.
        seconds: CPU seconds of the source's preparation.
        confidence: share of the image that the panorama has seen.
    """

    path: str
    source: str
    distance_m: float
    psnr_db: float
    ssim: float
    seconds: float
    confidence: float


@dataclass(frozen=True)
class TrueView:
    """A true view: distance from the panorama, camera pose (4, 4), image, and the pose that SLAM estimates there."""

    distance_m: float
    pose: Pose
    rgb: RgbImage
    slam_pose: Pose | None = None


@dataclass
class Comparison:
    """Result of a comparison.

    Attributes:
        depth: figures of the panorama's depth.
        slam_error_m: largest position error of the SLAM along each path.
        rows: figures of each view.
        strips: images by path, distance and source, ``truth`` among the sources.
    """

    depth: dict[str, Any] = field(default_factory=dict)
    slam_error_m: dict[str, float] = field(default_factory=dict)
    rows: list[ViewRow] = field(default_factory=list)
    strips: dict[str, dict[float, dict[str, RgbImage]]] = field(default_factory=dict)


def make_place(world: str, start_seed: int = 0) -> Place:
    """Make a world, its renderer and its start.

    Raises:
        ValueError: no such world, or its start is not free.
    """
    made = before = named_world(world)
    if world.partition(":")[0] == "corridor":  # the obstacle was not there when the place was scanned
        before = make_world(world.replace("corridor", "corridor-free", 1))
    return Place(made, before, EquirectRenderer(made), start_pose(made, start_seed))


def default_config(settings: VspaceSettings) -> VirtualSpaceConfig:
    """Return the configuration of the virtual space."""
    return VirtualSpaceConfig(source="auto", panorama_width=settings.panorama_width)


def scores(image: RgbImage, truth: RgbImage) -> tuple[float, float]:
    """Return PSNR (dB, at most 99) and SSIM of two images (H, W, 3)."""
    return min(psnr_db(image, truth), 99.0), ssim(image, truth)


def compare(world: str, settings: VspaceSettings, config: VirtualSpaceConfig | None = None) -> Comparison:
    """Compare the views of each source with the world's own along each path.

    Raises:
        ValueError: no such world, its start is not free, or the depth of the panorama cannot be scaled.
    """
    config = config or default_config(settings)
    warm_up(config)
    place = make_place(world, settings.start_seed)
    (pose,) = path_poses(place.world, place.start, "straight", [0.0])
    shot = take_shot(place.renderer, pose, settings.panorama_width, settings.seed)
    comparison = Comparison(depth_figures(shot))
    ready: dict[str, tuple[RenderView, float]] = {}
    for path in settings.paths:
        views = true_views(place, path, settings)
        errors = [_apart_m(view.pose, view.slam_pose) for view in views if view.slam_pose is not None]
        if errors:
            comparison.slam_error_m[path] = max(errors)
        for source in settings.sources:
            base = base_of(source, settings.method)
            if base not in ready:
                ready[base] = make_source(base, shot, settings, config, place)
            _add_views(comparison, path, source, ready[base], views, settings)
    return comparison


def compare_recorded(bag: Path, settings: VspaceSettings, number: int) -> Comparison:
    """Compare the views of a recorded keyframe with what later keyframes saw, at their poses.

    Args:
        bag: recording with ``/keyframe``.
        settings: sources of ``RECORDED``; keyframes up to ``reach_m`` away count, by steps of ``step_m``.
        number: number of the keyframe.

    Raises:
        ValueError: the recording has no usable keyframes, or no later one is near enough.
    """
    keyframes = read_keyframes(bag)
    near = later_keyframes(keyframes, number, settings, FOV_RAD)
    if not near:
        raise ValueError(f"{bag}: no keyframe after number {number} lies within {settings.reach_m:g} m of it")
    views = [TrueView(settings.step_m * round(at / settings.step_m), pose, rgb) for at, pose, rgb in near]
    comparison = Comparison()
    config, ready = default_config(settings), {}
    for source in settings.sources:
        base = base_of(source, settings.method)
        if base not in ready:
            ready[base] = make_source(base, keyframes[number], settings, config, None)
        _add_views(comparison, "recorded", source, ready[base], views, settings)
    return comparison


def true_views(place: Place, path: str, settings: VspaceSettings) -> list[TrueView]:
    """Render the world along a path, with the poses of SLAM if a source needs them."""
    poses = path_poses(place.world, place.start, path, settings.distances_m)
    errors = slam_errors(place.world, poses, settings) if "slam-pose" in settings.sources else None
    views = []
    for number, (distance, pose) in enumerate(zip(settings.distances_m, poses, strict=False)):
        rgb = place.renderer.render_perspective(pose, *settings.size, FOV_RAD, supersample=3).rgb
        slam_pose = None
        if errors is not None:
            x, y, yaw = errors[number]
            slam_pose = pose @ pose_matrix(x, y, yaw=yaw)
        views.append(TrueView(distance, pose, rgb, slam_pose))
    return views


def _apart_m(pose: Pose, other: Pose) -> float:
    return float(np.linalg.norm((pose - other)[:2, 3]))


def _add_views(
    comparison: Comparison, path: str, source: str, ready: tuple[RenderView, float], views: Sequence[TrueView],
    settings: VspaceSettings,
) -> None:  # fmt: skip
    """Render a source at the poses of the true views, and add rows and images to the comparison."""
    render, seconds = ready
    for view in views:
        pose = view.slam_pose if source == "slam-pose" else view.pose
        if pose is None:
            continue
        image, confidence = render(pose, *settings.size, FOV_RAD)
        if source in FILLED:
            image = filled(image, confidence, view.rgb)
        share = float(np.mean(confidence))
        comparison.rows.append(_row(path, source, view.distance_m, image, view.rgb, seconds, share))
        if view.distance_m in STRIP_AT_M:
            strip = comparison.strips.setdefault(path, {}).setdefault(view.distance_m, {"truth": view.rgb})
            strip.setdefault(source, image)


def filled(image: RgbImage, confidence: Any, truth: RgbImage) -> RgbImage:
    """Return an image (H, W, 3) with the truth where the keyframe has not seen the place."""
    return np.where(np.broadcast_to(confidence, truth.shape[:2])[..., None] > 0, image, truth)


def slam_errors(world: World, poses: Sequence[Pose], settings: VspaceSettings) -> NDArray[np.float64] | None:
    """Drive along camera poses (4, 4) on slipping tracks; return the errors (N, 3) of the stack's SLAM there.

    An error is (x, y, yaw) in the robot's true frame. None is returned where the robot cannot drive.
    """
    from instant_ic.experiments.slam import run_log
    from instant_ic.experiments.slam_sim import round_trip

    places = [(float(pose[0, 3]), float(pose[1, 3])) for pose in poses]
    if len(places) < 2:
        return None
    try:
        trip = round_trip(world, seed=settings.seed, rounds=1, route=places)
    except ValueError:  # the robot touches something
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
) -> list[ViewRow]:
    """Compare views at the panorama and 1 m ahead by training time in CPU seconds (see ``converge_on``)."""
    config = config or default_config(settings)
    warm_up(config)
    place = make_place(world, settings.start_seed)
    poses = path_poses(place.world, place.start, "straight", (0.0, 1.0))
    render = place.renderer.render_perspective
    views = [
        TrueView(distance, pose, render(pose, *settings.size, FOV_RAD, 3).rgb)
        for distance, pose in zip((0.0, 1.0), poses, strict=False)
    ]
    shot = take_shot(place.renderer, poses[0], settings.panorama_width, settings.seed)
    return converge_on(shot, views, settings, times_s, config)


def converge_recorded(bag: Path, settings: VspaceSettings, number: int, times_s: Sequence[float]) -> list[ViewRow]:
    """Compare views at a recorded keyframe, and at the later one nearest to 1 m away (0.5 to 1.5 m)."""
    keyframes = read_keyframes(bag)
    here, *later = later_keyframes(keyframes, number, settings, FOV_RAD, itself=True)
    beside = sorted((one for one in later if 0.5 <= one[0] <= 1.5), key=lambda one: abs(one[0] - 1.0))
    views = [TrueView(at, pose, rgb) for at, (_, pose, rgb) in zip((0.0, 1.0), (here, *beside[:1]), strict=False)]
    return converge_on(keyframes[number], views, settings, times_s, default_config(settings))


def converge_on(
    shot: Shot, views: Sequence[TrueView], settings: VspaceSettings, times_s: Sequence[float],
    config: VirtualSpaceConfig,
) -> list[ViewRow]:  # fmt: skip
    """Train from a keyframe and compare at each time: ``ours`` as shown, its ``field`` alone, and ``paper``."""
    rows = []
    trained = replace(config, source="field")
    for name, shown_as in (("ours", ("ours", "field")), ("paper", ("paper",))):
        own = paper_config(trained) if name == "paper" else trained
        space, spent = make_space(shot, name, own), 0.0
        for seconds in sorted(times_s):
            train(space, seconds - spent)
            spent = seconds
            for source in shown_as:
                space.config = field_alone(own) if source == "field" else own
                for view in views:
                    made = space.render(view.pose, *settings.size, FOV_RAD)
                    share = float(made.confidence.mean())
                    rows.append(_row("straight", source, view.distance_m, made.rgb, view.rgb, seconds, share))
            space.config = own
    return rows


def _row(
    path: str, source: str, distance: float, image: RgbImage, truth: RgbImage, seconds: float, confidence: float
) -> ViewRow:
    psnr, similarity = scores(image, truth)
    return ViewRow(
        path, source, distance, round(psnr, 3), round(similarity, 4), round(seconds, 2), round(confidence, 3)
    )
