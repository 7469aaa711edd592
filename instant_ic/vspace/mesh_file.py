"""Loader of scanned places: triangles with colours from a mesh file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.mesh_parts import in_shares, is_y_up, mesh_parts
from instant_ic.vspace.nerf.field import Floats

SUFFIXES = (".glb", ".gltf", ".ply", ".obj")
GREY = (179.0, 179.0, 179.0)
"""Colour of a surface without any."""
MAX_LEVELS = 13
MAX_FILE_BYTES = 2 << 30
"""Larger files are refused unread: their triangles would not fit into the memory of a robot's station."""


class MeshError(ValueError):
    """A mesh cannot be used; the message names the file, the reason and the remedy."""


@dataclass(frozen=True)
class ScannedMesh:
    """Triangles in metres, z up, with the colours that the scanner saw.

    Attributes:
        triangles: corners, (T, 3, 3).
        corner_uv: texture coordinates of the corners, v downwards, 1 = the whole image, (T, 3, 2).
        corner_rgb: colours of the corners in 0..255 sRGB, (T, 3, 3); counts where there is no texture.
        texture: index of each triangle's image, −1 for none, (T,).
        texel_per_m: texels of the finest level a metre, (T,); of vertex colours, triangles a metre.
        texels: of all images and levels one after another, (N, 3) uint8.
        start: first texel of each image's level, (images, MAX_LEVELS).
        sizes: height and width of each image's level, (images, MAX_LEVELS, 2).
        levels: of each image, (images,).
    """

    triangles: Floats
    corner_uv: Floats
    corner_rgb: Floats
    texture: NDArray[np.int32]
    texel_per_m: Floats
    texels: NDArray[np.uint8]
    start: NDArray[np.int64]
    sizes: NDArray[np.int32]
    levels: NDArray[np.int32]

    @property
    def bounds(self) -> Floats:
        """Lowest and highest corner, (2, 3)."""
        corners = self.triangles.reshape(-1, 3)
        return np.stack([corners.min(axis=0), corners.max(axis=0)])


def load_mesh(path: str | Path, max_triangles: int = 5_000_000) -> ScannedMesh:
    """Reads GLB, glTF, PLY or OBJ with a texture or vertex colours.

    glTF has y up by its standard and is turned; the others are taken as they are, with z up.

    Raises:
        MeshError: no such file, another kind of file, damaged, without triangles, or too large.
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError(f"mesh {path}: no such file; give space.mesh a {', '.join(SUFFIXES)} file")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise MeshError(
            f"mesh {path}: {suffix or 'a file without ending'} is not read; use one of {', '.join(SUFFIXES)}"
        )
    if path.stat().st_size > MAX_FILE_BYTES:
        raise MeshError(
            f"mesh {path}: {path.stat().st_size / 2**30:.1f} GiB, at most {MAX_FILE_BYTES >> 30} are read;"
            " simplify it first"
        )
    try:
        if is_y_up(path):
            _check_accessors(path, 3 * max_triangles)
        return _read(path, max_triangles)
    except MeshError:
        raise
    except MemoryError as error:
        raise MeshError(f"mesh {path}: does not fit into memory; simplify it first") from error
    except Exception as error:  # trimesh's readers raise whatever their formats' parsers do
        raise MeshError(
            f"mesh {path}: damaged, or not what its ending says ({type(error).__name__}: {error})"
        ) from error


def _check_accessors(path: Path, most: int) -> None:
    """Check that a glTF's arrays are in its buffers: 50 bytes can declare any number of zeros without one.

    Raises:
        MeshError: an array without a buffer, or of more elements than the mesh may have.
    """
    content = path.read_bytes()
    if content[:4] == b"glTF":
        content = content[20 : 20 + int.from_bytes(content[12:16], "little")]
    for accessor in json.loads(content).get("accessors", []):
        if "bufferView" not in accessor or not 0 <= accessor["count"] <= most:
            raise MeshError(
                f"mesh {path}: an array of {accessor['count']} elements is not in its buffers, or is of more than "
                f"{most}; export it uncompressed, simplify the mesh, or raise space.mesh_max_triangles"
            )


def _read(path: Path, max_triangles: int) -> ScannedMesh:
    """The mesh of a file. Triangles are counted on the way, as one geometry may stand at many nodes."""
    import trimesh

    # Corners, their texture coordinates and colours, and the triangles' texture, of each part; of none first.
    nothing = (np.zeros((0, 3, width), np.float32) for width in (3, 2, 3))
    parts: list[tuple[NDArray[Any], ...]] = [(*nothing, np.zeros(0, np.int32))]
    images: dict[int, tuple[Any, NDArray[np.uint8]]] = {}  # by id, with what keeps it
    count = 0
    for part in mesh_parts(trimesh.load_scene(str(path), process=False), is_y_up(path)):
        count += len(part.faces)
        if count > max_triangles:
            raise MeshError(
                f"mesh {path}: at least {count} triangles, space.mesh_max_triangles is {max_triangles};"
                " simplify the mesh, or raise the limit"
            )
        factor = None if part.factor is None else part.factor.astype(np.float32)
        if factor is not None:
            factor = 255 * (_to_srgb(factor) if part.factor_is_linear else factor)
        if part.image is not None and id(part.image) not in images:
            images[id(part.image)] = part.image, _with_factor(part.image, factor)
        number = -1 if part.image is None else list(images).index(id(part.image))
        uv = np.zeros((*part.faces.shape, 2)) if part.corner_uv is None else part.corner_uv
        corners, colours = part.vertices[part.faces], _corner_colours(part.visual, part.faces, factor)
        texture = np.full(len(part.faces), number, np.int32)
        parts.append((corners.astype(np.float32), uv.astype(np.float32), colours, texture))
    triangles, corner_uv, corner_rgb, texture = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    twice_area = np.linalg.norm(np.cross(a.astype(np.float64), b), axis=1)
    keep = np.isfinite(twice_area) & (twice_area > 1e-12)
    if not keep.any():
        raise MeshError(f"mesh {path}: holds no triangles with an area; is it a point cloud? Mesh it first")
    texels, start, sizes, levels = _pyramids([rgb for _, rgb in images.values()])
    index, uv = texture[keep], corner_uv[keep]
    return ScannedMesh(
        triangles=np.ascontiguousarray(triangles[keep]),
        corner_uv=np.ascontiguousarray(uv),
        corner_rgb=np.ascontiguousarray(corner_rgb[keep]),
        texture=index,
        texel_per_m=_texel_density(uv, twice_area[keep], sizes, index),
        texels=texels,
        start=start,
        sizes=sizes,
        levels=levels,
    )


def _corner_colours(visual: Any, faces: NDArray[np.integer], factor: Floats | None) -> Floats:
    """Colours of the corners (T, 3, 3) in 0..255: of the vertices, the faces, or the material."""
    kind = getattr(visual, "kind", None)
    if kind == "vertex":
        return 255 * in_shares(visual.vertex_colors).astype(np.float32)[faces][..., :3]
    if kind == "face":
        return 255 * np.repeat(in_shares(visual.face_colors).astype(np.float32)[:, None, :3], 3, axis=1)
    attributes = getattr(visual, "vertex_attributes", {})
    if "color" in attributes:  # of glTF, beside a material
        return 255 * in_shares(attributes["color"]).astype(np.float32)[faces][..., :3]
    return np.tile(np.array(GREY, np.float32) if factor is None else factor, (len(faces), 3, 1))


def _to_srgb(linear: Floats) -> Floats:
    """Light in 0..1 as sRGB values (IEC 61966-2-1)."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055).astype(np.float32)


def _with_factor(picture: Any, factor: Floats | None) -> NDArray[np.uint8]:
    """A factor of light is nearly a factor of sRGB values too."""
    rgb = np.asarray(picture.convert("RGB"))
    return rgb if factor is None else np.clip(np.rint(rgb * (factor / 255)), 0, 255).astype(np.uint8)


def _pyramids(
    pictures: list[NDArray[np.uint8]],
) -> tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.int32], NDArray[np.int32]]:
    """Each image at full, half, quarter... size, area-averaged."""
    from instant_ic.vspace.prior import area_average

    start = np.zeros((len(pictures), MAX_LEVELS), np.int64)
    sizes = np.ones((len(pictures), MAX_LEVELS, 2), np.int32)
    levels = np.zeros(len(pictures), np.int32)
    rows: list[NDArray[np.uint8]] = []
    at = 0
    for number, picture in enumerate(pictures):
        level = picture
        for depth in range(MAX_LEVELS):
            start[number, depth], sizes[number, depth], levels[number] = at, level.shape[:2], depth + 1
            rows.append(level.reshape(-1, 3))
            at += len(rows[-1])
            height, width = level.shape[:2]
            if max(height, width) == 1:
                break
            level = area_average(level, max(1, height // 2), max(1, width // 2))
    return np.concatenate(rows) if rows else np.zeros((1, 3), np.uint8), start, sizes, levels


def _texel_density(
    uv: Floats, twice_area: NDArray[np.float64], sizes: NDArray[np.int32], texture: NDArray[np.int32]
) -> Floats:
    """Texels a metre, by the areas in the image and in the world; without an image, triangles a metre."""
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    in_uv = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).astype(np.float64)
    whole = np.append(sizes[:, 0].astype(np.float64).prod(axis=1), 0.0)  # the last is of texture −1
    return np.sqrt(np.where(texture < 0, 2, in_uv * whole[texture]) / twice_area).astype(np.float32)
