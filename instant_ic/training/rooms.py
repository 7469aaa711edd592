"""Training panoramas: generated interiors, rendered from possible positions of a robot's camera."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from instant_ic.geometry.poses import pose_matrix
from instant_ic.training.dataset import save_sample

FIRST_HELD_OUT = 900_000
"""Worlds from this seed on are reserved for evaluations."""
CAMERA_HEIGHT_M, CLEARANCE_M = (0.5, 1.7), (0.3, 0.7)
"""Lowest and highest camera above the floor; distance from objects, minimum and maximum."""
TILT_DEG = 1.5
"""Standard deviation of roll and pitch."""


@dataclass(frozen=True)
class RoomsConfig:
    """Recipe of generated panoramas.

    Attributes:
        worlds: number of worlds.
        poses: number of panoramas in each world.
        priors: number of fused depth images of each panorama, each with its own faults and number of revolutions.
        first_world: seed of the first world; the others follow.
        height: rows of a panorama.
        textures: folder of photographs that replace most procedural textures; empty: none.
    """

    worlds: int = 400
    poses: int = 6
    priors: int = 2
    first_world: int = 1000
    height: int = 256
    textures: str = ""

    def __post_init__(self) -> None:
        if self.worlds < 2 or self.poses < 1:
            raise ValueError(f"at least 2 worlds and 1 pose are needed (got {self.worlds}, {self.poses})")
        if self.first_world < 0 or self.first_world + self.worlds > FIRST_HELD_OUT:
            raise ValueError(f"world seeds must be in 0..{FIRST_HELD_OUT - 1}: higher ones are for evaluation "
                             f"(got {self.first_world}..{self.first_world + self.worlds - 1})")  # fmt: skip


def render_rooms(config: RoomsConfig, folder: Path, worlds: Iterable[int]) -> Iterator[Path]:
    """Render worlds of the recipe into a folder, one file a panorama, and yield the files.

    The same recipe gives the same files. Worlds that the folder has are skipped, so that an interrupted run continues.
    """
    from instant_ic.sim.render import EquirectRenderer
    from instant_ic.training.interiors import interior_world
    from instant_ic.training.photographs import with_photographs
    from instant_ic.training.sparse import sample_prior

    for seed in worlds:
        if (folder / f"{seed}-{config.poses - 1}.npz").exists():
            continue
        rng, prior_rng = np.random.default_rng((7, seed)), np.random.default_rng((8, seed))
        world = interior_world(seed)
        if config.textures:
            world = with_photographs(world, config.textures, rng)
        renderer = EquirectRenderer(world)
        try:
            poses = world.sample_free_poses(rng, config.poses, clearance_m=rng.uniform(*CLEARANCE_M))
        except ValueError:  # no free place
            continue
        for number, (x, y, yaw) in enumerate(poses):
            roll, pitch = np.radians(TILT_DEG) * rng.standard_normal(2)
            height = rng.uniform(*CAMERA_HEIGHT_M)
            pose = pose_matrix(x, y, height, roll, pitch, math.remainder(yaw, math.tau))
            frame = renderer.render(pose, 2 * config.height, config.height)
            priors = [sample_prior(renderer, pose, frame.rgb, frame.depth_m, prior_rng) for _ in range(config.priors)]
            path = folder / f"{seed}-{number}.npz"
            save_sample(path, frame.rgb, frame.depth_m, [prior for prior in priors if prior is not None])
            yield path
