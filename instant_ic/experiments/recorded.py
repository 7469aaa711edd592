"""Views from a recorded drive: panoramas of the bag that come later are left out and serve as the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from instant_ic.experiments.plots import perspective_crop
from instant_ic.experiments.vspace import FILLED, STRIP_AT_M, Comparison, Row, converge_on, filled, scores
from instant_ic.experiments.vspace_sources import FOV_RAD, KEYFRAMES, Place, Shot, VspaceSettings, base_of, make_source

if TYPE_CHECKING:
    from instant_ic.vspace import VirtualSpaceConfig

SOURCES = ("ours", "older", "no-depth", "depth-warp", "point-warp", "panorama", "fill")
"""Those that need no simulated world."""
TOPIC = "/keyframe"


def count_keyframes(bag: Path) -> int:
    """Number of the bag's keyframes whose depth can be trusted; raises as ``read_keyframes``."""
    return len(_messages(bag))


def read_keyframes(bag: Path) -> list[Shot]:
    """Keyframes of a bag whose depth can be trusted, oldest first; their true depth is unknown, they have their own.

    Raises:
        ValueError: no bag, fewer than two such keyframes, or one that cannot be decoded.
    """
    from instant_ic.adapters.nerf import decode_keyframe
    from instant_ic.depth.sources import DepthResult

    found = []
    for message in _messages(bag):
        rgb, depth, pose, sigma = decode_keyframe(message)
        sigma = sigma if isinstance(sigma, np.ndarray) else np.full(depth.shape, sigma, np.float32)
        known = sigma[np.isfinite(sigma)]
        middle = float(np.median(known)) if known.size else 1.0
        result = DepthResult(True, 1.0, 0.0, depth, 1.0, middle, 0, "", sigma, "recorded")
        found.append(Shot(np.asarray(pose, np.float64), rgb, depth, depth, result, depth))
    return found


def compare_recorded(bag: Path, settings: VspaceSettings, number: int) -> Comparison:
    """Show what later keyframes saw from an earlier one, at their poses.

    The sources are of ``SOURCES``; keyframes up to ``settings.reach_m`` away count, by steps of ``step_m``. ``number``:
    of the earlier keyframe.

    Raises:
        ValueError: as ``read_keyframes``, or no later keyframe is near enough.
    """
    keyframes = read_keyframes(bag)
    shots = keyframes[max(0, number + 1 - max(KEYFRAMES.values())) : number + 1]
    nowhere: Any = None
    place = Place(nowhere, nowhere, nowhere, (0.0, 0.0, 0.0), _config(settings), None)
    here, (width, height) = keyframes[number].pose, settings.size
    near = _later(keyframes, number, settings)
    if not near:
        raise ValueError(f"{bag}: no keyframe after number {number} lies within {settings.reach_m:g} m of it")
    comparison = Comparison((float(here[0, 3]), float(here[1, 3]), 0.0))
    ready: dict[str, Any] = {}
    for source in settings.sources:
        base = base_of(source, settings.method)
        if base not in ready:
            ready[base] = make_source(base, shots, settings, place)
        draw, seconds = ready[base]
        for distance, one in near:
            at = settings.step_m * round(distance / settings.step_m)
            truth = perspective_crop(one.rgb, np.eye(3), width, height, FOV_RAD)
            image, confidence = draw(one.pose, width, height, FOV_RAD)
            if source in FILLED:
                image = filled(image, confidence, truth)
            psnr, similarity = scores(image, truth)
            comparison.rows.append(Row("recorded", source, at, psnr, similarity, seconds, float(np.mean(confidence))))
            if at in STRIP_AT_M:
                comparison.strips.setdefault("recorded", {}).setdefault(at, {"truth": truth}).setdefault(source, image)
    return comparison


def converge_recorded(bag: Path, settings: VspaceSettings, number: int, times_s: Sequence[float]) -> list[Row]:
    """As ``vspace.converge``: views at a keyframe, and at the later one that is nearest to 1 m away (0.5 to 1.5 m).

    Raises:
        ValueError: as ``read_keyframes``.
    """
    keyframes = read_keyframes(bag)
    here, (width, height) = keyframes[number], settings.size
    beside = [each for each in _later(keyframes, number, settings) if 0.5 <= each[0] <= 1.5]
    chosen = [(0.0, here), *((1.0, one) for _, one in sorted(beside, key=lambda each: abs(each[0] - 1.0))[:1])]
    views = [(at, one.pose, perspective_crop(one.rgb, np.eye(3), width, height, FOV_RAD)) for at, one in chosen]
    return converge_on(here, views, settings, _config(settings), times_s)


def _config(settings: VspaceSettings) -> VirtualSpaceConfig:
    from instant_ic.vspace import VirtualSpaceConfig

    return VirtualSpaceConfig(source="auto", panorama_width=settings.panorama_width)


def _later(keyframes: Sequence[Shot], number: int, settings: VspaceSettings) -> list[tuple[float, Shot]]:
    """Later keyframes up to ``reach_m`` away, each with its distance in metres."""
    here = keyframes[number].pose[:3, 3]
    away = [(float(np.linalg.norm(one.pose[:3, 3] - here)), one) for one in keyframes[number + 1 :]]
    return [(distance, one) for distance, one in away if distance <= settings.reach_m]


def _messages(bag: Path) -> list[Any]:
    from instant_ic.experiments.bags import opened
    from instant_ic.msg import deserialize

    with opened(bag, {TOPIC: ("Keyframe",)}, ". Record it again") as reader:
        messages = [deserialize(one.payload, one.type_name) for one in reader.messages([TOPIC])]
    fit = [message for message in messages if message.fit]
    if len(fit) < 2:
        raise ValueError(f"{bag}: {len(fit)} of {len(messages)} keyframes have trusted depth, 2 are needed")
    return fit
