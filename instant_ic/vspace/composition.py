"""Composition of a view on the CPU: the keyframe's warped panorama or the field, and the estimated background."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from instant_ic.vspace.keyframes import Keyframe
from instant_ic.vspace.nerf.field import Floats, Rays
from instant_ic.vspace.view import continue_unseen

Rendering = tuple[Floats, Floats, Floats]
"""Colours (P, 3), 0 to 1, depth along each ray in metres (P,), and confidence (P,)."""
ALIKE, APART = 0.03, 0.06
"""Mean colour differences (0 to 1) below which two images agree fully, and above which they do not agree at all."""
AROUND_PIXELS = 5
"""Side of the window over which the difference of two images is averaged, in pixels."""


@dataclass(frozen=True)
class ComposedView:
    """A rendered view of P pixels.

    Attributes:
        colour: RGB, 0 to 1, (P, 3).
        depth: metres along each ray, (P,); 0 where the ray hits nothing.
        confidence: 1 on surfaces that a keyframe has seen, 0.5 where their depth was filled, 0 elsewhere, (P,).
        background: weight of the estimated background, 0 to 1, (P,); 0 on surfaces that a keyframe has seen.
    """

    colour: Floats
    depth: Floats
    confidence: Floats
    background: Floats


def compose(rays: Rays, keyframe: Keyframe | None, field: Rendering | None) -> ComposedView:
    """Render the keyframe's warped panorama or the field, and the background where nothing has been seen.

    Args:
        rays: rays of a perspective view, or of any view if ``keyframe`` is None.
        keyframe: the keyframe to warp, whose background is rendered too; None to show the field alone.
        field: the field's rendering; None to show the panorama.
    """
    if field is None:
        assert keyframe is not None, "neither a keyframe nor a field to render"
        field = keyframe.warp.render_rays(rays)
    colour, depth, confidence = field
    background = np.zeros(len(depth), np.float32)
    unseen = confidence == 0
    if keyframe is not None and unseen.any():
        background = keyframe.background.render_rays(rays, unseen, field)
    return ComposedView(colour, depth, confidence, background)


def filled_image(view: ComposedView, shape: tuple[int, int], wraps: bool) -> Floats:
    """Return the image (H, W, 3) with unseen pixels filled from their surroundings and the background blended in.

    Args:
        view: a view of H · W pixels.
        shape: H and W.
        wraps: True if the left edge borders on the right edge, as in a panorama.
    """
    colour = view.colour.reshape(*shape, 3)
    depth, confidence = view.depth.reshape(shape), view.confidence.reshape(shape)
    image = continue_unseen(colour, depth, confidence, wraps)
    share = np.where(confidence > 0, 0, view.background.reshape(shape))[..., None]
    return image + share * (colour - image)


def dissolve(before: Floats, after: Floats, share: float) -> Floats:
    """Blend two images (H, W, 3) where they agree. Elsewhere take ``after``, so that no object appears twice.

    Args:
        before: the old image.
        after: the new image.
        share: weight of the new image, 0 to 1.
    """
    import cv2

    change = after - before
    apart = cv2.blur(np.abs(change).max(axis=2), (AROUND_PIXELS, AROUND_PIXELS))
    kept = (1 - share) * np.clip((APART - apart) / (APART - ALIKE), 0, 1)
    return np.asarray(after - kept[..., None] * change, np.float32)
