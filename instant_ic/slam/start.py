"""Creation of the SLAM with or without a saved map, and compilation of its kernels."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from instant_ic.slam.config import SlamConfig
from instant_ic.slam.grid_slam import GridSlam
from instant_ic.slam.localization import SavedMap
from instant_ic.slam.map_files import load_graph, load_grid
from instant_ic.slam.pose_graph import Edge, optimise
from instant_ic.slam.scan import Scan
from instant_ic.util.jit import leave_out_blas


def make_slam(config: SlamConfig | None = None, map_file: Path | None = None, localize: bool = False) -> GridSlam:
    """Create the SLAM, with a saved map if one is named.

    Args:
        config: parameters; None uses the defaults.
        map_file: saved map, ``NAME`` or ``NAME.yaml``; None starts a new map.
        localize: keep the saved map unchanged. Otherwise it is extended, which needs ``NAME.graph.npz``.

    Raises:
        MapError: the map cannot be read.
        ValueError: the map has no occupied or no free cell, or localisation was requested without a map.
    """
    config = config or SlamConfig()
    if map_file is None:
        if localize:
            raise ValueError("localization needs a saved map: set map_file")
        return GridSlam(config)
    stem = map_file.with_suffix("") if map_file.suffix in (".yaml", ".yml") else map_file
    return GridSlam(config, SavedMap(config, load_grid(map_file), None if localize else load_graph(stem)))


def warm_up(config: SlamConfig | None = None) -> None:
    """Compile the kernels or load them from their cache, and import the solver.

    Otherwise, the kernels would delay the first scan, and the solver (60 MB) the scans at the first loop closure.
    """
    leave_out_blas()
    slam = GridSlam(config)
    angles = np.linspace(-math.pi, math.pi, 181)[:-1]
    ranges = np.minimum(2.0 / np.maximum(np.abs(np.cos(angles)), 1e-6), 3.0 / np.maximum(np.abs(np.sin(angles)), 1e-6))
    for index in range(2):
        slam.process(Scan(ranges, -math.pi, 2 * math.pi / 180, 0.1, 30.0, index + 1))
    slam.grid()
    optimise(np.zeros((2, 3)), [Edge(0, 1, np.ones(3), np.eye(3))], {0: 0, 1: 1})
