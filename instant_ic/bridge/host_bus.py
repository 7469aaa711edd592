"""Topics of this host's bus into a link, and out of it: discovery, types, QoS, late readers, no echo."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from ..bus import LATCHED, RELIABLE, SENSOR, Node, Publisher, QoS, RegistryError, Subscription, registry
from ..bus.qos import PRESETS
from ..bus.transport import Received
from .host_link import HostLink
from .host_session import Arrived
from .host_topics import TopicRule

BRIDGE_MODULE = "instant_ic.nodes.host_bridge"


class ExportedTopics:
    """What this host's nodes publish, given to the link; not what a bridge publishes here.

    Args:
        node: the bridge's node.
        rules: topics to give, by name without namespace.
        link: where they go.
    """

    def __init__(self, node: Node[Any], rules: dict[str, TopicRule], link: HostLink) -> None:
        self._node, self._rules, self._link = node, rules, link
        self._subscriptions: dict[str, tuple[Subscription, QoS]] = {}
        self._offered: dict[str, dict[str, QoS]] = {}
        self._origins: set[tuple[str, str]] = set()
        self._bridges: set[str] = {node.node_name}
        self._nodes: set[str] = set()

    def look(self) -> None:
        """Finds publishers that came, went, or offer another QoS than before."""
        run_dir = self._node.run_dir
        assert run_dir is not None
        nodes = registry.list_nodes(run_dir)
        self._nodes = {info.name for info in nodes}
        self._bridges = {self._node.node_name, *(info.name for info in nodes if info.module == BRIDGE_MODULE)}
        live: set[tuple[str, str]] = set()
        for name in self._rules:
            publishers = registry.topic_publishers(run_dir, self._node.resolve(name))
            offered = {p.node: PRESETS.get(p.qos, SENSOR) for p in publishers if p.node not in self._bridges}
            self._offered[name] = offered
            live |= {(name, origin) for origin in offered}
            if offered:
                self._listen(name, max(offered.values(), key=lambda qos: (qos.latched, qos.reliable)))
        for name, origin in self._origins - live:
            self._link.forget(name, origin)
        self._origins = live

    def _listen(self, name: str, qos: QoS) -> None:
        # A queue where every message counts; the newest of each publisher elsewhere.
        wanted = LATCHED if qos.latched else RELIABLE if qos.reliable else SENSOR
        present = self._subscriptions.get(name)
        if present is not None and present[1] == wanted:
            return
        if present is not None:
            self._node.drop(present[0])

        def export(received: Received) -> None:
            self._export(name, received)

        self._subscriptions[name] = self._node.subscribe_received(name, export, wanted), wanted

    def _export(self, name: str, received: Received) -> None:
        origin = received.publisher
        if origin not in self._nodes:  # it started this moment: is it a bridge?
            self.look()
        if origin in self._bridges:
            return
        qos = self._offered.get(name, {}).get(origin, self._subscriptions[name][1])
        self._link.offer(
            name,
            origin,
            received.type_name,
            (qos.name, qos.latched, qos.reliable),
            bytes(received.payload),
            received.publish_ns,
            wall_time=not self._node.use_sim_time,
        )

    @property
    def topics(self) -> list[str]:
        """Topics of the list that somebody publishes here."""
        return sorted(self._subscriptions)


@dataclass
class _Imported:
    type_name: str
    qos: QoS
    lock: threading.Lock = field(default_factory=threading.Lock)
    publisher: Publisher | None = None
    waiting: deque[Arrived] = field(default_factory=lambda: deque(maxlen=1000))
    last: dict[str, Arrived] = field(default_factory=dict)
    readers: int = 0


class ImportedTopics:
    """What comes over the link, published on this host as it was on the other.

    Args:
        node: the bridge's node.
        on_trouble: called with topic and words when a topic cannot be published here.
    """

    def __init__(self, node: Node[Any], on_trouble: Callable[[str, str], None]) -> None:
        self._node, self._on_trouble = node, on_trouble
        self._topics: dict[str, _Imported] = {}

    def take(self, arrived: Arrived) -> None:
        """Publishes a message; called on the link's thread, so that a command does not wait for the node's."""
        announce = arrived.announce
        topic = self._topics.get(announce.topic)
        if topic is None:
            topic = _Imported(announce.type_name, PRESETS.get(announce.qos, SENSOR))
            self._topics[announce.topic] = topic
            self._node.call_soon(self._advertise, announce.topic, topic)
        if topic.type_name != announce.type_name:
            self._on_trouble(
                announce.topic,
                f"{announce.origin} sends {announce.type_name}, but {topic.type_name} came before: refused; "
                "restart the bridge if the new type is right",
            )
            return
        with topic.lock:
            if topic.qos.latched:
                topic.last[announce.origin] = arrived
            if topic.publisher is None:
                topic.waiting.append(arrived)
            else:
                topic.publisher.publish_bytes(arrived.payload, arrived.publish_ns)

    def _advertise(self, name: str, topic: _Imported) -> None:
        try:
            publisher = self._node.publisher_raw(name, topic.type_name, topic.qos)
        except RegistryError as error:
            self._on_trouble(name, str(error))
            return
        with topic.lock:
            for arrived in topic.waiting if topic.qos.depth > 1 else list(topic.waiting)[-1:]:
                publisher.publish_bytes(arrived.payload, arrived.publish_ns)
            topic.waiting.clear()
            topic.publisher = publisher

    def serve_late_readers(self) -> None:
        """Gives readers that came the latched values of all who publish a topic there, as ``/tf_static`` has several.

        The bus itself keeps one latched value for a publisher, and here all of them come through this one.
        """
        for topic in list(self._topics.values()):
            if topic.publisher is None or len(topic.last) < 2:
                continue
            readers = topic.publisher.subscriber_count
            came, topic.readers = readers > topic.readers, readers
            if came:
                with topic.lock:
                    for arrived in topic.last.values():
                        topic.publisher.publish_bytes(arrived.payload, arrived.publish_ns)

    @property
    def topics(self) -> list[str]:
        """Topics that came."""
        return sorted(self._topics)
