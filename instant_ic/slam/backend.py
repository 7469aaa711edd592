"""Common interface of the SLAM methods; ``SlamConfig.backend`` selects one."""

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
    """Interface of a SLAM method, as the node and the evaluation use it.

    Attributes:
        map_from_odom: (3,), takes up all corrections.
        odom_from_base: (3,), at the last scan.
        motion: compares wheel odometry with scan matching.
    """

    map_from_odom: FloatArray
    odom_from_base: FloatArray
    motion: MotionMonitor

    @property
    def map_version(self) -> int:
        """Counter that grows when the map changes; 0 before there is a map."""
        ...

    @property
    def map_clipped(self) -> int:
        """Number of points outside the largest allowed map."""
        ...

    def process(
        self, scan: Scan, odom_pose: ArrayLike | None = None, base_from_laser: ArrayLike = (0.0, 0.0, 0.0)
    ) -> SlamResult:
        """Estimate the pose of a scan."""
        ...

    def background_job(self) -> Callable[[], Any] | None:
        """Return pending work that may run on another thread, or None. Pass its result to `take_over`."""
        ...

    def take_over(self, outcome: Any) -> None:
        """Apply the result of a background job, on the thread of `process`."""
        ...

    def finish(self) -> None:
        """Complete all pending work after the last scan."""
        ...

    def grid(self) -> OccupancyGrid:
        """Return the map."""
        ...

    def save(self, stem: Path) -> list[Path]:
        """Write the map and return the files."""
        ...

    def set_pose(self, map_from_base: ArrayLike) -> None:
        """Set the robot's pose in the saved map; ValueError if the pose cannot be used."""
        ...

    def figures(self) -> dict[str, object]:
        """Return state figures for reports and diagnostics."""
        ...


def make_slam(config: SlamConfig | None = None, map_file: Path | None = None, localize: bool = False) -> Slam:
    """Create the SLAM method that the configuration names.

    Args:
        config: defaults when None.
        map_file: a saved map, ``NAME`` or ``NAME.yaml``; None starts a new map.
        localize: True keeps the map unchanged; False extends it, which needs its ``NAME.graph.npz``.

    Raises:
        MapError: the map cannot be read.
        ValueError: the method does not support saved maps, or localisation was requested without one.
    """
    config = config or SlamConfig()
    if localize and map_file is None:
        raise ValueError("localization needs a saved map: set map_file")
    if config.backend == "rbpf":
        if map_file is not None:
            raise ValueError("backend rbpf does not support saved maps: use backend graph")
        from instant_ic.slam.rbpf import ParticleSlam

        return ParticleSlam(config)
    if map_file is None:
        return GridSlam(config)
    stem = map_file.with_suffix("") if map_file.suffix in (".yaml", ".yml") else map_file
    return GridSlam(config, load_grid(map_file), None if localize else load_graph(stem))


def warm_up(config: SlamConfig | None = None) -> None:
    """Compile the kernels, or load them from their cache, so that they do not delay the first scan."""
    slam = make_slam(config)
    angles = np.linspace(-math.pi, math.pi, 181)[:-1]
    ranges = np.minimum(2.0 / np.maximum(np.abs(np.cos(angles)), 1e-6), 3.0 / np.maximum(np.abs(np.sin(angles)), 1e-6))
    for index in range(2):
        slam.process(Scan(ranges, -math.pi, 2 * math.pi / 180, 0.1, 30.0, index + 1))
    slam.grid()
