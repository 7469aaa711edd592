"""Training of the completion network, which can be stopped and resumed.

The schedule runs over wall time or epochs, whichever ends first: on a shared machine only the time is known beforehand.
The evaluated and saved weights are an exponential moving average of the trained ones.
"""

from __future__ import annotations

import copy
import math
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from instant_ic.depth.metrics import DepthMetrics, depth_metrics, mean_metrics, solid_angle_weights
from instant_ic.training.augment import photograph, to_brightness, turn_and_mirror, without_lidar
from instant_ic.training.checkpoints import CheckpointError, read_checkpoint
from instant_ic.training.completion import CompletionNet
from instant_ic.training.dataset import Sample
from instant_ic.training.feeds import Batch, Feed, stack
from instant_ic.training.losses import depth_loss, edge_loss, sigma_loss
from instant_ic.util.files import replacing

POLE_WEIGHT = 0.1
"""Minimum weight of a row in the loss, with a mean row weight of 1.

Weighted by solid angle alone, the rows at the poles would hardly be trained and would show as spikes.
"""
HEAD_RATE = 0.1
"""Learning rate of the last layer relative to that of the decoder.

In each step, Adam moves each of the 400 weights behind an output by the rate. At the decoder's rate, the output would
leave the prior within a few steps, before the weights have learnt anything.
"""


@dataclass(frozen=True)
class TrainingConfig:
    """Training parameters.

    Attributes:
        minutes: wall time of the learning rate schedule, after which training ends.
        epochs: passes over the data after which training ends, if that comes first.
        batch_size: panoramas per step.
        learning_rate: maximum learning rate of AdamW.
        encoder_rate: learning rate of the pretrained encoder relative to that of the decoder; 0 fixes the encoder,
            which halves the cost of a step.
        weight_decay: weight decay of AdamW.
        warmup: share of the schedule in which the learning rate rises.
        average: decay of the weight average per step.
        edge_share: weight of the edge loss.
        sigma_share: weight of the loss of the uncertainty.
        photograph: augment images with the effects of a real camera.
        no_lidar: share of the panoramas whose prior is the network's depth alone, as without a LiDAR.
        brightness: mean byte to which each image is scaled before the network, as in inference; 0: unchanged.
        evaluation_panoramas: number of held-out panoramas evaluated during training.
        checkpoint_s: seconds between checkpoints with evaluation.
        max_range_m: range beyond which ground truth counts as unknown and output is clipped.
        mixed_precision: convolutions in bfloat16, or in float16 on a GPU without bfloat16.
        threads: CPU threads. On cores that other programs also use, more threads only wait for each other.
        seed: seed of weights, order and augmentation.
    """

    minutes: float = 60.0
    epochs: int = 40
    batch_size: int = 6
    learning_rate: float = 1e-3
    encoder_rate: float = 0.0
    weight_decay: float = 0.02
    warmup: float = 0.04
    average: float = 0.998
    edge_share: float = 0.5
    sigma_share: float = 0.1
    photograph: bool = True
    no_lidar: float = 0.2
    brightness: float = 178.5
    evaluation_panoramas: int = 48
    checkpoint_s: float = 300.0
    max_range_m: float = 40.0
    mixed_precision: bool = True
    threads: int = 1
    seed: int = 0


def select_device(name: str = "auto") -> torch.device:
    """Return the device of a training.

    Args:
        name: ``auto`` (a GPU if there is one, else the CPU) or a torch device.

    Raises:
        ValueError: there is no such device.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ValueError(f"device {name!r}: {str(error).splitlines()[0]}") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device {name!r}: torch {torch.__version__} finds no CUDA GPU")
    return device


def describe_device(device: torch.device) -> str:
    """Return the name of a device for the training record."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"CPU ({platform.machine()}, {os.cpu_count()} cores)"


def schedule(progress: float, warmup: float) -> float:
    """Return the factor of the learning rate at ``progress`` 0..1: a linear rise, then half a cosine down to 0."""
    if progress < warmup:
        return max(progress / warmup, 0.02)
    return 0.5 * (1 + math.cos(math.pi * min(1.0, (progress - warmup) / (1 - warmup))))


@torch.no_grad()
def update_average(average: nn.Module, model: nn.Module, decay: float) -> None:
    """Set ``average`` to ``decay * average + (1 - decay) * model`` for every floating tensor of the state."""
    for kept, new in zip(average.state_dict().values(), model.state_dict().values(), strict=True):
        if kept.is_floating_point():
            kept.lerp_(new.to(kept.dtype), 1 - decay)
        else:
            kept.copy_(new)


def to_tensors(batch: Batch, max_range_m: float, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Convert a batch to images (B, 3, H, W) in 0..1, ground truth (B, H, W) and priors (B, 6, H, W).

    Ground truth is 0 where it is unknown or beyond ``max_range_m``.
    """
    rgb, depth, prior = (torch.from_numpy(part).to(device) for part in batch)
    truth = depth.float()
    truth = torch.where(torch.isfinite(truth) & (truth <= max_range_m), truth, 0.0)
    return rgb.permute(0, 3, 1, 2).float() / 255.0, truth, prior.float()


@torch.inference_mode()
def predict(
    model: CompletionNet, sample: Sample, max_range_m: float, brightness: float = 0.0
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the depth of a panorama as in inference, and its ground truth; (H, W) metres each, 0 is unknown.

    There is no augmentation; it runs in float32 on the model's device.
    """
    model.eval()
    rgb, truth, prior = to_tensors(stack([sample]), max_range_m, next(model.parameters()).device)
    depth = model(to_brightness(rgb, brightness), prior)[0][0].clamp(0.1, max_range_m)
    return depth.cpu().numpy(), truth[0].cpu().numpy()


def evaluate(
    model: CompletionNet, samples: Sequence[Sample], max_range_m: float, brightness: float = 0.0
) -> DepthMetrics:
    """Return the mean metrics of :func:`predict` over panoramas, weighted by solid angle."""
    weights = solid_angle_weights(model.config.height)[:, None]
    each = (predict(model, sample, max_range_m, brightness) for sample in samples)
    return mean_metrics([depth_metrics(depth, truth, weights=weights) for depth, truth in each])


@dataclass
class Trainer:
    """One training run; :meth:`run` continues until the schedule ends or ``stop`` is set.

    Attributes:
        feed: training batches, of ``config.batch_size``.
        held_out: panoramas for evaluation, from worlds that are not in the feed.
        model: network to train, starting from its present weights.
        output: checkpoint file.
        data: source of the panoramas, for the record.
        origin: source of the first weights, for the record.
        command: the user's command line, for the record.
        bar: receives the progress 0..1 after each step.
        stop: set it to end early.
    """

    feed: Feed
    held_out: Sequence[Sample]
    model: CompletionNet
    config: TrainingConfig
    output: Path
    data: dict[str, Any] = field(default_factory=dict)
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    origin: dict[str, Any] = field(default_factory=dict)
    command: str = ""
    report: Callable[[str], None] = print
    bar: Callable[[float], None] = lambda progress: None
    stop: bool = False
    step: int = 0
    elapsed_s: float = 0.0
    history: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        torch.set_num_threads(self.config.threads)
        torch.manual_seed(self.config.seed)
        self.network = self.model.config
        rows = np.maximum(solid_angle_weights(self.network.height), POLE_WEIGHT)
        self.row_weights = torch.from_numpy(rows).to(self.device)
        rgb = self.feed.batch(0)[0]
        if rgb.shape[1:3] != (self.network.height, self.network.width):
            raise ValueError(f"the panoramas are {rgb.shape[1]} x {rgb.shape[2]}, the network takes "
                             f"{self.network.height} x {self.network.width}")  # fmt: skip
        self.model = self.model.to(self.device)
        self.model.encoder.requires_grad_(self.config.encoder_rate > 0)
        self.average = copy.deepcopy(self.model).eval()
        groups = []
        rates = {"encoder.": self.config.encoder_rate, "head.": HEAD_RATE}
        for decay, matrices in ((self.config.weight_decay, True), (0.0, False)):
            for name, parameter in self.model.named_parameters():
                if (parameter.ndim > 1) == matrices:
                    rate = next((rate for start, rate in rates.items() if name.startswith(start)), 1.0)
                    groups.append({"params": [parameter], "weight_decay": decay, "rate": rate})
        self.optimizer = torch.optim.AdamW(groups, lr=self.config.learning_rate)
        cuda = self.device.type == "cuda"
        self._half = torch.float16 if cuda and not torch.cuda.is_bf16_supported() else torch.bfloat16
        scales = self.config.mixed_precision and self._half == torch.float16
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=scales)

    @property
    def progress(self) -> float:
        """Progress through the schedule, 0..1, by time or epochs."""
        by_time = self.elapsed_s / (60 * self.config.minutes)
        return min(1.0, max(by_time, self.step / (self.config.epochs * self.feed.steps_an_epoch)))

    def _augmented(self, rgb: Tensor, depth: Tensor, prior: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Augment with a generator seeded by the step, so that a resumed run repeats the same augmentation."""
        generator = torch.Generator().manual_seed((self.config.seed << 40) + (self.step << 8))
        rgb, depth, prior = turn_and_mirror(generator, rgb, depth, prior)
        if self.config.photograph:
            rgb = photograph(rgb, depth, generator)
        prior = without_lidar(prior, self.config.no_lidar, generator)
        return to_brightness(rgb, self.config.brightness), depth, prior

    def train_step(self) -> float:
        """Run one optimiser step and return the loss.

        Raises:
            RuntimeError: the loss is not finite.
        """
        factor = schedule(self.progress, self.config.warmup)
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate * factor * group["rate"]
        batch = to_tensors(self.feed.batch(self.step), self.config.max_range_m, self.device)
        rgb, truth, prior = self._augmented(*batch)
        self.model.train()
        with torch.autocast(self.device.type, self._half, enabled=self.config.mixed_precision):
            predicted, sigma = self.model(rgb, prior)
        loss = depth_loss(predicted, truth, self.row_weights)
        loss = loss + self.config.edge_share * edge_loss(predicted, truth, self.row_weights)
        guessed = truth * (prior[:, 2] == 0)
        loss = loss + self.config.sigma_share * sigma_loss(predicted, sigma, guessed, self.row_weights)
        if not torch.isfinite(loss):
            raise RuntimeError(f"step {self.step}: loss is {loss.item()}; lower learning_rate")
        self.optimizer.zero_grad(set_to_none=True)
        self.scaler.scale(loss).backward()
        self.scaler.unscale_(self.optimizer)
        nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
        self.scaler.step(self.optimizer)
        self.scaler.update()
        self.step += 1
        # A smaller decay at first, so that the average does not retain the start weights for long.
        update_average(self.average, self.model, min(self.config.average, (1 + self.step) / (10 + self.step)))
        return float(loss.item())

    def run(self) -> DepthMetrics:
        """Train to the end of the schedule; return the metrics over all held-out panoramas."""
        self.output.parent.mkdir(parents=True, exist_ok=True)
        begin = time.monotonic() - self.elapsed_s
        last_checkpoint, last_report, losses = time.monotonic(), (time.monotonic(), self.step), []
        if not self.history:
            self._checkpoint(self._evaluate(self._picked()), [])  # figures of the prior itself, before any training
        while self.progress < 1.0 and not self.stop:
            losses.append(self.train_step())
            self.elapsed_s = time.monotonic() - begin
            self.bar(self.progress)
            now = time.monotonic()
            if self.step % 50 == 0 or now - last_report[0] > 60:
                last_report = self._report(losses, *last_report)
            if now - last_checkpoint > self.config.checkpoint_s:
                self._checkpoint(self._evaluate(self._picked()), losses)
                self.elapsed_s = time.monotonic() - begin
                last_checkpoint, last_report = time.monotonic(), (time.monotonic(), self.step)
        final = self._evaluate(self.held_out)
        self._checkpoint(final, losses)
        return final

    def close(self) -> None:
        """Close the feed."""
        self.feed.close()

    def _report(self, losses: list[float], since: float, since_step: int) -> tuple[float, int]:
        """Report loss and speed since a time and step; return the current ones."""
        now, count = time.monotonic(), self.step - since_step
        loss, rate = np.mean(losses[-count:]), count * self.config.batch_size / (now - since)
        self.report(f"step {self.step} epoch {self.step / self.feed.steps_an_epoch:.2f} loss {loss:.4f} "
                    f"{rate:.1f} panoramas/s {100 * self.progress:.0f} %")  # fmt: skip
        return now, self.step

    def _picked(self) -> list[Sample]:
        step = max(1, len(self.held_out) // self.config.evaluation_panoramas)
        return [self.held_out[i] for i in range(0, len(self.held_out), step)]

    def _evaluate(self, samples: Sequence[Sample]) -> DepthMetrics:
        return evaluate(self.average, samples, self.config.max_range_m, self.config.brightness)

    def _checkpoint(self, metrics: DepthMetrics, losses: list[float]) -> None:
        entry: dict[str, Any] = {"step": self.step, "minutes": round(self.elapsed_s / 60, 1), **metrics.as_dict()}
        entry["loss"] = round(float(np.mean(losses[-100:])), 5) if losses else None
        self.history.append(entry)
        state = {
            "config": self.network.as_dict(),
            "state_dict": self.average.state_dict(),
            "record": self.record(),
            "resume": {
                "model": self.model.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "scaler": self.scaler.state_dict(),
                "step": self.step,
                "elapsed_s": self.elapsed_s,
            },
        }
        with replacing(self.output) as file:
            torch.save(state, file)
        self.report(f"held-out panoramas: {entry}")

    def record(self) -> dict[str, Any]:
        """Return the origin of the weights as plain values: command, start, data, network, training and results."""
        return {
            "command": self.command,
            "start": self.origin,
            "network": self.network.as_dict(),
            "parameters": sum(p.numel() for p in self.model.parameters()),
            "training": asdict(self.config),
            "data": {**self.data, "panoramas": len(self.feed.samples)},
            "held_out": len(self.held_out),
            "device": describe_device(self.device),
            "steps": self.step,
            "epochs": round(self.step / self.feed.steps_an_epoch, 2),
            "wall_minutes": round(self.elapsed_s / 60, 1),
            "torch": str(torch.__version__),
            "history": self.history,
        }

    def resume(self, path: Path) -> None:
        """Resume a run from its checkpoint.

        Raises:
            CheckpointError: the file is not a checkpoint of a run with this network.
        """
        state = read_checkpoint(path)
        if not isinstance(state, dict) or "resume" not in state or state.get("config") != self.network.as_dict():
            raise CheckpointError(f"{path}: not a checkpoint of a run with {self.network}")
        self.average.load_state_dict(state["state_dict"])
        self.model.load_state_dict(state["resume"]["model"])
        self.optimizer.load_state_dict(state["resume"]["optimizer"])
        self.scaler.load_state_dict(state["resume"]["scaler"])
        self.step, self.elapsed_s = state["resume"]["step"], state["resume"]["elapsed_s"]
        self.history = state["record"]["history"]
