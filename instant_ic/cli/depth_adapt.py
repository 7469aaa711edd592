"""``ic depth adapt``: a completion fine-tuned to a building by a drive through it, taken only where it is better."""

from __future__ import annotations

import argparse
import copy
import shlex
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from instant_ic.cli.arguments import check_files, positive, positive_int, verb
from instant_ic.cli.errors import UserError

LEARNING_RATE, BATCH, MOST_EPOCHS = 2e-4, 4, 40


def add_parser(commands: Any) -> None:
    add = verb(
        commands, "adapt", "adapt depth completion to a building by a recorded drive", adapt,
        "ic depth adapt runs/drive -o models/mine.onnx",
        "Fine-tune a completion on the panoramas of a drive; what the LiDAR measured later on the way is the truth. "
        "Stretches of the drive and a sector of directions are left out. The new model is written only if it is better "
        "on both by more than chance explains; else the exit status is 1. Ctrl-C ends the training early.",
    ).add_argument  # fmt: skip
    add("bag", type=Path, help="recording with panoramas, LiDAR, /tf and /tf_static; 15 m or more")
    add("--start", type=Path, metavar="ONNX", help="completion to start from (default: the shipped one)")
    add("--network", metavar="ONNX", help="network of depth_estimator (default: the shipped one)")
    add("-o", "--output", type=Path, required=True, metavar="ONNX", help="model to write")
    add("--minutes", type=positive, default=5.0, help="training time (%(default)g)")
    add("--learning-rate", type=positive, default=LEARNING_RATE, metavar="RATE", help="peak rate (%(default)g)")
    add("--threads", type=positive_int, default=1, help="CPU threads (%(default)s)")


def adapt(args: argparse.Namespace) -> int:
    check_files(args.output, suffix=".onnx")
    import numpy as np
    import torch

    from instant_ic.cli.depth_train import ends_early
    from instant_ic.cli.progress import progress
    from instant_ic.depth.model import DEFAULT_COMPLETION, DEFAULT_MODEL, DepthModel
    from instant_ic.training.adaptation import errors, gain, samples, split
    from instant_ic.training.drive import read_drive
    from instant_ic.training.export import export_model, load_exported
    from instant_ic.training.feeds import FileFeed
    from instant_ic.training.trainer import Team, Trainer, TrainingConfig
    from instant_ic.util.paths import shipped_file

    torch.set_num_threads(args.threads)
    start, manifest = load_exported(args.start or shipped_file("models", DEFAULT_COMPLETION))
    size = (manifest.input_height, manifest.input_width)
    network = DepthModel.find(args.network or DEFAULT_MODEL, args.threads, "cpu")
    if network.manifest.prior_input:
        raise UserError(f"--network {args.network}: a completion; give a network that takes the image alone", 2)
    with progress("reading the drive") as bar:
        keyframes = read_drive(args.bag, network, size, bar)
    parts = split(keyframes)
    print(f"{args.bag}: {len(keyframes)} panoramas over {keyframes[-1].path_m:.1f} m, {len(parts.training)} for "
          f"training, {len(parts.places)} at places left out", flush=True)  # fmt: skip
    scale = manifest.max_range_m, manifest.brightness
    checked = {"places left out": parts.places, "sector left out": parts.sector}
    config = TrainingConfig(
        minutes=args.minutes, epochs=MOST_EPOCHS, batch_size=BATCH, learning_rate=args.learning_rate, warmup=0.1,
        sigma_share=0.0, no_lidar=0.0, checkpoint_s=1e9, evaluation_panoramas=1, threads=args.threads,
        max_range_m=manifest.max_range_m, brightness=manifest.brightness,
    )  # fmt: skip
    with progress("training") as bar, tempfile.TemporaryDirectory() as folder:
        before = {name: (errors(part, None, *scale), errors(part, start, *scale)) for name, part in checked.items()}
        training = samples(parts, start, *scale)
        feed = FileFeed(training, np.arange(len(training)), BATCH, info={"kind": "drive", "bag": args.bag.name})
        trainer = Trainer(
            feed, training[:1], copy.deepcopy(start), config, Path(folder) / "adapted.pt", Team(torch.device("cpu")),
            {"file": manifest.model, "sha256": manifest.sha256}, shlex.join(["ic", *sys.argv[1:]]),
            report=lambda line: None, bar=bar,
        )  # fmt: skip
        try:
            with ends_early(trainer):
                trainer.run()
        finally:
            trainer.close()
    model = trainer.average
    gains = {name: gain(part, *before[name], errors(part, model, *scale)) for name, part in checked.items()}
    for name, found in gains.items():
        print(f"mean relative error, {name}: {found}", flush=True)
    if not all(found.better for found in gains.values()):
        print(f"not better than {manifest.model} on both: {args.output} is not written", flush=True)
        return 1
    record = trainer.record() | {"check": {name: asdict(found) for name, found in gains.items()}}
    export_model(
        model, args.output, args.output.stem, manifest.licence, manifest.max_range_m, record, half_weights=True,
        brightness=manifest.brightness,
    )  # fmt: skip
    print(f"wrote {args.output} ({trainer.step} steps, {trainer.elapsed_s / 60:.1f} minutes)", flush=True)
    return 0
