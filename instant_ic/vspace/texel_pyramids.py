"""Image pyramids of a mesh's textures, as arrays for the renderer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.mesh_file import ColouredMesh, doubled_areas
from instant_ic.vspace.nerf.field import Floats
from instant_ic.vspace.prior import area_average

MAX_LEVELS = 13
"""Largest number of levels of an image pyramid, for images of up to 4096 pixels per side."""


@dataclass(frozen=True)
class TexelPyramids:
    """Image pyramids: each image at full, half, quarter and so on of its size, area-averaged.

    Attributes:
        texels: texels of all images and levels one after another, (N, 3) uint8.
        start: first texel of each image's level, (images, MAX_LEVELS).
        sizes: height and width of each image's level, (images, MAX_LEVELS, 2).
        levels: number of levels of each image, (images,).
    """

    texels: NDArray[np.uint8]
    start: NDArray[np.int64]
    sizes: NDArray[np.int32]
    levels: NDArray[np.int32]

    @classmethod
    def build(cls, images: list[NDArray[np.uint8]]) -> TexelPyramids:
        """Build the pyramids of images, (H, W, 3) each."""
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
        return cls(np.concatenate(rows) if rows else np.zeros((1, 3), np.uint8), start, sizes, levels)


def texel_density(mesh: ColouredMesh) -> Floats:
    """Return each triangle's texels per metre, (T,), from its areas in image and world.

    A triangle without an image counts as one texel.
    """
    edges = mesh.corner_uv[:, 1:] - mesh.corner_uv[:, :1]
    in_uv = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).astype(np.float64)
    whole = np.array([*(image.shape[0] * image.shape[1] for image in mesh.images), 0.0])  # the last is for texture −1
    twice_area = np.linalg.norm(doubled_areas(mesh.triangles), axis=1)
    return np.sqrt(np.where(mesh.texture < 0, 2, in_uv * whole[mesh.texture]) / twice_area).astype(np.float32)
