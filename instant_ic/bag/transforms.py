"""Removal of transforms that a running node broadcasts from recorded ``/tf`` messages."""

from __future__ import annotations

from collections.abc import Collection

from instant_ic.bag.message import BagMessage
from instant_ic.msg import deserialize, message_type, serialize

TRANSFORM_TOPICS = ("/tf", "/tf_static")


def without_children(message: BagMessage, frames: Collection[str]) -> bytes | None:
    """Remove the transforms with a child frame in ``frames`` from a transform message.

    Returns:
        The same bytes object if nothing was removed; None if nothing is left.
    """
    transforms = deserialize(message.payload, message.type_name).transforms
    kept = [transform for transform in transforms if transform.child_frame_id not in frames]
    if len(kept) == len(transforms):
        return message.payload
    return bytes(serialize(message_type(message.type_name)(transforms=kept))) if kept else None
