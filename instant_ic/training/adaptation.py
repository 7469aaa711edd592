"""Adapts a completion network to a building, by a drive through it, and says whether that made it better there.

Some stretches of the drive and a sector of directions take no part in the training. The adapted network counts as
better only if its error is smaller on both, by a factor that the differences between stretches do not explain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from instant_ic.depth.metrics import depth_metrics, solid_angle_weights
from instant_ic.geometry.projections import rays_of
from instant_ic.training.completion import CompletionNet
from instant_ic.training.dataset import Sample
from instant_ic.training.drive import DriveError, Keyframe
from instant_ic.training.trainer import predict

Floats = NDArray[np.floating]
STRETCH_M, LEFT_OUT_M, MARGIN_M = 5.0, 1.5, 0.5
"""The last ``LEFT_OUT_M`` of each stretch of the path are left out; training keyframes are ``MARGIN_M`` away."""
SECTOR_DEG = 60.0
"""Width of the sector around the map's x axis that is left out."""
LEAST_STRETCHES = 3
CONFIDENCE = 0.95
NOISE = 0.005
"""Relative error that is the LiDAR's own: smaller ones do not count as different."""
_ANCHORS = 1 / 16
"""Share of the pixels without a label that keep the start model's depth as label: labels outweigh them wherever more
than a few percent of the pixels have one, and what the LiDAR never sees stays as it was."""


@dataclass(frozen=True)
class LeftOut:
    """Pixels of a keyframe that take no part in the training, and the stretch of the path that it belongs to."""

    keyframe: Keyframe
    label_m: Floats
    stretch: int


@dataclass(frozen=True)
class Split:
    """The drive's parts: keyframes for training with their labels, and what each part of the check sees."""

    training: list[tuple[Keyframe, Floats]]
    places: list[LeftOut]
    sector: list[LeftOut]


@dataclass(frozen=True)
class Gain:
    """Mean relative errors on one part of the check, each a mean over stretches of the path.

    Attributes:
        prior, start, adapted: of the fused depth, and of the two networks.
        gain, margin: mean over stretches of log(start / adapted), each with ``NOISE`` added, and half of its 90 %
            interval (Student's t).
        stretches, panoramas: their numbers.
    """

    prior: float
    start: float
    adapted: float
    gain: float
    margin: float
    stretches: int
    panoramas: int

    @property
    def better(self) -> bool:
        return self.gain > self.margin and self.adapted < self.start

    def __str__(self) -> str:
        return (f"prior {self.prior:.4f}, start {self.start:.4f}, adapted {self.adapted:.4f}, gain "
                f"{100 * self.gain:+.1f} ± {100 * self.margin:.1f} % ({self.panoramas} panoramas, {self.stretches} "
                f"stretches)")  # fmt: skip


def split(keyframes: Sequence[Keyframe]) -> Split:
    """Divide a drive into training and check.

    Raises:
        DriveError: it is too short.
    """
    left_out = np.array([one.path_m % STRETCH_M >= STRETCH_M - LEFT_OUT_M for one in keyframes])
    places = np.array([one.model_from_camera[:3, 3] for one in keyframes])
    training, sector = [], []
    for number in np.flatnonzero(~left_out).tolist():
        if left_out.any() and np.linalg.norm(places[left_out] - places[number], axis=1).min() < MARGIN_M:
            continue
        one = keyframes[number]
        label, inside = one.label_m.astype(np.float32), in_sector(one)
        training.append((one, np.where(inside, np.float32(0), label)))
        if (label[inside] > 0).any():
            sector.append(LeftOut(one, np.where(inside, label, np.float32(0)), int(one.path_m // STRETCH_M)))
    checked = [
        LeftOut(keyframes[number], keyframes[number].label_m.astype(np.float32),
                int(keyframes[number].path_m // STRETCH_M))
        for number in np.flatnonzero(left_out).tolist()
    ]  # fmt: skip
    for part, what in ((checked, "stretches that are left out"), (sector, "stretches with the sector in view")):
        if (count := len({one.stretch for one in part})) < LEAST_STRETCHES:
            raise DriveError(
                f"the drive is too short to check a model by it: {len(keyframes)} keyframes over "
                f"{keyframes[-1].path_m:.1f} m give {count} {what}, {LEAST_STRETCHES} are needed. Record "
                f"{LEAST_STRETCHES * STRETCH_M:.0f} m or more, in all directions"
            )
    return Split(training, checked, sector)


def in_sector(keyframe: Keyframe) -> NDArray[np.bool_]:
    """Pixels (H, W) that look into the sector."""
    pose = keyframe.model_from_camera[:3, :3].astype(np.float32)
    rays = rays_of(keyframe.label_m.shape) @ pose.T
    return np.asarray(np.abs(rays[..., 1]) < math.tan(math.radians(SECTOR_DEG / 2)) * rays[..., 0])


def samples(parts: Split, start: CompletionNet, max_range_m: float, brightness: float) -> list[Sample]:
    """Training samples; ``start`` gives the depth of the anchors."""
    found = []
    for number, (one, label) in enumerate(parts.training):
        sample = Sample(one.rgb, label, number, one.prior)
        depth, _ = predict(start, sample, max_range_m, brightness)
        anchor = np.random.default_rng(number).random(label.shape) < _ANCHORS
        target = np.where(label > 0, label, np.where(anchor, depth, 0))
        found.append(Sample(one.rgb, target.astype(np.float16), number, one.prior))
    return found


def errors(part: Sequence[LeftOut], model: CompletionNet | None, max_range_m: float, brightness: float) -> Floats:
    """Mean relative error of each keyframe, weighted by solid angle; of the prior without a model."""
    found = []
    for one in part:
        depth: Floats = one.keyframe.prior[0].astype(np.float32)
        if model is not None:
            depth, _ = predict(model, Sample(one.keyframe.rgb, one.label_m, 0, one.keyframe.prior), max_range_m,
                               brightness)  # fmt: skip
        weights = solid_angle_weights(len(depth))[:, None]
        found.append(depth_metrics(depth, one.label_m, weights=weights).mre)
    return np.array(found)


def gain(part: Sequence[LeftOut], prior: Floats, start: Floats, adapted: Floats) -> Gain:
    """Compare errors of the same keyframes (N,): neighbours see the same surfaces, so each stretch counts once."""
    stretch = np.array([one.stretch for one in part])
    means = np.array([[values[stretch == number].mean() for number in np.unique(stretch)]
                      for values in (prior, start, adapted)])  # fmt: skip
    # Factors, because the stretches differ much more in their errors than in how much of them is corrected.
    count, change = means.shape[1], np.log((means[1] + NOISE) / (means[2] + NOISE))
    margin = float(stdtrit(count - 1, CONFIDENCE) * change.std(ddof=1) / math.sqrt(count))
    errors_of = means.mean(axis=1).tolist()
    return Gain(errors_of[0], errors_of[1], errors_of[2], float(change.mean()), margin, count, len(part))
