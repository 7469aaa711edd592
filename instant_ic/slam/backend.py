"""The SLAM methods behind one interface, chosen by ``SlamConfig.backend``."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from instant_ic.slam.config import SlamConfig
from instant_ic.slam.grid_slam import GridSlam, SlamResult
from instant_ic.slam.occupancy import OccupancyGrid
from instant_ic.slam.scan import Scan


class Slam(Protocol):
    """What the node and the evaluation need of a SLAM method."""

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

    def figures(self) -> dict[str, object]:
        """What is worth telling of its state, for reports and diagnostics."""
        ...


def make_slam(config: SlamConfig | None = None) -> Slam:
    """The method that the configuration names."""
    config = config or SlamConfig()
    return GridSlam(config)


def warm_up(config: SlamConfig | None = None) -> None:
    """Compile the kernels, or load them from their cache, so that the first scan is not held up by it."""
    slam = make_slam(config)
    angles = np.linspace(-math.pi, math.pi, 181)[:-1]
    ranges = np.minimum(2.0 / np.maximum(np.abs(np.cos(angles)), 1e-6), 3.0 / np.maximum(np.abs(np.sin(angles)), 1e-6))
    for index in range(2):
        slam.process(Scan(ranges, -math.pi, 2 * math.pi / 180, 0.1, 30.0, index + 1))
    slam.grid()
