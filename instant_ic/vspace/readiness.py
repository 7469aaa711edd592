"""Expected PSNR of a view, without its ground truth.

Three things make the image on the operator's page differ from the truth: the page itself (size of the view, JPEG,
magnification), the depth's error, which moves surfaces aside, and places that have not been seen at all. The cost of a
shift is read off the panorama: the mean squared difference between it and itself turned by that angle. The gains are
fitted to live frames (``benchmarks/readiness.py``). Tried without gain on other worlds: detail that near surfaces lack,
the panorama's finest detail, the view's own detail, the share of filled depth, depth edges by parallax, and how well
the warp renders older keyframes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.image_quality import psnr_of_mse
from instant_ic.geometry.projections import nearest_pixels
from instant_ic.vspace.nerf.field import Floats, Rays
from instant_ic.vspace.prior import PanoramaPrior, area_average

_ROWS, _ROW_STEP = 512, 4
_TURNS = np.array([1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144])
BASE_MSE = 0.6e-3
"""Error of a view at the keyframe's own pose, as the page shows it."""
SHIFT_GAIN, UNSEEN_GAIN = 1.0, 1.65


@dataclass(frozen=True)
class Texture:
    """``mse[i]``: mean squared difference (0..1 units) between a panorama and itself turned by ``angle_rad[i]``."""

    angle_rad: Floats
    mse: Floats
    variance: float

    @classmethod
    def of(cls, rgb: NDArray[np.uint8]) -> Texture:
        """Measure a panorama (H, 2 H, 3), in its middle third, where a turn moves pixels by its own angle."""
        height, whole = min(_ROWS, rgb.shape[0]), rgb.shape[0]
        band = rgb[whole // 3 : whole - whole // 3]
        averaged = area_average(band, max(1, round(len(band) * height / whole)), 2 * height)
        small = averaged[::_ROW_STEP].astype(np.float32) / 255
        mse = [np.mean((small - np.roll(small, int(turn), 1)) ** 2) for turn in _TURNS]
        angles = np.concatenate([[0.0], _TURNS * (math.pi / height)])
        return cls(angles.astype(np.float32), np.array([0.0, *mse], np.float32), float(small.var(axis=(0, 1)).mean()))

    def cost(self, angle_rad: Floats) -> Floats:
        """Return the expected squared difference at shifts in radians."""
        return np.interp(angle_rad, self.angle_rad, self.mse).astype(np.float32)


def error_terms(
    prior: PanoramaPrior, texture: Texture, rays: Rays, depth: Floats, confidence: Floats
) -> tuple[float, float]:
    """Return the squared errors (0 to 1 units) of a view from shifts and from unseen parts, before weighting.

    Args:
        prior: keyframe that the view is rendered from, with each pixel's sigma.
        texture: texture of its panorama.
        rays: P rays of the view.
        depth: metres along the rays as rendered, (P,).
        confidence: confidence as rendered, (P,); 0 is unseen.
    """
    seen = confidence > 0
    unseen = float(1 - seen.mean())
    if not seen.any():
        return 0.0, unseen * texture.variance
    points = rays.origin + depth[seen, None] * rays.directions[seen]
    back = prior.map_from_camera[:3, 3].astype(np.float32) - points
    away = np.maximum(np.linalg.norm(back, axis=1), 1e-3)
    cosine = -np.einsum("ij,ij->i", back, rays.directions[seen]) / away
    ratio = away / np.maximum(depth[seen], 1e-3)
    sine = np.sqrt(np.clip(1 - cosine * cosine, 0, 1))
    height, width = prior.sigma.shape
    sigma = prior.sigma[nearest_pixels(prior.in_camera(points), width, height)]
    shift = (sigma * ratio * sine).astype(np.float32)
    return (1 - unseen) * float(texture.cost(shift).mean()), unseen * texture.variance


def expected_psnr_db(terms: tuple[float, float], training_psnr_db: float, panorama_share: float) -> float:
    """Return the PSNR on the page from ``error_terms``; the field's parts have at least its training error."""
    shift, unseen = terms
    training = 0.0 if panorama_share == 1 else (1 - panorama_share) * 10 ** (-training_psnr_db / 10)
    mse = BASE_MSE + SHIFT_GAIN * shift + UNSEEN_GAIN * unseen + training
    return psnr_of_mse(mse)
