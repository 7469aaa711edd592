#!/usr/bin/env python3
"""The virtual space's field on an NVIDIA GPU: training, views, and the field against the warp.

    python benchmarks/gpu.py [--step train,views,field-or-warp] [--out runs/gpu]
    python benchmarks/gpu.py --cpu --step train,views --worlds corridor

- train: time until views of the field are within 1 dB of its final ones. The paper needs 3 to 4 s; target: at most 1 s.
- views: views a second, alone and while training. The paper has 10; target: at least 60 at 1280 x 720.
- field-or-warp: PSNR and SSIM of the field and of the paper's field (density) against the warp of the same keyframes,
  with one and several keyframes, true and wrong depth, on views of places that were left out.

Each step takes less than 10 minutes (``--seconds`` limits each training) and writes OUT/STEP.json. Times are wall time;
every call ends with a copy to the CPU. ``--cpu`` measures the CPU's kernels, in CPU seconds of one thread. Otherwise an
NVIDIA GPU, torch's CUDA build and ``pip install 'instant-ic[triton]'`` are needed.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import platform
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from reporting import note, parser_for, report

from instant_ic.geometry.image_quality import psnr_db, ssim
from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.worlds import make_world
from instant_ic.vspace import FieldConfig, TrainConfig, ViewContentConfig, VirtualSpace, VirtualSpaceConfig

FOV = math.pi / 2
PANORAMA = 1024
"""Width of the keyframes' panoramas in pixels."""
SIZES = ((320, 180), (640, 360), (1280, 720))
"""Sizes of the timed views, width and height in pixels."""
FIELD_ONLY = ViewContentConfig(field_alone=True)
KEYFRAMES = {"one": (0.0,), "three": (-1.5, -0.75, 0.0), "three, one ahead": (-1.5, 3.0, 0.0)}
"""Places of the keyframes along x in metres, in order of arrival."""
DEPTH_ERRORS = (0.0, 0.04)
"""Standard deviations of the keyframes' depth errors, as a share of the depth."""
LEFT_OUT = {0.5: (0.5, 0.0, 0.0), 1.0: (1.0, -0.2, 0.3), 1.5: (1.5, 0.2, -0.4), 2.0: (2.0, 0.0, 0.0)}
"""Places of the judged views by distance from the newest keyframe: x, y in metres, yaw in radians."""
REPEATS, SLOW_S = 15, 4.0
"""Number of timed calls, and the time in seconds after which fewer are enough."""


@dataclass(frozen=True)
class GpuRun:
    """Options of a run on GPU or CPU.

    Attributes:
        devices: names as in ``VirtualSpaceConfig.device``; field-or-warp uses the first one.
        seconds: longest time of a training.
        worlds: names as in ``make_world``.
        view: size of the views whose quality is measured, width and height in pixels.
        clock: seconds; CPU seconds in a run on the CPU.
    """

    devices: Sequence[str]
    seconds: float
    worlds: Sequence[str]
    view: tuple[int, int] = (640, 360)
    train: TrainConfig = field(default_factory=TrainConfig)
    clock: Callable[[], float] = time.perf_counter

    def median_s(self, call: Callable[[], object]) -> float:
        """Return the median time of a call in seconds, after a first call that is not timed."""
        call()
        times: list[float] = []
        while len(times) < REPEATS and sum(times) < SLOW_S:
            start = self.clock()
            call()
            times.append(self.clock() - start)
        return statistics.median(times)

    def config(self, device: str, **changes: Any) -> VirtualSpaceConfig:
        """Return the configuration of a space on a device."""
        return VirtualSpaceConfig(device=device, train=self.train, **changes)


class SimulatedPlace:
    """A simulated world seen from its start; poses are relative to that."""

    def __init__(self, name: str, view: tuple[int, int]) -> None:
        world = make_world(name)
        x, y, _ = world.spawn
        self._renderer, self._view = EquirectRenderer(world), view
        # Keyframes and views lie along the longest free way.
        free_m = self._renderer.render(pose_matrix(x, y, 1.2), 64, 32).depth_m[14:18].min(axis=0)
        ways = np.minimum(free_m, np.roll(free_m, 32) + 1.5)  # ahead, and half as far behind
        self.start = pose_matrix(x, y, 1.2, yaw=math.pi - (int(np.argmax(ways)) + 0.5) * (2 * math.pi / 64))

    def keyframe(self, x: float, depth_error: float = 0.0) -> tuple[Any, ...]:
        """Return the arguments of ``VirtualSpace.set_keyframe``.

        Args:
            x: place of the camera along the way, in metres.
            depth_error: standard deviation of smooth depth errors, as a share of the depth.
        """
        pose = self.start @ pose_matrix(x)
        panorama = self._renderer.render(pose, PANORAMA, PANORAMA // 2, supersample=2)
        coarse = np.random.default_rng(round(100 * x) + 1000).normal(size=(9, 16)).astype(np.float32)
        smooth = cv2.resize(coarse, (PANORAMA, PANORAMA // 2), interpolation=cv2.INTER_CUBIC)
        depth_m = panorama.depth_m * (1 + depth_error * smooth / smooth.std())
        return panorama.rgb, depth_m, pose, max(depth_error, 0.02)

    def truth(self, pose: Any) -> Any:
        """Return the true view from a pose, (H, W, 3) uint8."""
        return self._renderer.render_perspective(self.start @ pose, *self._view, FOV, supersample=2).rgb

    def shown(self, space: VirtualSpace, pose: Any) -> Any:
        """Return the virtual space's view from a pose, (H, W, 3) uint8."""
        return space.render(self.start @ pose, *self._view, FOV).rgb


def train(run: GpuRun) -> dict[str, Any]:
    """Measure the quality of views of the field by training time; rendering in between is not counted."""
    result: dict[str, Any] = {}
    for world in run.worlds:
        place = SimulatedPlace(world, run.view)
        poses = [pose_matrix(), pose_matrix(1.0), pose_matrix(0.5, 0.4, yaw=0.35)]
        truth, keyframe = [place.truth(pose) for pose in poses], place.keyframe(0.0)
        for device in run.devices:
            space = VirtualSpace(run.config(device, view=FIELD_ONLY))
            space.set_keyframe(*keyframe)
            space.train(iterations=3)  # compiles
            space.set_keyframe(*keyframe)
            spent, curve = 0.0, []
            while spent < run.seconds and not space.status.converged:
                start = run.clock()
                space.train(iterations=10)
                spent += run.clock() - start
                values = [psnr_db(place.shown(space, pose), real) for pose, real in zip(poses, truth, strict=True)]
                curve.append((round(spent, 4), round(statistics.mean(values), 3)))
            final = curve[-1][1]
            result.setdefault(world, {})[device] = {
                "device": space.status.device,
                "within_1_db_s": next(at for at, db in curve if db >= final - 1),
                "within_3_db_s": next(at for at, db in curve if db >= final - 3),
                "final_psnr_db": final,
                "iterations": space.status.iterations,
                "ms_per_iteration": round(1e3 * spent / space.status.iterations, 3),
            }
    return result


def views(run: GpuRun) -> dict[str, Any]:
    """Time the first view after a keyframe and views a second, of the field and of the panorama's warp."""
    place = SimulatedPlace(run.worlds[0], run.view)
    result: dict[str, Any] = {}
    first_keyframe, keyframe = place.keyframe(-0.3), place.keyframe(0.0)
    pose = place.start @ pose_matrix(1.0, 0.1, yaw=0.1)
    for device in run.devices:
        for name, content in (("field", FIELD_ONLY), ("as shown", ViewContentConfig())):
            start = run.clock()
            space = VirtualSpace(run.config(device, view=content))
            found: dict[str, Any] = {"device": space.status.device, "start_s": round(run.clock() - start, 2)}
            space.set_keyframe(*first_keyframe)
            space.train(iterations=3)
            for size in SIZES:
                space.render(pose, *size, FOV)  # compiles
            start = run.clock()
            space.set_keyframe(*keyframe)
            space.render(pose, *SIZES[-1], FOV)
            found["first_view_s"] = round(run.clock() - start, 3)
            space.train(iterations=200)
            for size in SIZES:
                found |= _views_per_second(run, space, pose, size)
            if torch.cuda.is_available():
                found["gpu_memory_mb"] = round(torch.cuda.max_memory_allocated() / 2**20)
            result.setdefault(device, {})[name] = found
    return result


def _views_per_second(run: GpuRun, space: VirtualSpace, pose: Any, size: tuple[int, int]) -> dict[str, float]:
    def view() -> None:
        space.render(pose, *size, FOV)

    def train_and_view() -> None:
        space.train(iterations=10)
        view()

    name = f"{size[0]}x{size[1]}"
    return {
        f"fps_{name}": round(1 / run.median_s(view), 1),
        f"fps_training_{name}": round(1 / run.median_s(train_and_view), 1),
    }


def field_or_warp(run: GpuRun) -> dict[str, Any]:
    """Compare left-out views of the warp of all keyframes and of fields trained on them."""
    result: dict[str, Any] = {}
    alone = run.config(run.devices[0], keyframes=4, view=FIELD_ONLY)
    density = FieldConfig(geometry="density")
    sources = {
        "warp": dataclasses.replace(alone, source="warp"),
        "field": alone,
        "density": dataclasses.replace(alone, field=density, device="cpu"),  # the GPU has no kernels for it
    }
    for world in run.worlds:
        place = SimulatedPlace(world, run.view)
        for depth_error, (name, places) in itertools.product(DEPTH_ERRORS, KEYFRAMES.items()):
            taken = [place.keyframe(x, depth_error) for x in places]
            found = {
                source: _left_out_views(run, place, taken, config)
                for source, config in sources.items()
                if source != "density" or name == "three, one ahead"
            }
            result.setdefault(world, {}).setdefault(f"depth {depth_error:.0%} off", {})[name] = found
            means = {source: round(statistics.mean(one["psnr_db"].values()), 2) for source, one in found.items()}
            note(f"{world}, depth {depth_error:.0%} off, {name}: {means}")
    return result


def _left_out_views(
    run: GpuRun, place: SimulatedPlace, keyframes: Sequence[Any], config: VirtualSpaceConfig
) -> dict[str, Any]:
    space = VirtualSpace(config)
    for keyframe in keyframes:
        space.set_keyframe(*keyframe)
    start = run.clock()
    while config.source != "warp" and not space.status.converged and run.clock() - start < run.seconds:
        space.train(iterations=10)
    seconds = run.clock() - start
    found: dict[str, Any] = {"psnr_db": {}, "ssim": {}}
    for distance, (x, y, yaw) in LEFT_OUT.items():
        pose = pose_matrix(x, y, yaw=yaw)
        shown, truth = place.shown(space, pose), place.truth(pose)
        found["psnr_db"][f"{distance:g} m"] = round(psnr_db(shown, truth), 2)
        found["ssim"][f"{distance:g} m"] = round(ssim(shown, truth), 4)
    return found | {"seconds": round(seconds, 2), "iterations": space.status.iterations}


STEPS = {"train": train, "views": views, "field-or-warp": field_or_warp}


def main() -> int:
    parser = parser_for(__doc__, with_json=False)
    parser.add_argument("--step", default=",".join(STEPS), help="steps, by commas (default: all)")
    parser.add_argument("--out", type=Path, default=Path("runs/gpu"), help="folder of the results (default runs/gpu)")
    parser.add_argument("--seconds", type=float, default=10.0, help="longest time of a training (default 10)")
    parser.add_argument("--cpu", action="store_true", help="measure the kernels of the CPU; CPU seconds")
    parser.add_argument("--worlds", default="corridor,random:11,random:12", help="worlds, by commas")
    args = parser.parse_args()
    steps = args.step.split(",")
    if unknown := sorted(set(steps) - set(STEPS)):
        parser.error(f"--step: no such step: {', '.join(unknown)}; there are {', '.join(STEPS)}")
    if not (args.cpu or torch.cuda.is_available()):
        parser.error("torch finds no CUDA device; --cpu measures the CPU's kernels")
    run = GpuRun(("cuda",), args.seconds, args.worlds.split(","))
    if args.cpu:
        torch.set_num_threads(1)
        small = TrainConfig(iterations=1000)
        run = dataclasses.replace(run, devices=("cpu",), view=(320, 180), clock=time.process_time, train=small)
    args.out.mkdir(parents=True, exist_ok=True)
    machine = "CPU" if args.cpu else torch.cuda.get_device_name()
    failed = False
    for step in steps:
        start = time.perf_counter()
        try:
            found: dict[str, Any] = STEPS[step](run)
        except (RuntimeError, ImportError) as error:
            # One step's failure must not hide the others' figures.
            found, failed = {"error": f"{type(error).__name__}: {error}"}, True
        about = {"step": step, "machine": machine, "python": platform.python_version(), "torch": torch.__version__}
        report(about | {"took_s": round(time.perf_counter() - start, 1), "result": found}, args.out / f"{step}.json")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
