"""Truth of ``ic evaluate illusion``: the world with an obstacle and without it, and how far an image is from it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.teleop_worlds import Obstacle
from instant_ic.geometry.image_quality import psnr_db, ssim
from instant_ic.geometry.projections import perspective_directions

if TYPE_CHECKING:
    from instant_ic.sim.contact import OccupancyMask
    from instant_ic.sim.render import RenderedFrame
    from instant_ic.sim.world import World

FloatArray: TypeAlias = NDArray[np.float64]

ASIDE_M = 0.8
"""Largest distance of an obstacle's centre from the v-bot's line at which it blocks the v-bot's way."""
OBJECT_M, WALL_M = (0.03, 1.6), (1.9, 2.2)
"""Heights in which an object has surfaces, and in which only walls have."""
_CELL_M = 0.05
_AWAY_M = 1000.0
_FLOOR_M = 0.03
_WALL_FROM_M, _WALL_TO_M = 0.3, 2.0
_BLUR = 9


def corners(obstacle: Obstacle) -> FloatArray:
    """Return the corners (4, 2) of an obstacle's outline."""
    along = np.array([math.cos(obstacle.yaw), math.sin(obstacle.yaw)])
    across = np.array([-along[1], along[0]])
    signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
    half = np.stack([0.5 * obstacle.length * along, 0.5 * obstacle.width * across])
    return np.array([obstacle.x, obstacle.y]) + signs @ half


@dataclass(frozen=True)
class Passage:
    """The v-bot's way through obstacles: the line from its position (2,) when it takes over along a unit vector (2,).

    ``obstacles`` are those in the way, nearest first, each with the position of its near face along the line, metres.
    """

    start: FloatArray
    heading: FloatArray
    obstacles: tuple[tuple[float, Obstacle], ...]

    @classmethod
    def of(cls, pose: FloatArray, obstacles: Sequence[Obstacle]) -> Passage:
        """Return the passage that begins at pose (3,)."""
        start, heading = np.asarray(pose[:2], np.float64), np.array([math.cos(pose[2]), math.sin(pose[2])])
        left = np.array([-heading[1], heading[0]])
        ahead = []
        for one in obstacles:
            outline = corners(one) - start
            near, far = float((outline @ heading).min()), float((outline @ heading).max())
            if far > 0 and abs(float((outline @ left).mean())) < ASIDE_M:
                ahead.append((near, one))
        return cls(start, heading, tuple(sorted(ahead, key=lambda each: each[0])))

    def obstacle_at(self, place: FloatArray) -> tuple[float, Obstacle] | None:
        """Return how far a position (2,) lies behind the near face of the passed obstacle, and that obstacle.

        The obstacle is the last one whose near face lies behind the position, else the first one; None without any.
        """
        if not self.obstacles:
            return None
        along = float((np.asarray(place) - self.start) @ self.heading)
        passed = [each for each in self.obstacles if each[0] <= along]
        near, obstacle = passed[-1] if passed else self.obstacles[0]
        return along - near, obstacle


def things(world: World) -> tuple[NDArray[np.int32], OccupancyMask, NDArray[np.int32]]:
    """Find the free-standing objects of a world.

    An object is what is connected in the floor plan of ``OBJECT_M`` without the walls. Its surfaces lie in its cells
    completely, above the floor and below ``OBJECT_M``. Posters and skirting boards lie on a wall and are no objects.

    Returns:
        Number of the object of each surface, (S,), 0 for none; the floor plan; the number of the object of each cell.
    """
    plan, walls = (world.occupied(low, high, _CELL_M) for low, high in (OBJECT_M, WALL_M))
    beside_walls = cv2.dilate(walls.cells.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    _, labels = cv2.connectedComponents((plan.cells & ~beside_walls).astype(np.uint8), connectivity=8)
    around = cv2.dilate(labels.astype(np.float32), np.ones((5, 5), np.uint8)).astype(np.int32)
    vertices = world.vertices.reshape(len(world.normal), -1, 3)
    row, column = plan.index(world.vertices[:, :2]).T
    inside = (row >= 0) & (row < around.shape[0]) & (column >= 0) & (column < around.shape[1])
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    own = np.where(inside, around[row, column], 0).reshape(vertices.shape[:2])
    on_wall = (inside & beside_walls[row, column]).reshape(own.shape).all(axis=1)
    high = vertices[..., 2].max(axis=1)
    # A box's sides begin on the floor; the floor itself does not rise.
    whole = (own == own[:, :1]).all(axis=1) & (high > 0.01) & (high < WALL_M[0]) & ~on_wall
    return np.where(whole, own[:, 0], 0), plan, labels


def moved_by(world: World, surfaces: NDArray[np.bool_], shift_m: FloatArray) -> World:
    """Return the world with surfaces (S,) displaced by (3,) metres, together with their texture and light."""
    changed = {name: getattr(world, name).copy() for name in ("vertices", "offset", "uv", "light_uv", "light_linear")}
    by = shift_m.astype(np.float32)
    changed["vertices"].reshape(len(world.normal), -1, 3)[surfaces] += by
    changed["offset"][surfaces] += world.normal[surfaces] @ by
    for name in ("uv", "light_uv", "light_linear"):
        changed[name][surfaces, ..., 3] -= changed[name][surfaces, ..., :3] @ by
    return replace(world, **changed)


def without(world: World, obstacle: Obstacle) -> World:
    """Return the world without the object that stands at an obstacle's place; its shadow remains."""
    owner, plan, labels = things(world)
    outline = np.fliplr(plan.index(corners(obstacle))).astype(np.int32)
    place = cv2.dilate(cv2.fillConvexPoly(np.zeros(labels.shape, np.uint8), outline, 1), np.ones((3, 3), np.uint8))
    found = np.setdiff1d(np.unique(labels[place > 0]), [0])
    return moved_by(world, np.isin(owner, found), np.array([0.0, 0.0, -_AWAY_M]))


@dataclass(frozen=True)
class Score:
    """Distance of a shown image from the truth.

    Attributes:
        psnr_db, ssim: over the whole image.
        fog: pixels whose true surface is floor and whose colour is nearer to the walls'.
        floor: pixels whose true surface is floor.
    """

    psnr_db: float
    ssim: float
    fog: int
    floor: int


def score(
    shown: NDArray[np.uint8],
    truth: RenderedFrame,
    world_from_camera: FloatArray,
    fov_rad: float,
    with_ssim: bool = True,
) -> Score:
    """Compare a shown image (H, W, 3) with the true one, perspective along the camera's x."""
    floor, wall = surfaces(truth, world_from_camera, fov_rad)
    fog = fog_pixels(shown, truth.rgb, floor, wall)
    similarity = ssim(shown, truth.rgb) if with_ssim else math.nan
    return Score(psnr_db(shown, truth.rgb), similarity, int(np.count_nonzero(fog)), int(np.count_nonzero(floor)))


def surfaces(
    truth: RenderedFrame, world_from_camera: FloatArray, fov_rad: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the pixels of the floor, and of walls and objects up to 2 m, (H, W) each, by their height."""
    height, width = truth.depth_m.shape
    directions = perspective_directions(width, height, fov_rad)
    up = directions @ world_from_camera[2, :3].astype(np.float32) / np.linalg.norm(directions, axis=2)
    z = float(world_from_camera[2, 3]) + truth.depth_m * up
    met = truth.depth_m > 0
    return met & (z < _FLOOR_M), met & (z > _WALL_FROM_M) & (z < _WALL_TO_M)


def fog_pixels(
    shown: NDArray[np.uint8], true: NDArray[np.uint8], floor: NDArray[np.bool_], wall: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return the floor pixels whose shown colour is further from the floor's than from the wall's, (H, W).

    The floor's colour is the truth's around the pixel (mean of 9 × 9 floor pixels, so that texture does not count), the
    wall's is the median of the truth's wall pixels.
    """
    if not floor.any() or not wall.any():
        return np.zeros(floor.shape, bool)
    weight = floor.astype(np.float32)
    total = np.maximum(cv2.blur(weight, (_BLUR, _BLUR)), 1e-6)[..., None]
    ours, theirs = (
        cv2.blur(image.astype(np.float32) * weight[..., None], (_BLUR, _BLUR)) / total for image in (shown, true)
    )
    of_wall = np.median(true[wall], axis=0).astype(np.float32)
    nearer = np.linalg.norm(ours - of_wall, axis=2) < np.linalg.norm(ours - theirs, axis=2)
    return floor & nearer
