"""Truth of ``ic evaluate illusion``: the obstacle that is passed, and the distance of an image from the true one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.worlds import Obstacle
from instant_ic.geometry.image_quality import psnr_db, ssim
from instant_ic.geometry.projections import perspective_directions

if TYPE_CHECKING:
    from instant_ic.sim.render import RenderedFrame

FloatArray: TypeAlias = NDArray[np.float64]

ASIDE_M = 0.8
"""Largest distance of an obstacle's centre from the v-bot's line at which it blocks the v-bot's way."""
_FLOOR_M = 0.03
_WALL_FROM_M, _WALL_TO_M = 0.3, 2.0
_BLUR = 9


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
            outline = one.corners() - start
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
