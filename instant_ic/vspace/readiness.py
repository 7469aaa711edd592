"""Expected PSNR of a view, without its ground truth.

Two things make an image differ from the truth: the depth's error moves surfaces aside, and some have not been seen at
all. What a shift of some radians costs is read off the panorama itself: the mean squared difference between it and
itself turned by that angle. (The detail that a near surface lacks was tried as a third: the fit gave it no weight.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.image_quality import psnr_of_mse
from instant_ic.vspace.nerf.field import Floats, Rays
from instant_ic.vspace.prior import PanoramaPrior, area_average

_ROWS = 128
_TURNS = np.array([1, 2, 3, 5, 8, 13, 21, 34])
BASE_MSE = 8.8e-5
"""Error of a view at the keyframe's own pose, from sampling alone."""
SHIFT_GAIN, UNSEEN_GAIN = 0.76, 1.98
"""These three are fitted on simulated rooms: ``benchmarks/readiness.py --fit``."""


@dataclass(frozen=True)
class Texture:
    """``mse[i]``: mean squared difference (0..1 units) between a panorama and itself turned by ``angle_rad[i]``."""

    angle_rad: Floats
    mse: Floats
    variance: float

    @classmethod
    def of(cls, rgb: NDArray[np.uint8]) -> Texture:
        """Of a panorama (H, 2 H, 3), over the middle third of its rows, where a turn moves pixels by its own angle."""
        height = min(_ROWS, rgb.shape[0])
        small = area_average(rgb, height, 2 * height)[height // 3 : height - height // 3].astype(np.float32) / 255
        mse = [np.mean((small - np.roll(small, int(turn), 1)) ** 2) for turn in _TURNS]
        angles = np.concatenate([[0.0], _TURNS * (math.pi / height)])
        return cls(angles.astype(np.float32), np.array([0.0, *mse], np.float32), float(small.var(axis=(0, 1)).mean()))

    def cost(self, angle_rad: Floats) -> Floats:
        """Expected squared difference at shifts of so many radians."""
        return np.interp(angle_rad, self.angle_rad, self.mse).astype(np.float32)


def error_terms(
    priors: Sequence[PanoramaPrior], texture: Texture, rays: Rays, depth: Floats, confidence: Floats
) -> tuple[float, float]:
    """Squared errors (0..1 units) of a view from shifts and from unseen parts, before weighting.

    Args:
        priors: keyframes that the view is rendered from; a surface counts for the one that sees it most alike.
        texture: of the newest.
        rays, depth, confidence: the view, (P,) each, as rendered.
    """
    seen = confidence > 0
    unseen = float(1 - seen.mean())
    if not seen.any():
        return 0.0, unseen * texture.variance
    points = rays.origin + depth[seen, None] * rays.directions[seen]
    shift = np.full(len(points), np.inf, np.float32)
    for prior in priors:
        back = prior.map_from_camera[:3, 3].astype(np.float32) - points
        away = np.maximum(np.linalg.norm(back, axis=1), 1e-3)
        cosine = -np.einsum("ij,ij->i", back, rays.directions[seen]) / away
        ratio = away / np.maximum(depth[seen], 1e-3)
        sine = np.sqrt(np.clip(1 - cosine * cosine, 0, 1))
        shift = np.minimum(shift, float(np.median(prior.relative_sigma)) * ratio * sine)
    return (1 - unseen) * float(texture.cost(shift).mean()), unseen * texture.variance


def expected_psnr_db(terms: tuple[float, float], training_psnr_db: float, panorama_share: float) -> float:
    """PSNR from ``error_terms``; parts rendered by the field have at least its training error."""
    shift, unseen = terms
    training = 0.0 if panorama_share == 1 else (1 - panorama_share) * 10 ** (-training_psnr_db / 10)
    mse = BASE_MSE + SHIFT_GAIN * shift + UNSEEN_GAIN * unseen + training
    return psnr_of_mse(mse)
