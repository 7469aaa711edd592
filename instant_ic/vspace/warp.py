"""Views by warping a panorama by its depth, without training; the baseline of the field.

The depth image is a mesh that is cut at depth discontinuities and rendered into a z-buffer. Colours come from the
panorama at full resolution, averaged over each pixel's footprint. Gaps are filled from their farther side.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import directions_at
from instant_ic.vspace.nerf.field import Floats, Rays
from instant_ic.vspace.prior import ROOM, PanoramaPrior, edge_quads
from instant_ic.vspace.view import View, check_size, checked_pose, continue_unseen, perspective_rays, to_8bit

EDGE_RATIO = 0.05
"""Relative difference of neighbouring depths above which there is an edge, unless they lie on one plane."""
BLUR = 0.65
"""Share of a pixel over which a colour is averaged; below 1, because trilinear look-up also blurs (see ``sim.render``).
"""


@dataclass(frozen=True)
class Pyramid:
    """An image pyramid: a panorama at full, half, quarter and so on of its size, area-averaged.

    Attributes:
        texels: rows of all levels one after another, (N, 3) uint8.
        start: first texel of each level, (levels,) int64.
        sizes: height and width of each level, (levels, 2) int64.
    """

    texels: NDArray[np.uint8]
    start: NDArray[np.int64]
    sizes: NDArray[np.int64]

    @classmethod
    def of(cls, rgb: NDArray[np.uint8]) -> Pyramid:
        """Build the pyramid of a panorama (H, 2 H, 3), halving it until a side is odd or 8 rows remain."""
        levels = [rgb]
        while levels[-1].shape[0] >= 16 and levels[-1].shape[0] % 2 == 0:
            rows = levels[-1][::2].astype(np.uint16) + levels[-1][1::2]
            levels.append(((rows[:, ::2] + rows[:, 1::2] + 2) >> 2).astype(np.uint8))
        sizes = np.array([level.shape[:2] for level in levels], np.int64)
        start = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]]).astype(np.int64)
        return cls(np.concatenate([level.reshape(-1, 3) for level in levels]), start, sizes)

    def look_up(
        self, camera_from_map: Floats, rays: Rays, depth: Floats, wanted: Floats, share: float, colour: Floats
    ) -> None:
        """Blend the panorama's colour, averaged over each pixel's footprint, into that of a view's surfaces.

        Args:
            camera_from_map: inverse pose of the panorama, (4, 4) float32.
            rays: P rays of the view.
            depth: metres along the rays, (P,); 0 where a ray hits nothing.
            wanted: positive where a colour is wanted, (P,).
            share: weight of the panorama in the result, 0 to 1.
            colour: RGB of the view, 0 to 1, (P, 3); updated in place.
        """
        from instant_ic.vspace import warp_kernels

        places = np.empty((len(depth), 2), np.float32)
        warp_kernels.panorama_places(camera_from_map, rays.origin, rays.directions, depth, *self.sizes[0], places)
        warp_kernels.look_up(
            self.texels,
            self.start,
            self.sizes,
            places,
            *rays.shape,
            np.float32(BLUR),
            wanted,
            np.float32(share),
            colour,
        )


class PanoramaWarp:
    """A panorama with depth that can be rendered from other positions.

    Attributes:
        inverse, depth_edge, known: arrays of the mesh for ``warp_kernels.render_mesh``, (h + 2, w).

    Example:
        >>> warp = PanoramaWarp(prepare(rgb, depth_m, map_from_camera, 0.0, GeometryConfig(), 4096))  # doctest: +SKIP
        >>> warp.render(pose, 320, 180, fov_rad=1.57).rgb
    """

    def __init__(self, prior: PanoramaPrior, pyramid: Pyramid | None = None) -> None:
        """Build the mesh of a keyframe.

        Args:
            prior: the keyframe.
            pyramid: image pyramid of its panorama; built here if None.
        """
        self.prior = prior
        self.pyramid = pyramid or Pyramid.of(prior.rgb)
        self._camera_from_map = np.linalg.inv(prior.map_from_camera).astype(np.float32)
        height, width = prior.inverse_depth.shape
        # An additional row above and below closes the mesh at the poles.
        self.inverse, self.known = (
            np.ascontiguousarray(np.concatenate([a[:1], a, a[-1:]])) for a in (prior.inverse_depth, prior.known)
        )
        none = np.zeros((1, width), np.uint8)
        # The quads of the last row reach down to the pole, where there is no depth edge.
        depth_edge = edge_quads(prior.inverse_depth, EDGE_RATIO)
        gone = prior.content != ROOM
        if gone.any():  # quads at the rim of removed pixels are rendered only at their remaining corners
            right = np.roll(gone, -1, 1)
            depth_edge[:-1] |= (gone | right)[:-1] | (gone | right)[1:]
            depth_edge[-1] = 0
            self.known[1:-1][gone] = 2
            self.known[[0, -1]] = self.known[[1, -2]]
            none = (self.known[[0]] == 2).astype(np.uint8)
        below = (self.known[[-1]] == 2).astype(np.uint8)
        self.depth_edge = np.concatenate([none, depth_edge[:-1], below, below])
        self._halves = _half_step_directions(width, height)
        self._directions = np.ascontiguousarray(self._halves[::2, ::2])
        self._vertices = np.empty((height + 2, width, 3), np.float32)
        self._outside = np.empty((height + 2, width), np.uint8)

    def render(self, map_from_camera: NDArray[np.floating], width: int, height: int, fov_rad: float) -> View:
        """Render a perspective view along the camera's x axis with the horizontal field of view ``fov_rad``.

        Confidence is 1 on surfaces that the panorama shows, 0.5 where their depth was filled, 0 elsewhere.

        Raises:
            ValueError: size or field of view cannot be rendered, or the pose is not finite.
        """
        check_size(width, height)
        rays = perspective_rays(checked_pose(map_from_camera), width, height, fov_rad)
        colour, depth, confidence = self.render_rays(rays)
        depth, confidence = depth.reshape(height, width), confidence.reshape(height, width)
        image = continue_unseen(colour.reshape(height, width, 3), depth, confidence)
        return View(to_8bit(image), depth, confidence)

    def render_rays(self, rays: Rays) -> tuple[Floats, Floats, Floats]:
        """Render the rays of a perspective view; return the same as ``field.Device.render_rays``.

        Pixels without confidence have no colour, unless no pixel has any confidence.
        """
        from instant_ic.vspace import warp_kernels

        map_from_view, half = pinhole(rays)
        view_from_camera = (np.linalg.inv(map_from_view) @ self.prior.map_from_camera).astype(np.float32)
        nearness = np.zeros(rays.shape, np.float32)
        marks = np.zeros(rays.shape, np.uint8)
        aspect = np.float32(rays.shape[0] / rays.shape[1])
        warp_kernels.place_vertices(
            self.inverse, self._directions, view_from_camera, half, aspect, self._vertices, self._outside
        )
        warp_kernels.render_mesh(
            self._vertices, self._outside, self.inverse, self.depth_edge, self.known, self._halves,
            view_from_camera, half, nearness, marks,
        )  # fmt: skip
        depth = np.zeros(len(rays.axial), np.float32)
        np.divide(1 / rays.axial, nearness.reshape(-1), out=depth, where=nearness.reshape(-1) > 0)
        confidence = np.array([0, 0.5, 1, 0], np.float32)[marks.reshape(-1)]
        colour = np.zeros((len(depth), 3), np.float32)
        # A view from behind all surfaces shows only their backs. Colours without confidence are better than black.
        wanted = confidence if confidence.any() else depth
        self.pyramid.look_up(self._camera_from_map, rays, depth, wanted, 1.0, colour)
        return colour, depth, confidence


def pinhole(rays: Rays) -> tuple[NDArray[np.float64], np.float32]:
    """Return pose (4, 4) and tangent of half the horizontal field of view of a perspective view from its rays."""
    height, width = rays.shape
    some = rays.some(np.array([0, width - 1, (height - 1) * width, height * width - 1]))
    corners = (some.directions / some.axial[:, None]).reshape(2, 2, 3).astype(np.float64)
    ahead = corners.mean(axis=(0, 1))
    left, up = (corners[:, 0] - corners[:, 1]).mean(axis=0), (corners[0] - corners[1]).mean(axis=0)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([axis / np.linalg.norm(axis) for axis in (ahead, left, up)], axis=1)
    pose[:3, 3] = rays.origin
    # The centres of the outermost pixels lie half a pixel inside the image's edge.
    return pose, np.float32(0.5 * np.linalg.norm(left) * width / (width - 1))


@functools.lru_cache(maxsize=2)  # keyframes rarely change their size
def _half_step_directions(width: int, height: int) -> NDArray[np.float32]:
    """Return unit directions at every half pixel, with an additional row above and below, (2 height + 3, 2 width, 3).

    Entry (2 v + 2, 2 u) is the direction of pixel (v, u). Rows beyond a pole contain the pole's direction.
    """
    azimuth = math.pi - (np.arange(2 * width) + 1) * (math.pi / width)
    elevation = math.pi / 2 - (np.arange(-2, 2 * height + 1) + 1) * (math.pi / (2 * height))
    return directions_at(azimuth, np.clip(elevation, -math.pi / 2, math.pi / 2))
