"""Passes topics between this host's bus and a link: discovery, types, QoS, late subscribers, no echo."""

from __future__ import annotations

import functools
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from instant_ic.bridge.commands import DRIVE, STOP
from instant_ic.bridge.host_link import HostLink
from instant_ic.bridge.host_protocol import Announce
from instant_ic.bridge.host_session import Arrived
from instant_ic.bridge.host_topics import TopicRule, releases
from instant_ic.bus import RELIABLE, SENSOR, Node, Publisher, QoS, RegistryError, registry
from instant_ic.bus.qos import PRESETS
from instant_ic.bus.transport import Received, TransportError
from instant_ic.control.robot_lease import sender_name
from instant_ic.msg import MessageError, deserialize, serialize

BRIDGES = ("host_bridge", "zenoh_gateway")
"""Nodes that republish messages from elsewhere. Their messages are not exported, to avoid echoes."""

OLD_NEWS_NS = 1_000_000_000
"""A message on a shared state is dropped if the newest is newer by more than this; clock errors are smaller. A false
Bool must be newer by this than every stop of another publisher. Otherwise their order is uncertain, and the stop holds.
"""

MAX_LATCHED = 64
"""Largest number of publishers per latched topic whose last values are kept for late subscribers."""


class ExportedTopics:
    """Exports topics of this host's nodes to the link, except messages republished by a bridge.

    Args:
        rules: topics to export, by name without namespace.
        link: link that carries the topics to the other hosts.
        on_trouble: called with topic and error text when a topic cannot be exported.
    """

    def __init__(
        self, node: Node[Any], rules: dict[str, TopicRule], link: HostLink, on_trouble: Callable[[str, str], None]
    ) -> None:
        self._node, self._rules, self._link, self._on_trouble = node, rules, link, on_trouble
        self._bridges: set[str] = {node.node_name}
        self._offered: dict[tuple[str, str], QoS] = {}
        for name in rules:
            # Pass every message to the link, which decides what waits, is replaced or leaves immediately.
            node.subscribe_received(name, functools.partial(self._export, name), RELIABLE)

    def look(self) -> None:
        """Detect publishers that are new, gone, or offer a different QoS."""
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
                    self._pass(self._link.open, name, publisher.node, publisher.type_name, qos)
        for name, origin in before.keys() - self._offered.keys():
            self._link.forget(name, origin)

    def _export(self, name: str, received: Received) -> None:
        origin = received.publisher
        if (name, origin) not in self._offered:  # just started: look up its QoS and whether it is a bridge
            self.look()
            self._offered.setdefault((name, origin), SENSOR)  # already gone
        if origin in self._bridges:
            return
        message = (received.payload, received.publish_ns, not self._node.use_sim_time)
        self._pass(self._link.offer, name, origin, received.type_name, self._offered[name, origin], *message)

    def _pass(self, method: Callable[..., None], name: str, origin: str, type_name: str, qos: QoS, *rest: Any) -> None:
        """Call a method of the link; report a type unknown to this host instead of a traceback per message."""
        try:
            method(name, origin, type_name, (qos.name, qos.latched, qos.reliable), *rest)
        except ValueError as error:
            self._on_trouble(name, str(error))


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
    stops: dict[tuple[str, str], int] = field(default_factory=dict)  # (host, node) → born_ns; the two newest


class ImportedTopics:
    """Publishes messages that arrive over the link on this host's bus, unchanged.

    Args:
        rules: topics to import, by name without namespace.
        on_trouble: called with topic and error text when a topic cannot be published here.
        holder: returns the holder of the robot's lease as the arbiter reports it; empty if there is none or unknown.
    """

    def __init__(
        self,
        node: Node[Any],
        rules: dict[str, TopicRule],
        on_trouble: Callable[[str, str], None],
        holder: Callable[[], str] = lambda: "",
    ) -> None:
        self._node, self._rules, self._on_trouble, self._holder = node, rules, on_trouble, holder
        self._topics: dict[str, _Imported] = {}
        self._next_outdated_s = 0.0

    def open(self, announce: Announce) -> _Imported:
        """Create the publisher, so that subscribers find it before the first message; called on the link's thread."""
        topic = self._topics.get(announce.topic)
        if topic is None:
            topic = _Imported(announce.type_name, PRESETS.get(announce.qos, SENSOR))
            self._topics[announce.topic] = topic
            self._node.call_soon(self._advertise, announce.topic, topic)
        return topic

    def take(self, peer: str, arrived: Arrived) -> None:
        """Publish a message of a host. Called on the link's thread, so commands do not wait for the node's thread."""
        announce = arrived.announce
        topic = self.open(announce)
        if announce.topic == DRIVE:
            try:
                arrived = _signed(peer, arrived)
            except MessageError as error:
                self._on_trouble(DRIVE, f"command of {peer} refused: {error}")
                return
        if topic.type_name != announce.type_name:
            self._on_trouble(
                announce.topic,
                f"{announce.origin} sends {announce.type_name}, but {topic.type_name} was received before: refused; "
                "restart the bridge if the new type is right",
            )
            return
        with topic.lock:
            if topic.qos.latched:
                if self._rules[announce.topic].shared:  # one state set by several hosts: only the latest message counts
                    source, release = (peer, announce.origin), releases(announce.type_name, arrived.payload)
                    why = _outdated(topic, source, release, arrived.born_ns)
                    if not why and release and announce.topic == STOP:
                        why = self._not_driving(*source)
                    if why:
                        if time.monotonic() >= self._next_outdated_s:  # a peer must not fill the disk
                            self._next_outdated_s = time.monotonic() + 1.0
                            self._node.log.warning("dropped %s of %s: %s", announce.topic, peer, why)
                        return
                    _note_stop(topic, source, release, arrived.born_ns)
                    topic.last.clear()
                topic.newest_ns = max(arrived.born_ns, topic.newest_ns)
                topic.last.pop(announce.origin, None)
                topic.last[announce.origin] = arrived
                if len(topic.last) > MAX_LATCHED:
                    oldest = next(iter(topic.last))
                    del topic.last[oldest]
                    self._on_trouble(
                        announce.topic, f"more than {MAX_LATCHED} nodes publish it: the value of {oldest} was dropped"
                    )
            if topic.publisher is None:
                topic.waiting.append(arrived)
            else:
                self._publish(topic.publisher, arrived)

    def _not_driving(self, peer: str, origin: str) -> str:
        """Return why this node may not release: another bridged node drives. Empty if it may."""
        here, holder = f"{self._node.node_name}/", self._holder()
        theirs = f"{here}{sender_name(peer, origin)}/"
        return f"only {holder} may release" if holder.startswith(here) and not holder.startswith(theirs) else ""

    def _advertise(self, name: str, topic: _Imported) -> None:
        # The bridge has its own publisher of /diagnostics and the like; the other hosts' messages share it.
        publisher = next((p for p in self._node.publishers if p.topic == self._node.resolve(name)), None)
        if publisher is None:
            try:
                publisher = self._node.publisher_raw(name, topic.type_name, topic.qos)
            except RegistryError as error:
                self._on_trouble(name, str(error))
                return
        elif publisher.raw.type_name != topic.type_name:
            self._on_trouble(name, f"the other host sends {topic.type_name}, not {publisher.raw.type_name}: refused")
            return
        with topic.lock:
            for arrived in topic.waiting if topic.qos.depth > 1 else list(topic.waiting)[-1:]:
                self._publish(publisher, arrived)
            topic.waiting.clear()
            topic.publisher = publisher

    def serve_late_readers(self) -> None:
        """Send new subscribers the latched values of all publishers of a topic, such as ``/tf_static``.

        The bus keeps one latched value per publisher, and all values of the link go through this one publisher.
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
        except (TransportError, OSError) as error:  # a message that this bus cannot carry must not end the link
            self._on_trouble(arrived.announce.topic, str(error))


def _signed(peer: str, arrived: Arrived) -> Arrived:
    """Return a drive command whose frame id names the host and node that sent it, whatever it claimed.

    Raises:
        MessageError: the command cannot be decoded.
    """
    announce = arrived.announce
    message = deserialize(arrived.payload, announce.type_name)
    message.header.frame_id = sender_name(peer, announce.origin, message.header.frame_id)
    return replace(arrived, payload=bytes(serialize(message)))


def _outdated(topic: _Imported, source: tuple[str, str], release: bool, born_ns: int) -> str:
    """Return why a message on a shared state is too late; empty if it is in time."""
    if not release:
        return "outdated" if born_ns < topic.newest_ns - OLD_NEWS_NS else ""
    if any(born_ns < at_ns + OLD_NEWS_NS for other, at_ns in topic.stops.items() if other != source):
        return "a release must be 1 s newer than another publisher's stop; release again"
    return ""


def _note_stop(topic: _Imported, source: tuple[str, str], release: bool, born_ns: int) -> None:
    if release:
        topic.stops.clear()
        return
    topic.stops[source] = born_ns
    if len(topic.stops) > 2:  # two suffice: whoever releases, one of them is the newest stop of another publisher
        del topic.stops[min(topic.stops, key=lambda each: topic.stops[each])]
