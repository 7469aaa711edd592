"""Loader of mesh files (GLB, glTF, PLY, OBJ) on trimesh, within limits on what a file may declare."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

SUFFIXES = (".glb", ".gltf", ".ply", ".obj")
Y_UP_SUFFIXES = (".glb", ".gltf")
MAX_FILE_BYTES = 2 << 30
"""Larger files are refused unread: their triangles would not fit into the memory of a robot's station."""
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""glTF has y up and looks along z: (x, y, z) becomes (x, −z, y)."""


class MeshError(ValueError):
    """A mesh cannot be used; the message names the file, the reason and the remedy."""


@dataclass(frozen=True)
class MeshPart:
    """One geometry at one node of a scene.

    Attributes:
        vertices: corners in metres, z up, (V, 3).
        faces: indices of the triangles' corners, (F, 3).
        corner_uv: texture coordinates of the triangles' corners, v downwards, (F, 3, 2); None without a texture.
        image: the texture, a PIL image; None without one.
        factor: colour of the material, 0 to 1, (3,), by which the texture is multiplied; None if it has none.
        factor_is_linear: ``factor`` is linear light (glTF) and not sRGB.
        visual: visual of trimesh, with the colours of vertices and faces.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.integer]
    corner_uv: NDArray[np.floating] | None
    image: Any
    factor: NDArray[np.float64] | None
    factor_is_linear: bool
    visual: Any


def load_parts(path: str | Path, max_triangles: int = 5_000_000) -> list[MeshPart]:
    """Load the geometries of a file that have faces, node transforms applied, z up.

    glTF has y up by its standard and is turned; the others are taken as they are, with z up.

    Args:
        path: GLB, glTF, PLY or OBJ file.
        max_triangles: largest number of triangles; one geometry counts at each of its nodes.

    Raises:
        MeshError: no such file, another kind of file, damaged, without triangles, or too large.
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError(f"mesh {path}: no such file. Give a {', '.join(SUFFIXES)} file")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise MeshError(f"mesh {path}: {suffix or 'no suffix'} is not read. Use one of {', '.join(SUFFIXES)}")
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise MeshError(f"mesh {path}: {size / 2**30:.1f} GiB, at most {MAX_FILE_BYTES >> 30} are read. Simplify it")
    try:
        if suffix in Y_UP_SUFFIXES:
            _check_accessors(path, 3 * max_triangles)
        parts = list(_parts(path, max_triangles))
    except MeshError:
        raise
    except MemoryError as error:
        raise MeshError(f"mesh {path}: does not fit into memory. Simplify it") from error
    except Exception as error:  # trimesh's readers raise whatever their formats' parsers do
        raise MeshError(
            f"mesh {path}: damaged, or not what its suffix says ({type(error).__name__}: {error})"
        ) from error
    if not parts:
        raise MeshError(f"mesh {path}: holds no triangles. Is it a point cloud? Mesh it first")
    return parts


def _check_accessors(path: Path, most: int) -> None:
    """Check that the arrays of a glTF are in its buffers: 50 bytes can declare any number of zeros without one.

    Args:
        path: the file.
        most: largest number of elements of an array.

    Raises:
        MeshError: an array without a buffer, or with more elements.
    """
    content = path.read_bytes()
    if content[:4] == b"glTF":
        content = content[20 : 20 + int.from_bytes(content[12:16], "little")]
    for accessor in json.loads(content).get("accessors", []):
        if "bufferView" not in accessor or not 0 <= accessor["count"] <= most:
            raise MeshError(
                f"mesh {path}: an array of {accessor['count']} elements is not in its buffers, or has more than "
                f"{most}. Export it uncompressed, simplify the mesh, or raise the limit (space.mesh_max_triangles)"
            )


def _parts(path: Path, max_triangles: int) -> Iterator[MeshPart]:
    import trimesh

    scene = trimesh.load_scene(str(path), process=False)
    turn = _Z_UP_FROM_Y_UP if path.suffix.lower() in Y_UP_SUFFIXES else np.eye(3)
    count = 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if getattr(mesh, "faces", None) is None or len(mesh.faces) == 0:
            continue
        count += len(mesh.faces)
        if count > max_triangles:
            raise MeshError(
                f"mesh {path}: at least {count} triangles, the limit is {max_triangles}. Simplify the mesh, or raise "
                "the limit (space.mesh_max_triangles)"
            )
        vertices = (np.asarray(mesh.vertices) @ transform[:3, :3].T + transform[:3, 3]) @ turn.T
        faces = np.asarray(mesh.faces)
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise MeshError(f"mesh {path}: damaged, a triangle has a corner that is not there")
        image, factor, linear = _material(getattr(mesh.visual, "material", None))
        uv, corner_uv = getattr(mesh.visual, "uv", None), None
        if image is None or uv is None or len(uv) != len(vertices):
            image = None
        else:
            image.load()  # an error in its data is the file's
            corner_uv = np.asarray(uv)[faces]
            corner_uv[..., 1] = 1 - corner_uv[..., 1]  # trimesh's v runs upwards, an image's rows downwards
        yield MeshPart(vertices, faces, corner_uv, image, factor, linear, mesh.visual)


def in_shares(colour: Any) -> NDArray[np.float64]:
    """Return colours as shares of 1; integers are of their type's range, as trimesh keeps them."""
    values = np.asarray(colour)
    return values / np.iinfo(values.dtype).max if values.dtype.kind in "ui" else values.astype(np.float64)


def _material(material: Any) -> tuple[Any, NDArray[np.float64] | None, bool]:
    """Return image, colour factor, and True for a linear factor, of a trimesh material or None."""
    if material is None:
        return None, None, False
    image = getattr(material, "baseColorTexture", None)
    image = getattr(material, "image", None) if image is None else image
    linear = getattr(material, "baseColorFactor", None)
    if linear is not None:
        return image, in_shares(linear)[:3], True
    diffuse = getattr(material, "diffuse", None)
    return image, None if diffuse is None or image is not None else in_shares(diffuse)[:3], False
