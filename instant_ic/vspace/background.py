"""A guess of the surfaces behind a keyframe's surfaces, shown where no keyframe has seen anything.

Behind each depth edge the farther surface is continued, in depth and in colour, once for each keyframe: floor and
ceiling as the level planes they are, all else upright, each in the colours of its own kind. It lies fixed
in the map, so that images of a moving camera agree with each other. The place under the robot is a continuation of
the ground round it. The sky is rendered here too, endlessly far.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import equirect_directions
from instant_ic.vspace.nerf.field import Floats, Rays
from instant_ic.vspace.prior import ROBOT, ROOM, SKY, PanoramaPrior, area_average, edge_quads, fill_holes
from instant_ic.vspace.warp import pinhole

REACH_RAD = 0.3
"""How far behind an edge the background is continued, as seen from the keyframe."""
GUESS_SHARE, GUESS_REACH = 0.6, 0.04
"""Of the guess in the image, reached so far (share of its width) inside of what is unseen: near what is seen the
image's own continuation is the better guess. Measured: benchmarks/keyframes.py."""
_NEARER = 0.12  # a surface is in front of another where its inverse depth is greater by this share
_ON_LEVEL = 0.1  # inverse depths within this share of the floor's or the ceiling's are on it
_BEHIND = 1.05  # a guess lies farther than what hides it by this factor
_STEEP, _ALIKE, _LEVEL_SHARE = 0.6, 0.04, 0.6  # beyond this sine of the elevation so many heights agree so far
_SKY_M = 1e4
_ROWS = 256  # of the images that the background is made in: it is smooth
_directions = functools.lru_cache(maxsize=2)(equirect_directions)  # a keyframe is as large as the one before


@dataclass(frozen=True)
class Background:
    """A keyframe's background as a mesh of some quads of a panorama.

    Attributes:
        inverse: inverse depth, (h, w) float32; rgb: (h, w, 3) uint8.
        guessed: the upper left pixels (row, column) of the quads that are guesses, (N, 2) int32.
        sky: of those that are sky.
        map_from_camera: pose, (4, 4).
    """

    inverse: Floats
    rgb: NDArray[np.uint8]
    guessed: NDArray[np.int32]
    sky: NDArray[np.int32]
    map_from_camera: NDArray[np.float64]

    @classmethod
    def of(cls, prior: PanoramaPrior) -> Background:
        """The background of a keyframe. Needs numba."""
        from instant_ic.vspace.background_kernels import in_front

        step = max(1, prior.inverse_depth.shape[0] // _ROWS)
        inverse = np.ascontiguousarray(prior.inverse_depth[::step, ::step])
        content = prior.content[::step, ::step]
        height, width = inverse.shape
        sky = content == SKY
        inverse[sky] = 1 / _SKY_M
        directions = equirect_directions(width, height)
        rise = np.einsum("ijk,k->ij", directions, prior.map_from_camera[2, :3]).astype(np.float32)
        levels = level_planes(inverse, rise, content == ROOM)
        kind = np.zeros(inverse.shape, np.uint8)  # 1 floor, 2 ceiling, 0 all else
        for number, level in enumerate(levels, 1):
            kind[(level > 0) & (np.abs(inverse - level) < _ON_LEVEL * level)] = number
        reach = max(1, round(REACH_RAD / (2 * math.pi / width)))
        steps = np.zeros(inverse.shape, np.int32)
        # Beyond the reach as much again of the near surface is no source of what is behind it.
        in_front(inverse, edge_quads(inverse, _NEARER), kind, 2 * reach, steps)
        removed = (content != ROOM) & ~sky
        hole = ((steps > 0) & (steps <= reach)) | removed
        # Nor is the far side's first pixel, which has a part of the near surface's colour.
        source = ~_grown((steps > 0) | removed)
        if not source.any():
            source = ~hole
        keep = source | (content == ROBOT)  # the ground under the robot is known, or filled in already
        weight = (1 / (inverse * inverse)).astype(
            np.float32
        )  # what is far goes on behind what is near, not the other way round
        # In a room with a floor or a ceiling walls stand upright: their distance along it is the same up and down.
        flat = np.sqrt(np.maximum(1 - rise * rise, np.float32(1e-4))) if np.any(levels) else np.ones_like(rise)
        wall = keep & (kind == 0)
        upright = fill_holes(np.where(wall, inverse / flat, 0).astype(np.float32), wall, weight) * flat
        planes = np.stack([upright, *levels])
        filled, own = planes.max(axis=0), planes.argmax(axis=0)
        rgb = area_average(prior.rgb, height, width) if prior.rgb.shape[:2] != inverse.shape else prior.rgb.copy()
        painted = rgb.copy()
        for number in range(3):  # each from its own kind
            here, there = hole & (own == number), source & (kind == number)
            if here.any():
                there = there if there.any() else source
                colours = fill_holes(np.where(there[..., None], rgb, 0).astype(np.float32), there, weight)
                painted[here] = np.rint(colours[here])
        behind = hole & ((filled < inverse / _BEHIND) | removed)
        inverse = np.where(hole, filled, inverse).astype(np.float32)
        whole = edge_quads(inverse, _NEARER)[:-1] == 0
        guessed = _any_corner(behind) & whole
        return cls(
            np.maximum(inverse, 1 / _SKY_M), painted, _places(guessed), _places(_any_corner(sky) & ~guessed & whole),
            prior.map_from_camera,
        )  # fmt: skip

    def draw(
        self, rays: Rays, gain: Floats, wanted: NDArray[np.bool_], picture: tuple[Floats, Floats, Floats]
    ) -> NDArray[np.bool_]:
        """Render the background into a perspective image.

        Args:
            rays: of the view; gain: (3,) factors of the colours.
            wanted: (P,) where nothing has been seen.
            image: in and out: colour (P, 3), depth (P,), confidence (P,), which is 1 on the sky, else left 0.

        Returns:
            Where something was rendered, (P,).
        """
        from instant_ic.vspace.background_kernels import draw_quads, paint

        map_from_view, half = pinhole(rays)
        view_from_camera = (np.linalg.inv(map_from_view) @ self.map_from_camera).astype(np.float32)
        nearness, marks = np.zeros(rays.shape, np.float32), np.zeros(rays.shape, np.uint8)
        height, width = self.inverse.shape
        directions = _directions(width, height)
        for mark, quads in ((1, self.guessed), (2, self.sky)):
            draw_quads(quads, mark, self.inverse, directions, view_from_camera, half, nearness, marks)
        drawn = wanted & (nearness.reshape(-1) > 0)
        colour, depth, confidence = picture
        depth[drawn] = 1 / (rays.axial[drawn] * nearness.reshape(-1)[drawn])
        camera_from_map = np.linalg.inv(self.map_from_camera).astype(np.float32)
        paint(self.rgb, camera_from_map, gain, rays.origin, rays.directions, drawn, depth, colour)
        confidence[drawn & (marks.reshape(-1) == 2)] = 1
        return np.asarray(drawn)


def mixed_in(image: Floats, guess: Floats, guessed: NDArray[np.bool_]) -> Floats:
    """Mix guesses (H, W, 3), where there are some (H, W), into an image (H, W, 3) continued from its seen parts."""
    from instant_ic.vspace.background_kernels import mix_guess

    mixed = image.copy()
    mix_guess(guess, guessed, max(1, round(GUESS_REACH * guessed.shape[1])), GUESS_SHARE, mixed)
    return mixed


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


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Dilate by one pixel; columns wrap."""
    mask = mask | np.roll(mask, 1, 1) | np.roll(mask, -1, 1)
    padded = np.pad(mask, ((1, 1), (0, 0)))
    return padded[:-2] | mask | padded[2:]


def _any_corner(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Of each quad, (h − 1, w)."""
    right = np.roll(mask, -1, 1)
    return (mask | right)[:-1] | (mask | right)[1:]


def _places(quads: NDArray[np.bool_]) -> NDArray[np.int32]:
    return np.argwhere(quads).astype(np.int32)
