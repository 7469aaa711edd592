"""Choice between warp and field: both render views of older keyframes, whose panoramas are the ground truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.vspace.agreement import exposure_gains
from instant_ic.vspace.composition import Rendering, compose
from instant_ic.vspace.keyframes import KeyframeSet, spread
from instant_ic.vspace.nerf.field import Floats, Rays
from instant_ic.vspace.view import perspective_rays

TRIALS = 2
"""Largest number of older keyframes that are rendered."""
_SIZE, _FOV = (256, 144), math.pi / 2
"""Size of a trial's view in pixels, and its field of view. The resolution is that of a panorama with 1024 columns, so
that neither image is blurred."""


@dataclass(frozen=True)
class WarpTrial:
    """A view of an older keyframe, and the error of the warp that renders it from the newest.

    Attributes:
        rays: P rays from the older keyframe's position in the direction of the newest keyframe's heading.
        truth: colours of the older keyframe in the newest's exposure, 0 to 1, (P, 3).
        warp_error: mean squared error of the warp's colour, (P,); NaN on pixels that are not compared.
    """

    rays: Rays
    truth: Floats
    warp_error: Floats

    @classmethod
    def of(cls, rays: Rays, truth: Floats, judged: NDArray[np.bool_], warped: Floats) -> WarpTrial:
        """Compare the warp's colours with the truth.

        Args:
            rays: P rays of the view.
            truth: true colours, 0 to 1, (P, 3).
            judged: mask of the pixels that both the warp and the older keyframe have seen, (P,).
            warped: the warp's colours, (P, 3).
        """
        return cls(rays, truth, np.where(judged, _error(warped, truth), np.float32(np.nan)))


def trials(shown: KeyframeSet) -> tuple[WarpTrial, ...]:
    """Render, by the newest keyframe's warp, views of older keyframes that are neither shown nor learnt.

    Surfaces hidden from the shown keyframes are left out, because the warp takes their colours from the ground truth.
    """
    newest, found = shown.newest, []
    for older in spread((newest, *shown.kept), TRIALS):
        pose = newest.prior.map_from_camera.copy()
        pose[:3, 3] = older.prior.map_from_camera[:3, 3]
        rays = perspective_rays(pose, *_SIZE, _FOV)
        colour, _, known = older.warp.render_rays(rays)
        warped = compose(rays, newest, None)
        truth = np.clip(colour * exposure_gains([newest.prior, older.prior])[1], 0, 1).astype(np.float32)
        found.append(WarpTrial.of(rays, truth, (known > 0) & (warped.confidence > 0), warped.colour))
    return tuple(found)


def gain_db(trials: Sequence[WarpTrial], renderings: Sequence[Rendering]) -> float:
    """Return the PSNR of the field minus that of the warp on pixels that both render; NaN if there are none."""
    warp = field = 0.0
    for trial, (colour, _, confidence) in zip(trials, renderings, strict=True):
        both = np.isfinite(trial.warp_error) & (confidence > 0)
        warp += float(trial.warp_error[both].sum())
        field += float(_error(colour, trial.truth)[both].sum())
    return 10 * math.log10(warp / field) if warp > 0 and field > 0 else math.nan


def _error(colour: Floats, truth: Floats) -> Floats:
    return np.asarray(((colour - truth) ** 2).mean(axis=1), np.float32)


class Choice:
    """The choice between field and warp, with hysteresis against frequent changes.

    Args:
        least_db: smallest gain at which the field is shown; it is then shown until it is worse than the warp.

    Attributes:
        field: True if the field is shown.
        gain_db: last measurement; NaN before the first.
        hopeless: True if the field, at its last rate of progress, would still be worse at the end of its training.
    """

    def __init__(self, least_db: float, field: bool = False) -> None:
        self.field, self.gain_db, self.hopeless = field, math.nan, False
        self._least_db = least_db

    def take(self, gain_db: float, spans_left: float = math.inf) -> None:
        """Update the choice by a measurement; ``spans_left`` is remaining training over that since the last one."""
        grown, self.gain_db = gain_db - self.gain_db, gain_db
        self.field = gain_db >= (0 if self.field else self._least_db)
        self.hopeless = not self.field and gain_db + max(grown, 0) * spans_left < 0
