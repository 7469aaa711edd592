"""Names, types and quality of service of topics on both sides of the Zenoh gateway."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Sequence
from dataclasses import dataclass

from instant_ic.bridge.zenoh_format import TopicQoS
from instant_ic.bus import LATCHED, RELIABLE, SENSOR, QoS
from instant_ic.bus.registry import RegistryError, check_topic
from instant_ic.msg import MessageError, message_type, type_hash

ACTED_ON = ("*/operator/*", "*/cmd_vel", "*/robot/estop", "*/parameter_events")
"""Topics that move a robot, in any namespace, and parameter events: never imported by `subscribe`."""

GRACE_S = 3.0
"""Time in seconds that a vanished topic is kept, for example while its node restarts."""


def ros_qos(qos: QoS) -> TopicQoS:
    """Return the ROS 2 QoS of a preset: sensor data, reliable with a queue, or transient local."""
    if qos.latched:
        return TopicQoS(latched=True, depth=1)
    return TopicQoS(depth=10) if qos.reliable else TopicQoS(reliable=False, depth=5)


def bus_qos(qos: TopicQoS) -> QoS:
    """Return the closest preset; the inverse of :func:`ros_qos`."""
    if qos.latched:
        return LATCHED
    return RELIABLE if qos.reliable else SENSOR


@dataclass(frozen=True)
class Namespace:
    """Maps topic names between a run directory and the ROS graph.

    Attributes:
        name: namespace in the ROS graph: ``robot1`` maps ``/scan`` to ``/robot1/scan``; empty keeps names unchanged.
    """

    name: str = ""

    def __post_init__(self) -> None:
        if self.name:
            check_topic(f"/{self.name}")

    @property
    def ros(self) -> str:
        """The namespace as ROS 2 writes it: ``/robot1``, or ``/``."""
        return f"/{self.name}"

    def to_ros(self, topic: str) -> str:
        return f"/{self.name}{topic}" if self.name else topic

    def to_local(self, topic: str) -> str | None:
        """Return the local name of a ROS topic; None if it is outside the namespace."""
        head = f"/{self.name}" if self.name else ""
        return topic[len(head) :] if topic.startswith(f"{head}/") else None


def takes(patterns: Sequence[str], topic: str) -> bool:
    """Return whether one of the patterns (``/camera/*``) matches."""
    return any(fnmatch.fnmatchcase(topic, pattern) for pattern in patterns)


def parse_publish(entries: Sequence[str]) -> dict[str, int]:
    """Parse lines such as ``/lidar/points rate_hz=3``; return pattern → shortest period in ns (0: no limit).

    Raises:
        ValueError: a line has another form.
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
            raise ValueError(f"publish: {entry!r} must be /TOPIC or a pattern, optionally followed by rate_hz=N")
        periods[pattern] = int(1e9 / rate_hz)
    return periods


def known_hash(type_name: str) -> str | None:
    """Return the RIHS01 hash of a type; None if the type is neither in ROS 2 Jazzy nor ours."""
    try:
        return type_hash(message_type(type_name).__msgtype__)
    except MessageError:
        return None


def parse_subscribe(entries: Sequence[str]) -> tuple[str, ...]:
    """Check names and patterns such as ``/scan`` and ``/robot*/pose``.

    Raises:
        RegistryError: a name does not begin with a slash, or names a topic that moves a robot.
    """
    for topic in entries:
        if not topic.startswith("/") or " " in topic:
            raise RegistryError(f"subscribe: {topic!r} must be /TOPIC or a pattern")
        if not {"*", "?", "["} & set(topic) and takes(ACTED_ON, topic):
            raise RegistryError(f"subscribe: {topic} moves a robot; list it under commands, or rename it there")
    return tuple(entries)
