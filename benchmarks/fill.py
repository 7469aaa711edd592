"""Measures what views show of places that no keyframe has seen, with true depth, and prints JSON.

    python benchmarks/fill.py [--worlds corridor-free random:3] [--places 2] [--older 2] [--strips FOLDER]

Boxes: the keyframe is taken 1 m before a box, views 0 to 2.5 m behind its near face; truth is the world without the
box. Doorways: the keyframe is taken 1 m before a doorway, views 0.5 to 2 m ahead. ``none``: unseen pixels continued
from the image alone; ``inpaint``: OpenCV's (Telea); ``exact``: the truth there, the ceiling of every fill.
``floor_fog``: share of the floor that is unseen and has a colour nearer to the walls' than to the floor's.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from reporting import parser_of, report

from instant_ic.experiments.vspace import path_poses
from instant_ic.experiments.vspace_sources import CAMERA_HEIGHT_M
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import equirect_directions
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.worlds import make_world
from instant_ic.vspace import VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.view import perspective_rays

WIDTH, HEIGHT, FOV = 640, 360, math.pi / 2
BOXES = ((0.5, 0.5, 0.8), (0.6, 0.9, 1.1), (0.4, 0.6, 1.6))
METHODS = ("none", "ours", "inpaint", "exact")


def with_box(rgb: Any, depth: Any, pose: Any, map_from_box: Any, size: tuple[float, float, float]) -> None:
    """Render a box, standing on the floor, into a panorama and its depth, in place."""
    before = depth.copy()
    box_from_camera = np.linalg.inv(map_from_box) @ pose
    half = np.array(size) / 2
    for image in (depth, rgb):
        height, width = image.shape[:2]
        directions = equirect_directions(width, height) @ box_from_camera[:3, :3].T
        with np.errstate(divide="ignore"):
            sides = np.stack([(sign * half - box_from_camera[:3, 3]) / directions for sign in (-1, 1)])
        enter, leave = sides.min(axis=0), sides.max(axis=0)
        distance = enter.max(axis=-1)
        step = height // before.shape[0]
        behind = np.repeat(np.repeat(before, step, 0), step, 1)
        hit = (distance > 0) & (distance < leave.min(axis=-1)) & ((distance < behind) | (behind == 0))
        if image is depth:
            depth[hit] = distance[hit]
        else:
            shade = np.array([0.82, 0.7, 1.0])[enter.argmax(axis=-1)]
            rgb[hit] = (shade[..., None] * (232, 230, 222))[hit].astype(np.uint8)


def places(world: Any, renderer: EquirectRenderer, kind: str, count: int) -> list[tuple[float, float, float]]:
    """Starts (x, y, yaw), 1 m before a place for a box or a doorway, apart from each other."""
    found: list[tuple[float, float, float]] = []
    steps = np.arange(-2.0, 3.76, 0.25) if kind == "box" else np.arange(0, 2.01, 0.2)
    for x, y, yaw in world.sample_free_poses(np.random.default_rng(0), 600, 0.35):
        start = (float(x), float(y), float(yaw))
        if kind == "doorway":
            entry = before_doorway(renderer, start)
            if entry is None:
                continue
            start = entry
        if len(path_poses(world, start, "straight", steps)) < len(steps):
            continue
        if all(math.dist(start[:2], other[:2]) >= 1 for other in found):
            found.append(start)
        if len(found) == count:
            break
    return found


def before_doorway(renderer: EquirectRenderer, start: tuple[float, float, float]) -> Any:
    """The pose 1 m before the middle of a doorway ahead of a start, None where there is none."""
    x, y, yaw = start[0], start[1], round(start[2] / (math.pi / 2)) * math.pi / 2
    ahead, left = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])

    def sides(distance: float, aside: float = 0.0) -> Any:
        place = np.array([x, y]) + distance * ahead + aside * left
        origins = np.array([[*place, 0.9]] * 2, np.float32)
        return renderer.cast(origins, np.array([[*left, 0], [*-left, 0]], np.float32))[0]

    narrow = [(distance, sides(distance)) for distance in np.arange(0.4, 2.5, 0.1)]
    narrow = [one for one in narrow if one[1].max() < 0.8]
    if not narrow:
        return None
    distance, walls = min(narrow, key=lambda one: abs(one[1][0] - one[1][1]))
    aside = (walls[0] - walls[1]) / 2
    if min(sides(distance - 0.7, aside).sum(), sides(distance + 0.7, aside).sum()) < 1.6:
        return None
    return *(np.array([x, y]) + (distance - 1) * ahead + aside * left), yaw


def floor_fog(image: Any, truth: Any, depth: Any, pose: Any, unseen: Any) -> float:
    """See the module; NaN where too little floor or wall is in view."""
    rays = perspective_rays(pose, WIDTH, HEIGHT, FOV)
    rise = (rays.origin[2] + depth.reshape(-1) * rays.directions[:, 2]).reshape(depth.shape)
    floor, wall = rise < 0.05, (rise > 0.3) & (rise < 2)
    if floor.sum() < 200 or wall.sum() < 200:
        return math.nan
    means = truth[floor].mean(axis=0), truth[wall].mean(axis=0)

    def foggy(colours: Any) -> Any:
        away = [np.linalg.norm(colours[floor].astype(float) - mean, axis=1) for mean in means]
        return away[0] > away[1]

    textured = foggy(truth)
    return float((foggy(image) & ~textured & unseen[floor]).sum() / max(1, (~textured).sum()))


def measure(renderer: EquirectRenderer, kind: str, start: Any, number: int, older: int) -> tuple[list[Any], Any]:
    """Rows (distance, {method: (dB, fog)}) and the views side by side: truth and ``METHODS``."""
    origin = pose_matrix(start[0], start[1], CAMERA_HEIGHT_M, yaw=start[2])
    size = BOXES[number % len(BOXES)]
    space = VirtualSpace(VirtualSpaceConfig(device="cpu", source="warp", older=older))
    for back in (2, 1, 0) if older and kind == "box" else (0,):
        pose = origin @ pose_matrix(-float(back))
        rgb = renderer.render(pose, 1024, 512, supersample=2).rgb.copy()
        depth = renderer.render(pose, 512, 256).depth_m.copy()
        depth[~np.isfinite(depth)] = 0
        if kind == "box":
            with_box(rgb, depth, pose, origin @ pose_matrix(1 + size[0] / 2, z=size[2] / 2 - CAMERA_HEIGHT_M), size)
        space.set_keyframe(rgb, depth, pose, 0.02)
    rows, strip = [], []
    for distance in (0, 0.5, 1, 1.5, 2, 2.5) if kind == "box" else (0.5, 1, 1.5, 2):
        pose = origin @ pose_matrix(distance + (1 if kind == "box" else 0))
        frame = renderer.render_perspective(pose, WIDTH, HEIGHT, FOV, supersample=2)
        view = space.render(pose, WIDTH, HEIGHT, FOV)
        unseen = view.confidence == 0
        assert space.keyframe is not None and space.shown is not None
        plain = space.shown.newest.warp.render(pose, WIDTH, HEIGHT, FOV).rgb
        exact = np.where(unseen[..., None], frame.rgb, view.rgb)
        images = (plain, view.rgb, cv2.inpaint(plain, unseen.astype(np.uint8), 3, cv2.INPAINT_TELEA), exact)
        rows.append(
            (distance, {
                method: (psnr_db(image, frame.rgb), floor_fog(image, frame.rgb, frame.depth_m, pose, unseen))
                for method, image in zip(METHODS, images, strict=True)
            })
        )  # fmt: skip
        strip.append(np.concatenate([frame.rgb, *images], axis=1)[::2, ::2])
    return rows, np.concatenate(strip)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--worlds", nargs="+", default=["corridor-free", "random:3", "random:8", "random:21"])
    parser.add_argument("--places", type=int, default=2, help="of each kind in a world (default 2)")
    parser.add_argument("--older", type=int, default=2, help="older keyframes, 1 m apart (default 2)")
    parser.add_argument("--strips", type=Path, help="folder for images: truth, none, ours, inpaint, exact")
    arguments = parser.parse_args()
    rows: dict[str, list[Any]] = {"box": [], "doorway": []}
    result: dict[str, Any] = {"worlds": {}}
    for name in arguments.worlds:
        world = make_world(name)
        renderer = EquirectRenderer(world)
        for kind, all_rows in rows.items():
            here = []
            for number, start in enumerate(places(world, renderer, kind, arguments.places)):
                measured, strip = measure(renderer, kind, start, number, arguments.older)
                here += measured
                if arguments.strips:
                    arguments.strips.mkdir(parents=True, exist_ok=True)
                    label = Path(name).stem.replace(":", "")
                    cv2.imwrite(str(arguments.strips / f"{label}_{kind}_{number}.png"), strip[..., ::-1])
            all_rows += here
            if here:
                result["worlds"].setdefault(Path(name).name, {})[kind] = means(here)
    for kind, all_rows in rows.items():
        if all_rows:
            distances = sorted({distance for distance, _ in all_rows})
            by_distance = {str(d): means([row for row in all_rows if row[0] == d]) for d in distances}
            result[kind] = {"mean": means(all_rows), "by_distance_m": by_distance}
    report(result, arguments.json)


def means(rows: list[Any]) -> dict[str, dict[str, float]]:
    """Mean PSNR (dB) and floor fog of each method."""
    table = {method: np.array([row[method] for _, row in rows]) for method in METHODS}
    return {
        method: {"psnr_db": round(float(values[:, 0].mean()), 2), "floor_fog": round(_mean(values[:, 1]), 3)}
        for method, values in table.items()
    }


def _mean(values: Any) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else math.nan


if __name__ == "__main__":
    main()
