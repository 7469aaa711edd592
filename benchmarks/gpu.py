"""Measures on an NVIDIA GPU what a CPU cannot answer for the virtual space, in steps that run apart; writes JSON.

    python benchmarks/gpu.py [--step kernels,train,views,field-or-warp] [--out runs/gpu] [--dry-run | --cpu]

- kernels: values and gradients of the Triton kernels against plain torch on the same samples, and the time of both.
- train: time until views of the field are within 1 dB of its last. The paper needs 3 to 4 s; goal: at most 1 s.
- views: views a second, alone and while training. The paper has 10; goal: at least 60 at 1280 × 720.
- field-or-warp: PSNR and SSIM of fields against the warp of the same keyframes, with one and with several, true and
  wrong depth, on views of places that were left out. Fields: the default, one that also learns a panorama of the warp
  from ahead (taught), and the paper's (density, with losses on depth, opacity and distortion).

Each step takes less than 10 minutes (``--seconds`` limits a training of a field) and writes OUT/STEP.json, train and
field-or-warp OUT/STEP.png as well. Wall time; every call ends with a copy to the CPU, so nothing is still running.
``--cpu`` runs train, views and field-or-warp on a CPU; all their seconds are then CPU seconds of one thread.
``--dry-run`` does the same at tiny sizes on the CPU: its figures say only that the script works. Otherwise an NVIDIA
GPU, torch's CUDA build and `pip install 'instant-ic[triton]'` are needed.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
import platform
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from instant_ic.geometry.image_quality import psnr_db, ssim
from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import CUBE_FACES, equirect_directions
from instant_ic.vspace import FieldConfig, GeometryConfig, PictureConfig, TrainConfig, VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.nerf import reference
from instant_ic.vspace.nerf.field import Device, Lattice, TrainingScene, sample_weights
from instant_ic.vspace.nerf.occupancy import build_occupancy
from instant_ic.vspace.nerf.torch_device import TorchDevice
from instant_ic.vspace.prior import prepare
from instant_ic.vspace.view import perspective_rays

FOV = math.pi / 2
FIELD_ONLY = PictureConfig(field_alone=True)
TARGETS = {
    "kernels": {"gradient_error": "at most 0.01 of the largest", "same_depth": "at least 0.96"},
    "train": {"within_1_db_s": "at most 1 (paper: 3 to 4)"},
    "views": {"fps_1280x720": "at least 60 (paper: 10)", "fps_training_1280x720": "at least 30", "first_view_s": "0.3"},
    "field-or-warp": {"gain_db": "field over warp, above 0 with three keyframes"},
}
KEYFRAMES = {"one": (0.0,), "three": (-1.5, -0.75, 0.0), "three, one ahead": (-1.5, 3.0, 0.0)}
"""Places of the keyframes along x in metres, in order of arrival."""
DEPTH_ERRORS = (0.0, 0.04)
"""Standard deviation of the keyframes' depth, as a share of it."""
TAUGHT_AT = 1.2
"""Place along x of the panorama that the warp teaches the field, m."""
LEFT_OUT = {0.5: (0.5, 0.0, 0.0), 1.0: (1.0, -0.2, 0.3), 1.5: (1.5, 0.2, -0.4), 2.0: (2.0, 0.0, 0.0)}
"""Places of the judged views by distance from the newest keyframe: x, y in metres, yaw."""


@dataclass(frozen=True)
class Setup:
    """Sizes of a run. ``devices``: names as in ``VirtualSpaceConfig.device``, the first is the one to judge."""

    dry: bool
    out: Path
    devices: tuple[str, ...]
    seconds: float
    panorama: int = 1024
    sizes: tuple[tuple[int, int], ...] = ((320, 180), (640, 360), (1280, 720))
    view: tuple[int, int] = (640, 360)
    worlds: Sequence[str] = ("corridor", "random:11", "random:12")  # nothing was tuned on these two
    repeats: int = 15
    steps: int = 50
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    train: TrainConfig = dataclasses.field(default_factory=TrainConfig)
    geometry: GeometryConfig = dataclasses.field(default_factory=GeometryConfig)
    clock: Callable[[], float] = time.perf_counter
    slow_s: float = 4.0
    """Of one call's repeats."""

    def median_s(self, call: Callable[[], object]) -> float:
        """Median time of a call, seconds, after one that does not count; of fewer calls where they are slow."""
        call()
        times: list[float] = []
        while len(times) < self.repeats and sum(times) < self.slow_s:
            start = self.clock()
            call()
            times.append(self.clock() - start)
        return statistics.median(times)

    @classmethod
    def tiny(cls, out: Path) -> Setup:
        """Sizes of a dry run."""
        small = FieldConfig(levels=2, log2_table=10, hidden=16)
        train = TrainConfig(ray_columns=16, ray_rows=16, iterations=20)
        return cls(
            *(True, out, ("cpu", "torch-cpu"), 0.2, 64, ((32, 18), (48, 27), (64, 36)), (48, 27), ("corridor",), 2, 2),
            *(small, train, GeometryConfig(cell_m=0.2)),
        )

    def config(self, device: str, **changes: Any) -> VirtualSpaceConfig:
        return VirtualSpaceConfig(device=device, field=self.field, train=self.train, geometry=self.geometry, **changes)


class Place:
    """A simulated world seen from its start; poses are relative to that."""

    def __init__(self, name: str, setup: Setup) -> None:
        from instant_ic.sim.render import EquirectRenderer
        from instant_ic.sim.worlds import corridor_world, make_world

        # A dry run needs no soft light, which takes seconds.
        world = corridor_world(light_cell_m=1.0) if setup.dry else make_world(name)
        x, y, _ = world.spawn
        self._renderer, self._setup = EquirectRenderer(world), setup
        # Along the longest free way: keyframes and views lie on it.
        free_m = self._renderer.render(pose_matrix(x, y, 1.2), 64, 32).depth_m[14:18].min(axis=0)
        ways = np.minimum(free_m, np.roll(free_m, 32) + 1.5)  # ahead, and half as far behind
        self.start = pose_matrix(x, y, 1.2, yaw=math.pi - (int(np.argmax(ways)) + 0.5) * (2 * math.pi / 64))

    def keyframe(self, x: float, wrong: float = 0.0) -> tuple[Any, ...]:
        """Arguments of ``VirtualSpace.set_keyframe``; the depth has smooth errors of so large a share (1 sigma)."""
        pose, width = self.start @ pose_matrix(x), self._setup.panorama
        picture = self._renderer.render(pose, width, width // 2, supersample=2)
        coarse = np.random.default_rng(round(100 * x) + 1000).normal(size=(9, 16)).astype(np.float32)
        smooth = cv2.resize(coarse, (width, width // 2), interpolation=cv2.INTER_CUBIC)
        depth_m = picture.depth_m * (1 + wrong * smooth / smooth.std())
        return picture.rgb, depth_m, pose, max(wrong, 0.02)

    def truth(self, pose: Any) -> Any:
        """The world from a pose, (H, W, 3) uint8."""
        return self._renderer.render_perspective(self.start @ pose, *self._setup.view, FOV, supersample=2).rgb

    def shown(self, space: VirtualSpace, pose: Any) -> Any:
        """The same in a space."""
        return space.render(self.start @ pose, *self._setup.view, FOV).rgb


def kernels(setup: Setup) -> dict[str, Any]:
    """Errors, gradients, parameters after some steps and views, with one keyframe and with three."""
    place = Place(setup.worlds[0], setup)
    result: dict[str, Any] = {}
    for name in ("one", "three"):
        priors = [prepare(*place.keyframe(x), setup.geometry, setup.panorama) for x in reversed(KEYFRAMES[name])]
        lattice = Lattice.for_prior(priors[0], setup.field)
        gains = np.array([[1, 1, 1], [0.9, 1.1, 1.2], [1.1, 1.0, 0.9]], np.float32)[: len(priors)]
        result[name] = _compared(
            TrainingScene(tuple(priors), lattice, build_occupancy(priors, setup.geometry), gains), setup
        )
    return result


def _compared(scene: TrainingScene, setup: Setup) -> dict[str, Any]:
    torch_name = "cpu" if setup.dry else "cuda"
    peer = TorchDevice(setup.field, setup.train, torch_name)
    ours, result = _judged(setup), {}
    for device in (ours, peer):
        device.set_scene(scene)
    rng = np.random.default_rng(5)
    shape = (setup.train.ray_columns * setup.train.ray_rows, 3)
    result["gradient_error"] = _gradient_error(ours, peer, rng.random(shape, np.float32), setup)
    for device in (ours, peer):  # both optimisers start again
        device.load(ours.parameters())
        device.set_scene(scene)
    errors = []
    for _ in range(setup.steps):
        uniform = rng.random(shape, np.float32)
        errors.append([device.step(uniform, 0.02, 0.01) for device in (ours, peer)])
    result["step_errors"] = {"first": errors[0], "last": errors[-1]}
    tables = [device.parameters().table.reshape(-1) for device in (ours, peer)]
    result["correlation_of_tables"] = round(float(np.corrcoef(*tables)[0, 1]), 5)
    ours.load(peer.parameters())
    ours.set_scene(scene)
    rays = perspective_rays(scene.prior.map_from_camera @ pose_matrix(0.8, 0.2, yaw=0.2), *setup.view, FOV)
    for shares in ((0.0, 0.0), (0.6, 0.5), (1.0, 1.0)):
        (colour, depth, sure), (colours, depths, sures) = (device.draw(rays, *shares) for device in (ours, peer))
        same = np.isclose(depth, depths, rtol=0.01)
        result[f"view, panorama {shares[0]:g}, depth {shares[1]:g}"] = {
            "same_depth": round(float(same.mean()), 4),
            "same_confidence": round(float(np.mean(sure[same] == sures[same])), 4),
            "colour_error_p98": round(float(np.quantile(np.abs(colour[same] - colours[same]), 0.98)), 4),
        }
    uniform = rng.random(shape, np.float32)
    for name, device in (("ours", ours), ("torch", peer)):
        step_s = setup.median_s(lambda d=device: d.step(uniform, 1e-4, 1e-4))
        view_s = setup.median_s(lambda d=device: d.draw(rays, 0.0, 0.5))
        result[name] = {"step_ms": round(1e3 * step_s, 3), "view_ms": round(1e3 * view_s, 3)}
    return result


def _judged(setup: Setup) -> Device:
    if not setup.dry:  # Triton's interpreter would take minutes; tests/vspace/test_triton.py has it
        from instant_ic.vspace.nerf.triton_device import TritonDevice

        return TritonDevice(setup.field, setup.train, "cuda")
    from instant_ic.vspace.nerf.numba_device import NumbaDevice

    device = NumbaDevice(setup.field, setup.train)
    device.first_stride = 1  # interpolates nothing, as the others
    return device


def _gradient_error(ours: Any, peer: TorchDevice, uniform: Any, setup: Setup) -> dict[str, float] | str:
    """Largest difference of the gradients of one batch, as a share of the largest gradient: table and network."""
    if not hasattr(ours, "_launch_gradient"):
        return "not measured: a dry run uses no Triton"
    ours.step(uniform, 1e-9, 1e-9)  # uploads the batch, and compiles
    peer.load(ours.parameters())
    b = ours._buffers
    for grad in (b.table_grad, b.network_grad):
        grad.zero_()
    ours._launch_gradient(ours._scene)
    to = peer._device
    points, target, weight = (tensor.to(to) for tensor in (b.points, b.target, b.weight))
    colour, distance = (torch.from_numpy(w).to(to) for w in sample_weights(setup.train))
    scene = ours._scene
    field = dataclasses.replace(
        peer._field, cells_per_m=scene.cells_per_m.to(to), origin=scene.origin.to(to), focus=scene.focus.to(to)
    )
    loss = reference.loss(reference.query(field, points), target, colour * weight[:, 0], distance * weight[:, 1])
    expected = torch.autograd.grad(sum(loss), field.parameters())
    network = torch.cat([grad.reshape(-1) for grad in expected[1:]])
    found = {"table": (b.table_grad, expected[0].reshape(-1)), "network": (b.network_grad, network)}
    error = {key: float((a.to(to) - e).abs().max() / e.abs().max()) for key, (a, e) in found.items()}
    for grad in (b.table_grad, b.network_grad):
        grad.zero_()
    return {key: round(value, 6) for key, value in error.items()}


def train(setup: Setup) -> dict[str, Any]:
    """Curve of views of the field by training time; rendering in between is not counted."""
    result: dict[str, Any] = {}
    rows = []
    for world in setup.worlds:
        place = Place(world, setup)
        poses = [pose_matrix(), pose_matrix(1.0), pose_matrix(0.5, 0.4, yaw=0.35)]
        truth, keyframe = [place.truth(pose) for pose in poses], place.keyframe(0.0)
        images = {}
        for device in setup.devices:
            space = VirtualSpace(setup.config(device, picture=FIELD_ONLY))
            space.set_keyframe(*keyframe)
            space.train(iterations=3)  # compiles
            space.set_keyframe(*keyframe)
            spent, curve = 0.0, []
            while spent < setup.seconds and not space.status.converged:
                start = setup.clock()
                space.train(iterations=10)
                spent += setup.clock() - start
                images[device] = [place.shown(space, pose) for pose in poses]
                values = [psnr_db(view, real) for view, real in zip(images[device], truth, strict=True)]
                curve.append((round(spent, 4), round(statistics.mean(values), 3)))
            final = curve[-1][1]
            result.setdefault(world, {})[device] = {
                "device": space.status.device,
                "within_1_db_s": next(at for at, db in curve if db >= final - 1),
                "within_3_db_s": next(at for at, db in curve if db >= final - 3),
                "final_psnr_db": final,
                "iterations": space.status.iterations,
                "ms_per_iteration": round(1e3 * spent / space.status.iterations, 3),
                "curve_s_db": curve[:: max(1, len(curve) // 40)],
            }
        rows += [np.hstack(some) for some in (truth, *(images[device] for device in setup.devices))]
    write_image(setup.out / "train.png", np.vstack(rows))
    return result


def views(setup: Setup) -> dict[str, Any]:
    """First view after a keyframe and views a second, of the field and as shown (the panoramas' warp first)."""
    place, result = Place(setup.worlds[0], setup), {}
    first_keyframe, keyframe = place.keyframe(-0.3), place.keyframe(0.0)
    pose = place.start @ pose_matrix(1.0, 0.1, yaw=0.1)
    for device in setup.devices:
        for name, picture in (("field", FIELD_ONLY), ("as shown", PictureConfig())):
            start = setup.clock()
            space = VirtualSpace(setup.config(device, picture=picture))
            found: dict[str, Any] = {"device": space.status.device, "start_s": round(setup.clock() - start, 2)}
            space.set_keyframe(*first_keyframe)
            space.train(iterations=3)
            for size in setup.sizes:
                space.render(pose, *size, FOV)  # compiles
            start = setup.clock()
            space.set_keyframe(*keyframe)
            space.render(pose, *setup.sizes[-1], FOV)
            found["first_view_s"] = round(setup.clock() - start, 3)
            space.train(iterations=10 if setup.dry else 200)
            for width, height in setup.sizes:

                def frame(space: VirtualSpace = space, w: int = width, h: int = height) -> None:
                    space.render(pose, w, h, FOV)

                def while_training(space: VirtualSpace = space, frame: Callable[[], None] = frame) -> None:
                    space.train(iterations=10)
                    frame()

                found[f"fps_{width}x{height}"] = round(1 / setup.median_s(frame), 1)
                found[f"fps_training_{width}x{height}"] = round(1 / setup.median_s(while_training), 1)
            if torch.cuda.is_available():
                found["gpu_memory_mb"] = round(torch.cuda.max_memory_allocated() / 2**20)
            result.setdefault(device, {})[name] = found
    return result


def field_or_warp(setup: Setup) -> dict[str, Any]:
    """Left-out views of the warp of all keyframes and of fields trained on them, by world, depth and keyframes."""
    result: dict[str, Any] = {}
    rows = []
    device = setup.devices[0]
    density = dataclasses.replace(setup.field, geometry="density")
    alone = setup.config(device, keyframes=4, picture=FIELD_ONLY)
    sources = {
        "warp": dataclasses.replace(alone, source="warp"),
        "field": alone,
        "taught": alone,
        # Only plain torch knows it on a GPU.
        "density": dataclasses.replace(alone, field=density, device="torch-cuda" if device == "triton" else device),
    }
    for world in setup.worlds:
        place = Place(world, setup)
        poses = {distance: pose_matrix(x, y, yaw=yaw) for distance, (x, y, yaw) in LEFT_OUT.items()}
        truth = {distance: place.truth(pose) for distance, pose in poses.items()}
        for wrong, (name, places) in itertools.product(DEPTH_ERRORS, KEYFRAMES.items()):
            taken, found, images = [place.keyframe(x, wrong) for x in places], {}, []
            for source, config in sources.items():
                if source in ("taught", "density") and name != "three, one ahead":
                    continue
                space = VirtualSpace(config)
                if source == "taught":
                    space.set_keyframe(*_warped_keyframe(taken, place.start @ pose_matrix(TAUGHT_AT), sources["warp"]))
                for keyframe in taken:
                    space.set_keyframe(*keyframe)
                start = setup.clock()
                while source != "warp" and not space.status.converged and setup.clock() - start < setup.seconds:
                    space.train(iterations=10)
                seconds = setup.clock() - start
                shown = {distance: place.shown(space, pose) for distance, pose in poses.items()}
                images.append(np.hstack(list(shown.values())))
                found[source] = {
                    "psnr_db": {f"{d:g} m": round(psnr_db(view, truth[d]), 2) for d, view in shown.items()},
                    "ssim": {f"{d:g} m": round(ssim(view, truth[d]), 4) for d, view in shown.items()},
                    "seconds": round(seconds, 2),
                    "iterations": space.status.iterations,
                }
            means = {source: statistics.mean(values["psnr_db"].values()) for source, values in found.items()}
            gains = {source: round(mean - means["warp"], 2) for source, mean in means.items() if source != "warp"}
            result.setdefault(world, {}).setdefault(f"depth {wrong:.0%} off", {})[name] = found | {"gain_db": gains}
            print(f"{world}, depth {wrong:.0%} off, {name}: {means}", file=sys.stderr, flush=True)
            if name == "three, one ahead":
                rows += [np.hstack(list(truth.values())), *images]
    write_image(setup.out / "field-or-warp.png", np.vstack(rows))
    return result


def _warped_keyframe(taken: list[tuple[Any, ...]], pose: Any, config: VirtualSpaceConfig) -> tuple[Any, ...]:
    """Arguments of ``set_keyframe``: the warp's panorama from a pose, what no keyframe has seen included."""
    space = VirtualSpace(config)
    for keyframe in taken:
        space.set_keyframe(*keyframe)
    height, width = taken[0][0].shape[:2]
    directions = equirect_directions(width, height)
    rgb, depth = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32)
    for rotation in CUBE_FACES.values():
        turned = pose.copy()
        turned[:3, :3] = pose[:3, :3] @ rotation
        face = space.render(turned, width // 4, width // 4, np.pi / 2)
        x, y, z = np.moveaxis(directions @ rotation.astype(np.float32), -1, 0)
        inside = (x >= np.abs(y)) & (x >= np.abs(z))
        half = width // 8
        column, row = ((half * (1 - t[inside] / x[inside])).astype(int).clip(0, 2 * half - 1) for t in (y, z))
        rgb[inside], depth[inside] = face.rgb[row, column], face.depth_m[row, column]
    return rgb, depth, pose, 0.05


def write_image(path: Path, rgb: Any) -> None:
    """Rows of images, at most 2560 pixels wide."""
    rgb = rgb[:, :, ::-1]
    if rgb.shape[1] > 2560:
        rgb = cv2.resize(rgb, (2560, round(rgb.shape[0] * 2560 / rgb.shape[1])), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), rgb)


STEPS = {"kernels": kernels, "train": train, "views": views, "field-or-warp": field_or_warp}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--step", default=",".join(STEPS), help="steps, by commas (default: all)")
    parser.add_argument("--out", type=Path, default=Path("runs/gpu"), help="folder of the results (default runs/gpu)")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each training at most (default 10)")
    parser.add_argument("--dry-run", action="store_true", help="tiny sizes on the CPU")
    parser.add_argument("--cpu", action="store_true", help="train, views and field-or-warp on the CPU; CPU seconds")
    parser.add_argument("--devices", default="triton,torch-cuda", help="of train and views, by commas; first: judged")
    parser.add_argument("--worlds", default="corridor,random:11,random:12", help="worlds, by commas")
    arguments = parser.parse_args()
    steps = arguments.step.split(",")
    if unknown := sorted(set(steps) - set(STEPS)):
        parser.error(f"--step: no such step: {', '.join(unknown)}; there are {', '.join(STEPS)}")
    if arguments.cpu and not {*steps} <= {"train", "views", "field-or-warp"}:
        parser.error("--cpu: only the steps train, views and field-or-warp are of use on a CPU")
    if not (arguments.dry_run or arguments.cpu or torch.cuda.is_available()):
        parser.error("torch finds no CUDA device; --dry-run checks the script without one")
    arguments.out.mkdir(parents=True, exist_ok=True)
    if arguments.dry_run:
        torch.set_num_threads(1)  # of tiny work threads wait for each other
        setup = Setup.tiny(arguments.out)
    else:
        setup = Setup(
            *(False, arguments.out, tuple(arguments.devices.split(",")), arguments.seconds),
            worlds=arguments.worlds.split(","),
        )
    if arguments.cpu:
        torch.set_num_threads(1)
        small = {"view": (320, 180), "clock": time.process_time, "train": TrainConfig(iterations=1000)}
        setup = dataclasses.replace(setup, devices=("cpu",), **small)
    machine = "dry run on the CPU" if setup.dry else "CPU" if arguments.cpu else torch.cuda.get_device_name()
    failed = False
    for step in steps:
        start = time.perf_counter()
        try:
            found: dict[str, Any] = STEPS[step](setup)
        except (RuntimeError, ImportError) as error:
            # One step's failure must not hide the others' figures.
            found, failed = {"error": f"{type(error).__name__}: {error}"}, True
        about = {"step": step, "machine": machine, "python": platform.python_version(), "torch": torch.__version__}
        result = about | {"targets": TARGETS[step], "took_s": round(time.perf_counter() - start, 1), "result": found}
        text = json.dumps(result, indent=1)
        (arguments.out / f"{step}.json").write_text(text + "\n")
        print(text, flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
