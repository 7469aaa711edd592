"""One message, as every part of the package handles it: bytes with topic, type, stamp and QoS. Errors of bags."""

from __future__ import annotations

from dataclasses import dataclass

from instant_ic.bus.qos import QoS


class BagError(RuntimeError):
    """A bag cannot be written or read; the message says why and what to do."""


class DiskFullError(BagError):
    """No space left on the disk. The bag is complete except for the messages that did not fit."""


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
