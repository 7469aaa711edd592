"""Training on a few striped images: it learns, repeats, resumes, and records what it did."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from instant_ic.training.checkpoints import CheckpointError
from instant_ic.training.completion import CompletionConfig, CompletionNet, load_completion
from instant_ic.training.dataset import Sample
from instant_ic.training.feeds import Feed
from instant_ic.training.trainer import (
    Trainer,
    TrainingConfig,
    evaluate,
    schedule,
    select_device,
    to_tensors,
    update_average,
)

TINY = CompletionConfig(64, (8, 8, 8), 2)


def stripes(count: int, height: int = 64) -> list[Sample]:
    """Pictures whose brightness tells their depth."""
    samples = []
    for index in range(count):
        depth = np.full((height, 2 * height), 1.0 + index % 4, np.float32)
        depth[:2] = 0.0
        rgb = np.repeat((depth * 50).astype(np.uint8)[..., None], 3, axis=-1)
        samples.append(Sample(rgb, depth, index, np.zeros((6, *depth.shape), np.float32)))
    return samples


def trainer(output: Path, epochs: int, samples: list[Sample] | None = None, **options) -> Trainer:
    samples = samples or stripes(12)
    config = TrainingConfig(
        minutes=60, epochs=epochs, batch_size=3, threads=1, mixed_precision=False, average=0.8, learning_rate=1e-2,
        photograph=False, brightness=0.0,
    )  # fmt: skip
    torch.manual_seed(0)
    return Trainer(
        Feed(samples[:9], 3), samples[9:], CompletionNet(TINY), config, output, {"folder": "stripes"},
        report=lambda line: None, **options,
    )  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A run of 12 epochs."""
    path, lines, shares = tmp_path_factory.mktemp("r") / "a.pt", [], []
    run = trainer(path, 12, command="ic depth train")
    run.report, run.bar = lines.append, shares.append
    first_loss = run.train_step()
    metrics = run.run()
    run.close()
    return SimpleNamespace(path=path, run=run, metrics=metrics, lines=lines, shares=shares, first_loss=first_loss)


def test_training_learns(trained: SimpleNamespace) -> None:
    assert trained.run.step == 36
    assert trained.metrics.mre < 0.8 * trained.run.history[0]["mre"]
    assert trained.run.history[-1]["loss"] < 0.8 * trained.first_loss
    assert trained.shares == sorted(trained.shares) and trained.shares[-1] == 1.0


def test_record_tells_what_made_the_weights(trained: SimpleNamespace) -> None:
    record = torch.load(trained.path, weights_only=True)["record"]
    assert record["data"] == {"folder": "stripes", "panoramas": 9} and record["held_out"] == 3
    assert (record["steps"], record["epochs"], record["command"]) == (36, 12.0, "ic depth train")
    assert record["device"].startswith("CPU") and record["start"] == {}
    assert record["history"][-1]["mre"] == round(trained.metrics.mre, 5)
    json.dumps(record)


def test_same_seed_gives_the_same_weights_also_when_taken_up_again(tmp_path: Path) -> None:
    whole, part = trainer(tmp_path / "whole.pt", 3), trainer(tmp_path / "part.pt", 3)
    whole.run()
    for _ in range(4):
        part.train_step()
    part.stop = True
    part.run()
    again = trainer(tmp_path / "part.pt", 3)
    again.resume(tmp_path / "part.pt")
    assert again.step == 4
    again.run()
    for one in (whole, part, again):
        one.close()
    for mine, other in ((whole.model, again.model), (whole.average, again.average)):
        assert all(
            torch.equal(a, b) for a, b in zip(mine.state_dict().values(), other.state_dict().values(), strict=True)
        )
    loaded = load_completion(tmp_path / "part.pt")
    assert all(torch.equal(a, b) for a, b in zip(loaded.parameters(), again.average.parameters(), strict=True))


def test_only_a_run_of_this_network_is_taken_up(tmp_path: Path) -> None:
    run = trainer(tmp_path / "x.pt", 1)
    torch.save({"config": CompletionConfig().as_dict(), "state_dict": {}, "resume": {}}, tmp_path / "other.pt")
    (tmp_path / "broken.pt").write_bytes(b"no checkpoint")
    for name, words in (("other", "not a checkpoint of a run"), ("broken", "damaged"),
                        ("absent", "No such file")):  # fmt: skip
        with pytest.raises(CheckpointError, match=words):
            run.resume(tmp_path / f"{name}.pt")
    run.close()


def test_images_of_another_size_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="32 x 64, the network takes 64 x 128"):
        trainer(tmp_path / "x.pt", 1, stripes(12, height=32))


def test_truth_that_is_unknown_or_too_far_is_zero() -> None:
    depth = np.array([[[1.0, 17.0, np.nan, np.inf]]], np.float16)  # as stored
    batch = np.full((1, 1, 4, 3), 51, np.uint8), depth, np.zeros((1, 6, 1, 4), np.float16)
    rgb, truth, prior = to_tensors(batch, 16.0, torch.device("cpu"))
    assert truth.dtype == prior.dtype == torch.float32
    assert truth.tolist() == [[[1.0, 0.0, 0.0, 0.0]]]
    assert rgb.shape == (1, 3, 1, 4) and torch.allclose(rgb, torch.tensor(0.2))


def test_evaluation_weighs_by_solid_angle(monkeypatch: pytest.MonkeyPatch) -> None:
    model = CompletionNet(TINY)
    same = torch.full((1, 64, 128), 2.0)
    monkeypatch.setattr(CompletionNet, "forward", lambda self, image, prior: (same, same))
    depth = np.full((64, 128), 2.0, np.float32)
    depth[:16] = 1.0  # the upper 45° to 90°: (1 - sin 45°) / 2 of the sphere, a quarter of the rows; relative error 1
    prior = np.zeros((6, 64, 128), np.float32)
    got = evaluate(model, [Sample(np.zeros((64, 128, 3), np.uint8), depth, 0, prior)], 16.0)
    assert got.mre == pytest.approx((1 - np.sqrt(0.5)) / 2, abs=1e-5)


def test_a_fixed_encoder_stays_and_a_slower_one_moves(tmp_path: Path) -> None:
    for rate in (0.0, 0.5):
        run = trainer(tmp_path / "x.pt", 1)
        run.config = replace(run.config, encoder_rate=rate)
        run = Trainer(run.feed, run.held_out, run.model, run.config, run.output)
        torch.nn.init.normal_(run.model.head.weight, std=0.1)
        before = run.model.encoder.stem.conv.weight.clone()
        run.train_step()
        assert torch.equal(before, run.model.encoder.stem.conv.weight) == (rate == 0)
        run.close()


def test_schedule_by_hand() -> None:
    assert schedule(0.05, 0.1) == pytest.approx(0.5)
    assert schedule(0.1, 0.1) == pytest.approx(1.0)
    assert schedule(0.55, 0.1) == pytest.approx(0.5)
    assert schedule(1.0, 0.1) == pytest.approx(0.0)
    assert schedule(0.0, 0.1) == 0.02


def test_average_by_hand() -> None:
    kept, new = torch.nn.BatchNorm1d(1), torch.nn.BatchNorm1d(1)
    torch.nn.init.constant_(kept.weight, 1.0), torch.nn.init.constant_(new.weight, 2.0)
    new.num_batches_tracked.fill_(7)
    update_average(kept, new, 0.75)
    assert kept.weight.item() == 1.25 and kept.num_batches_tracked.item() == 7


def test_devices_that_are_not_there() -> None:
    assert select_device("cpu").type == "cpu"
    with pytest.raises(ValueError, match="device 'gpu'"):
        select_device("gpu")
    if not torch.cuda.is_available():
        assert select_device("auto").type == "cpu"
        with pytest.raises(ValueError, match="finds no CUDA GPU"):
            select_device("cuda")
