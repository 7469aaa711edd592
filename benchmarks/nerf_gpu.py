"""The virtual space on an NVIDIA GPU: the figures of its targets, for the Triton kernels and for plain torch.

    python benchmarks/nerf_gpu.py [--world corridor|room] [--seconds 10]

Prints JSON for the field alone, and ``as_shown``, which starts with the panorama's warp. Wall time after GPU
synchronisation; medians. Without a GPU every figure is "not measured", with the reason. ``start_s`` of ``triton``
includes the compilation, unless the kernels are already in the cache (``cache_dir``).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from nerf import FOV, scene

from instant_ic import paths
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.vspace import PictureConfig, VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.view import perspective_rays

SIZES = ((320, 180), (640, 360), (1280, 720))
TARGETS = {
    "within_1_db_s": "at most 1",
    "fps_alone_1280x720": "at least 60",
    "fps_while_training_1280x720": "at least 30",
    "first_picture_s": "at most 0.3",
}


def median_s(call: Callable[[], object], repeats: int = 15) -> float:
    import torch

    call()
    times = []
    for _ in range(repeats):
        torch.cuda.synchronize()
        start = time.perf_counter()
        call()
        torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def quality(config: VirtualSpaceConfig, world: str, seconds: float) -> dict[str, Any]:
    """Training time until the views are within 1 dB of the last; rendering in between is not counted."""
    picture, pose, poses, truth = scene(world)
    space = VirtualSpace(config)
    space.set_keyframe(picture.rgb, picture.depth_m, pose, 0.02)
    spent, curve = 0.0, []
    while spent < seconds and not space.status.converged:
        start = time.perf_counter()
        space.train(iterations=10)
        spent += time.perf_counter() - start
        views = [psnr_db(space.render(p, *SIZES[0], FOV).rgb, t) for p, t in zip(poses, truth, strict=True)]
        curve.append((spent, statistics.mean(views)))
    final = curve[-1][1]
    return {
        "within_1_db_s": round(next(at for at, db in curve if db >= final - 1), 3),
        "within_3_db_s": round(next(at for at, db in curve if db >= final - 3), 3),
        "final_view_psnr_db": round(final, 2),
        "iterations": space.status.iterations,
        "ms_per_iteration": round(1e3 * spent / space.status.iterations, 3),
    }


def speed(config: VirtualSpaceConfig, world: str) -> dict[str, Any]:
    """First view, views per second alone and with ten iterations each, and the field's share of a view."""
    import torch

    picture, pose, poses, _ = scene(world)
    start = time.perf_counter()
    space = VirtualSpace(config)
    started = time.perf_counter() - start
    space.set_keyframe(picture.rgb, picture.depth_m, pose, 0.02)  # allocates buffers and compiles kernels
    space.train(iterations=3)
    space.render(poses[1], *SIZES[2], FOV)
    start = time.perf_counter()
    space.set_keyframe(picture.rgb, picture.depth_m, poses[0], 0.02)
    space.render(poses[1], *SIZES[2], FOV)
    torch.cuda.synchronize()
    first = time.perf_counter() - start
    space.train(iterations=200)
    result: dict[str, Any] = {
        "device": space.status.device,
        "start_s": round(started, 2),
        "first_picture_s": round(first, 3),
    }
    uniform = np.random.default_rng(0).random((config.train.ray_columns * config.train.ray_rows, 3), np.float32)
    step = median_s(lambda: space._device.step(uniform, 1e-4, 1e-4), 50)
    result["step_ms"] = round(1e3 * step, 3)
    result["step_ns_a_sample"] = round(1e9 * step / (2 * len(uniform)), 1)  # hash, network, loss, gradient, Adam
    for width, height in SIZES:
        rays = perspective_rays(poses[1], width, height, FOV)

        def frame(w: int = width, h: int = height) -> None:
            space.render(poses[1], w, h, FOV)

        def with_training(w: int = width, h: int = height) -> None:
            for _ in range(10):
                space._device.step(uniform, 1e-4, 1e-4)
            space.render(poses[1], w, h, FOV)

        name = f"{width}x{height}"
        result[f"fps_alone_{name}"] = round(1 / median_s(frame), 1)
        result[f"fps_while_training_{name}"] = round(1 / median_s(with_training), 1)
        result[f"field_ms_{name}"] = round(1e3 * median_s(lambda rays=rays: space._device.draw(rays, 0.0, 0.5)), 2)
    result["gpu_memory_mb"] = round(torch.cuda.max_memory_allocated() / 2**20)
    return result


def not_measured(reason: str) -> dict[str, Any]:
    words = f"not measured: {reason}"
    shown = dict.fromkeys([key for key in TARGETS if key != "within_1_db_s"], words)
    return {**dict.fromkeys((*TARGETS, "step_ms"), words), "as_shown": shown}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", choices=("corridor", "room"), default="corridor")
    parser.add_argument("--seconds", type=float, default=10.0, help="of training at most (default 10)")
    arguments = parser.parse_args()
    result: dict[str, Any] = {"targets": TARGETS, "cache_dir": str(paths.cache_dir() / "triton")}
    import torch

    reason = "" if torch.cuda.is_available() else "torch finds no CUDA device"
    field = PictureConfig(panorama_until_db=0.0, field_from_db=0.0)
    for device in ("triton", "torch-cuda"):
        if reason:
            result[device] = not_measured(reason)
            continue
        config = VirtualSpaceConfig(device=device, picture=field)
        try:
            torch.cuda.reset_peak_memory_stats()
            result[device] = {**speed(config, arguments.world), **quality(config, arguments.world, arguments.seconds)}
            shown = dataclasses.replace(config, picture=PictureConfig())
            result[device]["as_shown"] = speed(shown, arguments.world)
        except RuntimeError as error:  # a failure of one backend must not hide the other's figures
            result[device] = not_measured(f"{type(error).__name__}: {error}")
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
