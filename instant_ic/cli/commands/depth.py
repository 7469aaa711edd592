"""``ic depth``: train and run depth models."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli import depth_train
from instant_ic.cli.arguments import group, positive_int, verb
from instant_ic.cli.errors import UserError

if TYPE_CHECKING:
    from instant_ic.depth.model import DepthModel

PROVIDERS = ("auto", "tensorrt", "cuda", "cpu")


def add_parser(subparsers: Any) -> None:
    commands = group(
        subparsers, "depth", "train and run 360° depth models",
        "Train and run 360° depth models (docs/depth.md).",
        "ic depth estimate panorama.jpg --output depth.png",
    )  # fmt: skip
    depth_train.add_parser(commands)
    depth_train.add_render_parser(commands)
    add = verb(
        commands, "textures", "unpack photographic textures for ic depth render", textures,
        "ic depth textures robosuite-1.5.2-py3-none-any.whl -o runs/textures",
        "Write the surface textures of a robosuite wheel (MIT licence) as JPEG files into a folder, for\n"
        "ic depth render --textures. Get the wheel with: pip download --no-deps robosuite==1.5.2",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    ).add_argument  # fmt: skip
    add("wheel", type=Path, help="the wheel")
    add("-o", "--output", type=Path, default=Path("runs/textures"), help="folder (%(default)s)")
    add = verb(
        commands, "estimate", "estimate the depth of one panorama as a coloured image", estimate,
        "ic depth estimate panorama.jpg --output depth.png --npy depth.npy",
        "Estimate the depth of one equirectangular image; write a coloured PNG and optionally the values.",
    ).add_argument  # fmt: skip
    add("image", type=Path, help="equirectangular image")
    add("--model", type=Path, help="ONNX file with a manifest beside it (default: the shipped one)")
    add("--provider", choices=PROVIDERS, default="auto", help="execution provider (%(default)s)")
    add("--threads", type=positive_int, default=2, help="CPU threads (%(default)s)")
    add("-o", "--output", type=Path, default=Path("depth.png"), help="coloured depth (%(default)s)")
    add("--npy", type=Path, help="also write the depth as a float32 array")


def textures(args: argparse.Namespace) -> int:
    from instant_ic.training.photographs import unpack

    print(f"wrote {unpack(args.wheel, args.output)} textures to {args.output}")
    return 0


def _load(args: argparse.Namespace) -> DepthModel:
    from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
    from instant_ic.util.paths import shipped_file

    model = DepthModel.load(args.model or shipped_file("models", DEFAULT_MODEL), args.threads, args.provider)
    if args.provider not in ("auto", model.provider):
        print(f"runs on {model.provider}: {args.provider} does not work here (pip install onnxruntime-gpu?)",
              file=sys.stderr)  # fmt: skip
    return model


def estimate(args: argparse.Namespace) -> int:
    import cv2
    import numpy as np

    from instant_ic.cli.commands.vspace import write_image
    from instant_ic.depth.colour import coloured_depth
    from instant_ic.util.limits import load_image

    picture = load_image(args.image, cv2.IMREAD_COLOR)
    if picture is None:
        raise UserError(f"{args.image}: not a readable image")
    model = _load(args)
    rgb = np.ascontiguousarray(picture[..., ::-1])
    try:
        model.estimate(rgb)  # the first run allocates memory, so the second one is timed
        begin = time.perf_counter()
        depth = model.estimate(rgb)
    except ValueError as error:  # includes ManifestError
        raise UserError(f"{args.image}: {error}") from error
    took = time.perf_counter() - begin
    if args.npy:
        np.save(args.npy, depth)
    write_image(args.output, coloured_depth(depth))
    low, middle, high = np.percentile(depth[depth > 0], (1, 50, 99)) if (depth > 0).any() else (0.0, 0.0, 0.0)
    print(f"{model.manifest.name} on {model.provider}: {took:.3f} s, {model.manifest.output_kind}, "
          f"1 % {low:.2f}, median {middle:.2f}, 99 % {high:.2f}; wrote {args.output}")  # fmt: skip
    return 0
