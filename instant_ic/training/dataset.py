"""Panoramas with depth on disk: written once by a renderer, read by the training through memory maps."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

INFO = "dataset.json"


class DatasetError(ValueError):
    """A data folder is missing, incomplete, or its panoramas have another shape than requested."""


@dataclass(frozen=True)
class Sample:
    """One panorama.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) radial metres, 0 = unknown.
        world: its seed.
        prior: (5, H, W) incomplete depth (``depth.completion.prior_channels``); None: the feed simulates it.
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.floating]
    world: int
    prior: NDArray[np.floating] | None = None


class Subset:
    """A selection of panoramas from a collection."""

    def __init__(self, samples: Any, indices: Sequence[int] | NDArray[np.intp]) -> None:
        self.samples, self.indices = samples, indices

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> Sample:
        sample: Sample = self.samples[int(self.indices[index])]
        return sample

    @classmethod
    def joined(cls, parts: Sequence[Subset]) -> Subset:
        """Concatenate several subsets."""
        places = [(part, index) for part in parts for index in range(len(part))]
        return cls(_Joined(places), range(len(places)))


@dataclass(frozen=True)
class _Joined:
    places: list[tuple[Subset, int]]

    def __getitem__(self, index: int) -> Sample:
        part, within = self.places[index]
        return part[within]


class PanoramaDataset:
    """A folder with ``rgb.npy``, ``depth.npy`` and ``prior.npy`` (float16), ``world.npy`` and ``dataset.json``."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        try:
            self.info: dict[str, Any] = json.loads((self.folder / INFO).read_text(encoding="utf-8"))
            self.rgb = np.load(self.folder / "rgb.npy", mmap_mode="r")
            self.depth = np.load(self.folder / "depth.npy", mmap_mode="r")
            self.prior = np.load(self.folder / "prior.npy", mmap_mode="r")
            self.world = np.load(self.folder / "world.npy")
        except (OSError, ValueError) as error:
            raise DatasetError(f"{self.folder}: not a panorama data folder ({error})") from error
        count = int(self.info["count"])
        self.rgb, self.depth, self.world = self.rgb[:count], self.depth[:count], self.world[:count]

    def __len__(self) -> int:
        return len(self.world)

    def __getitem__(self, index: int) -> Sample:
        depth, prior = np.asarray(self.depth[index], np.float32), np.asarray(self.prior[index])
        return Sample(np.asarray(self.rgb[index]), depth, int(self.world[index]), prior)

    def split(self, held_out_share: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices for training and for evaluation. Whole worlds are held out, the last ones.

        Raises:
            ValueError: the share leaves no world for training or none for evaluation.
        """
        worlds = np.unique(self.world)
        count = max(1, round(len(worlds) * held_out_share))
        if not 0 < held_out_share < 1 or count >= len(worlds):
            raise ValueError(f"held_out_share {held_out_share} of {len(worlds)} worlds leaves nothing to train on")
        held_out = np.isin(self.world, worlds[-count:])
        return np.flatnonzero(~held_out), np.flatnonzero(held_out)


def write_dataset(
    folder: str | Path, samples: Iterable[Sample], count: int, size: tuple[int, int], info: dict[str, Any]
) -> Iterator[int]:
    """Write up to ``count`` samples of ``size`` (height, width); yield the number written after each.

    The folder can be opened at any time while it is written; if writing is interrupted, it holds fewer samples.

    Raises:
        DatasetError: a sample has another shape.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    height, width = size
    rgb = np.lib.format.open_memmap(folder / "rgb.npy", "w+", np.uint8, (count, height, width, 3))
    depth = np.lib.format.open_memmap(folder / "depth.npy", "w+", np.float16, (count, height, width))
    prior = np.lib.format.open_memmap(folder / "prior.npy", "w+", np.float16, (count, 5, height, width))
    world = np.lib.format.open_memmap(folder / "world.npy", "w+", np.int64, (count,))
    for index, sample in enumerate(samples):
        if index == count:
            break
        if sample.rgb.shape != (height, width, 3) or sample.depth_m.shape != (height, width):
            raise DatasetError(f"sample {index}: rgb {sample.rgb.shape}, depth {sample.depth_m.shape}, expected {size}")
        rgb[index], depth[index], world[index] = sample.rgb, sample.depth_m, sample.world
        prior[index] = 0 if sample.prior is None else sample.prior
        temporary = folder / (INFO + ".part")
        temporary.write_text(json.dumps({**info, "count": index + 1}, indent=2) + "\n", encoding="utf-8")
        temporary.replace(folder / INFO)
        yield index + 1
