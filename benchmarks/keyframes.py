"""Effect of keyframes on rendered views, in simulated worlds with true depth; prints JSON.

    python benchmarks/keyframes.py [--mesh house.glb] [--only views,field,unseen,refresh,layers,time]

- views: PSNR (dB) and SSIM 2 m from the nearest of one keyframe, three in a row, and three around the place.
- field: the same for the field alone after --seconds, one field on all keyframes.
- unseen: views with unseen areas left black, filled from their surroundings, and as shown.
- refresh: a drive with a keyframe every 0.75 m; how far a view falls behind what the earlier keyframes would have shown
  there, and how much unseen areas flicker.
- layers: PSNR (dB) of views rendered by the space and from its published layers; their size, and CPU time to encode.
- time: CPU time of each step from a keyframe to its first view, and of a view.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from instant_ic.geometry.image_quality import psnr_db, ssim
from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace import VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.config import PictureConfig
from instant_ic.vspace.layers import LayerEncoder, decode

SIZE, FOV, PANORAMA = (320, 180), math.pi / 2, 1024
VIEWS = (pose_matrix(2.0), pose_matrix(2.0, 0.3, yaw=0.5), pose_matrix(2.0, yaw=-1.2))
ASIDE = (*VIEWS, pose_matrix(1.0), pose_matrix(0.5, 0.5, yaw=0.5), pose_matrix(1.0, -0.6, yaw=-0.7))
PLACES = {"one": (0.0,), "three behind": (-1.5, -0.75, 0.0), "three round": (-1.5, 4.0, 0.0)}
"""Positions of the keyframes along x, in order of arrival."""
STEP_M, KEYFRAME_M, AHEAD_M, WAY_M = 0.05, 0.75, 0.6, 3.0
"""The drive: distance between views, between keyframes, of the view ahead of the robot, and in total."""


def score(view: Any, truth: Any) -> tuple[float, float]:
    """PSNR in dB and SSIM."""
    return round(psnr_db(view, truth), 2), round(ssim(view, truth), 3)


class World:
    """A world, and the position in it to which all poses are relative."""

    def __init__(self, renderer: Any, base: Any) -> None:
        self.renderer, self.base = renderer, base

    def keyframe(self, pose: Any) -> tuple[Any, ...]:
        """Arguments of ``VirtualSpace.set_keyframe``."""
        picture = self.renderer.render(self.base @ pose, PANORAMA, PANORAMA // 2, supersample=2)
        return picture.rgb, picture.depth_m, self.base @ pose, 0.02

    def truth(self, pose: Any) -> Any:
        return self.renderer.render_perspective(self.base @ pose, *SIZE, FOV, supersample=2).rgb

    def view(self, space: VirtualSpace, pose: Any) -> Any:
        return space.render(self.base @ pose, *SIZE, FOV)


def warp(keyframes: int = 1) -> VirtualSpace:
    return VirtualSpace(VirtualSpaceConfig(source="warp", keyframes=keyframes))


def views(world: World, _: argparse.Namespace) -> dict[str, Any]:
    """All arrangements of keyframes."""
    return _arrangements(world, lambda: warp(3), 0.0)


def field(world: World, arguments: argparse.Namespace) -> dict[str, Any]:
    """The same with the field alone."""
    config = VirtualSpaceConfig(keyframes=3, picture=PictureConfig(panorama_until_db=0, field_from_db=0))
    return _arrangements(world, lambda: VirtualSpace(config), arguments.seconds)


def _arrangements(world: World, make: Callable[[], VirtualSpace], seconds: float) -> dict[str, Any]:
    truth = [world.truth(pose) for pose in VIEWS]
    result = {}
    for name, places in PLACES.items():
        space = make()
        for x in places:
            space.set_keyframe(*world.keyframe(pose_matrix(x)))
            start = time.thread_time()
            while time.thread_time() - start < seconds / len(places) and not space.train(iterations=5).converged:
                pass
        world.view(space, np.eye(4))
        start = time.process_time()
        drawn = [world.view(space, pose) for pose in VIEWS]
        spent = (time.process_time() - start) / len(VIEWS)
        result[name] = {
            "psnr_ssim": [score(view.rgb, real) for view, real in zip(drawn, truth, strict=True)],
            "known": [round(view.mean_confidence, 3) for view in drawn],
            "cpu_ms": round(spent * 1e3),
        }
    return result


def unseen(world: World, _: argparse.Namespace) -> dict[str, Any]:
    """One keyframe; means over views around it."""
    space = warp()
    space.set_keyframe(*world.keyframe(np.eye(4)))
    assert space._shown is not None
    alone = space._shown.keyframes[0].warp
    assert alone is not None
    rows = []
    for pose in ASIDE:
        real, shown, continued = world.truth(pose), world.view(space, pose), alone.render(world.base @ pose, *SIZE, FOV)
        black = continued.rgb.copy()
        black[continued.confidence == 0] = 0
        rows.append([value for picture in (black, continued.rgb, shown.rgb) for value in score(picture, real)])
    mean = np.mean(rows, axis=0)
    names = ("black", "continued", "shown")
    return {name: [round(float(mean[2 * n]), 2), round(float(mean[2 * n + 1]), 4)] for n, name in enumerate(names)}


def refresh(world: World, _: argparse.Namespace) -> dict[str, Any]:
    """The drive with one keyframe and with three: each view compared with the view without the newest keyframe."""
    result = {}
    for keyframes in (1, 3):
        space, before = warp(keyframes), warp(keyframes)
        first = world.keyframe(np.eye(4))
        space.set_keyframe(*first)
        before.set_keyframe(*first)
        taken, drops, quality, flicker = [first], [], [], []
        last: Any = None
        for number in range(round(WAY_M / STEP_M)):
            x = number * STEP_M
            if number and number % round(KEYFRAME_M / STEP_M) == 0:
                taken.append(world.keyframe(pose_matrix(x)))
                before = warp(keyframes)
                for one in taken[:-1]:
                    before.set_keyframe(*one)
                space.show(space.prepare(*taken[-1]), dissolve=True)
            pose = pose_matrix(x + AHEAD_M, 0.15 * math.sin(2 * x), yaw=0.2 * math.sin(1.5 * x))
            real, shown = world.truth(pose), world.view(space, pose)
            quality.append(psnr_db(shown.rgb, real))
            if len(taken) > 1:
                drops.append(psnr_db(world.view(before, pose).rgb, real) - quality[-1])
            both = shown.confidence == 0 if last is None else (shown.confidence == 0) & (last.confidence == 0)
            if last is not None and both.any():
                flicker.append(float(np.abs(shown.rgb[both].astype(float) - last.rgb[both]).mean()))
            last = shown
        result[f"keyframes {keyframes}"] = {
            "mean_psnr_db": round(float(np.mean(quality)), 2),
            "worst_psnr_db": round(min(quality), 2),
            "worst_drop_db": round(max(drops), 2),
            "change_of_unseen_between_pictures": round(float(np.mean(flicker)), 2) if flicker else 0.0,
        }
    return result


def layers(world: World, _: argparse.Namespace) -> dict[str, Any]:
    """One keyframe and three; depth with 1 % of noise, which is the hardest to compress, and the camera's image."""
    result: dict[str, Any] = {}
    rng = np.random.default_rng(0)
    for name in ("one", "three behind"):
        space, encoder, images = warp(3), LayerEncoder(), []
        for x in PLACES[name]:
            rgb, depth_m, pose, _ = world.keyframe(pose_matrix(x))
            images.insert(0, cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())
            rgb = cv2.cvtColor(cv2.imdecode(np.frombuffer(images[0], np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
            space.set_keyframe(rgb, depth_m * rng.normal(1, 0.01, depth_m.shape), pose, 0.02)
            start = time.process_time()
            assert space._shown is not None
            made = encoder.encode(space._shown, range(len(images), 0, -1), images)
            encoded = time.process_time() - start
        other = warp(3)
        start = time.process_time()
        other.show(decode(made, space.config.panorama_width))
        spent = time.process_time() - start
        rows = [[psnr_db(world.view(one, pose).rgb, world.truth(pose)) for one in (space, other)] for pose in ASIDE]
        parts = [len(one.colour) + len(one.geometry_png) for one in made.layers]
        newest = made.since(made.version - 1).layers
        result[name] = {
            "space_layers_db": np.round(np.mean(rows, axis=0), 2).tolist(),
            "largest_difference_db": round(float(np.abs(np.diff(rows, axis=1)).max()), 3),
            "encode_newest_ms": round(encoded * 1e3),
            "decode_all_ms": round(spent * 1e3),
            "kb": [round(size / 1024) for size in parts],
            "kb_of_change": round(sum(len(one.colour) + len(one.geometry_png) for one in newest) / 1024),
        }
    return result


def times(world: World, _: argparse.Namespace) -> dict[str, Any]:
    """CPU time of the last of four keyframes (2048 × 1024), kernels compiled."""
    result: dict[str, Any] = {}
    for keyframes in (1, 3):
        space = VirtualSpace(VirtualSpaceConfig(keyframes=keyframes))
        spent: dict[str, int] = {}

        def timed(name: str, call: Callable[..., Any], *arguments: Any, into: dict[str, int] = spent) -> Any:
            start = time.process_time()
            made = call(*arguments)
            into[name] = round((time.process_time() - start) * 1e3)
            return made

        for x in (0.0, 0.4, 0.8, 1.2):
            pose = world.base @ pose_matrix(x)
            picture = world.renderer.render(pose, 2048, 1024)
            depth_m = np.ascontiguousarray(picture.depth_m[::2, ::2])
            prepared = timed("prepare_ms", space.prepare, picture.rgb, depth_m, pose, 0.02)
            timed("show_ms", space.show, prepared)
            timed("first_picture_640x360_ms", space.render, pose, 640, 360, FOV)
            timed("learn_ms", space.learn, timed("scene_ms", space.scene_of, prepared))
        for width, height in ((320, 180), (640, 360), (1280, 720)):
            timed(f"{width}x{height}_ms", space.render, world.base @ pose_matrix(1.7), width, height, FOV)
        result[f"keyframes {keyframes}"] = spent
    return result


PARTS = {"views": views, "field": field, "unseen": unseen, "refresh": refresh, "layers": layers, "time": times}


def main() -> None:
    from instant_ic.sim.render import EquirectRenderer
    from instant_ic.sim.worlds import corridor_world, load_world

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", help="small_house.glb, to measure in it as well")
    parser.add_argument("--only", default=",".join(PARTS), help="parts, by commas")
    parser.add_argument("--seconds", type=float, default=8.0, help="CPU time of the field's training")
    arguments = parser.parse_args()
    parts = arguments.only.split(",")
    if unknown := sorted(set(parts) - set(PARTS)):
        parser.error(f"--only: no such part: {', '.join(unknown)}; there are {', '.join(PARTS)}")
    worlds = {"corridor": World(EquirectRenderer(corridor_world()), pose_matrix(3.0, z=1.2))}
    if arguments.mesh:
        start = pose_matrix(6.3, -2.4, 1.0, yaw=math.pi)
        worlds["mesh"] = World(EquirectRenderer(load_world(arguments.mesh)), start)
    result = {part: {name: PARTS[part](world, arguments) for name, world in worlds.items()} for part in parts}
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
