"""Measures the virtual space on this machine and prints JSON: kernels, time to quality, rendering, memory.

    python benchmarks/nerf.py [--seconds 60] [--world corridor|room] [--only PART ...]

CPU time of the process is measured instead of wall time, so that other load on the machine has little effect. The
machine's own speed affects it fully, so hash encoding and iterations are measured beside a peer in the same run. The
peer is nerfstudio's ``HashEncoding(implementation="torch")`` if nerfstudio is installed, else
``benchmarks/peer_hash.py``, which performs the same operations in torch; ``peer`` names it. The scene is the
simulator's corridor (true depth, 1024 × 512 panorama), or the box room of the tests. ``benchmarks/gpu.py`` measures a
GPU.
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
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from peer_hash import peer_encoding

from instant_ic.experiments import box_room
from instant_ic.geometry.image_quality import psnr_db, ssim
from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace import FieldConfig, PictureConfig, VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.nerf import kernels
from instant_ic.vspace.warm_up import warm_up

SIZES = ((320, 180), (640, 360), (1280, 720))
FOV = math.pi / 2
LOG2_TABLE = 17


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


def wall_points(samples: int) -> Any:
    """Points along a wall, (N, 3)."""
    place = np.arange(samples)
    return np.stack([np.full(samples, 2.0), place % 256 * 0.02, place // 256 * 0.02], axis=1).astype(np.float32)


def hash_encoding(levels: int, features: int, samples: int = 1 << 15) -> dict[str, Any]:
    """CPU nanoseconds per sample of our encoding and the peer's, over all levels, alternating in one run."""
    import torch

    rng = np.random.default_rng(0)
    table = rng.normal(size=(levels, 1 << LOG2_TABLE, features)).astype(np.float32)
    grad, touched = np.zeros_like(table), kernels.no_marks(table)
    cells = np.geomspace(2, 80, levels).astype(np.float32)
    points, focus = wall_points(samples), np.zeros((1, 4), np.float32)
    peer_name, peer = peer_encoding(levels, features, LOG2_TABLE, 16, 640)
    # The peer encodes points of the unit cube.
    unit = torch.from_numpy(points - points.min(axis=0)) / float(np.ptp(points, axis=0).max())

    def ours(backward: bool) -> None:
        _encode_all(table, grad, touched, cells, focus, points, backward)

    def theirs(backward: bool) -> None:
        with torch.set_grad_enabled(backward):
            out = peer(unit)
        if backward:
            out.backward(torch.ones_like(out))

    result: dict[str, Any] = {"peer": peer_name}
    for name, backward in (("forward", False), ("forward_backward", True)):
        ours(backward)
        theirs(backward)
        times = [
            (cpu_seconds(lambda b=backward: ours(b), 3), cpu_seconds(lambda b=backward: theirs(b), 1)) for _ in range(3)
        ]
        mine, peers = (statistics.median(column) / samples * 1e9 for column in zip(*times, strict=True))
        result[f"{name}_ns"] = round(mine, 1)
        result[f"{name}_peer_ns"] = round(peers, 1)
        result[f"{name}_times_faster"] = round(peers / mine, 1)
    return result


def whole_iteration(repeats: int = 5) -> dict[str, Any]:
    """CPU milliseconds of a training step of 16 384 samples.

    Ours includes its rays; the peer is its encoding with torch's network, autograd and Adam on the same number of
    samples.
    """
    import torch

    picture = box_room.panorama(np.eye(4), 256)
    space = VirtualSpace(VirtualSpaceConfig(device="cpu"))
    space.set_keyframe(picture.rgb, picture.depth_m, np.eye(4), 0.02)
    space.train(iterations=3)
    config = space.config.field
    samples = 2 * space.config.train.ray_columns * space.config.train.ray_rows
    name, encoding = peer_encoding(config.levels, config.features, config.log2_table, 16, 640)
    network = torch.nn.Sequential(
        torch.nn.Linear(config.levels * config.features, config.hidden),
        torch.nn.ReLU(),
        torch.nn.Linear(config.hidden, 4),
    )
    adam = torch.optim.Adam([*encoding.parameters(), *network.parameters()], lr=0.01, eps=1e-15)
    rng = np.random.default_rng(0)

    def step() -> None:
        points = torch.from_numpy(rng.random((samples, 3), np.float32))
        target = torch.from_numpy(rng.random((samples, 4), np.float32))
        adam.zero_grad()
        ((network(encoding(points)) - target) ** 2).mean().backward()
        adam.step()

    step()
    ours = cpu_seconds(lambda: space.train(iterations=1), 4 * repeats) * 1e3
    theirs = cpu_seconds(step, repeats) * 1e3
    return {
        "samples": samples,
        "ms": round(ours, 1),
        "peer": name,
        "peer_ms": round(theirs, 1),
        "times_faster": round(theirs / ours, 1),
    }


def scene(world: str) -> tuple[Any, Any, list[Any], list[Any]]:
    """Panorama, its pose, and pairs of pose and ground-truth image at the keyframe, 1 m ahead and to the side."""
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


def shown(source: str) -> VirtualSpaceConfig:
    """``field``: the field alone; ``shown``: the default; ``density``: the field alone, as density."""
    alone = PictureConfig(field_alone=True)
    if source == "shown":
        return VirtualSpaceConfig()
    geometry = "density" if source == "density" else "distance"
    return VirtualSpaceConfig(picture=alone, field=FieldConfig(geometry=geometry))


def time_to_quality(world: str, seconds: float, source: str) -> dict[str, Any]:
    """Train for up to ``seconds`` of CPU (or the schedule's end) and track the views' PSNR.

    ``within_*_cpu_s`` counts from the keyframe's arrival and includes its preparation.
    """
    picture, pose, poses, truth = scene(world)
    space = VirtualSpace(shown(source))
    start = time.process_time()
    space.set_keyframe(picture.rgb, picture.depth_m, pose, 0.02)
    space.render(pose, *SIZES[0], FOV)
    first_picture = time.process_time() - start
    spent, curve = first_picture, []
    while spent < seconds and not space.status.converged:
        start = time.process_time()
        space.train(iterations=5 if space.status.iterations < 60 else 20)
        spent += time.process_time() - start
        drawn = [space.render(p, *SIZES[0], FOV).rgb for p in poses]
        views = [psnr_db(a, b) for a, b in zip(drawn, truth, strict=True)]
        curve.append((spent, statistics.mean(views), space.status.ready_iterations > 0))
    final = max(row[1] for row in curve[-3:])

    def reached(db: float) -> float:
        return round(next(row[0] for row in curve if row[1] >= final - db), 2)

    return {
        "first_picture_cpu_s": round(first_picture, 2),
        "iterations": space.status.iterations,
        "cpu_s": round(spent, 2),
        "ms_per_iteration": round((spent - first_picture) / space.status.iterations * 1e3, 1),
        "ready_after_cpu_s": next((round(row[0], 2) for row in curve if row[2]), None),
        "within_3_db_cpu_s": reached(3),
        "within_1_db_cpu_s": reached(1),
        "training_psnr_db": round(space.status.psnr_db, 2),
        "views": scores(drawn, truth),
        "curve_cpu_s_psnr_db": [(round(row[0], 1), round(row[1], 2)) for row in curve[:: max(1, len(curve) // 15)]],
    }


def scores(drawn: list[Any], truth: list[Any]) -> list[tuple[float, float]]:
    """PSNR in dB and SSIM of each view."""
    return [(round(psnr_db(a, b), 2), round(ssim(a, b), 3)) for a, b in zip(drawn, truth, strict=True)]


def pictures(world: str, train_ms: float = 30.0) -> dict[str, Any]:
    """CPU milliseconds per view and views per second on one thread, alone and with a slice of training each."""
    picture, pose, poses, _ = scene(world)
    result: dict[str, Any] = {"train_ms_per_frame": train_ms}
    for source in ("shown", "field", "density"):
        space = VirtualSpace(shown(source))
        space.set_keyframe(picture.rgb, picture.depth_m, pose, 0.02)
        space.train(iterations=40)
        sizes = {}
        for width, height in SIZES:
            space.render(poses[1], width, height, FOV)

            def frame(w: int = width, h: int = height, space: VirtualSpace = space) -> None:
                space.render(poses[1], w, h, FOV)

            def with_training(frame: Callable[[], None] = frame, space: VirtualSpace = space) -> None:
                frame()
                space.train(budget_ms=train_ms)

            alone, training = cpu_seconds(frame, 5), cpu_seconds(with_training, 5)
            sizes[f"{width}x{height}"] = {
                "cpu_ms": round(alone * 1e3, 1),
                "fps_alone": round(1 / alone, 1),
                "fps_while_training": round(1 / training, 1),
            }
        result[source] = sizes
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="CPU seconds of training, at most (default 60)")
    parser.add_argument("--world", choices=("corridor", "room"), default="corridor")
    parts = ("hash", "iteration", "quality", "pictures")
    parser.add_argument("--only", choices=parts, action="append", help="this part; may be given several times")
    arguments = parser.parse_args()
    wanted, world, seconds = arguments.only or parts, arguments.world, arguments.seconds
    import torch

    torch.set_num_threads(1)
    start = time.process_time()
    warm_up(VirtualSpaceConfig())
    warm_up(VirtualSpaceConfig(field=FieldConfig(geometry="density")))
    result: dict[str, Any] = {
        "machine": platform.processor() or platform.machine(),
        "cpu": cpu_name(),
        "world": world,
        "warm_up_cpu_s": round(time.process_time() - start, 2),
    }
    if "hash" in wanted:
        result["hash_8x2_T17"], result["hash_8x4_T17"] = hash_encoding(8, 2), hash_encoding(8, 4)
    if "iteration" in wanted:
        result["iteration"] = whole_iteration()
    if "quality" in wanted:
        result["time_to_quality"] = {name: time_to_quality(world, seconds, name) for name in ("field", "shown")}
    result["peak_rss_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    if "pictures" in wanted:
        result["pictures"] = pictures(world)
    print(json.dumps(result, indent=2))


def cpu_name() -> str:
    """The processor's name, if Linux reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


if __name__ == "__main__":
    main()
