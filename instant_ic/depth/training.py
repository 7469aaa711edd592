"""Trains SliceNet on a panorama data folder; can be stopped at any time and taken up again.

The schedule runs over wall time or epochs, whichever ends first: on a machine that is shared, time is what is known
beforehand. The weights that are evaluated and saved are an exponential average of the trained ones.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from .augment import camera_colours, turn_and_mirror
from .dataset import DatasetError, PanoramaDataset
from .losses import depth_loss, edge_loss
from .metrics import DepthMetrics, depth_metrics, mean_metrics, solid_angle_weights
from .slicenet import CheckpointError, SliceNet, SliceNetConfig


@dataclass(frozen=True)
class TrainingConfig:
    """How to train.

    Attributes:
        minutes: wall time after which the learning rate has come down and training ends.
        epochs: passes over the data after which it ends, if that comes first.
        batch_size: panoramas a step.
        learning_rate: the largest, of AdamW.
        weight_decay: of AdamW.
        warmup: share of the schedule in which the learning rate rises.
        average: decay of the weight average a step.
        edge_share: weight of the edge loss.
        held_out_share: share of the worlds kept for evaluation.
        evaluation_panoramas: how many of those are evaluated during training.
        checkpoint_s: seconds between checkpoints with evaluation.
        max_range_m: truth beyond it is unknown, output beyond it is cut.
        mixed_precision: convolutions in bfloat16, where that is faster.
        threads: CPU threads. Two on two cores that others use as well are several times slower than one: each
            of the LSTM's many short steps waits for the slower thread.
        seed: of weights, order and augmentation.
    """

    minutes: float = 60.0
    epochs: int = 40
    batch_size: int = 8
    learning_rate: float = 2e-3
    weight_decay: float = 0.02
    warmup: float = 0.04
    average: float = 0.998
    edge_share: float = 0.5
    held_out_share: float = 0.08
    evaluation_panoramas: int = 48
    checkpoint_s: float = 300.0
    max_range_m: float = 16.0
    mixed_precision: bool = True
    threads: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        for key in ("minutes", "epochs", "batch_size", "learning_rate", "checkpoint_s", "max_range_m", "threads"):
            if getattr(self, key) <= 0:
                raise ValueError(f"{key} must be above 0 (got {getattr(self, key)})")
        if not 0 < self.warmup < 1 or not 0 <= self.average < 1:
            raise ValueError(f"warmup and average must lie in 0..1 (got {self.warmup}, {self.average})")


def schedule(progress: float, warmup: float) -> float:
    """Factor of the learning rate at ``progress`` 0..1: linear rise, then half a cosine down to 0."""
    if progress < warmup:
        return max(progress / warmup, 0.02)
    return 0.5 * (1 + math.cos(math.pi * min(1.0, (progress - warmup) / (1 - warmup))))


@torch.no_grad()
def update_average(average: nn.Module, model: nn.Module, decay: float) -> None:
    """``average = decay * average + (1 - decay) * model`` for every floating tensor of the state."""
    for kept, new in zip(average.state_dict().values(), model.state_dict().values(), strict=True):
        if kept.is_floating_point():
            kept.lerp_(new.to(kept.dtype), 1 - decay)
        else:
            kept.copy_(new)


@torch.inference_mode()
def evaluate(model: SliceNet, data: PanoramaDataset, indices: np.ndarray, max_range_m: float) -> DepthMetrics:
    """Mean metrics of the model over the panoramas ``indices``, without augmentation, in float32."""
    model.eval()
    each = []
    for index in indices:
        sample = data[int(index)]
        picture = torch.from_numpy(sample.rgb.transpose(2, 0, 1)[None].astype(np.float32) / 255.0)
        predicted = model(picture)[0].clamp(0.1, max_range_m).numpy()
        each.append(depth_metrics(predicted, sample.depth_m, sample.depth_m <= max_range_m))
    return mean_metrics(each)


@dataclass
class Trainer:
    """One run of the training; :meth:`run` goes on until the schedule ends or ``stop`` is set."""

    data: PanoramaDataset
    network: SliceNetConfig
    config: TrainingConfig
    output: Path
    report: Callable[[str], None] = print
    stop: bool = False
    step: int = 0
    elapsed_s: float = 0.0
    history: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.data.size != (self.network.height, self.network.width):
            raise DatasetError(f"{self.data.folder}: panoramas are {self.data.size}, the network takes "
                               f"{(self.network.height, self.network.width)}")  # fmt: skip
        torch.set_num_threads(self.config.threads)
        torch.manual_seed(self.config.seed)
        self.train_indices, self.held_out = self.data.split(self.config.held_out_share)
        self.model = SliceNet(self.network)
        self._start_at_typical_depth()
        self.average = copy.deepcopy(self.model).eval()
        decayed = [p for p in self.model.parameters() if p.ndim > 1]
        plain = [p for p in self.model.parameters() if p.ndim <= 1]
        self.optimizer = torch.optim.AdamW(
            [{"params": decayed, "weight_decay": self.config.weight_decay}, {"params": plain, "weight_decay": 0.0}],
            lr=self.config.learning_rate,
        )
        self.generator = torch.Generator().manual_seed(self.config.seed)
        self.train_indices, self.held_out = self.data.split(self.config.held_out_share)
        self.row_weights = torch.from_numpy(solid_angle_weights(self.network.height))

    @torch.no_grad()
    def _start_at_typical_depth(self) -> None:
        """Sets mean and spread of the last norm to those of the data, which Adam's small steps take long to reach."""
        some = self.train_indices[:: max(1, len(self.train_indices) // 32)]
        depth = np.asarray(self.data.depth[some], np.float32)
        known = depth[(depth > 0) & (depth <= self.config.max_range_m)]
        norm = self.model.decoder[-1].get_submodule("layers.1")
        assert isinstance(norm, nn.BatchNorm2d)
        norm.bias.fill_(float(np.median(known)))
        norm.weight.fill_(max(0.1, float(known.std())))

    @property
    def steps_an_epoch(self) -> int:
        """Whole batches in a pass over the training panoramas."""
        return max(1, len(self.train_indices) // self.config.batch_size)

    @property
    def progress(self) -> float:
        """0..1 through the schedule, by time or epochs."""
        by_time = self.elapsed_s / (60 * self.config.minutes)
        return min(1.0, max(by_time, self.step / (self.config.epochs * self.steps_an_epoch)))

    def batch(self) -> tuple[Tensor, Tensor]:
        """The next augmented batch: (B, 3, H, W) in 0..1 and (B, H, W) metres, 0 = unknown."""
        epoch, place = divmod(self.step, self.steps_an_epoch)
        order = np.random.default_rng((self.config.seed, epoch)).permutation(self.train_indices)
        size = self.config.batch_size
        picked = np.sort(order[place * size : (place + 1) * size])
        rgb = torch.from_numpy(np.asarray(self.data.rgb[picked])).permute(0, 3, 1, 2).float() / 255.0
        depth = torch.from_numpy(np.asarray(self.data.depth[picked], np.float32))
        depth = torch.where(depth <= self.config.max_range_m, depth, 0.0)
        rgb, depth = turn_and_mirror(rgb, depth, self.generator)
        return camera_colours(rgb, self.generator), depth

    def train_step(self) -> float:
        """One step of the optimiser; gives the loss.

        Raises:
            RuntimeError: the loss is not finite.
        """
        factor = schedule(self.progress, self.config.warmup)
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate * factor
        rgb, truth = self.batch()
        self.model.train()
        with torch.autocast("cpu", torch.bfloat16, enabled=self.config.mixed_precision):
            predicted = self.model(rgb)
        predicted = predicted.float()
        loss = depth_loss(predicted, truth, self.row_weights)
        loss = loss + self.config.edge_share * edge_loss(predicted, truth, self.row_weights)
        if not torch.isfinite(loss):
            raise RuntimeError(f"step {self.step}: loss is {loss.item()}; lower learning_rate")
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
        self.optimizer.step()
        self.step += 1
        # A young average would remember the random start for long.
        update_average(self.average, self.model, min(self.config.average, (1 + self.step) / (10 + self.step)))
        return float(loss.item())

    def run(self) -> DepthMetrics:
        """Trains to the end of the schedule; gives the metrics over all held-out panoramas."""
        begin = time.monotonic() - self.elapsed_s
        last_checkpoint, losses = time.monotonic(), []
        while self.progress < 1.0 and not self.stop:
            losses.append(self.train_step())
            self.elapsed_s = time.monotonic() - begin
            if self.step % 50 == 0:
                rate = self.config.batch_size * self.step / self.elapsed_s
                self.report(f"step {self.step} epoch {self.step / self.steps_an_epoch:.2f} "
                            f"loss {np.mean(losses[-50:]):.4f} {rate:.1f} panoramas/s "
                            f"{100 * self.progress:.0f} %")  # fmt: skip
            if time.monotonic() - last_checkpoint > self.config.checkpoint_s:
                picked = self.held_out[:: max(1, len(self.held_out) // self.config.evaluation_panoramas)]
                self._checkpoint(evaluate(self.average, self.data, picked, self.config.max_range_m), losses)
                self.elapsed_s = time.monotonic() - begin
                last_checkpoint = time.monotonic()
        final = evaluate(self.average, self.data, self.held_out, self.config.max_range_m)
        self._checkpoint(final, losses)
        return final

    def _checkpoint(self, metrics: DepthMetrics, losses: list[float]) -> None:
        entry: dict[str, Any] = {"step": self.step, "minutes": round(self.elapsed_s / 60, 1), **metrics.as_dict()}
        entry["loss"] = round(float(np.mean(losses[-100:])), 5) if losses else None
        self.history.append(entry)
        self.report(f"held-out worlds: {entry}")
        state = {
            "config": self.network.as_dict(),
            "state_dict": self.average.state_dict(),
            "record": self.record(),
            "resume": {
                "model": self.model.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "generator": self.generator.get_state(),
                "step": self.step,
                "elapsed_s": self.elapsed_s,
            },
        }
        self.output.parent.mkdir(parents=True, exist_ok=True)
        temporary = self.output.with_name(self.output.name + ".part")
        torch.save(state, temporary)
        temporary.replace(self.output)

    def record(self) -> dict[str, Any]:
        """What made these weights: data, network, training, results (plain values)."""
        return {
            "network": self.network.as_dict(),
            "parameters": sum(p.numel() for p in self.model.parameters()),
            "training": asdict(self.config),
            "data": dict(self.data.info),
            "panoramas": {"train": len(self.train_indices), "held_out": len(self.held_out)},
            "steps": self.step,
            "epochs": round(self.step / self.steps_an_epoch, 2),
            "wall_minutes": round(self.elapsed_s / 60, 1),
            "torch": str(torch.__version__),
            "history": self.history,
        }

    def resume(self, path: Path) -> None:
        """Takes up a run from its checkpoint.

        Raises:
            CheckpointError: the file is no checkpoint of a run with this network.
        """
        state = torch.load(path, map_location="cpu", weights_only=True)
        if "resume" not in state or SliceNetConfig(**state["config"]) != self.network:
            raise CheckpointError(f"{path}: not a checkpoint of a run with {self.network}")
        self.average.load_state_dict(state["state_dict"])
        self.model.load_state_dict(state["resume"]["model"])
        self.optimizer.load_state_dict(state["resume"]["optimizer"])
        self.generator.set_state(state["resume"]["generator"])
        self.step, self.elapsed_s = state["resume"]["step"], state["resume"]["elapsed_s"]
        self.history = state["record"]["history"]
