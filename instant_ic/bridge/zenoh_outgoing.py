"""Exports topics of a run directory to the ROS graph over Zenoh."""

from __future__ import annotations

import fnmatch
import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from instant_ic.bridge.zenoh_format import GID_SIZE, SENDER_SIZE, Attachment, data_key
from instant_ic.bridge.zenoh_session import RosNode, zenoh
from instant_ic.bus import ERROR, RELIABLE, Node, QoS, Subscription
from instant_ic.bus.qos import PRESETS
from instant_ic.bus.registry import PublisherInfo, TopicInfo
from instant_ic.bus.transport import Received
from instant_ic.msg import MessageError, message_type, type_hash

GRACE_S = 3.0
"""Time in seconds that a vanished topic is kept, for example while its node restarts."""

_HEARTBEAT_S = 0.5  # shows a late or lossy reader of a latched topic which message it missed, as in rmw_zenoh


def known_hash(type_name: str) -> str | None:
    """Return the RIHS01 hash of a type; None if the type is neither in ROS 2 Jazzy nor ours."""
    try:
        return type_hash(message_type(type_name).__msgtype__)
    except MessageError:
        return None


def parse_publish(entries: Sequence[str]) -> dict[str, int]:
    """Parse lines such as ``/lidar/points rate_hz=3``; return pattern → shortest period in ns (0: no limit).

    Raises:
        ValueError: a line is malformed.
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


class RosPublisher:
    """A publisher in the ROS graph.

    Args:
        node: node of the publisher.
        topic: full name, including the namespace.
        type_name: ``std_msgs/msg/String``.
        type_hash: RIHS01 hash of the type.
        qos: preset; a latched topic keeps its last message for late subscribers.
    """

    def __init__(self, node: RosNode, topic: str, type_name: str, type_hash: str, qos: QoS = RELIABLE) -> None:
        package = zenoh()
        session = node.session
        key = data_key(session.domain, topic, type_name, type_hash)
        reliability = package.Reliability.RELIABLE if qos.reliable else package.Reliability.BEST_EFFORT
        # As in rmw_zenoh, a link that cannot keep up drops messages instead of blocking us; the reader counts the loss.
        options = {"congestion_control": package.CongestionControl.DROP, "reliability": reliability}
        if qos.latched:
            self._publisher = package.ext.declare_advanced_publisher(
                session.zenoh,
                key,
                cache=package.ext.CacheConfig(max_samples=1),
                publisher_detection=True,
                sample_miss_detection=package.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
                **options,
            )
        else:
            self._publisher = session.zenoh.declare_publisher(key, **options)
        self._token = node.endpoint("MP", topic, type_name, type_hash, qos)
        self.gid = session.gid_head + os.urandom(GID_SIZE - SENDER_SIZE)
        self._count = 0

    def put(self, payload: bytes | memoryview, source_ns: int) -> None:
        """Send CDR bytes unchanged, with their time of publication."""
        self._count += 1
        self._publisher.put(bytes(payload), attachment=Attachment(self._count, source_ns, self.gid).pack())

    def close(self) -> None:
        self._token.undeclare()
        self._publisher.undeclare()


@dataclass
class _Mirror:
    """A bus publisher in the ROS graph."""

    ros: RosPublisher
    gone_s: float | None = None
    due_ns: int = 0

    def early(self, now_ns: int, period_ns: int) -> bool:
        """Return whether a rate limit drops a message that arrives now."""
        if now_ns < self.due_ns:
            return True
        # On a fixed grid of periods, a limit of 3 Hz on a 10 Hz topic gives 3 Hz. A pause restarts it, without a burst.
        self.due_ns = (self.due_ns if now_ns - self.due_ns < period_ns else now_ns) + period_ns
        return False


@dataclass
class _ExportedTopic:
    """An exported topic: one subscription on the bus, and a mirror of each of its publishers by node name."""

    period_ns: int
    subscription: Subscription
    mirrors: dict[str, _Mirror] = field(default_factory=dict)


class Outgoing:
    """Exports topics unchanged, under the names of the nodes that publish them.

    Each publisher on the bus has its own ROS publisher. Latched values of several nodes (``/tf_static``) are therefore
    all kept for late subscribers, and ``ros2 node list`` shows the nodes themselves.

    Args:
        node: the gateway.
        own: the gateway in the ROS graph.
        prefix: text before the names of topics in the ROS graph: ``/robot1``, or empty.
        publish: see :func:`parse_publish`; the first matching pattern applies.
        imported: returns whether the gateway imports a topic; messages that it imported are not exported again.

    Attributes:
        count, thinned: messages sent, and messages dropped by a rate limit.
    """

    def __init__(
        self, node: Node[Any], own: RosNode, prefix: str, publish: Sequence[str], imported: Callable[[str], bool]
    ) -> None:
        self._node = node
        self._own = own
        self._prefix = prefix
        self._periods = parse_publish(publish)
        self._imported = imported
        self._topics: dict[str, _ExportedTopic] = {}
        self._nodes: dict[str, RosNode] = {}
        self.count = 0
        self.thinned = 0

    @property
    def topics(self) -> list[str]:
        return sorted(self._topics)

    def reconcile(self, present: Sequence[TopicInfo]) -> None:
        """Export new topics, and drop those whose publishers have been gone for a while."""
        live: dict[str, list[PublisherInfo]] = {}
        for info in present:
            publishers = [p for p in info.publishers if not self._came_in(info.topic, p.node)]
            period_ns = next((p for each, p in self._periods.items() if fnmatch.fnmatchcase(info.topic, each)), None)
            if not publishers or period_ns is None:
                continue
            live[info.topic] = publishers
            if info.topic not in self._topics:
                qos = max((PRESETS.get(p.qos, RELIABLE) for p in publishers), key=lambda q: (q.latched, q.reliable))
                subscription = self._node.subscribe_received(info.topic, self._forward, qos)
                self._topics[info.topic] = _ExportedTopic(period_ns, subscription)
            for publisher in publishers:
                self._mirror(info.topic, publisher.node, publisher.type_name, PRESETS.get(publisher.qos, RELIABLE))
        for topic in list(self._topics):
            self._drop_gone(topic, {publisher.node for publisher in live.get(topic, ())})
        used = {name for exported in self._topics.values() for name in exported.mirrors}
        for name in self._nodes.keys() - used:
            self._nodes.pop(name).close()

    def _drop_gone(self, topic: str, here: set[str]) -> None:
        """Drop the mirrors of a topic's publishers that have been gone for a while, and the topic with the last one."""
        exported, now = self._topics[topic], time.monotonic()
        for name, mirror in list(exported.mirrors.items()):
            if name in here:
                mirror.gone_s = None
            elif mirror.gone_s is None:
                mirror.gone_s = now
            elif now - mirror.gone_s > GRACE_S:
                exported.mirrors.pop(name).ros.close()
        if not exported.mirrors and not here:
            self._node.drop(exported.subscription)
            del self._topics[topic]

    def _mirror(self, topic: str, node: str, type_name: str, qos: QoS) -> _Mirror | None:
        """Return the mirror of a node's publisher; create it if needed. Return None if its type is unknown."""
        mirrors = self._topics[topic].mirrors
        if node not in mirrors:
            if (hash_ := known_hash(type_name)) is None:
                self._node.diagnose(f"out {topic}", ERROR, f"{type_name} is unknown here: not exported")
                return None
            own = self._own
            there = own if node == self._node.node_name else self._nodes.get(node)
            if there is None:
                there = self._nodes[node] = RosNode(own.session, own.namespace, node)
            mirrors[node] = _Mirror(RosPublisher(there, self._prefix + topic, type_name, hash_, qos))
            self._node.log.debug("%s of %s is exported as %s", topic, node, self._prefix + topic)
        return mirrors[node]

    def _came_in(self, topic: str, publisher: str) -> bool:
        """Return whether a publisher only republishes imported messages, which must not be exported again."""
        return publisher == self._node.node_name and self._imported(topic)

    def _forward(self, received: Received) -> None:
        exported = self._topics.get(received.topic)
        if exported is None or self._came_in(received.topic, received.publisher):
            return
        # A publisher's first message may arrive before the next look at the registry.
        mirror = self._mirror(received.topic, received.publisher, received.type_name, exported.subscription.raw.qos)
        if mirror is None:
            return
        if exported.period_ns and mirror.early(received.received_ns, exported.period_ns):
            self.thinned += 1
            return
        mirror.ros.put(received.payload, received.publish_ns)
        self.count += 1
