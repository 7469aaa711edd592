"""Exports topics of a run directory to the ROS graph over Zenoh."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from instant_ic.bridge.zenoh_format import GID_SIZE, SENDER_SIZE, Attachment, TopicQoS, data_key
from instant_ic.bridge.zenoh_session import RosNode, RosSession, ZenohError, zenoh
from instant_ic.bridge.zenoh_topics import GRACE_S, Namespace, known_hash, parse_publish, ros_qos, takes
from instant_ic.bus import ERROR, RELIABLE, Node, QoS, Subscription
from instant_ic.bus.qos import PRESETS
from instant_ic.bus.registry import PublisherInfo, TopicInfo
from instant_ic.bus.transport import Received

_HEARTBEAT_S = 0.5  # lets a late reader of a latched topic, or one with losses, find what it missed, as in rmw_zenoh


class RosPublisher:
    """A publisher in the ROS graph; :meth:`put` may be called from any thread.

    Args:
        node: node of the publisher.
        topic: full name, including the namespace.
        type_name: ``std_msgs/msg/String``.
        type_hash: RIHS01 hash of the type.
        qos: quality of service; a latched topic keeps its last ``depth`` messages for late subscribers.
    """

    def __init__(self, node: RosNode, topic: str, type_name: str, type_hash: str, qos: TopicQoS) -> None:
        package = zenoh()
        session = node.session
        key = data_key(session.domain, topic, type_name, type_hash)
        reliability = package.Reliability.RELIABLE if qos.reliable else package.Reliability.BEST_EFFORT
        # As in rmw_zenoh: a link that cannot keep up loses messages, which the reader counts, but never blocks us.
        options = {"congestion_control": package.CongestionControl.DROP, "reliability": reliability}
        if qos.latched:
            self._publisher = package.ext.declare_advanced_publisher(
                session.zenoh,
                key,
                cache=package.ext.CacheConfig(max_samples=qos.depth or 1),
                publisher_detection=True,
                sample_miss_detection=package.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
                **options,
            )
        else:
            self._publisher = session.zenoh.declare_publisher(key, **options)
        self._token = node.endpoint("MP", topic, type_name, type_hash, qos)
        self._lock = threading.Lock()
        self.gid = session.gid_head + os.urandom(GID_SIZE - SENDER_SIZE)
        self.count = 0

    def put(self, payload: bytes | memoryview, source_ns: int) -> None:
        """Send CDR bytes unchanged, with their time of publication.

        Raises:
            ZenohError: the session is closed.
        """
        with self._lock:
            self.count += 1
            attachment = Attachment(self.count, source_ns, self.gid).pack()
            try:
                self._publisher.put(bytes(payload), attachment=attachment)
            except zenoh().ZError as error:
                raise ZenohError(f"Zenoh: {error}") from None

    def close(self) -> None:
        self._token.undeclare()
        self._publisher.undeclare()


@dataclass
class _Out:
    """An exported topic: one subscription on the bus, and one ROS publisher for each of its publishers."""

    period_ns: int
    subscription: Subscription | None = None
    publishers: dict[str, RosPublisher] = field(default_factory=dict)
    gone_s: dict[str, float] = field(default_factory=dict)
    due_ns: dict[str, int] = field(default_factory=dict)


class Outgoing:
    """Exports topics unchanged, under the names of the nodes that publish them.

    Each publisher on the bus has its own ROS publisher. Latched values of several nodes (``/tf_static``) are therefore
    all kept for late subscribers, and ``ros2 node list`` shows the nodes themselves.

    Args:
        session: the Zenoh session.
        namespace: namespace of the topics in the ROS graph.
        own: the gateway itself in the ROS graph.
        publish: see :func:`parse_publish`; the first matching pattern applies.

    Attributes:
        brought_in: returns whether the same gateway imports a topic; messages that it imported are not exported again.
        count, thinned: messages sent, and messages dropped by a rate limit.

    Raises:
        ValueError: a line of ``publish`` is wrong.
    """

    def __init__(
        self, node: Node[Any], session: RosSession, namespace: Namespace, own: RosNode, publish: Sequence[str]
    ) -> None:
        self._node = node
        self._session = session
        self._own = own
        self._namespace = namespace
        self._periods = parse_publish(publish)
        self._topics: dict[str, _Out] = {}
        self._nodes: dict[str, RosNode] = {}
        self.brought_in: Callable[[str], bool] = lambda topic: False
        self.count = 0
        self.thinned = 0

    @property
    def topics(self) -> list[str]:
        return sorted(self._topics)

    def reconcile(self, present: Sequence[TopicInfo]) -> None:
        """Export new topics, and drop those whose publishers have been gone for a while."""
        now = time.monotonic()
        live: dict[str, list[PublisherInfo]] = {}
        for info in present:
            publishers = [p for p in info.publishers if not self._came_in(info.topic, p.node)]
            if publishers and takes(tuple(self._periods), info.topic):
                live[info.topic] = publishers
        for topic, publishers in live.items():
            if (out := self._topics.get(topic)) is None:
                period = next(p for pattern, p in self._periods.items() if takes((pattern,), topic))
                out = self._topics[topic] = _Out(period)
            for publisher in publishers:
                self._mirror(topic, publisher.node, publisher.type_name, PRESETS.get(publisher.qos, RELIABLE))
            if out.subscription is None:
                qos = max((PRESETS.get(p.qos, RELIABLE) for p in publishers), key=lambda q: (q.latched, q.reliable))
                out.subscription = self._node.subscribe_received(topic, self._forward, qos)
        for topic, out in list(self._topics.items()):
            here = {publisher.node for publisher in live.get(topic, ())}
            for name in [name for name in out.publishers if name not in here]:
                if now - out.gone_s.setdefault(name, now) > GRACE_S:
                    out.publishers.pop(name).close()
                    del out.gone_s[name]
            for name in here:
                out.gone_s.pop(name, None)
            if not out.publishers:
                if out.subscription is not None:
                    self._node.drop(out.subscription)
                del self._topics[topic]
        used = {name for out in self._topics.values() for name in out.publishers}
        for name in [name for name in self._nodes if name not in used]:
            self._nodes.pop(name).close()

    def _mirror(self, topic: str, node: str, type_name: str, qos: QoS) -> RosPublisher | None:
        """Return the ROS publisher that represents a node's publisher; create it if needed."""
        out = self._topics[topic]
        if node not in out.publishers:
            if (hash_ := known_hash(type_name)) is None:
                self._node.diagnose(f"out {topic}", ERROR, f"{type_name} is unknown here: not exported")
                return None
            there = self._own if node == self._own.name else self._nodes.get(node)
            if there is None:
                there = self._nodes[node] = RosNode(self._session, self._namespace.ros, node)
            name = self._namespace.to_ros(topic)
            out.publishers[node] = RosPublisher(there, name, type_name, hash_, ros_qos(qos))
            self._node.log.debug("%s of %s is exported as %s", topic, node, name)
        return out.publishers[node]

    def _came_in(self, topic: str, publisher: str) -> bool:
        """Return whether a publisher only republishes imported messages, which must not be exported again."""
        return publisher == self._node.node_name and self.brought_in(topic)

    def _forward(self, received: Received) -> None:
        out = self._topics.get(received.topic)
        if out is None or self._came_in(received.topic, received.publisher):
            return
        publisher = out.publishers.get(received.publisher)
        if publisher is None and out.subscription is not None:  # received before the next look at the registry
            publisher = self._mirror(received.topic, received.publisher, received.type_name, out.subscription.raw.qos)
        if publisher is None or self._early(out, received):
            return
        publisher.put(received.payload, received.publish_ns)
        self.count += 1

    def _early(self, out: _Out, received: Received) -> bool:
        """Return True if the rate limit drops a message; each publisher has its own limit."""
        if not out.period_ns:
            return False
        due_ns = out.due_ns.get(received.publisher, 0)
        if received.received_ns < due_ns:
            self.thinned += 1
            return True
        # Keep a fixed grid of periods, so that a limit of 3 Hz on a 10 Hz topic gives 3 Hz; no burst after a pause.
        start_ns = due_ns if received.received_ns - due_ns < out.period_ns else received.received_ns
        out.due_ns[received.publisher] = start_ns + out.period_ns
        return False
