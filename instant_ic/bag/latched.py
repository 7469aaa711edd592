"""The current value of each latched topic, so that every file of a bag can start with it."""

from __future__ import annotations

from dataclasses import dataclass

from instant_ic.bag.mcap_writer import Buffer
from instant_ic.bag.transforms import TRANSFORM_TOPICS
from instant_ic.msg import MessageError, deserialize

Key = tuple[str, frozenset[str]]


@dataclass(frozen=True)
class LatchedValue:
    """A message of a latched topic that is still valid.

    Attributes:
        payload: CDR bytes.
        publish_ns: time of publication.
    """

    topic: str
    type_name: str
    payload: Buffer
    publish_ns: int


class LatchedValues:
    """Keeps the last message of each latched topic and publisher.

    On ``/tf_static`` every message carries all frames of its publisher. A message replaces the earlier messages whose
    frames it repeats, from any publisher.
    """

    def __init__(self) -> None:
        self._values: dict[Key, LatchedValue] = {}

    def put(self, value: LatchedValue, publisher: str = "") -> None:
        """Store a newer value."""
        key = (value.topic, self._names(value, publisher))
        for other in [k for k in self._values if k[0] == value.topic and k[1] <= key[1]]:
            del self._values[other]
        self._values[key] = value

    def values(self, but: LatchedValue | None = None, publisher: str = "") -> list[LatchedValue]:
        """Return all current values, oldest first, without those that ``but`` is about to replace."""
        names = (but.topic, self._names(but, publisher)) if but is not None else ("", frozenset())
        kept = [v for k, v in self._values.items() if not (k[0] == names[0] and k[1] <= names[1])]
        return sorted(kept, key=lambda value: value.publish_ns)

    @staticmethod
    def _names(value: LatchedValue, publisher: str) -> frozenset[str]:
        if value.topic in TRANSFORM_TOPICS:
            try:
                message = deserialize(value.payload, value.type_name)
                return frozenset(transform.child_frame_id for transform in message.transforms)
            except (MessageError, AttributeError):  # bytes of another type: recorded anyway, keyed by publisher
                pass
        return frozenset([publisher])
