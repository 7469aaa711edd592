"""Quality-of-service presets, by the names that a ROS 2 user knows the ideas by."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class QoS:
    """How a topic is carried.

    Attributes:
        name: the preset's name, shown by ``ic topic info``.
        depth: how many messages a reader keeps for a busy node; 1 means the newest of each publisher.
        latched: a late joiner gets the last value.
        reliable: a full queue is a fault that is counted and told, not the normal way of skipping.
    """

    name: str
    depth: int
    latched: bool = False
    reliable: bool = False


SENSOR = QoS("sensor", depth=1)
"""Newest only: a slow node works on the newest message, never on a queue of old ones."""

RELIABLE = QoS("reliable", depth=1000, reliable=True)
"""Every message in order; what does not fit the queue is counted as lost."""

LATCHED = QoS("latched", depth=16, latched=True, reliable=True)
"""The last value is kept by the publisher and given to whoever comes later."""

RECORD = QoS("record", depth=4000, reliable=True)
"""For recorders: as ``reliable`` with a deeper queue."""

PRESETS = {qos.name: qos for qos in (SENSOR, RELIABLE, LATCHED, RECORD)}
