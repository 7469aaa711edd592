"""Training panoramas: random worlds of the simulator, seen from where a robot's camera could be."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from instant_ic.geometry.poses import pose_matrix

from .dataset import Sample


@dataclass(frozen=True)
class RoomsConfig:
    """Recipe of a data folder.

    Attributes:
        worlds: number of random worlds.
        poses: panoramas in each.
        first_world: seed of the first world; the others follow. Held-out worlds are the last ones.
        height: rows of a panorama.
        camera_height_m: lowest and highest camera above the floor.
        tilt_deg: standard deviation of roll and pitch.
        clearance_m: distance from things, lowest and highest.
    """

    worlds: int = 400
    poses: int = 6
    first_world: int = 1000
    height: int = 256
    camera_height_m: tuple[float, float] = (0.8, 1.4)
    tilt_deg: float = 1.0
    clearance_m: tuple[float, float] = (0.3, 0.6)

    def __post_init__(self) -> None:
        if self.worlds < 2 or self.poses < 1:
            raise ValueError(f"at least 2 worlds and 1 pose are needed (got {self.worlds}, {self.poses})")

    @property
    def count(self) -> int:
        """Panoramas in all."""
        return self.worlds * self.poses

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for the folder's ``dataset.json``."""
        return {"kind": "instant_ic.sim.worlds.random_world", **asdict(self)}


def render_rooms(config: RoomsConfig, worlds: Iterable[int] | None = None) -> Iterator[Sample]:
    """Renders the recipe (or only some world seeds of it); the same recipe gives the same panoramas.

    Worlds without a free place are left out, so that fewer samples than ``config.count`` may come.
    """
    from instant_ic.sim.render import EquirectRenderer
    from instant_ic.sim.worlds import random_world

    seeds = range(config.first_world, config.first_world + config.worlds) if worlds is None else worlds
    for seed in seeds:
        rng = np.random.default_rng((7, seed))
        world = random_world(seed)
        renderer = EquirectRenderer(world)
        try:
            poses = world.sample_free_poses(rng, config.poses, clearance_m=rng.uniform(*config.clearance_m))
        except ValueError:
            continue
        for x, y, yaw in poses:
            roll, pitch = np.radians(config.tilt_deg) * rng.standard_normal(2)
            height = rng.uniform(*config.camera_height_m)
            pose = pose_matrix(x, y, height, roll, pitch, math.remainder(yaw, math.tau))
            frame = renderer.render(pose, 2 * config.height, config.height)
            yield Sample(frame.rgb, frame.depth_m, seed)
