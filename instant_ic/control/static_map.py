"""The map of the place, as navigation reads it; without numba, for nodes that need no costmap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

OCCUPIED = 65
"""Cells from this probability on are obstacles."""


@dataclass(frozen=True)
class StaticMap:
    """An occupancy grid: -1 unknown, 0..100 probability of being occupied."""

    occupancy: NDArray[np.int8]
    resolution: float
    origin: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.occupancy.ndim != 2 or self.occupancy.size == 0:
            raise ValueError(f"map must be a grid with cells (got shape {self.occupancy.shape})")
        if not self.resolution > 0:
            raise ValueError(f"map resolution must be > 0 (got {self.resolution})")
