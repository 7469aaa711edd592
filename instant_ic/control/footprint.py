"""The robot's outline: a rectangle round the origin of ``base_link``."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.robot import Rectangle


@dataclass(frozen=True)
class Footprint(Rectangle):
    """The robot's outline, with its radii, corners and points for collision checks."""

    @property
    def inscribed_radius_m(self) -> float:
        """Distance of an obstacle from the centre below which the robot collides at every heading."""
        return 0.5 * min(self.length_m, self.width_m)

    @property
    def circumscribed_radius_m(self) -> float:
        """Distance of the nearest obstacle from the centre above which the robot is free at every heading."""
        return 0.5 * math.hypot(self.length_m, self.width_m)

    def corners(self, padding_m: float = 0.0) -> NDArray[np.float64]:
        """Return the corners (4, 2) in ``base_link``, counter-clockwise from front left."""
        a, b = 0.5 * self.length_m + padding_m, 0.5 * self.width_m + padding_m
        return np.array([[a, b], [-a, b], [-a, -b], [a, -b]])

    def points(self, spacing_m: float, padding_m: float = 0.0) -> NDArray[np.float64]:
        """Return a grid of points (N, 2) over the rectangle, edges included, at most ``spacing_m`` apart."""
        a, b = 0.5 * self.length_m + padding_m, 0.5 * self.width_m + padding_m
        xs = np.linspace(-a, a, max(2, math.ceil(2 * a / spacing_m) + 1))
        ys = np.linspace(-b, b, max(2, math.ceil(2 * b / spacing_m) + 1))
        return np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
