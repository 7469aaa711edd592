"""Quality-of-service presets, comparable to those of ROS 2."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class QoS:
    """How a topic is transported.

    Attributes:
        name: the preset's name, shown by ``ic topic info``.
        depth: how many messages a reader keeps for a busy node; 1 means the newest of each publisher.
        latched: a late joiner gets the last value.
        reliable: a full queue is a fault that is counted and reported, not the normal way to skip messages.
    """

    name: str
    depth: int
    latched: bool = False
    reliable: bool = False


SENSOR = QoS("sensor", depth=1)
"""Newest only: a slow node works on the newest message, never on a queue of old ones."""

RELIABLE = QoS("reliable", depth=1000, reliable=True)
"""Every message in order; messages that do not fit into the queue are counted as lost."""

LATCHED = QoS("latched", depth=16, latched=True, reliable=True)
"""The publisher keeps the last value and sends it to late joiners."""

RECORD = QoS("record", depth=4000, reliable=True)
"""For recorders: like ``reliable``, with a longer queue."""

PRESETS = {qos.name: qos for qos in (SENSOR, RELIABLE, LATCHED, RECORD)}
