"""The current value of each latched topic, with which every file of a bag starts."""

from __future__ import annotations

from collections.abc import Iterable

from instant_ic.bag.message import BagMessage
from instant_ic.bag.transforms import TRANSFORM_TOPICS
from instant_ic.msg import MessageError, deserialize


class LatchedValues:
    """The last message of each latched topic and publisher.

    On ``/tf_static`` every message carries all frames of its publisher. A message replaces the earlier messages whose
    frames it repeats, from any publisher.
    """

    def __init__(self) -> None:
        self._values: dict[tuple[str, frozenset[str]], BagMessage] = {}

    def put(self, message: BagMessage) -> None:
        topic, names = message.topic, _names(message)
        self._values = {key: v for key, v in self._values.items() if not (key[0] == topic and key[1] <= names)}
        self._values[topic, names] = message

    def values(self) -> list[BagMessage]:
        """Return all current values, oldest first."""
        return sorted(self._values.values(), key=lambda value: value.stamp_ns)


class Repetitions:
    """Filter for the latched values that each later file of a bag repeats from the earlier files.

    Args:
        starts_ns: stamp of the first message of each file except the first; may grow.
    """

    def __init__(self, starts_ns: Iterable[int] = ()) -> None:
        self.starts_ns = set(starts_ns)
        self._seen: set[int] = set()  # hashes, because a map has megabytes

    def repeats(self, message: BagMessage) -> bool:
        """Remember a message, and return whether it repeats an earlier one."""
        if not message.qos.latched:
            return False
        value = hash((message.topic, message.payload))
        repeated = message.stamp_ns in self.starts_ns and value in self._seen
        self._seen.add(value)
        return repeated


def _names(message: BagMessage) -> frozenset[str]:
    """Return the names that a newer message replaces: child frames, or the publisher."""
    if message.topic in TRANSFORM_TOPICS:
        try:
            decoded = deserialize(message.payload, message.type_name)
            return frozenset(transform.child_frame_id for transform in decoded.transforms)
        except (MessageError, AttributeError):  # bytes of another type: recorded anyway, keyed by publisher
            pass
    return frozenset([message.publisher])
