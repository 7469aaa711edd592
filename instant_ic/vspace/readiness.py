"""Expected PSNR of a view, without its ground truth.

The image on the operator's page differs from the truth for three reasons: the page itself (size of the view, JPEG,
magnification), errors of the depth, which shift surfaces, and unseen parts. The cost of a shift is measured on the
panorama, as the mean squared difference between the panorama and a copy rotated by that angle. The weights are fitted
to live frames (``benchmarks/readiness.py``). The following did not improve the estimate on other worlds: missing detail
of near surfaces, the panorama's finest detail, the view's own detail, the share of filled depth, depth edges weighted
by parallax, and the warp's error on older keyframes.
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
"""Mean squared error of a view at the keyframe's pose, as shown on the page."""
SHIFT_GAIN, UNSEEN_GAIN = 1.0, 1.65


@dataclass(frozen=True)
class Texture:
    """A panorama's texture: mean squared difference ``mse[i]`` (0 to 1) to a copy rotated by ``angle_rad[i]``."""

    angle_rad: Floats
    mse: Floats
    variance: float

    @classmethod
    def of(cls, rgb: NDArray[np.uint8]) -> Texture:
        """Measure the middle third of a panorama (H, 2 H, 3), where a rotation shifts pixels by nearly its angle."""
        height, whole = min(_ROWS, rgb.shape[0]), rgb.shape[0]
        band = rgb[whole // 3 : whole - whole // 3]
        averaged = area_average(band, max(1, round(len(band) * height / whole)), 2 * height)
        small = averaged[::_ROW_STEP].astype(np.float32) / 255
        mse = [np.mean((small - np.roll(small, int(turn), 1)) ** 2) for turn in _TURNS]
        angles = np.concatenate([[0.0], _TURNS * (math.pi / height)])
        return cls(angles.astype(np.float32), np.array([0.0, *mse], np.float32), float(small.var(axis=(0, 1)).mean()))

    def cost(self, angle_rad: Floats) -> Floats:
        """Return the expected mean squared difference for shifts in radians."""
        return np.interp(angle_rad, self.angle_rad, self.mse).astype(np.float32)


def error_terms(
    prior: PanoramaPrior, texture: Texture, rays: Rays, depth: Floats, confidence: Floats
) -> tuple[float, float]:
    """Return the squared errors (colours 0 to 1) of a view from shifts and from unseen parts, before weighting.

    Args:
        prior: keyframe from which the view is rendered.
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
    """Return the PSNR on the page for ``error_terms``. Parts shown by the field have at least its training error."""
    shift, unseen = terms
    training = 0.0 if panorama_share == 1 else (1 - panorama_share) * 10 ** (-training_psnr_db / 10)
    mse = BASE_MSE + SHIFT_GAIN * shift + UNSEEN_GAIN * unseen + training
    return psnr_of_mse(mse)
