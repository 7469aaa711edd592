"""Composition of a view on the CPU: the keyframes' warped panoramas, the field and the background."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.vspace.compose import Layer, compose
from instant_ic.vspace.nerf.field import Floats, Rays
from instant_ic.vspace.store import Keyframe, KeyframeSet
from instant_ic.vspace.view import continue_unseen

Drawing = tuple[Floats, Floats, Floats]
"""Colours (P, 3) in 0..1, depth along the ray (P,) and confidence (P,)."""
Painted = tuple[NDArray[np.uint8], Floats, Floats]
"""A finished image: (H, W, 3) uint8, depth (P,) and confidence (P,)."""


_ALIKE, _APART, _AROUND = 0.03, 0.06, 5
"""Images agree where the mean difference (0..1) over so many pixels a side is below the first, not at all from the
second on."""


@dataclass(frozen=True)
class Picture:
    """A rendered view (P, …); ``guessed``: share of the background's guess in the image, 0 in what has been seen."""

    colour: Floats
    depth: Floats
    confidence: Floats
    guessed: Floats


def draw(
    rays: Rays,
    shown: KeyframeSet | None,
    field: Drawing | None,
    layers: dict[int, Drawing],
) -> Picture:
    """Compose a view: warped panoramas or the field, and the background in unseen places.

    Args:
        rays: of a perspective view; of any where ``shown`` is None.
        shown: the keyframes; None: the field alone, nothing is warped.
        field: the view as the field has it, as ``field.Device.draw`` gives it; None: the panoramas.
        layers: in and out, the warps of keyframes that have been rendered for this view.
    """
    if field is None:
        assert shown is not None, "neither keyframes nor a field to render"
        picture = _warped(rays, shown, layers)
    else:
        picture = field
    colour, depth, confidence = picture
    guessed = np.zeros(len(depth), np.float32)
    for keyframe, gain in () if shown is None else _nearest_first(shown, rays):
        wanted = (confidence == 0) & (guessed == 0)
        if keyframe.background is None or not wanted.any():
            break
        guessed += keyframe.background.draw(rays, gain, wanted, picture)
    return Picture(colour, depth, confidence, guessed)


def _warped(rays: Rays, shown: KeyframeSet, layers: dict[int, Drawing]) -> Drawing:
    """Compose the keyframes' panoramas, warped by their depth."""
    drawn = []
    for keyframe, gain in _nearest_first(shown, rays):
        if id(keyframe.warp) not in layers:
            layers[id(keyframe.warp)] = keyframe.warp.draw(rays)
        drawn.append(Layer(keyframe.prior, gain, *layers[id(keyframe.warp)]))
    if len(drawn) > 1:
        return compose(drawn, rays)
    colour, depth, confidence = layers[id(shown.keyframes[0].warp)]
    return colour.copy(), depth.copy(), confidence.copy()


def continued(picture: Picture, shape: tuple[int, int], wraps: bool) -> Floats:
    """The image (H, W, 3) with unknown parts filled from their surroundings and the guesses blended in."""
    drawn = picture.colour.reshape(*shape, 3)
    depth, confidence = picture.depth.reshape(shape), picture.confidence.reshape(shape)
    image = continue_unseen(drawn, depth, confidence, wraps)
    share = np.where(confidence > 0, 0, picture.guessed.reshape(shape))[..., None]
    return image + share * (drawn - image)


def passed(before: Floats, after: Floats, share: float) -> Floats:
    """An image (H, W, 3) on its way from ``before`` to ``after``, of which it has ``share`` where both agree.

    Where they do not, the same thing would stand in two places: those parts change at once.
    """
    import cv2

    change = after - before
    apart = cv2.blur(np.abs(change).max(axis=2), (_AROUND, _AROUND))
    kept = (1 - share) * np.clip((_APART - apart) / (_APART - _ALIKE), 0, 1)
    return np.asarray(after - kept[..., None] * change, np.float32)


def painted(picture: Picture, image: Floats) -> Painted:
    """The image of ``continued``, or a blend of several, in 8 bit; depth and confidence of ``picture``."""
    rgb = np.rint(np.clip(image, 0, 1) * np.float32(255)).astype(np.uint8)
    return rgb, picture.depth, picture.confidence


def _nearest_first(shown: KeyframeSet, rays: Rays) -> list[tuple[Keyframe, Floats]]:
    """Keyframes and their gains by their distance from a view: the order in which they were taken does not matter."""

    def distance(pair: tuple[Keyframe, Floats]) -> tuple[float, ...]:
        place = pair[0].prior.map_from_camera[:3, 3]
        return float(np.linalg.norm(place - rays.origin)), *place.tolist()

    return sorted(zip(shown.keyframes, shown.gains, strict=True), key=distance)
