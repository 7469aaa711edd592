"""Rendered panoramas with depth, the samples of a training."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from instant_ic.util.files import replacing

Floats = NDArray[np.floating]
_HELD_OUT_WORLDS = 12


class DatasetError(ValueError):
    """A data folder is missing, incomplete, or its panoramas have another shape than requested."""


@dataclass(frozen=True)
class Sample:
    """One panorama.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) radial metres, 0 = unknown.
        world: seed of the world that the panorama shows.
        prior: (6, H, W) fused depth (``depth.completion.prior_channels``).
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.floating]
    world: int
    prior: NDArray[np.floating]


def save_sample(path: Path, rgb: NDArray[np.uint8], depth_m: Floats, priors: Sequence[Floats]) -> None:
    """Write a panorama with its priors (``Sample``) to ``NAME.npz``; the file appears only when it is complete."""
    with replacing(path) as file:
        np.savez_compressed(file, rgb=rgb, depth_m=depth_m.astype(np.float16), priors=np.array(priors, np.float16))


class RenderedDataset(Sequence[Sample]):
    """Panoramas of ``ic depth render``; each of their priors is a sample."""

    def __init__(self, files: Sequence[tuple[Path, int]]) -> None:
        self.files = list(files)

    @property
    def worlds(self) -> int:
        """Number of worlds that the panoramas show."""
        return len({_world(path) for path, _ in self.files})

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> Sample:  # type: ignore[override]
        path, number = self.files[index]
        try:
            with np.load(path) as file:
                return Sample(file["rgb"], file["depth_m"], _world(path), file["priors"][number])
        except Exception as error:  # a damaged archive raises anything
            raise DatasetError(f"{path}: damaged ({error}): delete it and run ic depth render again") from error


def open_rendered(folder: Path, size: tuple[int, int]) -> tuple[RenderedDataset, RenderedDataset]:
    """Return the panoramas of a folder for training and for evaluation.

    One world in twelve is held out for evaluation. A world stays in its part when more worlds are rendered.

    Args:
        folder: folder that ``ic depth render`` wrote.
        size: height and width that the panoramas must have.

    Raises:
        DatasetError: there is no panorama of this size in the folder, or none for training or for evaluation.
    """
    files: list[tuple[Path, int]] = []
    for path in sorted(folder.glob("*-*.npz")):
        shape = _shape(path)
        if shape[0] and shape[2:] != size:  # a few panoramas have no prior, because none could be fitted
            raise DatasetError(f"{path}: {shape[2]} x {shape[3]}, the network takes {size[0]} x {size[1]}: render "
                               "the worlds again into another folder with its --height")  # fmt: skip
        files += [(path, number) for number in range(shape[0])]
    if not files:
        raise DatasetError(f"{folder}: no rendered panoramas: run ic depth render -o {folder}")
    training = RenderedDataset([file for file in files if _world(file[0]) % _HELD_OUT_WORLDS])
    held_out = RenderedDataset([file for file in files if _world(file[0]) % _HELD_OUT_WORLDS == 0])
    if not training or not held_out:
        raise DatasetError(f"{folder}: worlds for training or for evaluation are missing: render "
                           f"{_HELD_OUT_WORLDS} or more")  # fmt: skip
    return training, held_out


def _world(path: Path) -> int:
    return int(path.stem.split("-")[0])


def _shape(path: Path) -> tuple[int, ...]:
    """Return the shape of a panorama's priors, from the header alone."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open("priors.npy") as file:
            version = np.lib.format.read_magic(file)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            return read(file)[0]
    except Exception as error:  # a damaged archive raises anything
        raise DatasetError(f"{path}: damaged ({error}): delete it and run ic depth render again") from error
