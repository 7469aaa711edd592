"""Surfaces hidden behind the visible ones of a keyframe.

Gaps open at depth edges when the viewpoint moves. Once per keyframe, this module estimates what they show:

1. ``level_planes``: fit floor and ceiling, the horizontal planes on which most steep pixels agree.
2. ``_hidden_pixels``: mark the pixels behind each depth edge, up to ``reach_rad`` from it, and moved objects.
3. ``continuation.continued_walls``: continue floor, ceiling or the column's wall into them, in depth.
4. ``continuation.continued_colours``: colour them from the visible part of the same surface. ``seen_by`` then takes
   colours from older keyframes that saw the hidden surface.

The result is fixed in the map, so that views from different poses agree. The ground under the robot is hidden too and
is continued from the ground around it. Sky is placed at ``sky_m``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import rays_of
from instant_ic.vspace.continuation import continued_colours, continued_walls, grown
from instant_ic.vspace.nerf.field import Floats, Rays
from instant_ic.vspace.prior import ROOM, SKY, PanoramaPrior, area_average, edge_quads, fill_holes
from instant_ic.vspace.warp import pinhole


@dataclass(frozen=True)
class BackgroundConfig:
    """Tuning of the background; angles as seen from the keyframe's camera.

    Attributes:
        rows: rows of the images in which the background is computed; few suffice, because the background is smooth.
        reach_rad: largest distance from a depth edge at which hidden pixels are filled.
        edge_ratio: relative step of the inverse depth above which there is a depth edge; smaller steps are noise.
        on_plane: largest relative difference of inverse depths at which a pixel is on floor or ceiling.
        behind: factor by which a hidden surface must lie farther than the surface in front of it.
        steep: smallest sine of the elevation of the pixels to which floor and ceiling are fitted.
        plane_tolerance: largest relative difference of a pixel's height from a plane's that still counts as on it.
        plane_share: smallest share of the steep pixels that must lie on a plane.
        wall_rise: largest sine of the elevation of the pixels from which walls are found.
        same_surface: largest relative difference of depths at which an older keyframe has seen a hidden surface.
        sky_m: distance of the sky in metres.
    """

    rows: int = 256
    reach_rad: float = 0.35
    edge_ratio: float = 0.4
    on_plane: float = 0.1
    behind: float = 1.05
    steep: float = 0.6
    plane_tolerance: float = 0.04
    plane_share: float = 0.6
    wall_rise: float = 0.7
    same_surface: float = 0.08
    sky_m: float = 1e4


CONFIG = BackgroundConfig()
OTHER, FLOOR, CEILING, NOTHING = 0, 1, 2, 9
"""Kinds of pixels: walls and objects, floor, ceiling, and pixels without a surface of the room."""


@dataclass(frozen=True)
class Background:
    """Hidden surfaces of a keyframe, as a mesh over a panorama of (h, w) pixels.

    Attributes:
        inverse_depth: 1/m along each pixel's ray, (h, w) float32.
        rgb: colours, (h, w, 3) uint8.
        opacity: weight of the estimate when rendered, 0 to 255, (h, w) uint8; the renderer fills the rest from
            neighbouring pixels of the view.
        quads: upper left pixel (row, column) of each quad of estimated surface, (N, 2) int32.
        sky_quads: the same for sky, (M, 2) int32.
        map_from_camera: pose of the keyframe's camera, (4, 4) float64.
    """

    inverse_depth: Floats
    rgb: NDArray[np.uint8]
    opacity: NDArray[np.uint8]
    quads: NDArray[np.int32]
    sky_quads: NDArray[np.int32]
    map_from_camera: NDArray[np.float64]

    @classmethod
    def of(cls, prior: PanoramaPrior) -> Background:
        """Estimate the background of a keyframe."""
        step = max(1, prior.inverse_depth.shape[0] // CONFIG.rows)
        inverse = np.ascontiguousarray(prior.inverse_depth[::step, ::step])
        content = prior.content[::step, ::step]
        sky = content == SKY
        inverse[sky] = 1 / CONFIG.sky_m
        rise = np.einsum("ijk,k->ij", rays_of(inverse.shape), prior.map_from_camera[2, :3]).astype(np.float32)
        levels = level_planes(inverse, rise, content == ROOM)
        kind = np.full(inverse.shape, OTHER, np.uint8)
        for number, level in enumerate(levels, FLOOR):
            kind[(level > 0) & (np.abs(inverse - level) < CONFIG.on_plane * level)] = number
        edges = edge_quads(inverse, CONFIG.edge_ratio)
        removed = (content != ROOM) & ~sky
        hole = _hidden_pixels(inverse, edges, kind) | removed
        # With a floor or a ceiling, walls are vertical, so that a wall's horizontal distance is constant in a column.
        flat = np.sqrt(np.maximum(1 - rise * rise, np.float32(1e-4))) if np.any(levels) else np.ones_like(rise)
        kind[content != ROOM] = NOTHING
        walls = continued_walls(inverse / flat, (kind == OTHER) & (np.abs(rise) < CONFIG.wall_rise), hole)
        planes = np.stack([np.where(removed, 0, walls.found * flat), *levels])
        rgb = prior.rgb
        rgb = area_average(rgb, *inverse.shape) if rgb.shape[:2] != inverse.shape else rgb.copy()
        colours, opacity = continued_colours(rgb, planes, kind, grown(edges > 0), rise / flat, walls)
        filled = planes.max(axis=0)
        lost = removed & (filled <= 0)
        if lost.any():  # pixels on no plane are filled from their surroundings
            filled[lost] = fill_holes(np.where(hole, 0, inverse).astype(np.float32), ~hole)[lost]
            colours[lost] = np.rint(fill_holes(np.where(hole[..., None], 0, rgb).astype(np.float32), ~hole)[lost])
            opacity[lost] = 255
        behind = hole & (filled > 0) & ((filled < inverse / CONFIG.behind) | removed)
        inverse = np.where(hole, filled, inverse).astype(np.float32)
        whole = edge_quads(inverse, CONFIG.edge_ratio)[:-1] == 0
        estimated = _any_corner(behind) & whole
        return cls(
            np.maximum(inverse, 1 / CONFIG.sky_m), colours, np.where(sky, np.uint8(255), opacity), _places(estimated),
            _places(_any_corner(sky) & ~estimated & whole), prior.map_from_camera,
        )  # fmt: skip

    def seen_by(self, others: Sequence[tuple[PanoramaPrior, Floats]]) -> Background:
        """Return the background with the colours of other keyframes that have seen a part of it.

        If several keyframes have seen a surface, the one nearest to the surface counts, whatever their order.

        Args:
            others: keyframes, and the factors (3,) that bring their colours to this one's exposure.
        """
        if not others or not len(self.quads):
            return self
        height, width = self.inverse_depth.shape
        mask = np.zeros((height, width), bool)
        for down in (0, 1):
            for right in (0, 1):
                mask[np.minimum(self.quads[:, 0] + down, height - 1), (self.quads[:, 1] + right) % width] = True
        pose = self.map_from_camera.astype(np.float32)
        ways = rays_of(self.inverse_depth.shape)[mask] / self.inverse_depth[mask][:, None]
        points = np.einsum("ij,kj->ik", ways, pose[:3, :3]) + pose[:3, 3]
        rgb, opacity = self.rgb.copy(), self.opacity.copy()
        colours, opacities, nearest = rgb[mask], opacity[mask], np.full(len(points), np.inf, np.float32)
        for prior, gain in others:
            local = prior.in_camera(points)
            distance = np.sqrt(np.einsum("ij,ij->i", local, local))
            better = prior.sees(local, distance, CONFIG.same_surface) & (distance < nearest)
            colours[better] = np.rint(np.clip(prior.colours(local[better]) * gain, 0, 255))
            nearest[better], opacities[better] = distance[better], 255
        rgb[mask], opacity[mask] = colours, opacities
        return replace(self, rgb=rgb, opacity=opacity)

    def render_rays(self, rays: Rays, wanted: NDArray[np.bool_], view: tuple[Floats, Floats, Floats]) -> Floats:
        """Render the background into a perspective view.

        Args:
            rays: P rays of the view.
            wanted: mask of the pixels that no keyframe has seen, (P,).
            view: colour (P, 3), depth (P,) and confidence (P,); updated in place. Confidence becomes 1 on the sky.

        Returns:
            Weight of the estimate in the view, 0 to 1, (P,); 0 where nothing was rendered.
        """
        from instant_ic.vspace.background_kernels import colour_pixels, render_quads

        map_from_view, half = pinhole(rays)
        view_from_camera = (np.linalg.inv(map_from_view) @ self.map_from_camera).astype(np.float32)
        nearness, marks = np.zeros(rays.shape, np.float32), np.zeros(rays.shape, np.uint8)
        directions = rays_of(self.inverse_depth.shape)
        for mark, quads in ((1, self.quads), (2, self.sky_quads)):
            render_quads(quads, mark, self.inverse_depth, directions, view_from_camera, half, nearness, marks)
        rendered = wanted & (nearness.reshape(-1) > 0)
        colour, depth, confidence = view
        depth[rendered] = 1 / (rays.axial[rendered] * nearness.reshape(-1)[rendered])
        camera_from_map = np.linalg.inv(self.map_from_camera).astype(np.float32)
        share = np.zeros(len(depth), np.float32)
        colour_pixels(
            self.rgb, self.opacity, camera_from_map, rays.origin, rays.directions, rendered, depth, colour, share
        )
        confidence[rendered & (marks.reshape(-1) == 2)] = 1
        return share


def _hidden_pixels(inverse: Floats, edges: NDArray[np.uint8], kind: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the pixels near a depth edge whose surface hides a farther one, (h, w).

    Args:
        inverse: inverse depth, (h, w).
        edges: quads that cross a depth edge, (h, w).
        kind: kinds of the pixels, (h, w); floor and ceiling hide nothing.
    """
    from instant_ic.vspace.background_kernels import in_front

    reach = max(1, round(CONFIG.reach_rad / (2 * math.pi / inverse.shape[1])))
    steps = np.zeros(inverse.shape, np.int32)
    in_front(inverse, edges, kind, reach, steps)
    return steps > 0


def level_planes(inverse: Floats, rise: Floats, room: NDArray[np.bool_]) -> list[Floats]:
    """Fit floor and ceiling.

    Args:
        inverse: inverse depth, (h, w).
        rise: sine of the pixels' elevation in the map, (h, w).
        room: pixels whose depth belongs to the room, (h, w).

    Returns:
        Inverse depth of floor and ceiling at each pixel, (h, w) each; 0 where the ray misses the plane, or if no plane
        was found.
    """
    planes = []
    for side in (-1, 1):
        steep = (side * rise > CONFIG.steep) & room
        heights = rise[steep] / inverse[steep]
        height = float(np.median(heights)) if len(heights) else 0.0
        on_plane = np.abs(heights - height) < CONFIG.plane_tolerance * abs(height)
        flat = len(heights) > 0 and np.mean(on_plane) > CONFIG.plane_share
        planes.append(np.maximum(rise / height, 0).astype(np.float32) if flat else np.zeros_like(inverse))
    return planes


def _any_corner(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the quads with any corner in the mask, (h − 1, w)."""
    right = np.roll(mask, -1, 1)
    return (mask | right)[:-1] | (mask | right)[1:]


def _places(quads: NDArray[np.bool_]) -> NDArray[np.int32]:
    return np.argwhere(quads).astype(np.int32)
