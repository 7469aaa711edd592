"""Held-out panoramas with ground-truth depth for the depth evaluations; training must not use them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.poses import pose_matrix

if TYPE_CHECKING:
    from instant_ic.sim.render import EquirectRenderer
    from instant_ic.sim.world import World

KINDS = ("random", "corridor", "long", "mesh")
FIRST_SEED = 900_000
"""Worlds from this seed on are for evaluation; training uses smaller seeds."""
CAMERA_HEIGHT_M = 1.2
LIDAR_HEIGHT_M = 0.6
_MESH_POSITIONS = {
    "small_house": ((3.2, -2.2), (-4.6, -0.2), (-5.5, -3.4), (6.3, -2.4), (1.5, 2.2)),
}
"""Free positions (x, y) in mesh files, by file stem; metres."""


@dataclass(frozen=True)
class Scene:
    """One panorama of a held-out world: level pose (4, 4), (H, W, 3) and ground-truth radial depth (H, W).

    The depth is 0 where the ray hits nothing. ``renderer`` is that of the world, ``name``: kind, world and place.
    """

    name: str
    renderer: EquirectRenderer
    map_from_camera: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    camera_height_m: float


def scenes(kind: str, count: int = 20, mesh: str | Path | None = None, height: int = 256) -> Iterator[Scene]:
    """The held-out panoramas of a kind; always the same ones.

    Args:
        kind: ``random`` (one world per panorama, seeds from ``FIRST_SEED``), ``long`` (the same with corridors
            and halls of 20 to 40 m), ``corridor`` (positions in the corridor of the experiments and its rooms) or
            ``mesh`` (its known positions first, then random free ones).
        count: panoramas.
        mesh: the file, for ``mesh``.
        height: rows of a panorama; twice as many columns.

    Raises:
        ValueError: unknown kind, count below 1, a mesh without a free position, or ``mesh`` does not match the kind.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)} (got {kind!r})")
    if count < 1:
        raise ValueError(f"count must be 1 or more (got {count})")
    if (kind == "mesh") != (mesh is not None):
        raise ValueError("kind mesh needs a mesh file, the other kinds take none")
    return _scenes(kind, count, Path(mesh) if mesh is not None else None, height)


def _scenes(kind: str, count: int, mesh: Path | None, height: int) -> Iterator[Scene]:
    from instant_ic.sim.render import EquirectRenderer
    from instant_ic.sim.worlds import corridor_world, load_world, long_world, random_world

    if kind in ("random", "long"):
        seed, made = FIRST_SEED, 0
        while made < count and seed < FIRST_SEED + 10 * count:
            world = random_world(seed) if kind == "random" else long_world(seed)
            try:
                places = world.sample_free_poses(np.random.default_rng([5, seed]), 1)
            except ValueError:  # some floor plans have no free position
                places = np.empty((0, 3))
            for x, y, yaw in places:
                yield _scene(f"{kind}:{seed}", EquirectRenderer(world), x, y, yaw, height)
                made += 1
            seed += 1
        return
    world = load_world(mesh) if mesh is not None else corridor_world()
    renderer = EquirectRenderer(world)
    for x, y, yaw in _places(world, count, mesh.stem if mesh is not None else ""):
        name = mesh.name if mesh is not None else "corridor"
        yield _scene(f"{name} ({x:.2f}, {y:.2f})", renderer, x, y, yaw, height)


def _places(world: World, count: int, stem: str) -> NDArray[np.float64]:
    """(count, 3) x, y, yaw: known positions first, looking along x; a larger ``count`` only appends."""
    known = [np.array([x, y, 0.0]) for x, y in _MESH_POSITIONS.get(stem, ())][:count]
    rngs = (np.random.default_rng([5, FIRST_SEED, k]) for k in range(count - len(known)))
    return np.array(known + [world.sample_free_poses(rng, 1)[0] for rng in rngs])


def _scene(name: str, renderer: EquirectRenderer, x: float, y: float, yaw: float, height: int) -> Scene:
    pose = pose_matrix(x, y, CAMERA_HEIGHT_M, yaw=yaw)
    frame = renderer.render(pose, 2 * height, height)
    return Scene(name, renderer, pose, frame.rgb, frame.depth_m, CAMERA_HEIGHT_M)
