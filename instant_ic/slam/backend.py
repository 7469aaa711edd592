"""The SLAM methods behind one interface, chosen by ``SlamConfig.backend``."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from instant_ic.slam.config import SlamConfig
from instant_ic.slam.grid_slam import GridSlam, SlamResult
from instant_ic.slam.map_files import load_graph, load_grid
from instant_ic.slam.motion import MotionMonitor
from instant_ic.slam.occupancy import OccupancyGrid
from instant_ic.slam.scan import FloatArray, Scan


class Slam(Protocol):
    """What the node and the evaluation need of a SLAM method.

    Attributes:
        map_from_odom: (3,), takes up all corrections.
        odom_from_base: (3,), at the last scan.
        motion: compares wheels and scans.
    """

    map_from_odom: FloatArray
    odom_from_base: FloatArray
    motion: MotionMonitor

    @property
    def map_version(self) -> int:
        """Grows when the map changes; 0 before there is one."""
        ...

    @property
    def map_clipped(self) -> int:
        """Points that fell outside the largest map."""
        ...

    def process(
        self, scan: Scan, odom_pose: ArrayLike | None = None, base_from_laser: ArrayLike = (0.0, 0.0, 0.0)
    ) -> SlamResult:
        """Place a scan."""
        ...

    def background_job(self) -> Callable[[], Any] | None:
        """Work that is due and may run on another thread; None: there is none. Its result goes to `take_over`."""
        ...

    def take_over(self, outcome: Any) -> None:
        """Take over what a background job found, on the thread of `process`."""
        ...

    def finish(self) -> None:
        """After the last scan: do all that is still due."""
        ...

    def grid(self) -> OccupancyGrid:
        """The map."""
        ...

    def save(self, stem: Path) -> list[Path]:
        """Write the map; returns the files."""
        ...

    def set_pose(self, map_from_base: ArrayLike) -> None:
        """Say where in the saved map the robot is; ValueError where that makes no sense."""
        ...

    def figures(self) -> dict[str, object]:
        """What is worth telling of its state, for reports and diagnostics."""
        ...


def make_slam(config: SlamConfig | None = None, map_file: Path | None = None, localize: bool = False) -> Slam:
    """The method that the configuration names.

    Args:
        config: defaults when None.
        map_file: a saved map, ``NAME`` or ``NAME.yaml``; None: begin a new one.
        localize: the map stays as it is; else it is continued, for which its ``NAME.graph.npz`` must be there.

    Raises:
        MapError: the map cannot be read.
        ValueError: the method cannot use a saved map, or localisation has none.
    """
    config = config or SlamConfig()
    if localize and map_file is None:
        raise ValueError("localization needs a saved map: set map_file")
    if config.backend == "rbpf":
        if map_file is not None:
            raise ValueError("backend rbpf cannot use a saved map: choose backend graph")
        from instant_ic.slam.rbpf import ParticleSlam

        return ParticleSlam(config)
    if map_file is None:
        return GridSlam(config)
    stem = map_file.with_suffix("") if map_file.suffix in (".yaml", ".yml") else map_file
    return GridSlam(config, load_grid(map_file), None if localize else load_graph(stem))


def warm_up(config: SlamConfig | None = None) -> None:
    """Compile the kernels, or load them from their cache, so that the first scan is not held up by it."""
    slam = make_slam(config)
    angles = np.linspace(-math.pi, math.pi, 181)[:-1]
    ranges = np.minimum(2.0 / np.maximum(np.abs(np.cos(angles)), 1e-6), 3.0 / np.maximum(np.abs(np.sin(angles)), 1e-6))
    for index in range(2):
        slam.process(Scan(ranges, -math.pi, 2 * math.pi / 180, 0.1, 30.0, index + 1))
    slam.grid()
