"""Keyframes prepared for rendering, and the choice of older ones that are kept with the newest."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from instant_ic.vspace.agreement import exposure_gains, moved
from instant_ic.vspace.background import Background
from instant_ic.vspace.nerf.field import Floats
from instant_ic.vspace.prior import PanoramaPrior
from instant_ic.vspace.readiness import Texture
from instant_ic.vspace.warp import PanoramaWarp, Pyramid

REACH_M = 3.0
"""Largest distance of an older keyframe whose pixels are used, in metres."""
APART_M = 0.25
"""Smallest distance between two keyframes that are kept, in metres."""
RECENT = 7
"""Number of keyframes kept, which cover the last 3.6 m of a drive at one keyframe per 0.6 m."""


@dataclass(frozen=True)
class Keyframe:
    """A keyframe prepared for rendering: its prior, its warp, and its background."""

    prior: PanoramaPrior
    warp: PanoramaWarp
    background: Background

    @classmethod
    def build(cls, prior: PanoramaPrior, pyramid: Pyramid | None = None) -> Keyframe:
        """Build the warp and the background of a keyframe.

        Args:
            prior: the keyframe.
            pyramid: image pyramid of its panorama; built here if None.
        """
        return cls(prior, PanoramaWarp(prior, pyramid), Background.of(prior))

    @cached_property
    def texture(self) -> Texture:
        """Texture of the panorama."""
        return Texture.of(self.prior.rgb)

    @property
    def position(self) -> NDArray[np.float64]:
        """Position of the camera in the map, (3,) metres."""
        return self.prior.map_from_camera[:3, 3]

    def without(self, moved: NDArray[np.bool_]) -> Keyframe:
        """Return the keyframe without moved objects.

        Args:
            moved: mask of pixels that show them, (h, w). It replaces the mask of an earlier call.
        """
        prior = self.prior.without(moved)
        return self if prior is self.prior else Keyframe.build(prior, self.warp.pyramid)


@dataclass(frozen=True)
class KeyframeSet:
    """The newest keyframe, which views show, and the older ones used with it.

    Attributes:
        keyframes: keyframes that the field learns from together, newest first.
        gains: factors that bring each keyframe's colours to the newest's exposure, (K, 3).
        kept: older keyframes, newest first, whose pixels show surfaces hidden from the newest.
    """

    keyframes: tuple[Keyframe, ...]
    gains: Floats
    kept: tuple[Keyframe, ...] = ()

    @property
    def newest(self) -> Keyframe:
        """The keyframe that views show."""
        return self.keyframes[0]

    @property
    def priors(self) -> tuple[PanoramaPrior, ...]:
        """Priors of ``keyframes``, newest first."""
        return tuple(keyframe.prior for keyframe in self.keyframes)


def extended(prior: PanoramaPrior, shown: KeyframeSet | None, count: int, older: int) -> KeyframeSet:
    """Prepare a new keyframe together with earlier keyframes of the same size.

    Args:
        prior: the new keyframe.
        shown: keyframes used so far; None before the first.
        count: number of keyframes that the field learns, in one exposure and without moved objects.
        older: number of older keyframes that contribute pixels of surfaces hidden from the new one.
    """
    before = () if shown is None else (*shown.keyframes, *shown.kept)
    size = (prior.rgb.shape, prior.inverse_depth.shape)
    before = tuple(one for one in before if (one.prior.rgb.shape, one.prior.inverse_depth.shape) == size)
    keyframes = (Keyframe.build(prior), *before[: count - 1])
    if len(keyframes) > 1:
        gone = moved([keyframe.prior for keyframe in keyframes])
        keyframes = tuple(one.without(mask) for one, mask in zip(keyframes, gone, strict=True))
    gains = exposure_gains([keyframe.prior for keyframe in keyframes])
    if not older:
        return KeyframeSet(keyframes, gains)
    first = keyframes[0]
    kept = recent((first, *before[count - 1 :]))[1:]
    others = [(one.prior, exposure_gains([first.prior, one.prior])[1]) for one in spread((first, *kept), older)]
    first = replace(first, background=first.background.seen_by(others))
    return KeyframeSet((first, *keyframes[1:]), gains, kept)


def spread(keyframes: Sequence[Keyframe], count: int) -> list[Keyframe]:
    """Choose the older keyframes that show most of the surfaces hidden from the newest.

    The first is the farthest within ``REACH_M``. Each further one is the farthest from all chosen ones, if it is at
    least ``APART_M`` away.

    Args:
        keyframes: the newest, then older ones from new to old.
        count: number of older keyframes to choose.
    """
    places = np.array([keyframe.position for keyframe in keyframes])
    gaps = np.linalg.norm(places - places[0], axis=1)
    within = gaps <= REACH_M
    chosen: list[Keyframe] = []
    while len(chosen) < count:
        best = int(np.where(within, gaps, 0).argmax())
        if gaps[best] < APART_M or not within[best]:
            break
        chosen.append(keyframes[best])
        gaps = np.minimum(gaps, np.linalg.norm(places - places[best], axis=1))
    return chosen


def recent(keyframes: Iterable[Keyframe]) -> tuple[Keyframe, ...]:
    """Return the newest ``RECENT`` keyframes that are at least ``APART_M`` apart, newest first."""
    kept: list[Keyframe] = []
    for keyframe in keyframes:
        if all(np.linalg.norm(other.position - keyframe.position) >= APART_M for other in kept):
            kept.append(keyframe)
    return tuple(kept[:RECENT])
