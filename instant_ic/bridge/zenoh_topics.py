"""Names, types and quality of service of topics on both sides of the gateway to Zenoh."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Sequence
from dataclasses import dataclass

from instant_ic.bridge.zenoh_format import TopicQoS
from instant_ic.bus import LATCHED, RELIABLE, SENSOR, QoS
from instant_ic.bus.registry import RegistryError, check_topic
from instant_ic.msg import MessageError, message_type, type_hash

STOP = "/operator/estop"
COMMANDS = {"/operator/cmd_vel": "geometry_msgs/msg/TwistStamped", STOP: "std_msgs/msg/Bool"}
"""What an operator elsewhere may send, and its type."""

ACTED_ON = ("*/operator/*", "*/cmd_vel", "*/robot/estop", "*/parameter_events")
"""Topics that move a robot, in any namespace, and what tells of its parameters: never brought in by `subscribe`."""

GRACE_S = 3.0
"""A topic that leaves and comes back, as when its node restarts, keeps its place for so long."""


def ros_qos(qos: QoS) -> TopicQoS:
    """Our preset as ROS 2 users know it: sensor data, reliable with a queue, transient local."""
    if qos.latched:
        return TopicQoS(latched=True, depth=1)
    return TopicQoS(depth=10) if qos.reliable else TopicQoS(reliable=False, depth=5)


def bus_qos(qos: TopicQoS) -> QoS:
    """The way back from :func:`ros_qos`."""
    if qos.latched:
        return LATCHED
    return RELIABLE if qos.reliable else SENSOR


@dataclass(frozen=True)
class Namespace:
    """Where a run directory's topics stand in the ROS graph.

    Attributes:
        name: ``robot1`` makes ``/scan`` here ``/robot1/scan`` there; empty leaves names as they are.
    """

    name: str = ""

    def __post_init__(self) -> None:
        """Checks the name."""
        if self.name:
            check_topic(f"/{self.name}")

    @property
    def ros(self) -> str:
        """As ROS 2 writes it: ``/robot1``, or ``/``."""
        return f"/{self.name}"

    def to_ros(self, topic: str) -> str:
        """Name there of a topic here."""
        return f"/{self.name}{topic}" if self.name else topic

    def to_local(self, topic: str) -> str | None:
        """Name here of a topic there; None where it is outside the namespace."""
        head = f"/{self.name}" if self.name else ""
        return topic[len(head) :] if topic.startswith(f"{head}/") else None


def takes(patterns: Sequence[str], topic: str) -> bool:
    """Whether one of the patterns (``/camera/*``) matches."""
    return any(fnmatch.fnmatchcase(topic, pattern) for pattern in patterns)


def parse_publish(entries: Sequence[str]) -> dict[str, int]:
    """Least time between messages in ns by pattern, of lines like ``/lidar/points rate_hz=3``; 0 sends all.

    Raises:
        ValueError: something else stands there.
    """
    periods = {}
    for entry in entries:
        pattern, _, option = entry.partition(" ")
        key, _, value = option.strip().partition("=")
        try:
            rate_hz = float(value) if option else math.inf
        except ValueError:
            rate_hz = 0.0
        if not pattern.startswith("/") or (option and key != "rate_hz") or not rate_hz > 0:
            raise ValueError(f"publish: {entry!r} must be /TOPIC, a pattern, or one of them with rate_hz=N behind it")
        periods[pattern] = int(1e9 / rate_hz)
    return periods


def known_hash(type_name: str) -> str | None:
    """RIHS01 hash of a type; None for one that is not in ROS 2 Jazzy or among our own."""
    try:
        return type_hash(message_type(type_name).__msgtype__)
    except MessageError:
        return None


def parse_subscribe(entries: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Patterns, and types of those topics that have one, of lines like ``/scan`` and ``/x std_msgs/msg/String``.

    Raises:
        RegistryError, MessageError: a topic's name is not legal, a type is not known, or the topic is of ACTED_ON.
    """
    patterns, types = [], {}
    for entry in entries:
        topic, _, name = entry.partition(" ")
        if name:
            if takes(ACTED_ON, topic):
                raise RegistryError(f"subscribe: {topic} moves a robot; list it under commands, or rename it there")
            types[check_topic(topic)] = message_type(name.strip()).__msgtype__
        patterns.append(topic)
    return patterns, types
