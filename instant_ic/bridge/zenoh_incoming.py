"""Imports topics of the ROS graph over Zenoh into a run directory."""

from __future__ import annotations

import fnmatch
import logging
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from instant_ic.bridge.commands import COMMANDS, DRIVE, STOP
from instant_ic.bridge.zenoh_format import Attachment, FormatError, Token, data_key
from instant_ic.bridge.zenoh_outgoing import GRACE_S, known_hash
from instant_ic.bridge.zenoh_session import RosNode, zenoh
from instant_ic.bus import ERROR, LATCHED, OK, RELIABLE, Node, Publisher, QoS
from instant_ic.bus.heartbeat import EVERY_NODES
from instant_ic.bus.registry import RegistryError
from instant_ic.control.command_gate import CommandGate
from instant_ic.control.robot_lease import RELEASED, Refusal, Verdict, sender_name
from instant_ic.msg import MessageError, deserialize, message_type, serialize, twist_stamped, twist_values, type_hash

ACTED_ON = ("*/operator/*", "*/cmd_vel", "*/robot/estop", "*/parameter_events")
"""Topics that move a robot, in any namespace, and parameter events: never imported by `subscribe`."""

MAX_TOPICS, MAX_SOURCES, MAX_NAME = 512, 64, 200
"""Most imported topics, publishers per topic, and characters of a name: limits against a hostile ROS graph."""

MAX_FRAMES = 1000
"""Most static transforms, all of which are sent again with each new one."""

MAX_PUBLISHERS = 256
"""Most publishers per topic whose gaps are counted; needed because senders choose their ids freely."""

_TF = "tf2_msgs/msg/TFMessage"
log = logging.getLogger(__name__)


def _matches(topic: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch.fnmatchcase(topic, pattern) for pattern in patterns)


def check_subscribe(entries: Sequence[str]) -> None:
    """Check names and patterns such as ``/scan`` and ``/robot*/pose``.

    Raises:
        ValueError: a name does not begin with a slash, or names a topic that moves a robot.
    """
    for topic in entries:
        if not topic.startswith("/") or " " in topic:
            raise ValueError(f"subscribe: {topic!r} must be /TOPIC or a pattern")
        if not {"*", "?", "["} & set(topic) and _matches(topic, ACTED_ON):
            raise ValueError(f"subscribe: {topic} moves a robot; list it under commands, or rename it there")


@dataclass(eq=False)
class _ImportedTopic:
    """An imported topic: a subscription in the ROS graph and a publisher on the bus.

    Attributes:
        topic: name of the topic on the bus.
        type_name: ``std_msgs/msg/String``.
        publisher: publisher on the bus.
        static: newest static transform of each child frame if the topic has latched transforms, else None. Several
            nodes send one message each, but our publisher keeps one latched value and therefore publishes the union.
        declared: subscriber and token in the ROS graph.
        sources: publishers in the ROS graph by session and entity.
        gone_s: time at which the last of the sources left; None while there are some, and before the first.
        sequences: newest sequence number of each publisher.
        count, lost: messages passed on, and messages lost on the way.
        malformed: messages refused because they have no readable attachment.
    """

    topic: str
    type_name: str
    publisher: Publisher
    static: dict[str, Any] | None
    declared: tuple[Any, ...] = ()
    sources: set[tuple[str, int]] = field(default_factory=set)
    gone_s: float | None = None
    sequences: dict[bytes, int] = field(default_factory=dict)
    count: int = 0
    lost: int = 0
    malformed: int = 0

    def read(self, sample: Any) -> Attachment | None:
        """Return the attachment of a message and count its publisher's gaps; None for a message to drop."""
        try:
            if sample.attachment is None:
                raise FormatError("no attachment")
            attachment = Attachment.unpack(sample.attachment.to_bytes())
        except FormatError as error:
            self.malformed += 1
            if self.malformed == 1:
                log.error("%s: refused a message not made by rmw_zenoh: %s", self.topic, error)
            return None
        last = self.sequences.pop(attachment.gid, attachment.sequence - 1)
        self.sequences[attachment.gid] = max(attachment.sequence, last)
        if attachment.sequence <= last:  # duplicate
            return None
        self.lost += attachment.sequence - last - 1
        if len(self.sequences) > MAX_PUBLISHERS:  # the publisher not heard from for the longest time
            del self.sequences[next(iter(self.sequences))]
        self.count += 1
        return attachment

    def merge(self, payload: bytes) -> bytes | memoryview:
        """Return all static transforms so far as one message; other payloads unchanged.

        Raises:
            MessageError: the bytes are not a TFMessage, or the transforms are too many.
        """
        if self.static is None:
            return payload
        static = self.static | {each.child_frame_id: each for each in deserialize(payload, _TF).transforms}
        if len(static) > MAX_FRAMES:
            raise MessageError(f"more than {MAX_FRAMES} static transforms")
        self.static = static
        return serialize(message_type(_TF)(list(self.static.values())))

    def close(self) -> None:
        for each in self.declared:
            each.undeclare()


class Incoming:
    """Imports topics of the ROS graph unchanged, with their original time of publication.

    Args:
        node: the gateway.
        own: the gateway in the ROS graph.
        prefix: text before the names of topics in the ROS graph: ``/robot1``, or empty.
        subscribe: names or patterns of topics, by local names; a topic exists once a publisher appears.
        commands: topics of :data:`COMMANDS` that are accepted.
        gate: checks commands.
        no_commands: reason why only an emergency stop is accepted as a command; empty if the link is secure.
    """

    def __init__(
        self,
        node: Node[Any],
        own: RosNode,
        prefix: str,
        subscribe: Sequence[str],
        commands: Sequence[str],
        gate: CommandGate,
        no_commands: str = "",
    ) -> None:
        self._node = node
        self._own = own
        self._prefix = prefix
        self._patterns = tuple(subscribe)
        self._no_commands = no_commands
        self._gate = gate
        self._gate_lock = threading.Lock()  # each subscription calls on its own thread
        self._topics: dict[str, _ImportedTopic] = {}
        self._refusing: set[str] = set()
        self._driver = ""  # sender of the newest drive command, by the name that the arbiter sees
        self._count_before = 0
        self._commands = set(commands) & {STOP} if no_commands else set(commands)
        for topic in self._commands:
            self._open(topic, COMMANDS[topic], LATCHED if topic == STOP else RELIABLE)

    @property
    def topics(self) -> list[str]:
        return sorted(self._topics)

    @property
    def count(self) -> int:
        """Messages received, including refused commands."""
        return self._count_before + sum(topic.count for topic in self._topics.values())

    def lost(self) -> dict[str, int]:
        """Return the lost messages by topic."""
        return {name: topic.lost for name, topic in sorted(self._topics.items()) if topic.lost}

    def malformed(self) -> int:
        return sum(topic.malformed for topic in self._topics.values())

    def wants(self, topic: str) -> bool:
        """Return whether a topic is imported once it has a publisher in the ROS graph."""
        return topic in self._commands or (_matches(topic, self._patterns) and not _matches(topic, ACTED_ON))

    def on_token(self, token: Token, alive: bool) -> None:
        """Follow the ROS graph; may be called from any thread."""
        if token.kind == "MP":
            self._node.call_soon(self._follow, token, alive)

    def _follow(self, token: Token, alive: bool) -> None:
        topic = token.topic.removeprefix(self._prefix)
        if not token.topic.startswith(f"{self._prefix}/") or not self.wants(topic):
            return
        source = (token.session, token.entity_id)
        imported = self._topics.get(topic)
        if not alive:
            if imported is not None and source in imported.sources:
                self._left(imported, source)
            return
        sources = imported.sources if imported is not None else ()
        full = len(sources) >= MAX_SOURCES or (imported is None and len(self._topics) >= MAX_TOPICS)
        if full or len(topic) > MAX_NAME:
            self._node.diagnose(
                "names",
                ERROR,
                f"{topic!r:.60} is not imported: at most {MAX_TOPICS} topics, {MAX_SOURCES} publishers of each, "
                f"{MAX_NAME} characters a name; narrow `subscribe`",
            )
            return
        type_name = imported.type_name if imported is not None else token.type_name
        if (token.type_name, token.type_hash) != (type_name, ours := known_hash(type_name)):
            theirs, here = f"{token.type_name} ({token.type_hash})", f"{type_name} ({ours or 'unknown'})"
            text = f"not imported: {token.node} there sends {theirs}, the definition here is {here}"
            self._node.diagnose(f"in {topic}", ERROR, text)
            return
        if imported is None:
            try:
                imported = self._open(topic, token.type_name, token.qos)
            except RegistryError as error:
                self._node.diagnose(f"in {topic}", ERROR, str(error))
                return
        imported.sources.add(source)
        imported.gone_s = None

    def _open(self, topic: str, type_name: str, qos: QoS) -> _ImportedTopic:
        """Subscribe in the ROS graph to other sessions' messages. Another definition of the type has another key."""
        name = message_type(type_name).__msgtype__
        # The gateway has its own publisher of /heartbeat and the like; other nodes' messages share it.
        publisher = next((p for p in self._node.publishers if p.topic == topic), None)
        if publisher is None:
            publisher = self._node.publisher_raw(topic, name, qos)
        imported = _ImportedTopic(topic, name, publisher, {} if qos.latched and name == _TF else None)
        self._topics[topic] = imported
        handle = self._command if topic in self._commands else self._plain

        def heard(sample: Any) -> None:
            """Take a message, in order per publisher, on a Zenoh thread."""
            if (attachment := imported.read(sample)) is not None:
                handle(imported, sample.payload.to_bytes(), attachment)

        package, session, there = zenoh(), self._own.session, self._prefix + topic
        key, remote = data_key(session.domain, there, name, type_hash(name)), package.Locality.REMOTE
        if qos.latched:  # requests the last message from each publisher
            subscriber = package.ext.declare_advanced_subscriber(
                session.zenoh,
                key,
                heard,
                allowed_origin=remote,
                history=package.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
                recovery=package.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                subscriber_detection=True,
            )
        else:
            subscriber = session.zenoh.declare_subscriber(key, heard, allowed_origin=remote)
        imported.declared = (self._own.endpoint("MS", there, name, type_hash(name), qos), subscriber)
        self._node.log.debug("%s is imported as %s", there, topic)
        return imported

    def _plain(self, imported: _ImportedTopic, payload: bytes, attachment: Attachment) -> None:
        try:
            imported.publisher.publish_bytes(imported.merge(payload), attachment.source_ns)
        except MessageError as error:
            self._report(imported.topic, ERROR, f"refused: {error}")

    def _command(self, imported: _ImportedTopic, payload: bytes, attachment: Attachment) -> None:
        topic = imported.topic
        with self._gate_lock:
            passed = self._check(imported, payload, attachment)
            if isinstance(passed, Refusal):
                self._refusing.add(topic)
                self._report(topic, ERROR, f"command refused: {passed.text}")
                return
            if topic in self._refusing:
                self._refusing.discard(topic)
                self._report(topic, OK, "commands are accepted")
            imported.publisher.publish_bytes(passed, attachment.source_ns)

    def _check(self, imported: _ImportedTopic, payload: bytes, attachment: Attachment) -> bytes | memoryview | Refusal:
        """Return the command to publish, or its refusal. A drive command is marked with its actual sender."""
        gate, age_s, steady_ns = self._gate, (time.time_ns() - attachment.source_ns) / 1e9, time.monotonic_ns()
        try:
            message = deserialize(payload, COMMANDS[imported.topic])
        except MessageError as error:
            return gate.refuse(Verdict.UNREADABLE, str(error))
        if imported.topic == STOP:
            # A stop is never too old, and every sender may stop. Only the driver may release, with a recent message.
            if message.data:
                return payload
            if self._no_commands:
                return gate.refuse(Verdict.INSECURE, f"release: {self._no_commands}")
            return gate.admit_release(attachment.sender, age_s, steady_ns) or payload
        if not imported.sources:
            return gate.refuse(Verdict.NO_SENDER, "the ROS graph has no publisher of this topic")
        if (refusal := gate.admit(*twist_values(message), age_s, attachment.sender, steady_ns)) is not None:
            return refusal
        self._driver = message.header.frame_id = sender_name(attachment.sender, message.header.frame_id)
        return serialize(message)

    def _report(self, topic: str, level: int, text: str) -> None:
        self._node.call_soon(self._node.diagnose, f"in {topic}", level, text)

    def _left(self, imported: _ImportedTopic, source: tuple[str, int]) -> None:
        """Handle a ROS publisher that is gone; if it was the last driver, stop the robot."""
        with self._gate_lock:  # a command in transit must not follow the zero
            imported.sources.remove(source)
            if imported.sources:
                return
            imported.gone_s = time.monotonic()
            if imported.topic == DRIVE and DRIVE in self._commands:
                # Stop immediately instead of after the arbiter's timeout.
                released = self._driver.removesuffix(RELEASED) + RELEASED
                imported.publisher.publish(twist_stamped(0.0, 0.0, time.time_ns(), released))

    def reconcile(self) -> None:
        """Drop topics whose publishers have been gone for a while; commands stay."""
        now = time.monotonic()
        for topic, imported in list(self._topics.items()):
            if topic not in self._commands and imported.gone_s is not None and now - imported.gone_s > GRACE_S:
                del self._topics[topic]
                imported.close()
                self._count_before += imported.count
                if topic not in EVERY_NODES:
                    self._node.drop(imported.publisher)
                self._node.diagnose(f"in {topic}", OK, "its publishers are gone")
