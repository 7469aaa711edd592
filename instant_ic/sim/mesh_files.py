"""Worlds from mesh files (GLB, glTF, PLY, OBJ)."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from instant_ic.geometry.colour import srgb_to_linear
from instant_ic.geometry.mesh_file import doubled_areas, load_mesh
from instant_ic.sim.lighting import affine_on_triangles, bake_mesh
from instant_ic.sim.textures import texture_set
from instant_ic.sim.world import World


def _spawn(world: World) -> tuple[float, float, float]:
    """Return the centre of the largest free area of the floor plan that has a floor below and a surface above."""
    mask = world.occupied(0.05, 1.9, 0.05)
    clearance = mask.distance_m()
    candidates = np.argwhere(clearance > 0.3)
    rng = np.random.default_rng(0)
    candidates = candidates[rng.permutation(len(candidates))[:4000]]
    xy = mask.centre(candidates)
    start = np.column_stack([xy, np.full(len(xy), 1.0)])
    down, _ = world.caster.cast(start, np.repeat([[0.0, 0.0, -1.0]], len(xy), axis=0))
    up, _ = world.caster.cast(start, np.repeat([[0.0, 0.0, 1.0]], len(xy), axis=0))
    indoors = np.isfinite(up) & (np.abs(down - 1.0) < 0.1)
    if not indoors.any():
        indoors = np.abs(down - 1.0) < 0.1
    if not indoors.any():
        return (0.0, 0.0, 0.0)
    best = np.flatnonzero(indoors)[np.argmax(clearance[tuple(candidates[indoors].T)])]
    return (float(xy[best, 0]), float(xy[best, 1]), 0.0)


def load_world(path: str | Path) -> World:
    """Load a world from a mesh file: apply node transforms, repeat textures, bake soft light.

    Raises:
        ValueError: the file cannot be read or has no triangles.
    """
    mesh = load_mesh(path)
    count, triangles = len(mesh.triangles), mesh.triangles.astype(np.float64)
    cross = doubled_areas(mesh.triangles)
    normal = cross / np.linalg.norm(cross, axis=1, keepdims=True)
    tint = np.where(mesh.texture[:, None] < 0, srgb_to_linear(mesh.corner_rgb.mean(axis=1) / 255), np.float32(1))
    images = [srgb_to_linear(image.astype(np.float32) / 255) for image in mesh.images]
    sources: list[str | npt.NDArray[np.floating]] = [*images, np.ones((1, 1, 3), np.float32)]  # the last one is plain
    world = World(
        name=Path(path).name,
        vertices=mesh.triangles.reshape(-1, 3),
        faces=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        face_surface=np.arange(count, dtype=np.int32),
        normal=normal.astype(np.float32),
        offset=np.einsum("ni,ni->n", normal, triangles[:, 0]).astype(np.float32),
        uv=affine_on_triangles(triangles, mesh.corner_uv.astype(np.float64)).astype(np.float32),
        texture=np.where(mesh.texture < 0, len(images), mesh.texture).astype(np.int32),
        tint=tint.astype(np.float32),
        emission=np.zeros(count, np.float32),
        textures=texture_set(sources, [False] * len(sources)),
        light_at=np.zeros((count, 3), np.int64),
        light_uv=np.zeros((count, 2, 4), np.float32),
        light_linear=np.tile(np.asarray([0, 0, 0, 1], np.float32), (count, 1)),
        light=np.ones((1, 3), np.float32),
    )
    world.spawn = _spawn(world)
    bake_mesh(world)
    return world
