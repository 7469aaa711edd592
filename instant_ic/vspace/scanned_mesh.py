"""A scanned place: triangles with colours from a mesh file, as the renderer takes them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.mesh_file import MeshError, in_shares, load_parts
from instant_ic.vspace.nerf.field import Floats

GREY = (179.0, 179.0, 179.0)
"""Colour of a surface without any, sRGB 0 to 255."""
MAX_LEVELS = 13
"""Levels of an image pyramid: images up to 4096 pixels a side."""


@dataclass(frozen=True)
class ScannedMesh:
    """Triangles in metres, z up, with the colours that the scanner saw.

    Attributes:
        triangles: corners in metres, (T, 3, 3).
        corner_uv: texture coordinates of the corners, v downwards, 1 = the whole image, (T, 3, 2).
        corner_rgb: sRGB colours of the corners, 0 to 255, (T, 3, 3); used where there is no texture.
        texture: index of each triangle's image, −1 for none, (T,).
        texel_per_m: texels of the finest level per metre, (T,); with vertex colours, triangles per metre.
        texels: texels of all images and levels one after another, (N, 3) uint8.
        start: first texel of each image's level, (images, MAX_LEVELS).
        sizes: height and width of each image's level, (images, MAX_LEVELS, 2).
        levels: number of levels of each image, (images,).
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
        """Lowest and highest corner in metres, (2, 3)."""
        corners = self.triangles.reshape(-1, 3)
        return np.stack([corners.min(axis=0), corners.max(axis=0)])


def load_mesh(path: str | Path, max_triangles: int = 5_000_000) -> ScannedMesh:
    """Load a mesh with a texture or vertex colours.

    Args:
        path: GLB, glTF, PLY or OBJ file.
        max_triangles: largest number of triangles.

    Raises:
        MeshError: no such file, another kind of file, damaged, without triangles, or too large.
    """
    corners, corner_uv, corner_rgb, texture = [], [], [], []
    images: dict[int, NDArray[np.uint8]] = {}  # by id of the part's image
    parts = load_parts(path, max_triangles)
    for part in parts:
        factor = None if part.factor is None else part.factor.astype(np.float32)
        if factor is not None:
            factor = 255 * (_to_srgb(factor) if part.factor_is_linear else factor)
        if part.image is not None and id(part.image) not in images:
            images[id(part.image)] = _with_factor(part.image, factor)
        number = -1 if part.image is None else list(images).index(id(part.image))
        uv = np.zeros((*part.faces.shape, 2)) if part.corner_uv is None else part.corner_uv
        corners.append(part.vertices[part.faces].astype(np.float32))
        corner_uv.append(uv.astype(np.float32))
        corner_rgb.append(_corner_colours(part.visual, part.faces, factor))
        texture.append(np.full(len(part.faces), number, np.int32))
    triangles, index, all_uv = np.concatenate(corners), np.concatenate(texture), np.concatenate(corner_uv)
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    twice_area = np.linalg.norm(np.cross(a.astype(np.float64), b), axis=1)
    keep = np.isfinite(twice_area) & (twice_area > 1e-12)
    if not keep.any():
        raise MeshError(f"mesh {path}: holds no triangles with an area. Is it a point cloud? Mesh it first")
    texels, start, sizes, levels = _pyramids(list(images.values()))
    index, uv = index[keep], all_uv[keep]
    return ScannedMesh(
        triangles=np.ascontiguousarray(triangles[keep]),
        corner_uv=np.ascontiguousarray(uv),
        corner_rgb=np.ascontiguousarray(np.concatenate(corner_rgb)[keep]),
        texture=index,
        texel_per_m=_texel_density(uv, twice_area[keep], sizes, index),
        texels=texels,
        start=start,
        sizes=sizes,
        levels=levels,
    )


def _corner_colours(visual: Any, faces: NDArray[np.integer], factor: Floats | None) -> Floats:
    """Return the colours of the corners, 0 to 255, (T, 3, 3), from the vertices, the faces, or the material."""
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
    """Convert linear light, 0 to 1, to sRGB values (IEC 61966-2-1)."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055).astype(np.float32)


def _with_factor(image: Any, factor: Floats | None) -> NDArray[np.uint8]:
    """Multiply an image by the material's colour; a factor of light is nearly a factor of sRGB values too."""
    rgb = np.asarray(image.convert("RGB"))
    return rgb if factor is None else np.clip(np.rint(rgb * (factor / 255)), 0, 255).astype(np.uint8)


def _pyramids(
    images: list[NDArray[np.uint8]],
) -> tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.int32], NDArray[np.int32]]:
    """Build each image at full, half, quarter... size, area-averaged."""
    from instant_ic.vspace.prior import area_average

    start = np.zeros((len(images), MAX_LEVELS), np.int64)
    sizes = np.ones((len(images), MAX_LEVELS, 2), np.int32)
    levels = np.zeros(len(images), np.int32)
    rows: list[NDArray[np.uint8]] = []
    at = 0
    for number, level in enumerate(images):
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
    """Return the texels (without an image: triangles) per metre, from the areas in the image and in the world."""
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    in_uv = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).astype(np.float64)
    whole = np.append(sizes[:, 0].astype(np.float64).prod(axis=1), 0.0)  # the last is of texture −1
    return np.sqrt(np.where(texture < 0, 2, in_uv * whole[texture]) / twice_area).astype(np.float32)
