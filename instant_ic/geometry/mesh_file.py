"""Loader of mesh files (GLB, glTF, PLY, OBJ) by trimesh, with limits on the sizes that a file may declare."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.colour import linear_to_srgb

Floats = NDArray[np.float32]
SUFFIXES = (".glb", ".gltf", ".ply", ".obj")
Y_UP_SUFFIXES = (".glb", ".gltf")
MAX_FILE_BYTES = 2 << 30
"""Larger files are refused before reading, because their triangles would not fit into the memory of the station."""
GREY = 0.85
"""Colour of a surface that has none, sRGB 0 to 1."""
_Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""glTF has y up and looks along z: (x, y, z) becomes (x, −z, y)."""


class MeshError(ValueError):
    """A mesh cannot be used; the message names the file, the reason and the remedy."""


@dataclass(frozen=True)
class ColouredMesh:
    """Triangles with their colours.

    Attributes:
        triangles: corners in metres, z up, (T, 3, 3).
        corner_uv: texture coordinates of the corners, v downwards, 0 to 1 over the image, (T, 3, 2).
        corner_rgb: sRGB colours of the corners, 0 to 255, (T, 3, 3); used where there is no texture.
        texture: index of each triangle's image, −1 for none, (T,).
        images: textures in the colour of their material, sRGB, (H, W, 3) uint8 each.
    """

    triangles: Floats
    corner_uv: Floats
    corner_rgb: Floats
    texture: NDArray[np.int32]
    images: list[NDArray[np.uint8]]


def load_mesh(path: str | Path, max_triangles: int = 5_000_000) -> ColouredMesh:
    """Load the triangles of a file with node transforms applied; triangles without an area are left out.

    glTF has y up by its standard and is turned. The other formats are read as they are, with z up.

    Args:
        path: GLB, glTF, PLY or OBJ file.
        max_triangles: largest number of triangles; a geometry counts once for each of its nodes.

    Raises:
        MeshError: the file is missing, of another kind, damaged, without triangles, or too large.
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
    images: dict[tuple[int, bytes], NDArray[np.uint8]] = {}
    try:
        if suffix in Y_UP_SUFFIXES:
            _check_accessors(path, 3 * max_triangles)
        parts = list(_parts(path, max_triangles, images))
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
    triangles, uv, rgb, texture = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    twice_area = np.linalg.norm(doubled_areas(triangles), axis=1)
    keep = np.isfinite(twice_area) & (twice_area > 1e-12)
    if not keep.any():
        raise MeshError(f"mesh {path}: holds no triangles with an area. Is it a point cloud? Mesh it first")
    return ColouredMesh(triangles[keep], uv[keep], rgb[keep], texture[keep], list(images.values()))


def doubled_areas(triangles: Floats) -> NDArray[np.float64]:
    """Return the normals (T, 3) of triangles (T, 3, 3); a normal's length is twice its triangle's area."""
    edges = triangles[:, 1:] - triangles[:, :1]
    return np.cross(edges[:, 0].astype(np.float64), edges[:, 1])


def _check_accessors(path: Path, most: int) -> None:
    """Check that a glTF's arrays are in its buffers. Without a buffer, 50 bytes can declare any number of zeros.

    Args:
        path: the file.
        most: largest number of elements of an array.

    Raises:
        MeshError: an array has no buffer, or more than ``most`` elements.
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


def _parts(
    path: Path, max_triangles: int, images: dict[tuple[int, bytes], NDArray[np.uint8]]
) -> Iterator[tuple[Floats, Floats, Floats, NDArray[np.int32]]]:
    """Yield the arrays of ``ColouredMesh`` for each node of each geometry that has faces.

    Args:
        path: the file.
        max_triangles: largest number of triangles.
        images: textures by the id of the file's image and the material's colour; filled here.
    """
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
        image, colour = _material(getattr(mesh.visual, "material", None))
        uv, number = getattr(mesh.visual, "uv", None), -1
        corner_uv = np.zeros((*faces.shape, 2), np.float32)
        if image is not None and uv is not None and len(uv) == len(vertices):
            key = id(image), colour.tobytes()
            if key not in images:
                images[key] = np.rint(np.asarray(image.convert("RGB")) * np.clip(colour, 0, 1)).astype(np.uint8)
            number = list(images).index(key)
            corner_uv[...] = np.asarray(uv)[faces]
            corner_uv[..., 1] = 1 - corner_uv[..., 1]  # trimesh's v runs upwards, an image's rows downwards
        rgb = 255 * _corner_colours(mesh.visual, faces, colour)
        yield vertices[faces].astype(np.float32), corner_uv, rgb, np.full(len(faces), number, np.int32)


def _material(material: Any) -> tuple[Any, Floats]:
    """Return the image of a trimesh material (None if it has none) and its colour, sRGB 0 to 1, (3,)."""
    if material is None:
        return None, np.full(3, GREY, np.float32)
    image = getattr(material, "baseColorTexture", None)
    image = getattr(material, "image", None) if image is None else image
    linear = getattr(material, "baseColorFactor", None)
    if linear is not None:
        return image, linear_to_srgb(_in_shares(linear)[:3])
    diffuse = getattr(material, "diffuse", None)
    if image is not None:
        return image, np.ones(3, np.float32)
    return None, np.full(3, GREY, np.float32) if diffuse is None else _in_shares(diffuse)[:3]


def _corner_colours(visual: Any, faces: NDArray[np.integer], colour: Floats) -> Floats:
    """Return the corners' colours, 0 to 1, (T, 3, 3), from the vertices, the faces or the material."""
    kind = getattr(visual, "kind", None)
    if kind == "vertex":
        return _in_shares(visual.vertex_colors)[faces][..., :3]
    if kind == "face":
        return np.repeat(_in_shares(visual.face_colors)[:, None, :3], 3, axis=1)
    attributes = getattr(visual, "vertex_attributes", {})
    if "color" in attributes:  # a glTF file may have vertex colours beside a material
        return _in_shares(attributes["color"])[faces][..., :3]
    return np.tile(colour, (*faces.shape, 1))


def _in_shares(colour: Any) -> Floats:
    """Return colours in the range 0 to 1; integers are divided by their type's largest value, as in trimesh."""
    values = np.asarray(colour)
    return (values / np.iinfo(values.dtype).max if values.dtype.kind in "ui" else values).astype(np.float32)
