"""``ic vspace``: train a virtual space from one panorama, and render it."""

from __future__ import annotations

import argparse
import dataclasses
import math
import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli.arguments import group, numbers, positive, positive_int, size, verb
from instant_ic.cli.errors import UserError
from instant_ic.util.files import replacing

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

DEVICES = ("auto", "cpu", "cuda")
"""Values of ``VirtualSpaceConfig.device``; that module is too heavy to import here."""
SIZES = {"perspective": (640, 360), "equirect": (1024, 512)}
"""Default width and height of a view in pixels."""
GIVEN_SIGMA, MODEL_SIGMA = 0.02, 0.1
"""Relative standard deviation of a depth from a file, and of a depth estimated by a model."""
FEW_KNOWN = 0.1
"""Share of known pixels below which a view gives a warning."""


def add_parser(subparsers: Any) -> None:
    """Add the command and its verbs."""
    verbs = group(
        subparsers, "vspace", "train and render a virtual space from one panorama",
        "Train a virtual space from one panorama and render it (docs/nerf.md). Poses are relative to the "
        "panorama's camera, in metres: x forward (the centre column of the panorama), y left, z up; yaw in degrees, "
        "counter-clockwise.",
        "ic vspace train room.jpg -o room && ic vspace render room --pose 0.5,0,0,30 -o view.png",
    )  # fmt: skip
    _add_train(verbs)
    _add_render(verbs)
    info_parser = verb(verbs, "info", "print the content of a saved space", info, "ic vspace info room")
    info_parser.add_argument("space", type=Path, metavar="DIR", help="folder written by ic vspace train")
    for parser in verbs.choices.values():
        # By itself, argparse recognises only single negative numbers as values, not "--pose -1,0,0,90".
        parser._negative_number_matcher = re.compile(r"-[\d.]")


def _add_train(verbs: Any) -> None:
    parser = verb(
        verbs, "train", "train on a panorama", train,
        "ic vspace train room.jpg --depth room_depth.png -o room",
        "Train on one panorama and save the space in a folder. Ctrl-C ends the training early and saves the result.",
    )  # fmt: skip
    add = parser.add_argument
    add("panorama", type=Path, help="equirectangular image, twice as wide as high")
    depth = parser.add_mutually_exclusive_group()
    text = "its radial depth: 16-bit PNG in mm; .npy or .npz (key depth) in m; 0 or non-finite is unknown"
    depth.add_argument("--depth", type=Path, metavar="D", help=text)
    text = "depth model, ONNX or manifest (default: the shipped one; its metres are an estimate, not scaled by a LiDAR)"
    depth.add_argument("--model", type=Path, metavar="M", help=text)
    text = f"(default: {GIVEN_SIGMA:g} with --depth, {MODEL_SIGMA:g} without)"
    add("--depth-sigma", type=positive, metavar="SHARE", help=f"relative standard deviation of depth {text}")
    add("--iterations", type=positive_int, default=600, metavar="N", help="length of the training (%(default)s)")
    add("--device", default="auto", choices=DEVICES, help="(%(default)s)")
    add("-o", "--out", type=Path, required=True, metavar="DIR", help="output folder, created if missing")


def _add_render(verbs: Any) -> None:
    parser = verb(
        verbs, "render", "render a view of a space", render,
        "ic vspace render room --pose 0.5,-0.2,0,30 --fov 90 --size 640x360 -o view.png",
        "Render a view of a saved space.",
    )  # fmt: skip
    add = parser.add_argument
    add("space", type=Path, metavar="DIR", help="folder written by ic vspace train")
    add("--device", choices=DEVICES, help="(default: as in training)")
    add("--fov", type=positive, default=90.0, metavar="DEG", help="horizontal field of view (%(default)g degrees)")
    sizes = ", ".join(f"{name} {w}x{h}" for name, (w, h) in SIZES.items())
    add("--size", type=size, metavar="WxH", help=f"pixels (default: {sizes})")
    add("--pose", type=numbers("x,y,z,yaw"), default=[0.0, 0.0, 0.0, 0.0], metavar="x,y,z,yaw", help="(0,0,0,0)")
    add("--projection", choices=tuple(SIZES), default="perspective", help="(%(default)s)")
    add("-o", "--out", type=Path, required=True, metavar="PNG", help="image to write")
    add("--depth", type=Path, metavar="FILE", help="also write the depth: .png (16-bit, mm) or .npy (m)")
    text = "also write the confidence: white is seen, black is not"
    add("--confidence", type=Path, metavar="PNG", help=text)


def train(args: argparse.Namespace) -> int:
    """Train a space and save it."""
    import numpy as np

    from instant_ic.cli.progress import progress
    from instant_ic.vspace import KeyframeError, TrainConfig, VirtualSpace, VirtualSpaceConfig
    from instant_ic.vspace.warm_up import warm_up

    rgb, depth, sigma = _keyframe(args)
    args.out.mkdir(parents=True, exist_ok=True)
    config = VirtualSpaceConfig(device=args.device)
    config = dataclasses.replace(config, train=dataclasses.replace(TrainConfig(), iterations=args.iterations))
    began = time.monotonic()
    warm_up(config)
    if time.monotonic() - began > 5:
        print("compiled the kernels (first run only)", file=sys.stderr)
    space, ended = VirtualSpace(config), ""
    try:
        space.set_keyframe(rgb, depth, np.eye(4), sigma)
    except KeyframeError as error:
        raise UserError(f"{args.panorama}{f' with {args.depth}' if args.depth else ''}: {error}") from error
    with progress("training") as advance:
        try:
            while not space.status.converged:
                space.train(budget_ms=200)
                advance(space.status.iterations / args.iterations)
        except KeyboardInterrupt:
            ended = "ended early: "
    file, status = space.save(args.out), space.status
    if status.warning:
        print(f"warning: {status.warning}", file=sys.stderr)
    print(f"{ended}{status.iterations} iterations in {status.train_seconds:.1f} s on "
          f"{status.device}, {status.psnr_db:.1f} dB on the panorama's own rays; depth known in "
          f"{(depth > 0).mean():.0%}, usable up to {status.ready_radius_m:.1f} m; wrote {file}")  # fmt: skip
    return 0


def _keyframe(args: argparse.Namespace) -> tuple[NDArray[np.uint8], NDArray[np.float32], float]:
    """Load the panorama; load or estimate its depth in metres; return both and the depth's relative deviation."""
    from instant_ic.depth.files import load_depth, load_rgb

    rgb = load_rgb(args.panorama)
    if args.depth:
        return rgb, load_depth(args.depth), args.depth_sigma or GIVEN_SIGMA
    return rgb, estimated_depth(args.model, rgb), args.depth_sigma or MODEL_SIGMA


def estimated_depth(model: Path | None, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Estimate the depth of a panorama in the model's own metres; print a note that its scale is not measured."""
    from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
    from instant_ic.util.paths import shipped_file

    loaded = DepthModel.load(model or shipped_file("models", DEFAULT_MODEL))
    print(f"no --depth: the scale is an estimate of {loaded.manifest.name}, not measured", file=sys.stderr)
    return loaded.estimate(rgb)


def render(args: argparse.Namespace) -> int:
    """Render a view of a saved space."""
    import numpy as np

    from instant_ic.geometry.poses import pose_matrix
    from instant_ic.vspace import VirtualSpace

    space = VirtualSpace.load(args.space, args.device)
    assert space.keyframe is not None
    x, y, z, yaw = args.pose
    pose = space.keyframe.map_from_camera @ pose_matrix(x, y, z, yaw=math.radians(yaw))
    width, height = args.size or SIZES[args.projection]
    if args.projection == "equirect" and width != 2 * height:
        raise UserError(f"--size of a panorama must be twice as wide as high (got {width}x{height})", 2)
    try:
        if args.projection == "perspective":
            view = space.render(pose, width, height, math.radians(args.fov))
        else:
            view = space.render_equirect(pose, width)
    except ValueError as error:
        raise UserError(f"--size, --fov: {error}", 2) from error
    write_image(args.out, view.rgb)
    if args.depth:
        write_depth(args.depth, view.depth_m)
    if args.confidence:
        write_image(args.confidence, (255 * view.confidence).astype(np.uint8))
    radius, away = space.status.ready_radius_m, math.dist(args.pose[:3], (0, 0, 0))
    if view.mean_confidence < FEW_KNOWN:
        print(f"warning: the panorama has seen little of this view ({view.mean_confidence:.0%}): "
              "the rest is extrapolated or black", file=sys.stderr)  # fmt: skip
    elif away > radius > 0:
        print(f"warning: {away:.1f} m from the panorama; the space is usable up to {radius:.1f} m",
              file=sys.stderr)  # fmt: skip
    print(f"{view.mean_confidence:.0%} of the image is known; wrote {args.out}")
    return 0


def info(args: argparse.Namespace) -> int:
    """Print the content of a saved space."""
    from instant_ic.vspace.saved import read, space_file

    saved = read(args.space)
    field, progress = saved.config.field, saved.progress
    fit = "usable" if progress.ready else "not usable yet"
    print(f"{space_file(args.space)}: {progress.iteration} iterations in {progress.train_seconds:.1f} s, "
          f"{progress.psnr_db:.1f} dB; {fit}")  # fmt: skip
    print(f"field: {field.levels} levels x {field.features} features, 2^{field.log2_table} entries, "
          f"network {field.levels * field.features}-{field.hidden}-4")  # fmt: skip
    for prior in saved.priors:
        height, width = prior.rgb.shape[:2]
        x, y, z = prior.map_from_camera[:3, 3]
        print(f"keyframe: panorama {width} x {height} at ({x:.2f}, {y:.2f}, {z:.2f}) m, depth known in "
              f"{prior.known.mean():.0%}, median {prior.median_depth_m:.2f} m")  # fmt: skip
    return 0


def write_image(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write an RGB or grey image in the format of the file suffix; never leave a partial file."""
    import cv2

    try:
        done, content = cv2.imencode(path.suffix or ".png", image[..., ::-1] if image.ndim == 3 else image)
    except cv2.error:
        done = False
    if not done:
        raise UserError(f"{path}: the name of an image must end in .png or .jpg", 2)
    with replacing(path) as file:
        file.write(content.tobytes())


def write_depth(path: Path, depth_m: NDArray[np.float32]) -> None:
    """Write depth as a 16-bit PNG in millimetres or as ``.npy`` in metres."""
    import numpy as np

    if path.suffix == ".npy":
        np.save(path, depth_m)
    elif path.suffix == ".png":
        write_image(path, np.rint(np.clip(1000 * depth_m, 0, 65535)).astype(np.uint16))
    else:
        raise UserError(f"{path}: the name of a depth file must end in .png (16-bit, mm) or .npy (m)", 2)
