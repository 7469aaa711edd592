"""``ic depth``: train, convert, check and run depth models."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli import depth_train
from instant_ic.cli.arguments import positive, positive_int
from instant_ic.cli.errors import UserError

if TYPE_CHECKING:
    from instant_ic.depth.model import DepthModel

PROVIDERS = ("auto", "tensorrt", "cuda", "cpu")


def add_parser(subparsers: Any) -> None:
    """Add ``depth`` with its own subcommands."""
    parser = subparsers.add_parser(
        "depth",
        help="train, convert, check and run 360° depth models",
        description="Train, convert, check and run 360° depth models (docs/depth.md).",
        epilog="example: ic depth estimate panorama.jpg --output depth.png",
    )
    commands = parser.add_subparsers(dest="depth_command", required=True)
    depth_train.add_parser(commands)
    _add_textures(commands)
    _add_convert(commands)
    _add_check(commands)
    _add_estimate(commands)


def _add_textures(commands: Any) -> None:
    parser = commands.add_parser(
        "textures",
        help="unpack photographic textures for ic depth train",
        description="Write the surface textures of a robosuite wheel (MIT licence) as JPEG files into a folder, for\n"
        "ic depth train --textures. Get the wheel with: pip download --no-deps robosuite==1.5.2",
        epilog="example: ic depth textures robosuite-1.5.2-py3-none-any.whl -o runs/textures",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("wheel", type=Path, help="the wheel")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/textures"), help="folder (%(default)s)")
    parser.set_defaults(func=textures)


def textures(args: argparse.Namespace) -> int:
    """``ic depth textures``."""
    from instant_ic.training.dataset import DatasetError
    from instant_ic.training.photographs import unpack

    try:
        count = unpack(args.wheel, args.output)
    except DatasetError as error:
        raise UserError(str(error)) from error
    print(f"wrote {count} textures to {args.output}")
    return 0


def _add_convert(commands: Any) -> None:
    parser = commands.add_parser(
        "convert",
        help="convert SliceNet weights to ONNX with a manifest",
        description="Convert a checkpoint (published SliceNet weights, or ours) to ONNX with its manifest, and compare "
        "the output of ONNX with that of torch. Nothing is written if they differ.",
        epilog="example: ic depth convert resnet50_m3d.pth -o slicenet_m3d.onnx",
    )
    parser.add_argument("weights", type=Path, help="checkpoint file")
    parser.add_argument("-o", "--output", type=Path, help="ONNX file to write (default: WEIGHTS.onnx)")
    parser.add_argument("--half", action="store_true", help="store the weights as float16, half the size")
    parser.add_argument("--brightness", type=float, default=0.0, metavar="BYTE",
                        help="mean byte value of the training images, 0 for any (%(default)s)")  # fmt: skip
    parser.add_argument(
        "--max-range", type=positive, default=16.0, metavar="M", help="longest range in metres (%(default)s)"
    )
    parser.add_argument("--name", help="name in the manifest (default: the file's name)")
    parser.add_argument("--licence", help="licence in the manifest (default: unknown; Apache-2.0 for our own)")
    parser.set_defaults(func=convert)


def _add_model(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--provider", choices=PROVIDERS, default="auto", help="execution provider (%(default)s)")
    parser.add_argument("--threads", type=positive_int, default=2, help="CPU threads (%(default)s)")


def _add_check(commands: Any) -> None:
    parser = commands.add_parser(
        "check",
        help="check a model file and its manifest, and time it",
        description="Load a model as the node does and print its manifest, inputs, outputs, execution provider and "
        "the time per panorama.",
        epilog="example: ic depth check models/da2.onnx --provider cuda",
    )
    parser.add_argument("model", type=Path, nargs="?", help="ONNX file or its manifest (default: the shipped one)")
    _add_model(parser)
    parser.add_argument("--runs", type=positive_int, default=3, metavar="N", help="timed runs (%(default)s)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(func=check)


def _add_estimate(commands: Any) -> None:
    parser = commands.add_parser(
        "estimate",
        help="estimate the depth of one panorama as a coloured image",
        description="Estimate the depth of one equirectangular image; write a coloured PNG and optionally the values.",
        epilog="example: ic depth estimate panorama.jpg --output depth.png --npy depth.npy",
    )
    parser.add_argument("image", type=Path, help="equirectangular image")
    parser.add_argument("--model", type=Path, help="ONNX file with a manifest beside it (default: the shipped one)")
    _add_model(parser)
    parser.add_argument("-o", "--output", type=Path, default=Path("depth.png"), help="coloured depth (%(default)s)")
    parser.add_argument("--npy", type=Path, help="also write the depth as a float32 array")
    parser.set_defaults(func=estimate)


def convert(args: argparse.Namespace) -> int:
    """``ic depth convert``."""
    import torch

    from instant_ic.training.export import ExportError, export_model
    from instant_ic.training.slicenet import CheckpointError, load_checkpoint

    output = args.output or args.weights.with_suffix(".onnx")
    if output.suffix != ".onnx":
        raise UserError(
            f"{output}: the name must end in .onnx; its manifest becomes {output.with_suffix('.yaml').name}"
        )
    begin = time.monotonic()

    def report(line: str) -> None:
        print(f"{time.monotonic() - begin:5.1f} s  {line}", flush=True)

    report(f"reading {args.weights}")
    try:
        model = load_checkpoint(args.weights)
        own = torch.load(args.weights, map_location="cpu", weights_only=True)
        count = sum(parameter.numel() for parameter in model.parameters())
        report(f"SliceNet {model.config.backbone}, {model.config.width} x {model.config.height}, {count / 1e6:.1f} M")
        licence = args.licence or ("Apache-2.0" if "config" in own else "unknown: ask the authors of the weights")
        export_model(
            model, output, args.name or output.stem, licence, args.max_range, own.get("record"), args.half,
            args.brightness, report,
        )  # fmt: skip
    except (CheckpointError, ExportError, ValueError) as error:
        raise UserError(str(error)) from error
    except OSError as error:
        raise UserError(f"{error.filename or output}: {error.strerror or error}") from error
    report(f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB) and {output.with_suffix('.yaml').name}")
    return 0


def _load(args: argparse.Namespace) -> DepthModel:
    from instant_ic.depth.manifest import ManifestError
    from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
    from instant_ic.paths import shipped_file

    try:
        model = DepthModel.load(args.model or shipped_file("models", DEFAULT_MODEL), args.threads, args.provider)
    except (ManifestError, FileNotFoundError) as error:
        raise UserError(str(error)) from error
    if args.provider not in ("auto", model.provider):
        print(f"runs on {model.provider}; {'; '.join(model.notes)}", file=sys.stderr)
    return model


def check(args: argparse.Namespace) -> int:
    """``ic depth check``."""
    from dataclasses import asdict

    import numpy as np

    from instant_ic.depth.manifest import InferenceError, ManifestError

    begin = time.perf_counter()
    model = _load(args)
    took = [time.perf_counter() - begin]
    manifest = model.manifest
    # Random colour blocks: an image of one colour would not reveal a constant output.
    coarse = np.random.default_rng(0).integers(0, 256, (8, 16, 3), np.uint8)
    picture = coarse.repeat(max(1, manifest.input_height // 8), 0).repeat(max(1, manifest.input_width // 16), 1)
    try:
        for _ in range(1 + args.runs):
            begin = time.perf_counter()
            depth = model.estimate(picture)
            took.append(time.perf_counter() - begin)
    except (ManifestError, InferenceError) as error:
        raise UserError(str(error)) from error
    load_s, first_s, seconds = took[0], took[1], float(np.median(took[2:]))
    known = depth[depth > 0]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    if args.json:
        summary = {
            "manifest": asdict(manifest), "provider": model.provider, "notes": model.notes, "threads": args.threads,
            "inputs": model.inputs, "outputs": model.outputs, "depth_shape": depth.shape, "depth_range": [low, high],
            "known": known.size / depth.size, "load_s": load_s, "first_s": first_s, "seconds": seconds,
        }  # fmt: skip
        print(json.dumps(summary, indent=1))
        return 0
    for key, value in asdict(manifest).items():
        print(f"{key:>14}  {value if value != '' else '-'}")
    for kind, ends in (("input", model.inputs), ("output", model.outputs)):
        for name, dtype, shape in ends:
            print(f"{kind:>14}  {name}: {dtype} {shape}")
    print(f"{'runs on':>14}  {model.provider}, CPU threads: {args.threads}")
    for note in model.notes:
        print(f"{'not on':>14}  {note}")
    print(f"{'output depth':>14}  {depth.shape[1]} x {depth.shape[0]}, {low:.3g} to {high:.3g}, "
          f"{known.size / depth.size:.0%} known (on a random test image)")  # fmt: skip
    print(f"{'time':>14}  {seconds:.3f} s per panorama (first run {first_s:.3f} s, loading {load_s:.2f} s)")
    return 0


def estimate(args: argparse.Namespace) -> int:
    """``ic depth estimate``."""
    import cv2
    import numpy as np

    from instant_ic.depth.colour import depth_picture
    from instant_ic.depth.manifest import InferenceError
    from instant_ic.limits import load_image

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
    except InferenceError as error:
        raise UserError(str(error)) from error
    took = time.perf_counter() - begin
    try:
        if args.npy:
            np.save(args.npy, depth)
        written = cv2.imwrite(str(args.output), depth_picture(depth)[..., ::-1])
    except (OSError, cv2.error) as error:
        raise UserError(f"cannot write: {error}") from error
    if not written:
        raise UserError(f"cannot write {args.output}")
    low, middle, high = np.percentile(depth[depth > 0], (1, 50, 99)) if (depth > 0).any() else (0.0, 0.0, 0.0)
    print(f"{model.manifest.name} on {model.provider}: {took:.3f} s, {model.manifest.output_kind}, "
          f"1 % {low:.2f}, median {middle:.2f}, 99 % {high:.2f}; wrote {args.output}")  # fmt: skip
    return 0
