"""A world of wall segments and exact rays through it: the oracle of the SLAM tests, apart from the code under test."""

from __future__ import annotations

import math

import numpy as np

from instant_ic.slam import Scan


class PlanarWorld:
    """Walls as segments (n, 4): x0 y0 x1 y1."""

    def __init__(self, walls: list[tuple[float, float, float, float]]) -> None:
        self.walls = np.array(walls, dtype=np.float64)

    def ranges(self, pose: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Exact distance along each angle of the laser at ``pose`` (3,), +inf where no wall is."""
        direction = np.stack([np.cos(pose[2] + angles), np.sin(pose[2] + angles)], axis=1)[:, None, :]
        start = self.walls[None, :, :2] - pose[:2]
        edge = self.walls[None, :, 2:] - self.walls[None, :, :2]
        cross = direction[..., 0] * edge[..., 1] - direction[..., 1] * edge[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            along_ray = (start[..., 0] * edge[..., 1] - start[..., 1] * edge[..., 0]) / cross
            along_wall = (start[..., 0] * direction[..., 1] - start[..., 1] * direction[..., 0]) / cross
        met = (np.abs(cross) > 1e-12) & (along_ray > 0) & (along_wall >= 0) & (along_wall <= 1)
        return np.where(met, along_ray, np.inf).min(axis=1)

    def scan(
        self,
        pose: np.ndarray,
        stamp_ns: int,
        beams: int = 720,
        noise_m: float = 0.0,
        seed: int = 0,
        range_max: float = 30.0,
    ) -> Scan:
        """A scan over 360°, with Gaussian range noise."""
        increment = 2 * math.pi / beams
        angles = -math.pi + increment * np.arange(beams)
        ranges = self.ranges(np.asarray(pose, dtype=np.float64), angles)
        ranges = ranges + noise_m * np.random.default_rng([seed, stamp_ns % 2**31]).standard_normal(beams)
        ranges[ranges > range_max] = np.inf
        return Scan(ranges, -math.pi, increment, 0.3, range_max, stamp_ns)


def rectangle(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    """Four walls."""
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


def box_room() -> PlanarWorld:
    """6 m × 4 m with a pillar, so that no turn and no shift looks like another; the origin is inside."""
    return PlanarWorld(rectangle(-2.0, -1.5, 4.0, 2.5) + rectangle(1.5, 1.0, 2.0, 1.4))


def corridor(length: float = 40.0, width: float = 2.0) -> PlanarWorld:
    """Two bare walls whose ends no ray of the laser reaches."""
    return PlanarWorld([(-length, -width / 2, length, -width / 2), (-length, width / 2, length, width / 2)])


def l_corridor() -> PlanarWorld:
    """An L of two 2 m wide corridors, 20 m and 15 m long, with three doorways into shallow rooms."""
    return PlanarWorld(
        [
            (-2.0, -1.0, 20.0, -1.0),
            (20.0, -1.0, 20.0, 15.0),
            (20.0, 15.0, 18.0, 15.0),
            (18.0, 15.0, 18.0, 9.0),
            (18.0, 8.0, 18.0, 1.0),
            (18.0, 1.0, 13.0, 1.0),
            (12.0, 1.0, 6.0, 1.0),
            (5.0, 1.0, -2.0, 1.0),
            (-2.0, 1.0, -2.0, -1.0),
            *rectangle(12.0, 1.0, 13.0, 2.5)[1:],
            *rectangle(5.0, 1.0, 6.0, 3.0)[1:],
            (18.0, 9.0, 16.0, 9.0),
            (16.0, 9.0, 16.0, 8.0),
            (16.0, 8.0, 18.0, 8.0),
        ]
    )
