"""Recordings for the experiments; later keyframes are left out of the virtual space and serve as the truth."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.bag.files import BagReader
from instant_ic.bag.message import BagError
from instant_ic.experiments.plots import perspective_crop
from instant_ic.experiments.vspace_sources import Shot, VspaceSettings
from instant_ic.msg import deserialize

TOPIC = "/keyframe"


@contextlib.contextmanager
def opened(bag: Path, kinds: Mapping[str, str], remedy: str = "", optional: str = "") -> Iterator[BagReader]:
    """Open a bag that has these topics.

    Args:
        bag: folder or file.
        kinds: type of each topic, without its package.
        remedy: advice at the end of the error if a topic is missing.
        optional: topic that may be missing.

    Raises:
        ValueError: the path is not a bag, the bag is damaged, or a topic is missing or has another type.
    """
    try:
        with BagReader(bag) as reader:
            types = {one.topic: one.type_name.rpartition("/")[2] for one in reader.topics}
            for topic, kind in kinds.items():
                if topic not in types and topic != optional:
                    raise ValueError(f"{bag}: {topic} is missing; the bag has {', '.join(sorted(types))}{remedy}")
                if (found := types.get(topic, kind)) != kind:
                    raise ValueError(f"{bag}: {topic} has the type {found}, not {kind}")
            yield reader
    except BagError as error:
        raise ValueError(str(error)) from error


def count_keyframes(bag: Path) -> int:
    """Return the number of keyframes with trusted depth; errors are those of ``read_keyframes``."""
    return len(_messages(bag))


def read_keyframes(bag: Path) -> list[Shot]:
    """Read the keyframes of a bag whose depth can be trusted, oldest first; their depth serves as the true depth.

    Raises:
        ValueError: the path is not a bag, it has fewer than two such keyframes, or one cannot be decoded.
    """
    from instant_ic.adapters.nerf import decode_keyframe
    from instant_ic.depth.sources import DepthResult

    found = []
    for message in _messages(bag):
        rgb, depth, pose, sigma = decode_keyframe(message)
        sigma = sigma if isinstance(sigma, np.ndarray) else np.full(depth.shape, sigma, np.float32)
        known = sigma[np.isfinite(sigma)]
        middle = float(np.median(known)) if known.size else 1.0
        result = DepthResult(True, 1.0, depth, 1.0, middle, 0, "", sigma, "recorded")
        found.append(Shot(np.asarray(pose, np.float64), rgb, depth, depth, result, depth))
    return found


def later_keyframes(
    keyframes: Sequence[Shot], number: int, settings: VspaceSettings, fov_rad: float, itself: bool = False
) -> list[tuple[float, Any, Any]]:
    """Return distance, pose and perspective view of the keyframes after ``number`` that lie within ``reach_m``."""
    here, found = keyframes[number].pose[:3, 3], []
    for one in keyframes[number + (not itself) :]:
        distance = float(np.linalg.norm(one.pose[:3, 3] - here))
        if distance <= settings.reach_m:
            found.append((distance, one.pose, perspective_crop(one.rgb, np.eye(3), *settings.size, fov_rad)))
    return found


def _messages(bag: Path) -> list[Any]:
    with opened(bag, {TOPIC: "Keyframe"}, ". Record it again") as reader:
        messages = [deserialize(one.payload, one.type_name) for one in reader.messages([TOPIC])]
    fit = [message for message in messages if message.fit]
    if len(fit) < 2:
        raise ValueError(f"{bag}: {len(fit)} of {len(messages)} keyframes have trusted depth, 2 are needed")
    return fit
