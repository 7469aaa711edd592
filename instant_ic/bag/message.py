"""Messages in a bag as bytes, definitions of their types, and errors of bags."""

from __future__ import annotations

from dataclasses import dataclass

from instant_ic.bus.qos import QoS

Topic = tuple[str, str]
"""Topic name and type."""


class BagError(RuntimeError):
    """A bag cannot be written or read; the message says why and what to do."""


class DiskFullError(BagError):
    """The disk is full. The bag is complete except for the messages that did not fit."""


@dataclass(frozen=True)
class Schema:
    """Definition of a message type in a bag.

    Attributes:
        name: type name, for example ``sensor_msgs/msg/Image``.
        encoding: ``ros2msg`` or ``ros2idl``; empty if the definition is unknown.
        text: the definition, including those of nested types.
        type_hash: RIHS01 hash; empty if unknown.
    """

    name: str
    encoding: str
    text: str
    type_hash: str


@dataclass(frozen=True)
class BagMessage:
    """A message that is in a bag, or that will be written into one.

    Attributes:
        type_name: message type, for example ``sensor_msgs/msg/Image``.
        payload: CDR bytes.
        stamp_ns: time of publication, nanoseconds since the epoch.
        qos: QoS of its publisher; for a message read from a bag, the closest preset.
        publisher: name of its publisher; empty if unknown.
    """

    topic: str
    type_name: str
    payload: bytes
    stamp_ns: int
    qos: QoS
    publisher: str = ""
