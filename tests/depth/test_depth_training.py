"""Data folder, augmentation and a very short training."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from instant_ic.depth.augment import camera_colours, turn_and_mirror
from instant_ic.depth.dataset import DatasetError, PanoramaDataset, Sample, write_dataset
from instant_ic.depth.slicenet import CheckpointError, SliceNetConfig, load_checkpoint
from instant_ic.depth.training import Trainer, TrainingConfig, schedule

TINY = SliceNetConfig(backbone="resnet18", height=64, width_multiplier=0.125, lstm_hidden=8, decoder_floor=8)


def stripes(count: int, worlds: int, height: int = 64) -> list[Sample]:
    """Pictures whose brightness tells their depth."""
    samples = []
    for index in range(count):
        depth = np.full((height, 2 * height), 1.0 + index % 4, np.float32)
        depth[:2] = 0.0
        rgb = np.repeat((depth * 50).astype(np.uint8)[..., None], 3, axis=-1)
        samples.append(Sample(rgb, depth, 100 + index * worlds // count))
    return samples


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    assert list(write_dataset(tmp_path / "data", stripes(12, 4), 12, (64, 128), {"kind": "stripes"}))[-1] == 12
    return tmp_path / "data"


def test_folder_gives_back_what_was_written(folder: Path) -> None:
    data = PanoramaDataset(folder)
    assert (len(data), data.size, data.info["kind"]) == (12, (64, 128), "stripes")
    for index, sample in enumerate(stripes(12, 4)):
        np.testing.assert_array_equal(data[index].rgb, sample.rgb)
        np.testing.assert_array_equal(data[index].depth_m, sample.depth_m)
        assert data[index].world == sample.world


def test_whole_worlds_are_held_out(folder: Path) -> None:
    data = PanoramaDataset(folder)
    train, held_out = data.split(0.25)
    assert set(data.world[held_out]) == {103}
    assert set(data.world[train]) == {100, 101, 102}
    with pytest.raises(ValueError, match="nothing to train on"):
        data.split(0.99)


def test_unfinished_folder_opens_and_foreign_ones_do_not(tmp_path: Path) -> None:
    writer = write_dataset(tmp_path / "cut", stripes(4, 2), 4, (64, 128), {})
    next(writer), next(writer)
    assert len(PanoramaDataset(tmp_path / "cut")) == 2
    with pytest.raises(DatasetError, match="not a panorama data folder"):
        PanoramaDataset(tmp_path)
    with pytest.raises(DatasetError, match="wanted"):
        list(write_dataset(tmp_path / "bad", stripes(1, 1, height=32), 1, (64, 128), {}))


def test_turn_and_mirror_keep_picture_and_depth_together() -> None:
    depth = torch.arange(32.0).repeat(6, 4, 1)
    rgb = depth[:, None].repeat(1, 3, 1, 1)
    turned, distance = turn_and_mirror(rgb, depth, torch.Generator().manual_seed(0))
    assert torch.equal(turned[:, 0], distance)
    steps = torch.remainder(distance.diff(dim=-1), 32)
    assert set(steps.unique().tolist()) == {1.0, 31.0}  # some turned, some mirrored too
    assert all(sorted(row.tolist()) == list(range(32)) for row in distance[:, 0])


def test_camera_colours_stay_in_range_and_change() -> None:
    rgb = torch.full((4, 3, 8, 8), 0.5)
    changed = camera_colours(rgb, torch.Generator().manual_seed(0))
    assert changed.min() >= 0 and changed.max() <= 1
    means = changed.mean(dim=(1, 2, 3))
    assert means.std() > 0.02


def test_schedule_by_hand() -> None:
    assert schedule(0.05, 0.1) == pytest.approx(0.5)
    assert schedule(0.1, 0.1) == pytest.approx(1.0)
    assert schedule(0.55, 0.1) == pytest.approx(0.5)
    assert schedule(1.0, 0.1) == pytest.approx(0.0)
    assert schedule(0.0, 0.1) == 0.02


def quick(epochs: int) -> TrainingConfig:
    return TrainingConfig(
        minutes=60, epochs=epochs, batch_size=3, held_out_share=0.25, threads=1, mixed_precision=False, average=0.8,
        learning_rate=1e-2,
    )  # fmt: skip


def test_training_learns_records_and_repeats(folder: Path, tmp_path: Path) -> None:
    data = PanoramaDataset(folder)
    lines: list[str] = []
    first = Trainer(data, TINY, quick(20), tmp_path / "a.pt", report=lines.append)
    begin = first.train_step()
    metrics = first.run()
    assert first.step == 60
    assert metrics.mre < 0.5 < begin
    assert any("held-out worlds" in line for line in lines)
    record = torch.load(tmp_path / "a.pt", weights_only=True)["record"]
    assert record["panoramas"] == {"train": 9, "held_out": 3}
    assert record["history"][-1]["mre"] == round(metrics.mre, 5)
    json.dumps(record)

    second = Trainer(data, TINY, quick(20), tmp_path / "b.pt", report=lines.append)
    assert second.run() == metrics  # one thread, same seed: the same weights
    same = zip(load_checkpoint(tmp_path / "a.pt").parameters(), second.average.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in same)


def test_training_is_taken_up_again(folder: Path, tmp_path: Path) -> None:
    data = PanoramaDataset(folder)
    whole = Trainer(data, TINY, quick(4), tmp_path / "whole.pt", report=lambda _: None)
    whole.run()
    part = Trainer(data, TINY, quick(4), tmp_path / "part.pt", report=lambda _: None)
    for _ in range(5):
        part.train_step()
    part.stop = True
    part.run()
    again = Trainer(data, TINY, quick(4), tmp_path / "part.pt", report=lambda _: None)
    again.resume(tmp_path / "part.pt")
    assert again.step == 5
    again.run()
    assert all(torch.equal(a, b) for a, b in zip(whole.model.parameters(), again.model.parameters(), strict=True))
    with pytest.raises(CheckpointError, match="not a checkpoint of a run"):
        Trainer(data, TINY, quick(4), tmp_path / "x.pt").resume(_other_checkpoint(tmp_path))


def _other_checkpoint(folder: Path) -> Path:
    path = folder / "other.pt"
    torch.save({"config": SliceNetConfig().as_dict(), "state_dict": {}, "resume": {}}, path)
    return path


def test_data_of_another_size_is_refused(folder: Path, tmp_path: Path) -> None:
    other = SliceNetConfig(backbone="resnet18", height=128, width_multiplier=0.125, lstm_hidden=8)
    with pytest.raises(DatasetError, match="the network takes"):
        Trainer(PanoramaDataset(folder), other, quick(1), tmp_path / "x.pt")


def test_rooms_are_reproducible() -> None:
    from instant_ic.depth.rooms import RoomsConfig, render_rooms

    recipe = RoomsConfig(worlds=2, poses=2, height=64)
    first, again = list(render_rooms(recipe)), list(render_rooms(recipe, worlds=[1001]))
    assert [s.world for s in first] == [1000, 1000, 1001, 1001]
    np.testing.assert_array_equal(first[2].rgb, again[0].rgb)
    np.testing.assert_array_equal(first[3].depth_m, again[1].depth_m)
    assert all((s.depth_m > 0).mean() > 0.99 for s in first)
