"""Views behind an obstacle with depth from the local 3D model, against one revolution, the network and true depth.

    python benchmarks/local_model.py --mesh ../shared/data/worlds/small_house.glb --strips DIR

In each world a robot drives 2.5 m towards a box; the keyframe is taken 1 m before it. Views of 640 x 360 pixels and 90
degrees, 0 to 2.5 m behind the box's near face, are compared with the world without the box. The mapper's CPU time is
that of this process for revolutions as they come at 0.5 m/s, 10 a second, and at rest. Prints JSON.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from reporting import parser_of, report

from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
from instant_ic.depth.scaler import ScalerConfig
from instant_ic.depth.sources import DepthSource, SourceConfig
from instant_ic.experiments.depth_lidar import Errors, measure_world
from instant_ic.experiments.depth_worlds import CAMERA_HEIGHT_M, LIDAR_HEIGHT_M
from instant_ic.geometry.image_quality import psnr_db, ssim
from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.transforms import TransformBuffer
from instant_ic.lidar.deskew import Revolution
from instant_ic.mapping.local_model import warm_up
from instant_ic.mapping.mapper import LocalMapper, LocalView
from instant_ic.sim.render import EquirectRenderer, Frame
from instant_ic.sim.world import Material, World, WorldBuilder
from instant_ic.sim.worlds import corridor_world, load_world, long_world, random_world
from instant_ic.util.paths import shipped_file
from instant_ic.vspace import VirtualSpace, VirtualSpaceConfig

BEHIND_M = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5)
APPROACH_M, BEFORE_M, SPEED = 2.5, 1.0, 0.5
SIZE = (256, 512)
UP = np.array([0.0, 0.0, 1.0])
S = 1_000_000_000


class WithBox:
    """Renders a world with a box in it."""

    def __init__(self, world: EquirectRenderer, box: EquirectRenderer) -> None:
        self.parts = (world, box)

    def render(self, pose: np.ndarray, width: int, height: int, supersample: int = 1) -> Frame:
        """As ``EquirectRenderer.render``."""
        room, box = (part.render(pose, width, height, supersample) for part in self.parts)
        on = (box.depth_m > 0) & ((box.depth_m < room.depth_m) | (room.depth_m <= 0))
        return Frame(np.where(on[..., None], box.rgb, room.rgb), np.where(on, box.depth_m, room.depth_m))

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, None]:
        """As ``EquirectRenderer.cast``, without the faces."""
        return np.minimum(*(part.cast(origins, directions)[0] for part in self.parts)), None


@dataclass(frozen=True)
class Scene:
    """A world with and without the box, and the line of the drive: start (x, y, yaw)."""

    name: str
    free: EquirectRenderer
    full: Any
    start: tuple[float, float, float]

    def pose(self, along_m: float) -> np.ndarray:
        """Pose of the camera on the line."""
        x, y, yaw = self.start
        return pose_matrix(x + along_m * math.cos(yaw), y + along_m * math.sin(yaw), CAMERA_HEIGHT_M, yaw=yaw)


def scenes(args: argparse.Namespace) -> Iterator[Scene]:
    """The corridor with its own box, and other worlds with one on a free line."""
    start = (4.0 - BEFORE_M - APPROACH_M, 0.0, 0.0)
    yield Scene("corridor", EquirectRenderer(corridor_world(obstacle=False)), EquirectRenderer(corridor_world()), start)
    worlds = [lambda seed=seed: random_world(seed) for seed in range(args.seed, args.seed + args.count)]
    worlds += [lambda seed=seed: long_world(seed) for seed in range(args.seed, args.seed + (args.count + 1) // 2)]
    worlds += [lambda path=path: load_world(path) for path in args.mesh]
    for make in worlds:
        world = make()
        line = free_line(world, np.random.default_rng(args.seed))
        if line is not None:
            x, y, yaw = line
            builder = WorldBuilder()
            centre = (APPROACH_M + BEFORE_M + 0.25) * np.array([math.cos(yaw), math.sin(yaw)]) + (x, y)
            builder.box(tuple(centre), (0.5, 0.5, 0.8), yaw=yaw, side=Material("white", 0.7, (1.0, 0.99, 0.965)))
            free = EquirectRenderer(world)
            box = EquirectRenderer(builder.build("box", 0.1, (0.0, 0.0, 0.0)))
            yield Scene(Path(world.name).name, free, WithBox(free, box), line)


def free_line(world: World, rng: np.random.Generator) -> tuple[float, float, float] | None:
    """Start of a straight line with 0.3 m free on both sides, from 0.3 m before the start to 3.5 m behind the box."""
    plan = world.occupied(0.03, 1.9, 0.05)
    try:
        places = world.sample_free_poses(rng, 1500)
    except ValueError:
        return None
    along = np.arange(-0.3, APPROACH_M + BEFORE_M + 3.5, 0.05)[:, None, None]
    for x, y, yaw in places:
        for turn in range(8):
            heading = np.array([math.cos(yaw + turn * math.pi / 4), math.sin(yaw + turn * math.pi / 4)])
            aside = np.linspace(-0.3, 0.3, 7)[None, :, None] * np.array([-heading[1], heading[0]])
            if not plan.at((np.array([x, y]) + along * heading + aside).reshape(-1, 2)).any():
                return float(x), float(y), float(yaw + turn * math.pi / 4)
    return None


def mapped(scene: Scene) -> tuple[LocalMapper, np.ndarray, float]:
    """The model at the keyframe, the points of the last revolution there, and CPU seconds a second of the drive."""
    transforms = TransformBuffer(cache_s=1e6)
    transforms.set("base_link", "velodyne", 0, pose_matrix(0, 0, LIDAR_HEIGHT_M), static=True)
    count = round(APPROACH_M / SPEED * 10) + 1
    lidar_from_camera = pose_matrix(0, 0, CAMERA_HEIGHT_M - LIDAR_HEIGHT_M)
    for k in range(count + 2):
        pose = scene.pose(min(k * 0.1 * SPEED, APPROACH_M))
        pose[2, 3] = 0.0
        transforms.set("odom", "base_link", k * S // 10, pose)
    mapper, points, cpu_s = LocalMapper(transforms), np.empty((0, 3)), 0.0
    for k in range(count + 1):
        pose = scene.pose(min(k * 0.1 * SPEED, APPROACH_M))
        points = measure_world(scene.full, pose, LIDAR_HEIGHT_M, CAMERA_HEIGHT_M, Errors(seed=k)).astype(float)
        at_lidar = points + lidar_from_camera[:3, 3]
        # A real revolution has twice as many points; all of one moment, as if the robot stopped for each.
        at_lidar = np.repeat(at_lidar, 2, axis=0)
        begin = time.process_time()
        mapper.revolution(Revolution("velodyne", k * S // 10, np.zeros(len(at_lidar)), lambda p=at_lidar: p))
        cpu_s += time.process_time() - begin
    return mapper, points, cpu_s / (APPROACH_M / SPEED)


def evaluate(scene: Scene, model: DepthModel, strips: Path | None) -> dict[str, Any]:
    """Quality by source of depth."""
    mapper, points, cpu = mapped(scene)
    pose = scene.pose(APPROACH_M)
    rgb, true = scene.full.render(pose, 1024, 512, 2).rgb, scene.full.render(pose, SIZE[1], SIZE[0]).depth_m
    raw = model.estimate(rgb)
    fused = DepthSource(SourceConfig(scaler=ScalerConfig(output_kind=model.manifest.output_kind)))
    alone = DepthSource(SourceConfig(source="lidar"))
    local = LocalView(mapper.model, pose)
    begin = time.process_time()
    modelled = fused.estimate(raw, points, UP, CAMERA_HEIGHT_M, local=local)
    depth_s = time.process_time() - begin
    results = {
        "structure alone": alone.estimate(None, points, UP, CAMERA_HEIGHT_M, SIZE),
        "structure and network": fused.estimate(raw, points, UP, CAMERA_HEIGHT_M),
        "local model": modelled,
    }
    depths = {name: (one.depth_m, one.sigma) for name, one in results.items()} | {"true depth": (true, 0.02)}
    views = [scene.pose(APPROACH_M + BEFORE_M + behind) for behind in BEHIND_M]
    truths = [scene.free.render_perspective(view, 640, 360, math.pi / 2, 2).rgb for view in views]
    found: dict[str, Any] = {"cpu_share": round(cpu, 4), "depth_cpu_s": round(depth_s, 4)}
    rows = [np.hstack(truths)]
    for name, (depth, sigma) in depths.items():
        space = VirtualSpace(VirtualSpaceConfig(source="warp", panorama_width=1024))
        space.set_keyframe(rgb, depth, pose, sigma)
        shown = [space.render(view, 640, 360, math.pi / 2).rgb for view in views]
        rows.append(np.hstack(shown))
        known = (true > 0) & (depth > 0)
        known[round(160 / 180 * SIZE[0]) :] = False  # the robot itself
        weight = np.cos(np.pi / 2 - (np.arange(SIZE[0]) + 0.5) * np.pi / SIZE[0])[:, None] * known
        error = np.minimum(np.abs(np.where(known, depth / np.where(known, true, 1) - 1, 0)), 1)
        quality = np.array([(psnr_db(a, b), ssim(a, b)) for a, b in zip(shown, truths, strict=True)])
        found[name] = {
            "psnr_db": np.round(quality[:, 0], 2).tolist(),
            "psnr_db_half_to_2_m": round(float(quality[1:5, 0].mean()), 2),
            "ssim_half_to_2_m": round(float(quality[1:5, 1].mean()), 3),
            "psnr_db_2_5_m": round(float(quality[5, 0]), 2),
            "mre": round(float((error * weight).sum() / weight.sum()), 4),
        }
    if strips is not None:
        import cv2

        strips.mkdir(parents=True, exist_ok=True)
        sheet = cv2.resize(np.vstack(rows), (1920, 180 * len(rows)), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(strips / f"{scene.name.replace(':', '_')}.jpg"), sheet[..., ::-1])
    return found


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=4, help="random worlds; half as many long ones")
    parser.add_argument("--seed", type=int, default=930_000, help="of the first world")
    parser.add_argument("--mesh", type=Path, nargs="*", default=[], help="mesh worlds besides")
    parser.add_argument(
        "--strips", type=Path, metavar="DIR", help="images: truth, then the sources in the order printed"
    )
    args = parser.parse_args()
    model = DepthModel.load(shipped_file("models", DEFAULT_MODEL), threads=1)
    warm_up()
    worlds = {scene.name: evaluate(scene, model, args.strips) for scene in scenes(args)}
    mean: dict[str, Any] = {"cpu_share": round(float(np.mean([one["cpu_share"] for one in worlds.values()])), 4)}
    for name in ("structure alone", "structure and network", "local model", "true depth"):
        keys = ("psnr_db_half_to_2_m", "ssim_half_to_2_m", "psnr_db_2_5_m", "mre")
        mean[name] = {key: round(float(np.mean([one[name][key] for one in worlds.values()])), 4) for key in keys}
    report({"worlds": worlds, "mean": mean}, args.json)


if __name__ == "__main__":
    main()
