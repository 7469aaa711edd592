"""Worlds from mesh files (GLB, glTF, PLY, OBJ)."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instant_ic.geometry.mesh_file import load_parts
from instant_ic.sim.lighting import bake_mesh
from instant_ic.sim.textures import srgb_to_linear, texture_set
from instant_ic.sim.world import World


def _linear(image: Any) -> npt.NDArray[np.float32]:
    """Convert a PIL image to linear light, (H, W, 3)."""
    return srgb_to_linear(np.asarray(image.convert("RGB"), np.float32) / 255.0)


def _affine_uv(triangles: npt.NDArray[np.float64], uv: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the affine maps (F, 2, 4) from points on triangles (F, 3, 3) to their texture coordinates (F, 3, 2)."""
    edges = np.stack([triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]], axis=1)
    change = np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], axis=1)
    gram = np.einsum("nij,nkj->nik", edges, edges)
    gram += (1e-9 * np.trace(gram, axis1=1, axis2=2) + 1e-18)[:, None, None] * np.eye(2)
    weights = np.linalg.solve(gram, edges)
    result = np.zeros((len(triangles), 2, 4))
    result[:, :, :3] = np.einsum("nij,nik->nkj", weights, change)
    result[:, :, 3] = uv[:, 0] - np.einsum("nkj,nj->nk", result[:, :, :3], triangles[:, 0])
    return result


def _spawn(world: World) -> tuple[float, float, float]:
    """Return the centre of the largest free area of the floor plan that has a floor and something overhead."""
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
    sources: list[str | npt.NDArray[np.floating]] = []
    known: dict[int, int] = {}
    arrays: list[dict[str, npt.NDArray[Any]]] = []
    parts = load_parts(path)
    for part in parts:
        key = -1 if part.image is None else id(part.image)
        corner_uv = np.zeros((*part.faces.shape, 2)) if part.corner_uv is None else part.corner_uv.astype(float)
        if key not in known:
            known[key] = len(sources)
            sources.append(np.ones((1, 1, 3), np.float32) if part.image is None else _linear(part.image))
        colour = part.factor
        if colour is None:
            colour = np.full(3, 0.7 if getattr(part.visual, "material", None) is None else 1.0)
        triangles = part.vertices[part.faces]
        arrays.append(
            {
                "triangles": triangles,
                "uv": _affine_uv(triangles, corner_uv),
                "texture": np.full(len(triangles), known[key], np.int32),
                "tint": np.repeat(colour[None].astype(np.float32), len(triangles), axis=0),
            }
        )
    world = _world(Path(path).name, {key: np.concatenate([part[key] for part in arrays]) for key in arrays[0]}, sources)
    world.spawn = _spawn(world)
    bake_mesh(world)
    return world


def _world(name: str, joined: dict[str, npt.NDArray[Any]], sources: list[str | npt.NDArray[np.floating]]) -> World:
    """Build a world without light from the arrays of its triangles, leaving out those without an area."""
    cross = np.cross(
        joined["triangles"][:, 1] - joined["triangles"][:, 0], joined["triangles"][:, 2] - joined["triangles"][:, 0]
    )
    twice_area = np.linalg.norm(cross, axis=1)
    keep = twice_area > 1e-10
    joined = {key: value[keep] for key, value in joined.items()}
    normal = cross[keep] / twice_area[keep, None]
    triangles = joined["triangles"]
    count = len(triangles)
    return World(
        name=name,
        vertices=triangles.reshape(-1, 3).astype(np.float32),
        faces=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        face_surface=np.arange(count, dtype=np.int32),
        normal=normal.astype(np.float32),
        offset=np.einsum("ni,ni->n", normal, triangles[:, 0]).astype(np.float32),
        uv=joined["uv"].astype(np.float32),
        texture=joined["texture"],
        tint=joined["tint"],
        emission=np.zeros(count, np.float32),
        textures=texture_set(sources, [False] * len(sources)),
        light_at=np.zeros((count, 3), np.int64),
        light_uv=np.zeros((count, 2, 4), np.float32),
        light_linear=np.tile(np.asarray([0, 0, 0, 1], np.float32), (count, 1)),
        light=np.ones((1, 3), np.float32),
    )
