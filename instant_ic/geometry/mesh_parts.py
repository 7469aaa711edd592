"""Parts of a mesh file as trimesh reads them: placed, z up, with their material."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Y_UP_SUFFIXES = (".glb", ".gltf")
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""glTF has y up and looks along z: (x, y, z) becomes (x, −z, y)."""


@dataclass(frozen=True)
class MeshPart:
    """One geometry at one node of a scene.

    Attributes:
        vertices: (V, 3) in metres, z up.
        faces: (F, 3) indices.
        corner_uv: texture coordinates of the corners, v downwards, (F, 3, 2); None without a texture.
        image: the texture, a PIL image; None without one.
        factor: the material's colour in 0..1, (3,), by which the texture is multiplied; None if it has none.
        factor_is_linear: whether ``factor`` is linear light (glTF) and not sRGB.
        visual: trimesh's visual, with the colours of vertices and faces.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.integer]
    corner_uv: NDArray[np.floating] | None
    image: Any
    factor: NDArray[np.float64] | None
    factor_is_linear: bool
    visual: Any


def mesh_parts(scene: Any, y_up: bool) -> Iterator[MeshPart]:
    """Yield the geometries with faces of a trimesh scene, node transforms applied.

    Args:
        scene: result of ``trimesh.load_scene``.
        y_up: whether y is up in the file.
    """
    turn = _Z_UP_FROM_Y_UP if y_up else np.eye(3)
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if getattr(mesh, "faces", None) is None or len(mesh.faces) == 0:
            continue
        vertices = (np.asarray(mesh.vertices) @ transform[:3, :3].T + transform[:3, 3]) @ turn.T
        faces = np.asarray(mesh.faces)
        image, factor, linear = _material(getattr(mesh.visual, "material", None))
        uv, corner_uv = getattr(mesh.visual, "uv", None), None
        if image is None or uv is None or len(uv) != len(vertices):
            image = None
        else:
            corner_uv = np.asarray(uv)[faces]
            corner_uv[..., 1] = 1 - corner_uv[..., 1]  # trimesh's v runs upwards, an image's rows downwards
        yield MeshPart(vertices, faces, corner_uv, image, factor, linear, mesh.visual)


def is_y_up(path: Path) -> bool:
    """Whether the format of a file has y up by its standard."""
    return path.suffix.lower() in Y_UP_SUFFIXES


def in_shares(colour: Any) -> NDArray[np.float64]:
    """Colours as shares of 1: integers are of their type's range (trimesh keeps both), fractions as they are."""
    values = np.asarray(colour)
    return values / np.iinfo(values.dtype).max if values.dtype.kind in "ui" else values.astype(np.float64)


def _material(material: Any) -> tuple[Any, NDArray[np.float64] | None, bool]:
    """Image, colour factor, and whether the factor is linear, of a trimesh material or None."""
    if material is None:
        return None, None, False
    image = getattr(material, "baseColorTexture", None)
    image = getattr(material, "image", None) if image is None else image
    linear = getattr(material, "baseColorFactor", None)
    if linear is not None:
        return image, in_shares(linear)[:3], True
    diffuse = getattr(material, "diffuse", None)
    return image, None if diffuse is None or image is not None else in_shares(diffuse)[:3], False
