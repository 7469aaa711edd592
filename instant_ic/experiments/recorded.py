"""Views from a recorded drive: panoramas of the bag that come later are left out and serve as the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.pictures import perspective_crop
from instant_ic.experiments.vspace import STRIP_AT_M, Comparison, Row, scores
from instant_ic.experiments.vspace_sources import KEYFRAMES, Place, Shot, VspaceSettings, make_source

SOURCES = ("ours", "older", "no-depth", "depth-warp", "point-warp", "panorama")
"""Those that need no simulated world."""
TOPIC = "/keyframe"


@dataclass(frozen=True)
class RecordedKeyframe:
    """A keyframe of a bag: panorama (H, 2 H, 3), depth (h, 2 h) in metres, pose (4, 4), relative sigma (h, 2 h)."""

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    pose: NDArray[np.float64]
    sigma: NDArray[np.float32]


def count_keyframes(bag: Path) -> int:
    """Number of the bag's keyframes whose depth can be trusted; raises as ``read_keyframes``."""
    return len(_messages(bag))


def read_keyframes(bag: Path) -> list[RecordedKeyframe]:
    """Keyframes of a bag whose depth can be trusted, oldest first.

    Raises:
        ValueError: no bag, fewer than two such keyframes, or one that cannot be decoded.
    """
    from instant_ic.depth.keyframes import decode_sigma
    from instant_ic.msg import image_array, matrix_from_pose
    from instant_ic.vspace.jobs import decode_panorama

    found = []
    for message in _messages(bag):
        depth = np.asarray(image_array(message.depth), np.float32)
        sigma = np.full(depth.shape, message.relative_sigma, np.float32)
        if message.sigma.data.size:
            sigma = decode_sigma(image_array(message.sigma))
        rgb = decode_panorama(np.asarray(message.panorama.data, np.uint8))
        found.append(RecordedKeyframe(rgb, depth, matrix_from_pose(message.pose), sigma))
    return found


def compare_recorded(bag: Path, settings: VspaceSettings, number: int) -> Comparison:
    """Show what later keyframes saw from an earlier one, at their poses.

    Args:
        bag: with ``/keyframe``.
        settings: ``sources`` of ``SOURCES``; keyframes up to ``reach_m`` away count, by steps of ``step_m``.
        number: of the earlier keyframe.

    Raises:
        ValueError: as ``read_keyframes``, or no later keyframe is near enough.
    """
    from instant_ic.depth.sources import DepthResult
    from instant_ic.vspace import VirtualSpaceConfig

    keyframes = read_keyframes(bag)
    shots = []
    for one in keyframes[max(0, number + 1 - max(KEYFRAMES.values())) : number + 1]:
        known = one.sigma[np.isfinite(one.sigma)]
        middle = float(np.median(known)) if known.size else 1.0
        depth = DepthResult(one.depth_m, one.sigma, True, 1.0, 0.0, 1.0, middle, 0, "", "recorded")
        shots.append(Shot(one.pose, one.rgb, one.depth_m, one.depth_m, depth, one.depth_m))
    config = VirtualSpaceConfig(source="auto", panorama_width=settings.panorama_width)
    nowhere: Any = None
    place = Place(nowhere, nowhere, nowhere, (0.0, 0.0, 0.0), config, None)
    here, (width, height), fov = keyframes[number].pose, settings.size, math.radians(settings.fov_deg)
    away = [(float(np.linalg.norm(one.pose[:3, 3] - here[:3, 3])), one) for one in keyframes[number + 1 :]]
    near = [(distance, one) for distance, one in away if distance <= settings.reach_m]
    if not near:
        raise ValueError(f"{bag}: no keyframe after number {number} lies within {settings.reach_m:g} m of it")
    comparison = Comparison((float(here[0, 3]), float(here[1, 3]), 0.0))
    for source in settings.sources:
        draw, seconds = make_source(source, shots, settings, place)
        for distance, one in near:
            at = settings.step_m * round(distance / settings.step_m)
            truth = perspective_crop(one.rgb, np.eye(3), width, height, fov)
            image, seen = draw(one.pose, width, height, fov)
            psnr, similarity = scores(image, truth)
            comparison.rows.append(Row("recorded", source, at, psnr, similarity, seconds, seen))
            if at in STRIP_AT_M:
                comparison.strips.setdefault("recorded", {}).setdefault(at, {"truth": truth}).setdefault(source, image)
    return comparison


def _messages(bag: Path) -> list[Any]:
    from instant_ic.bag.errors import BagError
    from instant_ic.bag.files import BagReader
    from instant_ic.msg import deserialize

    try:
        with BagReader(bag) as reader:
            names = [one.topic for one in reader.topics]
            if TOPIC not in names:
                raise ValueError(
                    f"{bag}: {TOPIC} is missing; it has {', '.join(names) or 'no topics'}. Record it again"
                )
            messages = [deserialize(one.payload, one.type_name) for one in reader.messages([TOPIC])]
    except BagError as error:
        raise ValueError(str(error)) from error
    fit = [message for message in messages if message.fit]
    if len(fit) < 2:
        raise ValueError(f"{bag}: {len(fit)} of {len(messages)} keyframes have trusted depth, 2 are needed")
    return fit
