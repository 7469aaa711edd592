"""Selection of keyframes, and encoding of their uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import Checked, NotNegative, Positive


@dataclass(frozen=True)
class KeyframeSelectionConfig(Checked):
    """Selection of keyframes.

    Attributes:
        distance_m: metres of motion until a new keyframe; a smaller value updates the virtual space more often.
        angle_deg: degrees of rotation until a new keyframe.
        refresh_s: seconds after which a standing robot takes a new keyframe, because objects may have moved.
        unfit_after_s: seconds that a due keyframe waits for depth that can be scaled.
    """

    distance_m: Positive = 0.6
    angle_deg: Positive = 45.0
    refresh_s: Positive = 30.0
    unfit_after_s: NotNegative = 5.0


class KeyframeSelector:
    """Selection of keyframes: first of images that may become one, then among those with depth.

    Attributes:
        count: number of keyframes.
    """

    def __init__(self, config: KeyframeSelectionConfig | None = None) -> None:
        self.config = config or KeyframeSelectionConfig()
        self.count = 0
        self._pose: NDArray[np.float64] | None = None
        self._fit = False
        self._taken_ns = 0
        self._due_since_ns: int | None = None

    def take(self, map_from_camera: NDArray[np.float64], fit: bool, stamp_ns: int) -> bool:
        """Return whether the image at this pose becomes a keyframe, and remember it as the last keyframe if so.

        Args:
            map_from_camera: pose of the image, (4, 4).
            fit: True if the depth could be scaled.
            stamp_ns: time of the image, by which waiting is measured.
        """
        if not self.due(map_from_camera, stamp_ns, fit):
            self._due_since_ns = None
            return False
        if not fit:
            if self._due_since_ns is None:
                self._due_since_ns = stamp_ns
            if stamp_ns - self._due_since_ns < self.config.unfit_after_s * 1e9:
                return False
        self._pose, self._fit, self._taken_ns = np.array(map_from_camera), fit, stamp_ns
        self._due_since_ns = None
        self.count += 1
        return True

    def restart(self) -> None:
        """Forget the last keyframe, so that the next fit image becomes one. The count continues."""
        self._pose, self._fit, self._due_since_ns = None, False, None

    def due(self, map_from_camera: NDArray[np.float64], stamp_ns: int, fit: bool = True) -> bool:
        """Return whether an image at this pose and time would become a keyframe, if its depth is ``fit``."""
        if self._pose is None or (fit and not self._fit):
            return True
        if fit and stamp_ns - self._taken_ns >= self.config.refresh_s * 1e9:
            return True
        moved = float(np.linalg.norm(map_from_camera[:3, 3] - self._pose[:3, 3]))
        if moved >= self.config.distance_m:
            return True
        cosine = (np.trace(self._pose[:3, :3].T @ map_from_camera[:3, :3]) - 1) / 2
        return math.degrees(math.acos(float(np.clip(cosine, -1, 1)))) >= self.config.angle_deg


_LEAST_SIGMA, _SIGMA_SPAN = 0.002, 500.0


def encode_sigma(sigma: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Encode relative standard deviations (H, W) as bytes in steps of 2.5 %; 0 is not finite (see Keyframe.msg)."""
    known = np.isfinite(sigma)
    share = np.log(np.maximum(np.where(known, sigma, 1.0), _LEAST_SIGMA) / _LEAST_SIGMA) / math.log(_SIGMA_SPAN)
    return np.where(known, 1 + np.rint(254 * np.minimum(share, 1.0)), 0).astype(np.uint8)


def decode_sigma(code: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Decode an image of ``encode_sigma``; inf is unknown."""
    sigma = _LEAST_SIGMA * _SIGMA_SPAN ** ((np.arange(256) - 1) / 254)
    sigma[0] = np.inf
    return np.asarray(sigma.astype(np.float32)[code])
