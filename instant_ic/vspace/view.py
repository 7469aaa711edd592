"""Views of the space and the rays of each projection."""

from __future__ import annotations

import abc
import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import equirect_directions, perspective_directions
from instant_ic.vspace.nerf.field import Floats, Rays
from instant_ic.vspace.prior import fill_holes

MIN_VIEW, MAX_VIEW = 16, 4096
"""Smallest and largest side of a view in pixels."""
_SOFT, _SOFT_EDGE = 16, 7
"""Width in pixels of the blur in estimated parts, and of the transition to them."""
_GREY = np.array([0.30, 0.59, 0.11], np.float32)
_STRIDE_RAD = 0.025
"""Angle in an equirect image within which the inverse depth of a plane is approximately linear."""


@dataclass(frozen=True)
class View:
    """An image of the space.

    Attributes:
        rgb: image, (H, W, 3) uint8; unknown parts are filled from their surroundings.
        depth_m: metres along each ray, (H, W); 0 where the ray hits nothing.
        confidence: 1 on surfaces that a keyframe has seen, 0.5 where their depth was filled, 0 elsewhere, (H, W).
        projection: ``perspective`` or ``equirect``.
        expected_psnr_db: estimated PSNR of the image (``readiness``).
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    confidence: NDArray[np.float32]
    projection: str = "perspective"
    expected_psnr_db: float = math.nan

    @property
    def unseen_share(self) -> float:
        """Share of the pixels that no keyframe has seen, 0 to 1."""
        return float(np.count_nonzero(self.confidence == 0)) / self.confidence.size

    @property
    def mean_confidence(self) -> float:
        """Mean confidence over the image, weighted by solid angle in an equirect image."""
        if self.projection != "equirect":
            return float(self.confidence.mean())
        height = self.confidence.shape[0]
        weight = np.sin((np.arange(height) + 0.5) * (math.pi / height))
        return float(self.confidence.mean(axis=1) @ weight / weight.sum())

    def softened(self) -> NDArray[np.uint8]:
        """Return the image for people, (H, W, 3), in which estimated parts are blurred and paler."""
        import cv2

        if (self.confidence >= 1).all():
            return self.rgb
        height, width = self.confidence.shape
        edge = np.ones((_SOFT_EDGE, _SOFT_EDGE))
        seen = cv2.blur(cv2.erode(np.asarray(self.confidence, np.float32), edge), edge.shape)[..., None]
        rgb = self.rgb.astype(np.float32)
        small = cv2.resize(rgb, (max(width // _SOFT, 1), max(height // _SOFT, 1)), interpolation=cv2.INTER_AREA)
        soft = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
        pale = 0.5 * (soft + (soft @ _GREY)[..., None])
        return np.asarray(np.rint(pale + seen * (rgb - pale)), np.uint8)


def check_size(width: int, height: int) -> None:
    """Raise ValueError if a view is too small or too large to render."""
    if not (MIN_VIEW <= width <= MAX_VIEW and MIN_VIEW <= height <= MAX_VIEW):
        raise ValueError(f"view must have {MIN_VIEW} to {MAX_VIEW} pixels per side (got {width} x {height})")


def checked_pose(map_from_camera: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the pose as float64. Raise ValueError if it is not a finite (4, 4) matrix."""
    pose = np.asarray(map_from_camera, np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError("pose of the view must be a finite 4x4 matrix")
    return pose


@functools.lru_cache(maxsize=2)
def _perspective(width: int, height: int, fov_rad: float) -> tuple[Floats, Floats]:
    directions = perspective_directions(width, height, fov_rad).reshape(-1, 3)
    axial = 1 / np.linalg.norm(directions, axis=1)
    return np.asfortranarray(directions * axial[:, None]), axial


@functools.lru_cache(maxsize=1)
def _equirect(width: int, height: int) -> tuple[Floats, Floats]:
    directions = equirect_directions(width, height).reshape(-1, 3)
    return np.asfortranarray(directions), np.ones(width * height, np.float32)


class LensRays(Rays):
    """Rays of a lens that are rotated into the map on demand, because a GPU rotates them itself.

    Attributes:
        lens: unit vectors in the camera's frame, (P, 3) in Fortran order; images of one size and projection share the
            array.
        turn: map_from_camera rotation, (3, 3) float32.
    """

    lens: Floats
    turn: Floats

    def __init__(self, pose: NDArray[np.float64], lens: Floats, axial: Floats, shape: tuple[int, int], stride: int):
        turn, origin = pose[:3, :3].astype(np.float32), pose[:3, 3].astype(np.float32)
        # Attributes of a frozen dataclass cannot be assigned.
        vars(self).update(origin=origin, axial=axial, shape=shape, stride=stride, lens=lens, turn=turn)

    @functools.cached_property
    def directions(self) -> Floats:
        return _turned(self.lens, self.turn)

    def some(self, chosen: NDArray[np.integer]) -> Rays:
        return Rays(self.origin, _turned(self.lens[chosen], self.turn), self.axial[chosen], (len(chosen), 1))


def _turned(directions: Floats, turn: Floats) -> Floats:
    # einsum instead of matmul, because BLAS would start threads that wait ten times as long as they compute. With the
    # coordinate as the first axis, einsum is four times as fast.
    return np.ascontiguousarray(np.einsum("jp,ij->ip", directions.T, turn).T)


def perspective_rays(pose: NDArray[np.float64], width: int, height: int, fov_rad: float) -> Rays:
    """Return the rays of a pinhole image along the camera's x axis."""
    return LensRays(pose, *_perspective(width, height, round(fov_rad, 6)), (height, width), 4)


def equirect_rays(pose: NDArray[np.float64], width: int) -> Rays:
    """Return the rays of a panorama, ``width`` × ``width / 2``."""
    pixels = _STRIDE_RAD / (2 * math.pi / width)
    stride = 4 if pixels >= 4 else 2 if pixels >= 2 else 1
    return LensRays(pose, *_equirect(width, width // 2), (width // 2, width), stride)


def continue_unseen(image: Floats, depth_m: Floats, confidence: Floats, wraps: bool = False) -> Floats:
    """Fill unknown pixels from their surroundings, mostly from the far side, because gaps open behind near surfaces.

    Args:
        image: image, (H, W, 3).
        depth_m: depth, (H, W).
        confidence: confidence, (H, W); 0 is unknown.
        wraps: True if the left edge borders on the right edge, as in a panorama.
    """
    seen = confidence > 0
    if seen.all() or not seen.any():  # nothing to fill, or nothing to fill it from
        return image
    if not wraps:
        return fill_holes(image, seen, weight=depth_m * depth_m)
    width = image.shape[1]
    side = width // 4
    around = np.r_[width - side : width, 0:width, 0:side]
    return continue_unseen(image[:, around], depth_m[:, around], confidence[:, around])[:, side : side + width]


def to_8bit(image: Floats) -> NDArray[np.uint8]:
    """Convert an image of values 0 to 1 to 8 bit."""
    return np.rint(np.clip(image, 0, 1) * np.float32(255)).astype(np.uint8)


class RayRenderer(abc.ABC):
    """Base of spaces that are rendered ray by ray, with their views in each projection."""

    @abc.abstractmethod
    def _view(self, rays: Rays, projection: str) -> View:
        """Render rays of shape (H, W). Unknown parts are filled from their surroundings."""

    def render(self, map_from_camera: NDArray[np.floating], width: int, height: int, fov_rad: float) -> View:
        """Render a perspective view along the camera's x axis with the horizontal field of view ``fov_rad``.

        Raises:
            NotReadyError: the space needs a keyframe and has none yet.
            ValueError: size or field of view cannot be rendered, or the pose is not finite.
        """
        check_size(width, height)
        return self._view(perspective_rays(checked_pose(map_from_camera), width, height, fov_rad), "perspective")

    def render_equirect(self, map_from_camera: NDArray[np.floating], width: int) -> View:
        """Render a panorama of ``width`` × ``width / 2`` pixels. Raises the same errors as ``render``."""
        check_size(width, width // 2)
        if width % 2:
            raise ValueError(f"a panorama's width must be even (got {width})")
        return self._view(equirect_rays(checked_pose(map_from_camera), width), "equirect")
