"""The folder of rendered panoramas, and parts of collections."""

from pathlib import Path

import numpy as np
import pytest

from instant_ic.training.dataset import DatasetError, PanoramaDataset, Sample, Subset, write_dataset


def stripes(count: int, worlds: int, height: int = 8) -> list[Sample]:
    samples = []
    for index in range(count):
        depth = np.full((height, 2 * height), 1.0 + index % 4, np.float32)
        rgb = np.repeat((depth * 50).astype(np.uint8)[..., None], 3, axis=-1)
        prior = np.full((5, height, 2 * height), index, np.float16)
        samples.append(Sample(rgb, depth, 100 + index * worlds // count, prior))
    return samples


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    assert list(write_dataset(tmp_path / "data", stripes(12, 4), 12, (8, 16), {"kind": "stripes"}))[-1] == 12
    return tmp_path / "data"


def test_folder_gives_back_what_was_written(folder: Path) -> None:
    data = PanoramaDataset(folder)
    assert (data.rgb.shape, data.info["kind"]) == ((12, 8, 16, 3), "stripes")
    for index, sample in enumerate(stripes(12, 4)):
        np.testing.assert_array_equal(data[index].rgb, sample.rgb)
        np.testing.assert_array_equal(data[index].depth_m, sample.depth_m)
        np.testing.assert_array_equal(data[index].prior, sample.prior)
        assert data[index].world == sample.world


def test_whole_worlds_are_held_out(folder: Path) -> None:
    data = PanoramaDataset(folder)
    train, held_out = data.split(0.25)
    assert set(data.world[held_out]) == {103}
    assert set(data.world[train]) == {100, 101, 102}
    with pytest.raises(ValueError, match="nothing to train on"):
        data.split(0.99)


def test_unfinished_folder_opens_and_foreign_ones_do_not(tmp_path: Path) -> None:
    writer = write_dataset(tmp_path / "cut", stripes(4, 2), 4, (8, 16), {})
    next(writer), next(writer)
    assert len(PanoramaDataset(tmp_path / "cut")) == 2
    with pytest.raises(DatasetError, match="not a panorama data folder"):
        PanoramaDataset(tmp_path)
    with pytest.raises(DatasetError, match="expected"):
        list(write_dataset(tmp_path / "bad", stripes(1, 1, height=4), 1, (8, 16), {}))


def test_parts_of_collections_join() -> None:
    first, second = stripes(4, 4), stripes(3, 3)
    joined = Subset.joined([Subset(first, np.array([3, 1])), Subset(second, range(2))])
    assert [sample.world for sample in (joined[i] for i in range(len(joined)))] == [103, 101, 100, 101]
