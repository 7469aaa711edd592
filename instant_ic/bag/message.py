"""A bag's message as bytes with topic, type, stamp and QoS, the definition of its type, and the errors of bags."""

from __future__ import annotations

from dataclasses import dataclass

from instant_ic.bus.qos import QoS

Topic = tuple[str, str]
"""Topic name and type."""


class BagError(RuntimeError):
    """A bag cannot be written or read; the message says why and what to do."""


class DiskFullError(BagError):
    """No space left on the disk. The bag is complete except for the messages that did not fit."""


@dataclass(frozen=True)
class Schema:
    """Definition of a message type in a bag.

    Attributes:
        name: type name, for example ``sensor_msgs/msg/Image``.
        encoding: ``ros2msg`` or ``ros2idl``; empty where the definition is unknown.
        text: the definition, including those of nested types.
        type_hash: RIHS01 hash; empty where it is unknown.
    """

    name: str
    encoding: str
    text: str
    type_hash: str


@dataclass(frozen=True)
class BagMessage:
    """A message in a bag, or on its way into one.

    Attributes:
        type_name: message type, for example ``sensor_msgs/msg/Image``.
        payload: CDR bytes.
        stamp_ns: time of publication, nanoseconds since the epoch.
        qos: QoS of its publisher; from a bag, the preset closest to it.
        publisher: name of its publisher, where it is known.
    """

    topic: str
    type_name: str
    payload: bytes
    stamp_ns: int
    qos: QoS
    publisher: str = ""
