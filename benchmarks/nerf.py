"""Measures the virtual space on this machine and prints JSON: kernels, time to quality, pictures, memory.

    python benchmarks/nerf.py [--seconds 20] [--world corridor|room]

CPU time of the whole process is measured, not wall time, so that other load on the machine counts little. The scene is
the simulator's corridor (true depth, 1024 × 512 panorama), or the box room of the tests.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import resource
import statistics
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numba import njit
from skimage.metrics import structural_similarity

from instant_ic import paths
from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import equirect_directions
from instant_ic.nerf import PictureConfig, TrainConfig, VirtualSpace, VirtualSpaceConfig, box_room, kernels
from instant_ic.nerf.prior import fill_holes
from instant_ic.nerf.warm_up import warm_up

SIZES = ((320, 180), (640, 360), (1280, 720))
FOV = math.pi / 2


@njit(nogil=True, fastmath=True)
def _encode_all(table, table_grad, touched, cells_per_m, focus, points, backward):  # type: ignore[no-untyped-def]
    x = np.ones((table.shape[0] * table.shape[2], kernels.BLOCK), np.float32)
    levels = table.shape[0] if backward else 1
    entries, weights = np.empty((levels, 8, kernels.BLOCK), np.uint32), np.empty((levels, 8, kernels.BLOCK), np.float32)
    origin = np.zeros(3, np.float32)
    for start in range(0, points.shape[0], kernels.BLOCK):
        kernels.encode_block(table, cells_per_m, origin, focus, points, start, kernels.BLOCK, entries, weights, x)
        if backward:
            kernels.encode_backward_block(table_grad, touched, entries, weights, kernels.BLOCK, x)


def cpu_seconds(call: Callable[[], Any], repeats: int) -> float:
    """Median CPU seconds of a call."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return statistics.median(times)


def hash_encoding(levels: int, features: int, samples: int = 1 << 15) -> dict[str, float]:
    """CPU nanoseconds a sample, points along a wall, all levels counted whole."""
    rng = np.random.default_rng(0)
    table = rng.normal(size=(levels, 1 << 17, features)).astype(np.float32)
    grad, touched = np.zeros_like(table), np.zeros(table.shape[:2], np.uint8)
    cells = np.geomspace(2, 80, levels).astype(np.float32)
    place = np.arange(samples)
    points = np.stack([np.full(samples, 2.0), place % 256 * 0.02, place // 256 * 0.02], axis=1).astype(np.float32)
    focus = np.zeros((1, 4), np.float32)
    result = {}
    for name, backward in (("forward", False), ("forward_backward", True)):
        _encode_all(table, grad, touched, cells, focus, points, backward)
        spent = cpu_seconds(lambda b=backward: _encode_all(table, grad, touched, cells, focus, points, b), 9)
        result[f"{name}_ns"] = round(spent / samples * 1e9, 1)
    return result


def scene(world: str) -> tuple[Any, Any, list[Any], list[Any]]:
    """Panorama, its pose, and pairs of pose and true picture at the keyframe, 1 m ahead and to the side."""
    if world == "room":
        keyframe = np.eye(4)
        poses = [keyframe, pose_matrix(1.0, -0.3), pose_matrix(0.0, -1.0, yaw=0.3)]
        truth = [box_room.perspective(p, *SIZES[0], FOV).rgb for p in poses]
        return box_room.panorama(keyframe, 512), keyframe, poses, truth
    from instant_ic.sim.render import EquirectRenderer
    from instant_ic.sim.worlds import corridor_world

    renderer = EquirectRenderer(corridor_world())
    keyframe = pose_matrix(z=1.2)
    poses = [keyframe, pose_matrix(1.0, 0.0, 1.2), pose_matrix(1.0, 0.5, 1.2, yaw=0.35)]
    truth = [renderer.render_perspective(p, *SIZES[0], FOV).rgb for p in poses]
    return renderer.render(keyframe, 1024, 512), keyframe, poses, truth


def psnr_db(a: Any, b: Any) -> float:
    return 10 * math.log10(255**2 / float(np.mean((a.astype(np.float64) - b) ** 2)))


def point_warp(picture: Any, depth_m: Any, pose: Any, view_pose: Any, width: int, height: int) -> Any:
    """The panorama's pixels as points, nearest first, in a view; holes are filled from around."""
    directions = equirect_directions(*picture.shape[1::-1])
    depth = cv2.resize(depth_m, picture.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    points = (directions * depth[..., None]).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3] - view_pose[:3, 3]
    x, y, z = (points @ view_pose[:3, :3]).T
    focal = 0.5 * width / math.tan(FOV / 2)
    ahead = x > 0.05
    u = np.rint(0.5 * (width - 1) - focal * y[ahead] / x[ahead]).astype(int)
    v = np.rint(0.5 * (height - 1) - focal * z[ahead] / x[ahead]).astype(int)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    at, far = (v * width + u)[inside], x[ahead][inside]
    order = np.argsort(-far, kind="stable")  # the nearest is written last
    image, seen = np.zeros((height * width, 3), np.float32), np.zeros(height * width, bool)
    image[at[order]] = picture.reshape(-1, 3)[ahead][inside][order]
    seen[at] = True
    return fill_holes(image.reshape(height, width, 3), seen.reshape(height, width)).astype(np.uint8)


def against_warp(picture: Any, pose: Any, poses: list[Any], truth: list[Any], iterations: int) -> dict[str, Any]:
    """PSNR (dB) and SSIM at the views after few iterations, by true depth and by the shipped model's."""
    estimate = DepthModel.load(paths.shipped_file("models", DEFAULT_MODEL), threads=1).estimate(picture.rgb)
    true = cv2.resize(picture.depth_m, estimate.shape[::-1], interpolation=cv2.INTER_AREA)
    known = (estimate > 0) & (true > 0)
    estimate = (estimate * np.median(true[known] / estimate[known])).astype(np.float32)
    error = float(np.mean(np.abs(estimate[known] / true[known] - 1)))
    field_only = PictureConfig(panorama_until_db=30.0, field_from_db=30.0)
    result: dict[str, Any] = {"iterations": iterations, "model_depth_error": round(error, 3)}
    for name, depth, sigma in (("true_depth", picture.depth_m, 0.02), ("model_depth", estimate, 0.08)):
        views: dict[str, list[Any]] = {
            "point_warp": [point_warp(picture.rgb, depth, pose, p, *SIZES[0]) for p in poses]
        }
        for label, colour in (("ours", PictureConfig()), ("field_only", field_only)):
            space = VirtualSpace(VirtualSpaceConfig(picture=colour))
            space.set_keyframe(picture.rgb, depth, pose, sigma)
            space.train(iterations=iterations)
            views[label] = [space.render(p, *SIZES[0], FOV).rgb for p in poses]
        for label, drawn in views.items():
            result[f"{name}_{label}"] = [
                (round(psnr_db(a, b), 2), round(float(structural_similarity(a, b, channel_axis=2)), 3))
                for a, b in zip(drawn, truth, strict=True)
            ]
    return result


def measure(world: str, seconds: float) -> dict[str, Any]:
    """Trains for about ``seconds`` of CPU and follows the pictures' PSNR on the way."""
    config = VirtualSpaceConfig(train=TrainConfig())
    start = time.process_time()
    warm_up(config)
    warm = time.process_time() - start
    picture, pose, poses, truth = scene(world)
    space = VirtualSpace(config)
    take = cpu_seconds(lambda: space.set_keyframe(picture.rgb, picture.depth_m, pose, 0.02), 3)
    spent, curve = 0.0, []
    while spent < seconds and not space.status.converged:
        start = time.process_time()
        space.train(iterations=5 if spent < 2 else 25)
        spent += time.process_time() - start
        views = [psnr_db(space.render(p, *SIZES[0], FOV).rgb, t) for p, t in zip(poses, truth, strict=True)]
        ready = space.status.ready_iterations > 0
        curve.append((spent, statistics.mean(views), space.status.psnr_db, ready, views))
    final = curve[-1][1]

    def reached(db: float) -> float:
        return round(next(row[0] for row in curve if row[1] >= final - db), 2)

    frames = {
        f"{w}x{h}": round(cpu_seconds(lambda w=w, h=h: space.render(poses[1], w, h, FOV), 5) * 1e3, 1) for w, h in SIZES
    }
    ready = next((row[0] for row in curve if row[3]), None)
    return {
        "warm_up_cpu_s": round(warm, 2),
        "keyframe_cpu_ms": round(take * 1e3, 1),
        "iterations": space.status.iterations,
        "train_cpu_s": round(spent, 2),
        "ms_per_iteration": round(spent / space.status.iterations * 1e3, 1),
        "ready_after_cpu_s": None if ready is None else round(ready, 2),
        "within_3_db_cpu_s": reached(3),
        "within_1_db_cpu_s": reached(1),
        "final_view_psnr_db": [round(v, 2) for v in curve[-1][4]],
        "final_training_psnr_db": round(curve[-1][2], 2),
        "frame_cpu_ms": frames,
        "against_warp": against_warp(picture, pose, poses, truth, 60) if world == "corridor" else {},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="CPU seconds of training (default 20)")
    parser.add_argument("--world", choices=("corridor", "room"), default="corridor")
    arguments = parser.parse_args()
    result = {
        "machine": platform.processor() or platform.machine(),
        "hash_8x2_T17": hash_encoding(8, 2),
        "hash_8x4_T17": hash_encoding(8, 4),
        "world": arguments.world,
        **measure(arguments.world, arguments.seconds),
        "peak_rss_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
