"""A guess of the surfaces behind a keyframe's surfaces, shown where no keyframe has seen anything.

Behind each depth edge floor, ceiling and walls are continued, in depth and in colour, once for each keyframe
(``continuation``). The guess lies fixed in the map, so that images of a moving camera agree with each other. The place
under the robot is a continuation of the ground around it. The sky is rendered here too, infinitely far.
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

REACH_RAD = 0.35
"""How far behind an edge the background is continued, as seen from the keyframe."""
_NEARER = 0.4  # a surface is in front of another where its inverse depth is greater by this share; less is noise
_ON_LEVEL = 0.1  # inverse depths within this share of the floor's or the ceiling's are on it
_BEHIND = 1.05  # a guess lies farther than what hides it by this factor
_STEEP, _ALIKE, _LEVEL_SHARE = 0.6, 0.04, 0.6  # beyond this sine of the elevation so many heights agree so far
_NOTHING = 9  # kind of what is no surface of the place
_WALL_RISE = 0.7  # sine of the elevation up to which an upright surface says how far walls are
_SEEN = 0.08  # depths within this share of a guess's are of its surface
_SKY_M = 1e4
_ROWS = 256  # of the images that the background is made in: it is smooth


@dataclass(frozen=True)
class Background:
    """A keyframe's background as a mesh of some quads of a panorama.

    Attributes:
        inverse: inverse depth, (h, w) float32; rgb: (h, w, 3) uint8.
        sure: share that a guess has in an image, (h, w) uint8 of 255; the rest is continued from around in the image.
        guessed: the upper left pixels (row, column) of the quads that are guesses, (N, 2) int32.
        sky: of those that are sky.
        map_from_camera: pose, (4, 4).
    """

    inverse: Floats
    rgb: NDArray[np.uint8]
    sure: NDArray[np.uint8]
    guessed: NDArray[np.int32]
    sky: NDArray[np.int32]
    map_from_camera: NDArray[np.float64]

    @classmethod
    def of(cls, prior: PanoramaPrior) -> Background:
        """The background of a keyframe."""
        from instant_ic.vspace.background_kernels import in_front

        step = max(1, prior.inverse_depth.shape[0] // _ROWS)
        inverse = np.ascontiguousarray(prior.inverse_depth[::step, ::step])
        content = prior.content[::step, ::step]
        height, width = inverse.shape
        sky = content == SKY
        inverse[sky] = 1 / _SKY_M
        directions = rays_of(inverse.shape)
        rise = np.einsum("ijk,k->ij", directions, prior.map_from_camera[2, :3]).astype(np.float32)
        levels = level_planes(inverse, rise, content == ROOM)
        kind = np.zeros(inverse.shape, np.uint8)  # 1 floor, 2 ceiling, 0 all else
        for number, level in enumerate(levels, 1):
            kind[(level > 0) & (np.abs(inverse - level) < _ON_LEVEL * level)] = number
        reach = max(1, round(REACH_RAD / (2 * math.pi / width)))
        steps = np.zeros(inverse.shape, np.int32)
        edges = edge_quads(inverse, _NEARER)
        in_front(inverse, edges, kind, reach, steps)
        removed = (content != ROOM) & ~sky
        hole = (steps > 0) | removed
        # In a room with a floor or a ceiling walls stand upright: their distance along it is the same up and down.
        flat = np.sqrt(np.maximum(1 - rise * rise, np.float32(1e-4))) if np.any(levels) else np.ones_like(rise)
        upright = inverse / flat
        kind[content != ROOM] = _NOTHING
        far, found = continued_walls(upright, (kind == 0) & (np.abs(rise) < _WALL_RISE), hole)
        planes = np.stack([np.where(removed, 0, found * flat), *levels])
        rgb = area_average(prior.rgb, height, width) if prior.rgb.shape[:2] != inverse.shape else prior.rgb.copy()
        painted, sure = continued_colours(rgb, planes, kind, grown(edges > 0), hole, upright, rise / flat, far, found)
        filled = planes.max(axis=0)
        lost = removed & (filled <= 0)
        if lost.any():  # in no plane: from around
            filled[lost] = fill_holes(np.where(hole, 0, inverse).astype(np.float32), ~hole)[lost]
            painted[lost] = np.rint(fill_holes(np.where(hole[..., None], 0, rgb).astype(np.float32), ~hole)[lost])
            sure[lost] = 255
        behind = hole & (filled > 0) & ((filled < inverse / _BEHIND) | removed)
        inverse = np.where(hole, filled, inverse).astype(np.float32)
        whole = edge_quads(inverse, _NEARER)[:-1] == 0
        guessed = _any_corner(behind) & whole
        return cls(
            np.maximum(inverse, 1 / _SKY_M), painted, np.where(sky, np.uint8(255), sure), _places(guessed),
            _places(_any_corner(sky) & ~guessed & whole), prior.map_from_camera,
        )  # fmt: skip

    def seen_by(self, others: Sequence[tuple[PanoramaPrior, Floats]]) -> Background:
        """The background with the pixels of other keyframes that have seen places of it.

        Of those that have, the nearest to the place counts, whatever their order.

        Args:
            others: keyframes, and the factors (3,) that bring their colours to this one's.
        """
        if not others or not len(self.guessed):
            return self
        height, width = self.inverse.shape
        mask = np.zeros((height, width), bool)
        for down in (0, 1):
            for right in (0, 1):
                mask[np.minimum(self.guessed[:, 0] + down, height - 1), (self.guessed[:, 1] + right) % width] = True
        pose = self.map_from_camera.astype(np.float32)
        ways = rays_of(self.inverse.shape)[mask] / self.inverse[mask][:, None]
        points = np.einsum("ij,kj->ik", ways, pose[:3, :3]) + pose[:3, 3]
        rgb, sure = self.rgb.copy(), self.sure.copy()
        colours, sures, nearest = rgb[mask], sure[mask], np.full(len(points), np.inf, np.float32)
        for prior, gain in others:
            local = prior.in_camera(points)
            distance = np.sqrt(np.einsum("ij,ij->i", local, local))
            better = prior.sees(local, distance, _SEEN) & (distance < nearest)
            colours[better] = np.rint(np.clip(prior.colours(local[better]) * gain, 0, 255))
            nearest[better], sures[better] = distance[better], 255
        rgb[mask], sure[mask] = colours, sures
        return replace(self, rgb=rgb, sure=sure)

    def draw(self, rays: Rays, wanted: NDArray[np.bool_], view: tuple[Floats, Floats, Floats]) -> Floats:
        """Render the background into a perspective view.

        Args:
            rays: P rays of the view.
            wanted: pixels that no keyframe has seen, (P,).
            view: colour (P, 3), depth (P,) and confidence (P,), updated in place; confidence becomes 1 on the sky.

        Returns:
            Weight of the estimate in the view, 0 to 1, (P,); 0 where nothing was rendered.
        """
        from instant_ic.vspace.background_kernels import draw_quads, paint

        map_from_view, half = pinhole(rays)
        view_from_camera = (np.linalg.inv(map_from_view) @ self.map_from_camera).astype(np.float32)
        nearness, marks = np.zeros(rays.shape, np.float32), np.zeros(rays.shape, np.uint8)
        directions = rays_of(self.inverse.shape)
        for mark, quads in ((1, self.guessed), (2, self.sky)):
            draw_quads(quads, mark, self.inverse, directions, view_from_camera, half, nearness, marks)
        drawn = wanted & (nearness.reshape(-1) > 0)
        colour, depth, confidence = view
        depth[drawn] = 1 / (rays.axial[drawn] * nearness.reshape(-1)[drawn])
        camera_from_map = np.linalg.inv(self.map_from_camera).astype(np.float32)
        share = np.zeros(len(depth), np.float32)
        paint(self.rgb, self.sure, camera_from_map, rays.origin, rays.directions, drawn, depth, colour, share)
        confidence[drawn & (marks.reshape(-1) == 2)] = 1
        return share


def level_planes(inverse: Floats, rise: Floats, room: NDArray[np.bool_]) -> list[Floats]:
    """Inverse depth of the floor and of the ceiling at each pixel, (h, w) each, 0 where it is not met or there is none.

    Args:
        inverse: inverse depth, (h, w); rise: sine of the pixels' elevation in the map, (h, w).
        room: (h, w) where the depth is of the place.
    """
    planes = []
    for side in (-1, 1):
        steep = (side * rise > _STEEP) & room
        heights = rise[steep] / inverse[steep]
        height = float(np.median(heights)) if len(heights) else 0.0
        flat = len(heights) > 0 and np.mean(np.abs(heights - height) < _ALIKE * abs(height)) > _LEVEL_SHARE
        planes.append(np.maximum(rise / height, 0).astype(np.float32) if flat else np.zeros_like(inverse))
    return planes


def _any_corner(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Of each quad, (h − 1, w)."""
    right = np.roll(mask, -1, 1)
    return (mask | right)[:-1] | (mask | right)[1:]


def _places(quads: NDArray[np.bool_]) -> NDArray[np.int32]:
    return np.argwhere(quads).astype(np.int32)
