"""Warp or field, by measurement: an older keyframe is a true image from a displaced place, which both must render."""

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
"""Older keyframes that are rendered, at most."""
_SIZE, _FOV = (256, 144), math.pi / 2
"""Size of a trial's view in pixels, and its field of view: as fine as a panorama of 1024 columns, so that neither side
is blurred."""


@dataclass(frozen=True)
class WarpTrial:
    """A view of an older keyframe as it was, and how well the warp renders it.

    Attributes:
        rays: P rays from that keyframe's place along the newest one's heading.
        truth: (P, 3), 0..1, in the newest keyframe's exposure.
        warp_error: (P,) mean squared error of the warp's colour, NaN where nothing is judged.
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
            judged: pixels that both the warp and the older keyframe have seen, (P,).
            warped: the warp's colours, (P, 3).
        """
        return cls(rays, truth, np.where(judged, _error(warped, truth), np.float32(np.nan)))


def trials(shown: KeyframeSet) -> tuple[WarpTrial, ...]:
    """Render the views of older keyframes, neither shown nor learnt, by the warp of the newest.

    Places hidden from the shown keyframes are left out: the warp has them from the very images that it is judged by.
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
    """Return by how much the field's PSNR exceeds the warp's on pixels that both render; NaN without any."""
    warp = field = 0.0
    for trial, (colour, _, confidence) in zip(trials, renderings, strict=True):
        both = np.isfinite(trial.warp_error) & (confidence > 0)
        warp += float(trial.warp_error[both].sum())
        field += float(_error(colour, trial.truth)[both].sum())
    return 10 * math.log10(warp / field) if warp > 0 and field > 0 else math.nan


def _error(colour: Floats, truth: Floats) -> Floats:
    return np.asarray(((colour - truth) ** 2).mean(axis=1), np.float32)


class Choice:
    """Which of the two is shown; with hysteresis, so that it does not change to and fro.

    Args:
        least_db: gain from which the field is shown; it stays until it is worse than the warp.

    Attributes:
        field: the field is shown.
        gain_db: last measurement; NaN before the first.
        hopeless: at the rate of its last gain, the field would still lose at the end of its training.
    """

    def __init__(self, least_db: float, field: bool = False) -> None:
        self.field, self.gain_db, self.hopeless = field, math.nan, False
        self._least_db = least_db

    def take(self, gain_db: float, spans_left: float = math.inf) -> None:
        """Take a measurement; ``spans_left``: training left, in units of that since the measurement before."""
        grown, self.gain_db = gain_db - self.gain_db, gain_db
        self.field = gain_db >= (0 if self.field else self._least_db)
        self.hopeless = not self.field and gain_db + max(grown, 0) * spans_left < 0
