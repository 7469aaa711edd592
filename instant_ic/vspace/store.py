"""Storage of the newest keyframes in preallocated slots."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.vspace.background import Background
from instant_ic.vspace.nerf.field import Floats
from instant_ic.vspace.prior import PanoramaPrior
from instant_ic.vspace.warp import PanoramaWarp, Pyramid

REACH_M, APART_M, RECENT = 3.0, 0.25, 7
"""Older keyframes are used from up to this distance, are this far apart, and this many are kept: at one each 0.6 m
those of 3.6 m, at 0.3 m in the virtual space those of 1.8 m."""


@dataclass(frozen=True)
class Keyframe:
    """A keyframe prepared for rendering; ``place``: its slot; ``background`` is None where decoded layers have none."""

    place: int
    prior: PanoramaPrior
    warp: PanoramaWarp
    background: Background | None


@dataclass(frozen=True)
class KeyframeSet:
    """The newest keyframe, which views show, and the older ones used with it.

    Attributes:
        keyframes: keyframes that the field learns from together, newest first.
        gains: factors that bring each keyframe's colours to the newest's exposure, (K, 3).
        kept: older keyframes, newest first, whose pixels show what is hidden from the newest.
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


def spread(keyframes: Sequence[Keyframe], count: int) -> list[Keyframe]:
    """Those of older keyframes (newest first, after the one that they are for) that show most of what it does not see.

    The farthest within ``REACH_M`` first, then those farthest from all chosen before; none within ``APART_M`` of
    another.
    """
    places = np.array([keyframe.prior.map_from_camera[:3, 3] for keyframe in keyframes])
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
    """The newest ``RECENT`` keyframes of those that lie apart, newest first: of a standing robot the newest."""
    kept: list[Keyframe] = []
    for keyframe in keyframes:
        place = keyframe.prior.map_from_camera[:3, 3]
        if all(np.linalg.norm(other.prior.map_from_camera[:3, 3] - place) >= APART_M for other in kept):
            kept.append(keyframe)
    return tuple(kept[:RECENT])


class KeyframeStore:
    """Arrays of keyframes of one size; nothing large is allocated for a keyframe after the first.

    ``put`` may be called from another thread than ``keep``.
    """

    def __init__(self, places: int) -> None:
        self._lock = threading.Lock()
        self._places = places
        self._arrays: list[dict[str, NDArray[Any]]] = []
        self._held: set[int] = set()

    def put(self, prior: PanoramaPrior) -> Keyframe:
        """Copy a keyframe into a free slot and prepare it for rendering."""
        names = [field.name for field in fields(prior) if isinstance(getattr(prior, field.name), np.ndarray)]
        arrays = self._free({name: getattr(prior, name) for name in names})
        for name in names:
            if name != "rgb":
                arrays[name][...] = getattr(prior, name)
        pyramid = Pyramid.of(prior.rgb, arrays["texels"])
        stored: dict[str, Any] = {name: arrays[name] for name in names}
        prior = replace(prior, **stored)
        return ready(int(arrays["place"]), prior, pyramid)

    def _free(self, like: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """The arrays of a free place; another one is made where all are held."""
        with self._lock:
            if self._arrays and any(self._arrays[0][name].shape != array.shape for name, array in like.items()):
                self._arrays, self._held = [], set()  # another size; keyframes in use keep their arrays
            free = next((n for n in range(len(self._arrays)) if n not in self._held), len(self._arrays))
            while len(self._arrays) < max(self._places, free + 1):
                self._arrays.append(_arrays_for(like, len(self._arrays)))
            self._held.add(free)
            return self._arrays[free]

    def keep(self, keyframes: Iterable[Keyframe]) -> None:
        """Frees all places but those of ``keyframes``."""
        with self._lock:
            self._held = {keyframe.place for keyframe in keyframes}


def ready(place: int, prior: PanoramaPrior, pyramid: Pyramid) -> Keyframe:
    """Prepare a keyframe for rendering."""
    return Keyframe(place, prior, PanoramaWarp(prior, pyramid), Background.of(prior))


def _arrays_for(like: dict[str, NDArray[Any]], place: int) -> dict[str, NDArray[Any]]:
    """A place for a keyframe of this size; the panorama is the first level of its pyramid."""
    arrays = {name: np.zeros_like(array) for name, array in like.items() if name != "rgb"}
    arrays["texels"] = np.zeros_like(Pyramid.of(like["rgb"]).texels)
    height, width = like["rgb"].shape[:2]
    arrays["rgb"] = arrays["texels"][: height * width].reshape(height, width, 3)
    return arrays | {"place": np.array(place)}
