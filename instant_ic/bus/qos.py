"""Quality-of-service presets, comparable to those of ROS 2."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class QoS:
    """Quality of service of a topic.

    Attributes:
        name: the preset's name, shown by ``ic topic info``.
        depth: number of messages that a reader queues for a busy node; 1 keeps the newest of each publisher.
        latched: send the last value to late joiners.
        reliable: count and report messages dropped from a full queue as a fault; otherwise dropping is normal.
    """

    name: str
    depth: int
    latched: bool = False
    reliable: bool = False


SENSOR = QoS("sensor", depth=1)
"""Newest message only, so that a slow node never works on a queue of old messages."""

RELIABLE = QoS("reliable", depth=1000, reliable=True)
"""Every message in order. Messages that do not fit into the queue are counted as lost."""

LATCHED = QoS("latched", depth=16, latched=True, reliable=True)
"""The publisher keeps the last value and sends it to late joiners."""

RECORD = QoS("record", depth=4000, reliable=True)
"""Every message in order with a longer queue, for recorders."""

PRESETS = {qos.name: qos for qos in (SENSOR, RELIABLE, LATCHED, RECORD)}
