"""``ic depth``: train, convert and run depth models."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli import depth_train
from instant_ic.cli.arguments import group, positive, positive_int, verb
from instant_ic.cli.errors import UserError
from instant_ic.cli.evaluations import errors_for_the_user

if TYPE_CHECKING:
    from instant_ic.depth.model import DepthModel

PROVIDERS = ("auto", "tensorrt", "cuda", "cpu")


def add_parser(subparsers: Any) -> None:
    commands = group(
        subparsers, "depth", "train, convert and run 360° depth models",
        "Train, convert and run 360° depth models (docs/depth.md).",
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
        commands, "convert", "convert SliceNet weights to ONNX with a manifest", convert,
        "ic depth convert resnet50_m3d.pth -o slicenet_m3d.onnx",
        "Convert a checkpoint (published SliceNet weights, or ours) to ONNX with its manifest, and compare "
        "the output of ONNX with that of torch. Nothing is written if they differ.",
    ).add_argument  # fmt: skip
    add("weights", type=Path, help="checkpoint file")
    add("-o", "--output", type=Path, help="ONNX file to write (default: WEIGHTS.onnx)")
    add("--half", action="store_true", help="store the weights as float16, half the size")
    text = "mean byte value of the training images, 0 for any (%(default)s)"
    add("--brightness", type=float, default=0.0, metavar="BYTE", help=text)
    add("--max-range", type=positive, default=16.0, metavar="M", help="longest range in metres (%(default)s)")
    add("--name", help="name in the manifest (default: the file's name)")
    add("--licence", help="licence in the manifest (default: unknown; Apache-2.0 for our own)")
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


def convert(args: argparse.Namespace) -> int:
    import torch

    from instant_ic.training.export import export_model
    from instant_ic.training.slicenet import load_checkpoint

    output = args.output or args.weights.with_suffix(".onnx")
    if output.suffix != ".onnx":
        raise UserError(
            f"{output}: the name must end in .onnx; its manifest becomes {output.with_suffix('.yaml').name}"
        )
    begin = time.monotonic()

    def report(line: str) -> None:
        print(f"{time.monotonic() - begin:5.1f} s  {line}", flush=True)

    report(f"reading {args.weights}")
    with errors_for_the_user():
        model = load_checkpoint(args.weights)
        own = torch.load(args.weights, map_location="cpu", weights_only=True)
        count = sum(parameter.numel() for parameter in model.parameters())
        report(f"SliceNet {model.config.backbone}, {model.config.width} x {model.config.height}, {count / 1e6:.1f} M")
        licence = args.licence or ("Apache-2.0" if "config" in own else "unknown: ask the authors of the weights")
        export_model(
            model, output, args.name or output.stem, licence, args.max_range, own.get("record"), args.half,
            args.brightness, report,
        )  # fmt: skip
    report(f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB) and {output.with_suffix('.yaml').name}")
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
    from instant_ic.depth.colour import depth_picture
    from instant_ic.util.limits import load_image

    picture = load_image(args.image, cv2.IMREAD_COLOR)
    if picture is None:
        raise UserError(f"{args.image}: not a readable image")
    model = _load(args)
    rgb = np.ascontiguousarray(picture[..., ::-1])
    try:
        model.estimate(rgb)  # the first run allocates memory; time the second
        begin = time.perf_counter()
        depth = model.estimate(rgb)
    except ValueError as error:  # includes ManifestError
        raise UserError(f"{args.image}: {error}") from error
    took = time.perf_counter() - begin
    if args.npy:
        np.save(args.npy, depth)
    write_image(args.output, depth_picture(depth))
    low, middle, high = np.percentile(depth[depth > 0], (1, 50, 99)) if (depth > 0).any() else (0.0, 0.0, 0.0)
    print(f"{model.manifest.name} on {model.provider}: {took:.3f} s, {model.manifest.output_kind}, "
          f"1 % {low:.2f}, median {middle:.2f}, 99 % {high:.2f}; wrote {args.output}")  # fmt: skip
    return 0
