"""``ic depth``: train, export and try depth models."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from instant_ic.depth.dataset import PanoramaDataset
    from instant_ic.depth.rooms import RoomsConfig

LICENCE = "Apache-2.0"


def add_parser(subparsers: Any) -> None:
    """Adds ``depth`` with its own subcommands."""
    parser = subparsers.add_parser(
        "depth",
        help="train, export and try 360° depth models",
        description="Train, export and try 360° depth models (docs/depth.md).",
        epilog="example: ic depth estimate panorama.jpg --output depth.png",
    )
    commands = parser.add_subparsers(dest="depth_command", required=True)
    _add_train(commands)
    _add_export(commands)
    _add_estimate(commands)


def _add_train(commands: Any) -> None:
    parser = commands.add_parser(
        "train",
        help="train the small SliceNet on generated rooms",
        description="Renders panoramas of random rooms into a cache folder (once), trains the small SliceNet on them "
        "and exports it. Ctrl-C ends early: the last weights are evaluated, saved and exported.",
        epilog="example: ic depth train --cache ~/rooms --minutes 60 --checkpoint runs/small.pt "
        "--export models/slicenet_small.onnx",
    )
    parser.add_argument("--cache", type=Path, required=True, help="folder of rendered panoramas, made when absent")
    parser.add_argument("--worlds", type=int, default=400, help="random worlds to render (%(default)s)")
    parser.add_argument("--poses", type=int, default=6, help="panoramas in each (%(default)s)")
    parser.add_argument("--minutes", type=float, default=60.0, help="wall time of the training (%(default)s)")
    parser.add_argument("--epochs", type=int, default=60, help="most passes over the data (%(default)s)")
    parser.add_argument("--batch-size", type=int, default=8, help="panoramas a step (%(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads; more only on idle cores (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of weights, order and augmentation (%(default)s)")
    parser.add_argument("--checkpoint", type=Path, default=Path("runs/depth/slicenet_small.pt"),
                        help="file of the weights (%(default)s)")  # fmt: skip
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint")
    parser.add_argument("--export", type=Path, help="ONNX file to write at the end, with manifest and record")
    parser.set_defaults(func=train)


def _add_export(commands: Any) -> None:
    parser = commands.add_parser(
        "export",
        help="turn a checkpoint into ONNX with its manifest",
        description="Turns a checkpoint (ours, or published SliceNet weights) into ONNX with its manifest, and holds "
        "the result against torch.",
        epilog="example: ic depth export runs/depth/slicenet_small.pt --output models/slicenet_small.onnx --half",
    )
    parser.add_argument("weights", type=Path, help="checkpoint file")
    parser.add_argument("--output", type=Path, required=True, help="ONNX file to write")
    parser.add_argument("--half", action="store_true", help="store the weights as float16")
    parser.add_argument("--brightness", type=float, default=0.0, help="mean byte of the training pictures; 0: any")
    parser.add_argument("--max-range", type=float, default=16.0, help="metres (%(default)s)")
    parser.add_argument("--licence", default=LICENCE, help="of the weights, for the manifest (%(default)s)")
    parser.set_defaults(func=export)


def _add_estimate(commands: Any) -> None:
    parser = commands.add_parser(
        "estimate",
        help="depth of one panorama as a coloured picture",
        description="Estimates the depth of one equirect picture; writes a coloured PNG and, if wanted, the numbers.",
        epilog="example: ic depth estimate panorama.jpg --output depth.png --npy depth.npy",
    )
    parser.add_argument("image", type=Path, help="equirect picture")
    parser.add_argument("--model", type=Path, help="ONNX file with a manifest beside it (default: the shipped one)")
    parser.add_argument("--output", type=Path, default=Path("depth.png"), help="coloured depth (%(default)s)")
    parser.add_argument("--npy", type=Path, help="depth as float32 array")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads (%(default)s)")
    parser.set_defaults(func=estimate)


def open_cache(folder: Path, recipe: RoomsConfig) -> PanoramaDataset:
    """The data folder, rendered first where it is absent or not complete."""
    from instant_ic.depth.dataset import PanoramaDataset, write_dataset
    from instant_ic.depth.rooms import render_rooms

    done = folder / "complete"
    if not done.exists():
        begin = time.monotonic()
        size = (recipe.height, 2 * recipe.height)
        for count in write_dataset(folder, render_rooms(recipe), recipe.count, size, recipe.as_dict()):
            if count % 100 == 0 or count == recipe.count:
                rate = count / (time.monotonic() - begin)
                print(f"rendered {count} of {recipe.count} panoramas, {rate:.1f} a second", flush=True)
        done.touch()
    return PanoramaDataset(folder)


def train(args: argparse.Namespace) -> int:
    """``ic depth train``."""
    from instant_ic.depth.export import export_model
    from instant_ic.depth.rooms import RoomsConfig
    from instant_ic.depth.slicenet import SMALL, load_checkpoint
    from instant_ic.depth.training import Trainer, TrainingConfig

    data = open_cache(args.cache, RoomsConfig(worlds=args.worlds, poses=args.poses, height=SMALL.height))
    config = TrainingConfig(
        minutes=args.minutes, epochs=args.epochs, batch_size=args.batch_size, threads=args.threads, seed=args.seed
    )
    trainer = Trainer(data, SMALL, config, args.checkpoint, report=lambda line: print(line, flush=True))
    if args.resume:
        trainer.resume(args.checkpoint)

    def end_early(number: int, frame: FrameType | None) -> None:
        trainer.stop = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end_early)
    metrics = trainer.run()
    print(json.dumps(metrics.as_dict()), flush=True)
    if args.export:
        manifest = export_model(
            load_checkpoint(args.checkpoint), args.export, args.export.stem, LICENCE, config.max_range_m,
            record=trainer.record(), half_weights=True, brightness=data.brightness(),
        )  # fmt: skip
        print(f"wrote {args.export} ({args.export.stat().st_size / 1e6:.1f} MB, {manifest.sha256[:12]})", flush=True)
    return 0


def export(args: argparse.Namespace) -> int:
    """``ic depth export``."""
    import torch

    from instant_ic.depth.export import export_model
    from instant_ic.depth.slicenet import CheckpointError, load_checkpoint

    try:
        model = load_checkpoint(args.weights)
    except CheckpointError as error:
        print(f"ic depth export: {error}", file=sys.stderr)
        return 1
    record = torch.load(args.weights, map_location="cpu", weights_only=True).get("record")
    manifest = export_model(
        model, args.output, args.output.stem, args.licence, args.max_range, record, args.half, args.brightness
    )
    print(f"wrote {args.output} ({args.output.stat().st_size / 1e6:.1f} MB), input "
          f"{manifest.input_width} x {manifest.input_height}")  # fmt: skip
    return 0


def estimate(args: argparse.Namespace) -> int:
    """``ic depth estimate``."""
    import cv2
    import numpy as np

    from instant_ic.depth.colour import depth_picture
    from instant_ic.depth.manifest import ManifestError
    from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
    from instant_ic.paths import shipped_file

    picture = cv2.imread(str(args.image), cv2.IMREAD_COLOR)
    if picture is None:
        print(f"ic depth estimate: {args.image}: not a readable picture", file=sys.stderr)
        return 1
    try:
        model = DepthModel.load(args.model or shipped_file("models", DEFAULT_MODEL), threads=args.threads)
    except (ManifestError, FileNotFoundError) as error:
        print(f"ic depth estimate: {error}", file=sys.stderr)
        return 1
    rgb = np.ascontiguousarray(picture[..., ::-1])
    model.estimate(rgb)  # the first run allocates; time the second
    begin = time.perf_counter()
    depth = model.estimate(rgb)
    took = time.perf_counter() - begin
    if args.npy:
        np.save(args.npy, depth)
    if not cv2.imwrite(str(args.output), depth_picture(depth)[..., ::-1]):
        print(f"ic depth estimate: cannot write {args.output}", file=sys.stderr)
        return 1
    low, middle, high = np.percentile(depth, (1, 50, 99))
    print(f"{model.manifest.name} on {model.provider}: {took:.3f} s, {model.manifest.output_kind}, "
          f"1 % {low:.2f}, median {middle:.2f}, 99 % {high:.2f}; wrote {args.output}")  # fmt: skip
    return 0
