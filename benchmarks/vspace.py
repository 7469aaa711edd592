"""Measures the rendered views of the virtual space against their targets and prints JSON.

    python benchmarks/vspace.py [--mesh small_house.glb] [--size 640x360] [--seconds 8] [--only speed,resolution]

``speed``: the depth warp, CPU ms per view, and the first view after a keyframe. ``resolution``: gain of a panorama's
full resolution over 1024 × 512 point samples. ``keyframes``: three keyframes against the best warp of the nearest one.
``ic evaluate vspace`` gives the curves by distance. CPU times are of one thread, so that other load has little effect.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.experiments.vspace import evaluate, path_poses, scores, start_pose
from instant_ic.experiments.vspace_sources import CAMERA_HEIGHT_M, VspaceSettings
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.worlds import make_world
from instant_ic.vspace import VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.warm_up import warm_up
from instant_ic.vspace.warp import PanoramaWarp

SIZES = ((320, 180), (640, 360), (1280, 720))
FOV = math.pi / 2
PARTS = ("speed", "resolution", "keyframes")


def speed(rgb: Any, depth_m: Any, pose: Any) -> dict[str, Any]:
    """CPU ms of the warp and of the first view after a keyframe, with the model's depth size of 512 × 256."""
    warp = PanoramaWarp(rgb, depth_m, pose)
    view = pose @ pose_matrix(1.0)
    result: dict[str, Any] = {}
    for width, height in SIZES:
        times = []
        for _ in range(7):
            start = time.process_time()
            warp.render(view, width, height, FOV)
            times.append((time.process_time() - start) * 1e3)
        result[f"warp_{width}x{height}_cpu_ms"] = round(statistics.median(times), 1)
    config = VirtualSpaceConfig(device="cpu")
    warm_up(config)
    cpu, wall = [], []
    for _ in range(3):
        space = VirtualSpace(config)
        started, start = time.perf_counter(), time.process_time()
        space.set_keyframe(rgb, depth_m, pose, 0.03)
        space.render(view, *SIZES[0], FOV)
        cpu.append(time.process_time() - start)
        wall.append(time.perf_counter() - started)
    result["first_picture_cpu_ms"] = round(statistics.median(cpu) * 1e3, 1)
    result["first_picture_wall_ms"] = round(statistics.median(wall) * 1e3, 1)
    return result


def resolution(renderer: EquirectRenderer, pose: Any, depth_m: Any, full: Any, size: tuple[int, int]) -> dict[str, Any]:
    """PSNR and SSIM 1 m ahead by panorama: 1024 × 512 point samples, the same area-averaged, full; true depth."""
    view = pose @ pose_matrix(1.0)
    truth = renderer.render_perspective(view, *size, FOV, supersample=3).rgb
    step = full.shape[1] // 1024
    averaged = renderer.render(pose, 1024, 512, supersample=4).rgb
    panoramas = {
        "1024x512 point samples": np.ascontiguousarray(full[step // 2 :: step, step // 2 :: step]),
        "1024x512 area-averaged": averaged,
        f"{full.shape[1]}x{full.shape[0]}": full,
    }
    result = {}
    for name, rgb in panoramas.items():
        drawn = PanoramaWarp(rgb, depth_m, pose).render(view, *size, FOV)
        psnr, ssim = scores(drawn.rgb, truth)
        seen = psnr_db(drawn.rgb[drawn.confidence > 0], truth[drawn.confidence > 0])
        result[name] = {"psnr_db": round(psnr, 2), "ssim": round(ssim, 4), "psnr_db_of_what_is_seen": round(seen, 2)}
    return result


def keyframes(world: str, start: tuple[float, float, float] | None, size: tuple[int, int], seconds: float) -> Any:
    """Three keyframes, each a metre behind the next, against warps of the nearest, 1 and 2 m ahead."""
    settings = VspaceSettings(
        sources=("ours", "depth-warp", "point-warp"), keyframes=3, step_m=1.0, reach_m=2.0, size=size, seconds=seconds
    )
    report = evaluate(world, settings, start)
    taken = {path: figures["panoramas"] for path, figures in report.depth.items()}
    return {"keyframes": taken, **{key: report.table(key) for key in ("psnr_db", "ssim")}, "verdict": report.verdict()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", type=Path, help="also a world from a mesh file")
    parser.add_argument("--mesh-start", type=float, nargs=3, default=(6.3, -2.4, 180.0), metavar=("X", "Y", "DEG"))
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--seconds", type=float, default=8.0, help="CPU s of training a keyframe (default 8)")
    parser.add_argument("--only", default=",".join(PARTS), help=f"some of {', '.join(PARTS)} (default all)")
    arguments = parser.parse_args()
    width, height = (int(n) for n in arguments.size.split("x"))
    parts = arguments.only.split(",")
    if unknown := set(parts) - set(PARTS):
        parser.error(f"--only: {', '.join(sorted(unknown))} is none of {', '.join(PARTS)}")
    x, y, degrees = arguments.mesh_start
    worlds: list[tuple[str, tuple[float, float, float] | None]] = [("corridor", None)]
    if arguments.mesh:
        worlds.append((str(arguments.mesh), (x, y, math.radians(degrees))))
    result: dict[str, Any] = {"machine": platform.processor() or platform.machine(), "size": arguments.size}
    for name, wanted in worlds:
        entry: dict[str, Any] = {}
        if "speed" in parts or "resolution" in parts:
            world = make_world(name)
            renderer = EquirectRenderer(world)
            sx, sy, yaw = start_pose(world, wanted)
            assert len(path_poses(world, (sx, sy, yaw), "straight", (0.0, 1.0))) == 2
            pose = pose_matrix(sx, sy, CAMERA_HEIGHT_M, yaw=yaw)
            full = renderer.render(pose, 4096, 2048).rgb
            depth_m = renderer.render(pose, 1024, 512).depth_m
            if "speed" in parts:
                entry["speed"] = speed(full[::2, ::2].copy(), depth_m[::2, ::2].copy(), pose)
            if "resolution" in parts:
                entry["resolution"] = resolution(renderer, pose, depth_m, full, (width, height))
        if "keyframes" in parts:
            # Behind the corridor's own start there is no room for two keyframes.
            entry["keyframes"] = keyframes(name, wanted or (0.4, 0.0, 0.0), (width, height), arguments.seconds)
        result[Path(name).name] = entry
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
