"""Imports topics of the ROS graph over Zenoh into a run directory."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from instant_ic.bridge.commands import COMMANDS, DRIVE, STOP
from instant_ic.bridge.zenoh_format import Attachment, FormatError, Token, TopicQoS, data_key
from instant_ic.bridge.zenoh_outgoing import Outgoing
from instant_ic.bridge.zenoh_session import RosNode, zenoh
from instant_ic.bridge.zenoh_topics import (
    ACTED_ON,
    GRACE_S,
    Namespace,
    bus_qos,
    known_hash,
    parse_subscribe,
    takes,
)
from instant_ic.bus import ERROR, OK, Node, Publisher
from instant_ic.bus.registry import RegistryError
from instant_ic.control.command_gate import CommandGate
from instant_ic.control.robot_lease import RELEASED, Refusal, Verdict, sender_name
from instant_ic.msg import MessageError, deserialize, message_type, serialize, twist_stamped, twist_values, type_hash

_TF = "tf2_msgs/msg/TFMessage"
MAX_TOPICS, MAX_SOURCES, MAX_NAME = 512, 64, 200
"""Most imported topics, publishers per topic, and characters of a name: limits against a hostile ROS graph."""


MAX_PUBLISHERS = 256
"""Most publishers per topic whose gaps are counted; needed because senders choose their ids freely."""

log = logging.getLogger(__name__)


class RosSubscription:
    """A subscription in the ROS graph. It receives only from other sessions, so our own messages do not return.

    Messages of another definition have another key and are not received. A latched subscription requests earlier
    messages from the publishers.

    Args:
        node, topic, type_name, type_hash, qos: as for :class:`RosPublisher`.
        on_message: called with ``(payload, attachment)``, in order per publisher, on a Zenoh thread.

    Attributes:
        count: messages passed on.
        lost: messages lost on the way.
        malformed: messages refused because they have no readable attachment.
    """

    def __init__(
        self,
        node: RosNode,
        topic: str,
        type_name: str,
        type_hash: str,
        qos: TopicQoS,
        on_message: Callable[[bytes, Attachment], None],
    ) -> None:
        package = zenoh()
        session = node.session
        self.topic = topic
        self.count = 0
        self.lost = 0
        self.malformed = 0
        self._sequences: dict[bytes, int] = {}
        self._on_message = on_message
        key = data_key(session.domain, topic, type_name, type_hash)
        remote = package.Locality.REMOTE
        if qos.latched:
            self._subscriber = package.ext.declare_advanced_subscriber(
                session.zenoh,
                key,
                self._heard,
                allowed_origin=remote,
                history=package.ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth or 1),
                recovery=package.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                subscriber_detection=True,
            )
        else:
            self._subscriber = session.zenoh.declare_subscriber(key, self._heard, allowed_origin=remote)
        self._token = node.endpoint("MS", topic, type_name, type_hash, qos)

    def _heard(self, sample: Any) -> None:
        try:
            if sample.attachment is None:
                raise FormatError("no attachment")
            attachment = Attachment.unpack(sample.attachment.to_bytes())
        except FormatError as error:
            self.malformed += 1
            if self.malformed == 1:
                log.error("%s: refused a message not made by rmw_zenoh: %s", self.topic, error)
            return
        last = self._sequences.pop(attachment.gid, None)
        if last is not None:
            if attachment.sequence <= last:  # duplicate
                self._sequences[attachment.gid] = last
                return
            self.lost += attachment.sequence - last - 1
        self._sequences[attachment.gid] = attachment.sequence
        if len(self._sequences) > MAX_PUBLISHERS:  # the publisher not heard from for the longest time
            del self._sequences[next(iter(self._sequences))]
        self.count += 1
        self._on_message(sample.payload.to_bytes(), attachment)

    def close(self) -> None:
        self._token.undeclare()
        self._subscriber.undeclare()


class StaticTransforms:
    """Union of ``/tf_static`` messages: several nodes send one each, but our publisher keeps one latched value."""

    def __init__(self) -> None:
        self._transforms: dict[str, Any] = {}

    def merge(self, payload: bytes) -> bytes | memoryview:
        """Return all transforms so far as one message, with the newest of each child frame.

        Raises:
            MessageError: the bytes are not a TFMessage.
        """
        for transform in deserialize(payload, _TF).transforms:
            self._transforms[transform.child_frame_id] = transform
        return serialize(message_type(_TF)(list(self._transforms.values())))


@dataclass
class _In:
    """An imported topic."""

    type_name: str
    qos: TopicQoS
    publisher: Publisher
    own_publisher: bool
    always: bool
    subscription: RosSubscription | None = None
    sources: set[tuple[str, int]] = field(default_factory=set)
    gone_s: float | None = None


class Incoming:
    """Imports topics of the ROS graph unchanged, with their original time of publication.

    Args:
        namespace: namespace of the topics in the ROS graph.
        own: the gateway itself in the ROS graph.
        subscribe: names or patterns of topics, by local names; a topic exists once a publisher appears.
        commands: those of :data:`COMMANDS` that are accepted.
        gate: checks commands.
        no_commands: why only an emergency stop is accepted as a command; empty if the link is secure.

    Raises:
        ValueError: a topic in the list is wrong.
    """

    def __init__(
        self,
        node: Node[Any],
        namespace: Namespace,
        own: RosNode,
        subscribe: Sequence[str],
        commands: Sequence[str],
        gate: CommandGate,
        no_commands: str = "",
    ) -> None:
        self._no_commands = no_commands
        self._node = node
        self._namespace = namespace
        self._gate = gate
        self._gate_lock = threading.Lock()  # each subscription calls on its own thread
        self._topics: dict[str, _In] = {}
        self._refusing: set[str] = set()
        self._driver = ""  # sender of the newest drive command, as the arbiter knows it
        self._count_before = 0
        self._patterns = parse_subscribe(subscribe)
        self._commands = set(commands) & {STOP} if no_commands else set(commands)
        self._own = own
        for topic in self._commands:
            self._open(topic, COMMANDS[topic], TopicQoS(latched=topic == STOP, depth=1), always=True)

    @property
    def topics(self) -> list[str]:
        return sorted(self._topics)

    @property
    def count(self) -> int:
        """Messages received, including refused commands."""
        held = [entry.subscription for entry in self._topics.values() if entry.subscription is not None]
        return self._count_before + sum(subscription.count for subscription in held)

    def lost(self) -> dict[str, int]:
        """Return the lost messages by topic."""
        held = {topic: entry.subscription for topic, entry in self._topics.items()}
        return {topic: s.lost for topic, s in held.items() if s is not None and s.lost}

    def malformed(self) -> int:
        return sum(entry.subscription.malformed for entry in self._topics.values() if entry.subscription is not None)

    def on_token(self, token: Token, alive: bool) -> None:
        """Follow the ROS graph; may be called from any thread."""
        if token.kind == "MP":
            self._node.call_soon(self._follow, token, alive)

    def _follow(self, token: Token, alive: bool) -> None:
        topic = self._namespace.to_local(token.topic)
        if topic is None or not self.wants(topic):
            return
        source = (token.session, token.entity_id)
        entry = self._topics.get(topic)
        if not alive:
            if entry is not None and source in entry.sources:
                self._left(topic, entry, source)
            return
        sources = entry.sources if entry is not None else ()
        if len(topic) > MAX_NAME or (entry is None and len(self._topics) >= MAX_TOPICS) or len(sources) >= MAX_SOURCES:
            self._node.diagnose(
                "names",
                ERROR,
                f"{topic!r:.60} is not imported: at most {MAX_TOPICS} topics, {MAX_SOURCES} publishers of each, "
                f"{MAX_NAME} characters a name; narrow `subscribe`",
            )
            return
        if not self._same_type(topic, token, entry):
            return
        if entry is None or (token.qos.latched and not entry.qos.latched):
            try:
                entry = self._open(topic, token.type_name, token.qos, entry is not None and entry.always)
            except RegistryError as error:
                self._node.diagnose(f"in {topic}", ERROR, str(error))
                return
        entry.sources.add(source)
        entry.gone_s = None

    def wants(self, topic: str) -> bool:
        """Return whether a topic is imported once it has a publisher in the ROS graph."""
        if topic in self._commands:
            return True
        return takes(self._patterns, topic) and not takes(ACTED_ON, topic)

    def _same_type(self, topic: str, token: Token, entry: _In | None) -> bool:
        """Check that a ROS publisher's type is that of the local topic; report a mismatch."""
        wanted = entry.type_name if entry is not None else token.type_name
        ours = known_hash(wanted)
        if token.type_name != wanted:
            why = f"{wanted} expected"
        elif ours is None:
            why = "which is not known here"
        elif token.type_hash != ours:
            why = f"by another definition ({token.type_hash}, ours is {ours})"
        else:
            return True
        text = f"{token.node} there sends {token.type_name}, {why}; it is not imported"
        self._node.diagnose(f"in {topic}", ERROR, text)
        return False

    def _open(self, topic: str, type_name: str, qos: TopicQoS, always: bool) -> _In:
        """Import a topic; if it is already imported, replace it with the new quality of service."""
        sources: set[tuple[str, int]] = set()
        if (old := self._topics.pop(topic, None)) is not None:
            sources = old.sources
            self._shut(old)
        name = message_type(type_name).__msgtype__
        # The gateway itself publishes /heartbeat and the like; other nodes' messages share that publisher.
        publisher = next((p for p in self._node.publishers if p.topic == topic), None)
        own = publisher is not None
        if publisher is None:
            publisher = self._node.publisher_raw(topic, name, bus_qos(qos))
        entry = self._topics[topic] = _In(name, qos, publisher, own, always, sources=sources)
        handle = self._handler(topic, entry)
        there = self._namespace.to_ros(topic)
        entry.subscription = RosSubscription(self._own, there, name, type_hash(name), qos, handle)
        self._node.log.debug("%s is imported as %s", there, topic)
        return entry

    def _handler(self, topic: str, entry: _In) -> Callable[[bytes, Attachment], None]:
        publish = entry.publisher.publish_bytes
        merge = StaticTransforms().merge if entry.qos.latched and entry.type_name == _TF else None

        def plain(payload: bytes, attachment: Attachment) -> None:
            if merge is None:
                publish(payload, attachment.source_ns)
                return
            try:
                publish(merge(payload), attachment.source_ns)
            except MessageError as error:
                self._tell(topic, ERROR, f"refused: {error}")

        def command(payload: bytes, attachment: Attachment) -> None:
            with self._gate_lock:
                passed = self._check(topic, entry, payload, attachment)
                if isinstance(passed, Refusal):
                    self._refusing.add(topic)
                    self._tell(topic, ERROR, f"command refused: {passed.text}")
                    return
                if topic in self._refusing:
                    self._refusing.discard(topic)
                    self._tell(topic, OK, "commands are accepted")
                publish(passed, attachment.source_ns)

        return command if topic in self._commands else plain

    def _check(self, topic: str, entry: _In, payload: bytes, attachment: Attachment) -> bytes | memoryview | Refusal:
        """Return the command to publish, or why not; a drive command names its sender, whatever that claims to be."""
        gate, age_s, steady_ns = self._gate, (time.time_ns() - attachment.source_ns) / 1e9, time.monotonic_ns()
        try:
            message = deserialize(payload, COMMANDS[topic])
        except MessageError as error:
            return gate.refuse(Verdict.UNREADABLE, str(error))
        if topic == STOP:
            # A stop is never too old, and every sender may stop. Only the driver may release, with a recent message.
            if message.data:
                return payload
            if self._no_commands:
                return gate.refuse(Verdict.INSECURE, f"release: {self._no_commands}")
            return gate.admit_release(attachment.sender, age_s, steady_ns) or payload
        if not entry.sources:
            return gate.refuse(Verdict.NO_SENDER, "the ROS graph has no publisher of this topic")
        if (refusal := gate.admit(*twist_values(message), age_s, attachment.sender, steady_ns)) is not None:
            return refusal
        self._driver = message.header.frame_id = sender_name(attachment.sender, message.header.frame_id)
        return serialize(message)

    def _tell(self, topic: str, level: int, words: str) -> None:
        self._node.call_soon(self._node.diagnose, f"in {topic}", level, words)

    def _left(self, topic: str, entry: _In, source: tuple[str, int]) -> None:
        """Handle a ROS publisher that is gone; if it was the last driver, stop the robot."""
        with self._gate_lock:  # its command in transit must not follow the zero
            entry.sources.remove(source)
            if entry.sources:
                return
            entry.gone_s = time.monotonic()
            if topic == DRIVE and topic in self._commands:
                # Stop immediately instead of after the arbiter's timeout.
                released = self._driver.removesuffix(RELEASED) + RELEASED
                entry.publisher.publish(twist_stamped(0.0, 0.0, time.time_ns(), released))

    def reconcile(self) -> None:
        """Drop topics whose publishers have been gone for a while."""
        now = time.monotonic()
        for topic, entry in list(self._topics.items()):
            if not entry.always and entry.gone_s is not None and now - entry.gone_s > GRACE_S:
                self._shut(self._topics.pop(topic))
                self._node.diagnose(f"in {topic}", OK, "its publishers are gone")

    def _shut(self, entry: _In) -> None:
        if entry.subscription is not None:
            entry.subscription.close()
            self._count_before += entry.subscription.count
        if not entry.own_publisher:
            self._node.drop(entry.publisher)


def topic_counts(outgoing: Outgoing, incoming: Incoming) -> tuple[str, int, dict[str, int]]:
    """Return the traffic in both directions: text, number of lost messages, and values of the diagnosis."""
    lost = incoming.lost()
    text = (
        f"{outgoing.count} messages out on {len(outgoing.topics)} topics, {incoming.count} in on {len(incoming.topics)}"
    )
    if lost:
        text += f"; lost: {', '.join(f'{topic} {count}' for topic, count in sorted(lost.items()))}"
    return text, sum(lost.values()), {"thinned": outgoing.thinned, "malformed": incoming.malformed()}
