"""Panoramas with depth, the samples of a training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


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


class Selection:
    """Panoramas selected from collections: pairs of a collection and the indices to take from it, in this order."""

    def __init__(self, *parts: tuple[Any, Sequence[int] | NDArray[np.intp]]) -> None:
        self._places = [(samples, int(index)) for samples, indices in parts for index in indices]

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> Sample:
        samples, place = self._places[index]
        sample: Sample = samples[place]
        return sample
