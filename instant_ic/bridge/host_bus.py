"""Topics of this host's bus into a link, and out of it: discovery, types, QoS, late readers, no echo."""

from __future__ import annotations

import functools
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from instant_ic.bridge.host_link import HostLink
from instant_ic.bridge.host_protocol import Announce
from instant_ic.bridge.host_session import Arrived
from instant_ic.bridge.host_topics import TopicRule
from instant_ic.bus import RELIABLE, SENSOR, Node, Publisher, QoS, RegistryError, registry
from instant_ic.bus.qos import PRESETS
from instant_ic.bus.transport import Received, TransportError
from instant_ic.msg import MessageError, deserialize

BRIDGES = ("host_bridge", "zenoh_gateway")
"""Nodes that publish here what was published elsewhere: it is not sent on, or it would come back."""

OLD_NEWS_NS = 1_000_000_000
"""Words on a shared state older than the latest by more than this are not taken; no clock error is so large. A false
Bool has no such grace: which of a release and a stop came first is then uncertain, and the stop must hold.
"""

MAX_LATCHED = 64
"""Publishers of one latched topic whose last values are kept for late readers."""


class ExportedTopics:
    """What this host's nodes publish, given to the link; not what a bridge publishes here.

    Args:
        node: the bridge's node.
        rules: topics to give, by name without namespace.
        link: where they go.
        on_trouble: called with topic and words when a topic cannot go.
    """

    def __init__(
        self, node: Node[Any], rules: dict[str, TopicRule], link: HostLink, on_trouble: Callable[[str, str], None]
    ) -> None:
        self._node, self._rules, self._link, self._on_trouble = node, rules, link, on_trouble
        self._bridges: set[str] = {node.node_name}
        self._offered: dict[tuple[str, str], QoS] = {}
        for name in rules:
            # Every message is handed to the link, which knows what of it is to wait, be replaced, or go at once.
            node.subscribe_received(name, functools.partial(self._export, name), RELIABLE)

    def look(self) -> None:
        """Finds publishers that came, went, or offer another QoS than before."""
        run_dir = self._node.run_dir
        assert run_dir is not None
        nodes = registry.list_nodes(run_dir)
        self._bridges = {self._node.node_name, *(info.name for info in nodes if info.executable in BRIDGES)}
        before, self._offered = self._offered, {}
        for name in self._rules:
            for publisher in registry.topic_publishers(run_dir, self._node.resolve(name)):
                qos = PRESETS.get(publisher.qos, SENSOR)
                self._offered[name, publisher.node] = qos
                if publisher.node not in self._bridges and (name, publisher.node) not in before:
                    with self._told(name):
                        self._link.open(name, publisher.node, publisher.type_name, _fields(qos))
        for name, origin in before.keys() - self._offered.keys():
            self._link.forget(name, origin)

    def _export(self, name: str, received: Received) -> None:
        origin = received.publisher
        if (name, origin) not in self._offered:  # it started this moment: what does it offer, and is it a bridge?
            self.look()
            self._offered.setdefault((name, origin), SENSOR)  # gone again already
        if origin in self._bridges:
            return
        qos = self._offered[name, origin]
        wall_time = not self._node.use_sim_time
        with self._told(name):
            self._link.offer(
                name, origin, received.type_name, _fields(qos), received.payload, received.publish_ns, wall_time
            )

    @contextmanager
    def _told(self, name: str) -> Iterator[None]:
        """A type that this host does not know is told once, not with a trace for each message."""
        try:
            yield
        except ValueError as error:
            self._on_trouble(name, str(error))


def _releases(arrived: Arrived) -> bool:
    """Whether a word on a shared state is that of a released emergency stop."""
    kind = arrived.announce.type_name
    try:
        return kind == "std_msgs/msg/Bool" and not deserialize(arrived.payload, kind).data
    except MessageError:  # no word at all; who reads it here refuses it and tells
        return False


def _fields(qos: QoS) -> tuple[str, bool, bool]:
    return qos.name, qos.latched, qos.reliable


@dataclass
class _Imported:
    type_name: str
    qos: QoS
    lock: threading.Lock = field(default_factory=threading.Lock)
    publisher: Publisher | None = None
    waiting: deque[Arrived] = field(default_factory=lambda: deque(maxlen=1000))
    last: dict[str, Arrived] = field(default_factory=dict)
    readers: int = 0
    newest_ns: int = 0


class ImportedTopics:
    """What comes over the link, published on this host as it was on the other.

    Args:
        node: the bridge's node.
        rules: topics to take, by name without namespace.
        on_trouble: called with topic and words when a topic cannot be published here.
    """

    def __init__(self, node: Node[Any], rules: dict[str, TopicRule], on_trouble: Callable[[str, str], None]) -> None:
        self._node, self._rules, self._on_trouble = node, rules, on_trouble
        self._topics: dict[str, _Imported] = {}

    def open(self, announce: Announce) -> _Imported:
        """Makes the publisher, so that readers find it before the first message; called on the link's thread."""
        topic = self._topics.get(announce.topic)
        if topic is None:
            topic = _Imported(announce.type_name, PRESETS.get(announce.qos, SENSOR))
            self._topics[announce.topic] = topic
            self._node.call_soon(self._advertise, announce.topic, topic)
        return topic

    def take(self, arrived: Arrived) -> None:
        """Publishes a message; called on the link's thread, so that a command does not wait for the node's."""
        announce = arrived.announce
        topic = self.open(announce)
        if topic.type_name != announce.type_name:
            self._on_trouble(
                announce.topic,
                f"{announce.origin} sends {announce.type_name}, but {topic.type_name} came before: refused; "
                "restart the bridge if the new type is right",
            )
            return
        with topic.lock:
            if topic.qos.latched:
                if self._rules[announce.topic].shared:  # one state that several hosts set: only the latest word holds
                    grace_ns = 0 if _releases(arrived) else OLD_NEWS_NS
                    if arrived.born_ns < topic.newest_ns - grace_ns:
                        self._node.log.warning("%s of %s is old news: left out", announce.topic, announce.origin)
                        return
                    topic.last.clear()
                topic.newest_ns = max(arrived.born_ns, topic.newest_ns)
                topic.last.pop(announce.origin, None)
                topic.last[announce.origin] = arrived
                if len(topic.last) > MAX_LATCHED:
                    oldest = next(iter(topic.last))
                    del topic.last[oldest]
                    self._on_trouble(
                        announce.topic, f"more than {MAX_LATCHED} nodes publish it: the value of {oldest} is forgotten"
                    )
            if topic.publisher is None:
                topic.waiting.append(arrived)
            else:
                self._publish(topic.publisher, arrived)

    def _advertise(self, name: str, topic: _Imported) -> None:
        try:
            publisher = self._node.publisher_raw(name, topic.type_name, topic.qos)
        except RegistryError as error:
            self._on_trouble(name, str(error))
            return
        with topic.lock:
            for arrived in topic.waiting if topic.qos.depth > 1 else list(topic.waiting)[-1:]:
                self._publish(publisher, arrived)
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
                        self._publish(topic.publisher, arrived)

    def _publish(self, publisher: Publisher, arrived: Arrived) -> None:
        try:
            publisher.publish_bytes(arrived.payload, arrived.publish_ns)
        except (TransportError, OSError) as error:  # one message that this bus cannot carry must not end the link
            self._on_trouble(arrived.announce.topic, str(error))
