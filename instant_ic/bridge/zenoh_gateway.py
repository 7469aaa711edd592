"""Topics of a run directory in the ROS graph over Zenoh, and of the ROS graph in a run directory."""

from __future__ import annotations

import fnmatch
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..bus import ERROR, LATCHED, OK, RELIABLE, SENSOR, Node, Publisher, QoS, Subscription
from ..bus.qos import PRESETS
from ..bus.registry import PublisherInfo, RegistryError, TopicInfo, check_topic
from ..bus.transport import Received
from ..msg import MessageError, deserialize, message_type, serialize, twist_stamped, twist_values, type_hash
from .commands import CommandGate, CommandRefused
from .zenoh_format import Attachment, Token, TopicQoS
from .zenoh_session import RosNode, RosPublisher, RosSession, RosSubscription

COMMANDS = {"/operator/cmd_vel": "geometry_msgs/msg/TwistStamped", "/operator/estop": "std_msgs/msg/Bool"}
"""What an operator elsewhere may send, and its type."""

_ACTED_ON = ("/operator/*", "/cmd_vel", "/nav/cmd_vel")
"""Topics that move a robot: never brought in by a pattern."""

_GRACE_S = 3.0  # a topic that leaves and comes back, as when its node restarts, keeps its place
_TF = "tf2_msgs/msg/TFMessage"


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
        RegistryError, MessageError: a topic's name is not legal, or a type is not known.
    """
    patterns, types = [], {}
    for entry in entries:
        topic, _, name = entry.partition(" ")
        if name:
            types[check_topic(topic)] = message_type(name.strip()).__msgtype__
        patterns.append(topic)
    return patterns, types


@dataclass
class _Out:
    """A topic that goes out: one subscription here, a publisher there for each of its publishers."""

    period_ns: int
    subscription: Subscription | None = None
    publishers: dict[str, RosPublisher] = field(default_factory=dict)
    gone_s: dict[str, float] = field(default_factory=dict)
    due_ns: dict[str, int] = field(default_factory=dict)


class Outgoing:
    """Topics of the run directory, byte for byte, under the names of the nodes that publish them.

    Each publisher here has its own publisher there, so latched values of several nodes (``/tf_static``) are all kept
    for late joiners, and ``ros2 node list`` shows the nodes themselves.

    Args:
        node: the gateway's node.
        session: the Zenoh session.
        namespace: where the topics stand there.
        own: the gateway itself in the ROS graph.
        publish: see :func:`parse_publish`; of several patterns that match, the first holds.

    Attributes:
        brought_in: tells whether a topic may come in by the same gateway; what it hands on does not go out again.
        count, thinned: messages that went out, and that a rate limit left out.

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
        """Topics that go out now."""
        return sorted(self._topics)

    def reconcile(self, present: Sequence[TopicInfo]) -> None:
        """Takes up what has appeared and lets go of what has left for a while."""
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
                if now - out.gone_s.setdefault(name, now) > _GRACE_S:
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
        """The publisher there that stands for a node's publisher here."""
        out = self._topics[topic]
        if node not in out.publishers:
            if (hash_ := known_hash(type_name)) is None:
                self._node.diagnose(f"out {topic}", ERROR, f"{type_name} is not known here: it cannot go out")
                return None
            there = self._own if node == self._own.name else self._nodes.get(node)
            if there is None:
                there = self._nodes[node] = RosNode(self._session, self._namespace.ros, node)
            name = self._namespace.to_ros(topic)
            out.publishers[node] = RosPublisher(there, name, type_name, hash_, ros_qos(qos))
            self._node.log.debug("%s of %s goes out as %s", topic, node, name)
        return out.publishers[node]

    def _came_in(self, topic: str, publisher: str) -> bool:
        """Whether a publisher here only hands on what came from there: that must not go out again."""
        return publisher == self._node.node_name and self.brought_in(topic)

    def _forward(self, received: Received) -> None:
        out = self._topics.get(received.topic)
        if out is None or self._came_in(received.topic, received.publisher):
            return
        publisher = out.publishers.get(received.publisher)
        if publisher is None and out.subscription is not None:  # heard before the next look at the registry
            publisher = self._mirror(received.topic, received.publisher, received.type_name, out.subscription.raw.qos)
        if publisher is None or self._early(out, received):
            return
        publisher.put(received.payload, received.publish_ns)
        self.count += 1

    def _early(self, out: _Out, received: Received) -> bool:
        """Whether the rate limit leaves a message out; each publisher has its own."""
        if not out.period_ns:
            return False
        due_ns = out.due_ns.get(received.publisher, 0)
        if received.received_ns < due_ns:
            self.thinned += 1
            return True
        # On the grid of periods, so that a limit of 3 Hz gives 3 Hz of a topic of 10 Hz; no burst after a pause.
        start_ns = due_ns if received.received_ns - due_ns < out.period_ns else received.received_ns
        out.due_ns[received.publisher] = start_ns + out.period_ns
        return False


class StaticTransforms:
    """The union of ``/tf_static`` messages: a publisher keeps one latched value, the robot's nodes send one each."""

    def __init__(self) -> None:
        self._transforms: dict[str, Any] = {}

    def merge(self, payload: bytes) -> bytes | memoryview:
        """All transforms so far as one message, the newest of each child frame.

        Raises:
            MessageError: the bytes are no TFMessage.
        """
        for transform in deserialize(payload, _TF).transforms:
            self._transforms[transform.child_frame_id] = transform
        return serialize(message_type(_TF)(list(self._transforms.values())))


@dataclass
class _In:
    """A topic that comes in."""

    type_name: str
    qos: TopicQoS
    publisher: Publisher
    own_publisher: bool
    always: bool
    subscription: RosSubscription | None = None
    sources: set[tuple[str, int]] = field(default_factory=set)
    gone_s: float | None = None


class Incoming:
    """Topics of the ROS graph, byte for byte, with the time at which they were published there.

    Args:
        node: the gateway's node.
        namespace: where the topics stand there.
        own: the gateway itself in the ROS graph.
        subscribe: ``TOPIC``, ``PATTERN`` or ``TOPIC TYPE`` by the names here. With a type the topic is there at once;
            else when a publisher of it appears.
        commands: which of :data:`COMMANDS` may come in.
        gate: what commands have to pass.

    Raises:
        ValueError: a type or a topic in the lists is wrong.
    """

    def __init__(
        self,
        node: Node[Any],
        namespace: Namespace,
        own: RosNode,
        subscribe: Sequence[str],
        commands: Sequence[str],
        gate: CommandGate,
    ) -> None:
        self._node = node
        self._namespace = namespace
        self._gate = gate
        self._gate_lock = threading.Lock()  # each subscription calls on its own thread
        self._topics: dict[str, _In] = {}
        self._refusing: set[str] = set()
        self.count = 0
        self._patterns, self._types = parse_subscribe(subscribe)
        self._types.update({topic: COMMANDS[topic] for topic in commands})
        self._commands = set(commands)
        self._own = own
        for topic, name in self._types.items():
            self._open(topic, name, TopicQoS(latched=topic == "/operator/estop", depth=1), always=True)

    @property
    def topics(self) -> list[str]:
        """Topics that come in now, by the names here."""
        return sorted(self._topics)

    def lost_by(self) -> dict[str, dict[str, int]]:
        """Topic → publisher's id → messages that never came."""
        held = {topic: entry.subscription for topic, entry in self._topics.items()}
        return {topic: dict(s.lost_by) for topic, s in held.items() if s is not None and s.lost_by}

    def malformed(self) -> int:
        """Messages without a readable attachment."""
        return sum(entry.subscription.malformed for entry in self._topics.values() if entry.subscription is not None)

    def on_token(self, token: Token, alive: bool) -> None:
        """Follows the ROS graph; may be called from any thread."""
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
        """Whether a topic comes in as soon as somebody there publishes it."""
        if topic in self._commands:
            return True
        return takes(self._patterns, topic) and not takes(_ACTED_ON, topic)

    def _same_type(self, topic: str, token: Token, entry: _In | None) -> bool:
        """Whether a publisher there sends what its topic carries here; tells if not."""
        wanted = entry.type_name if entry is not None else token.type_name
        who = f"{token.node} there sends {token.type_name}"
        if token.type_name != wanted:
            self._node.diagnose(f"in {topic}", ERROR, f"{who}, {wanted} expected; it is not brought in")
            return False
        if (ours := known_hash(wanted)) is None:
            self._node.diagnose(f"in {topic}", ERROR, f"{who}, which is not known here; it is not brought in")
            return False
        if token.type_hash != ours:
            self._node.diagnose(
                f"in {topic}", ERROR, f"{who} by another definition ({token.type_hash}, ours is {ours}); not brought in"
            )
            return False
        return True

    def _open(self, topic: str, type_name: str, qos: TopicQoS, always: bool) -> _In:
        """Brings a topic in, anew where it was in by another quality of service."""
        sources: set[tuple[str, int]] = set()
        if (old := self._topics.pop(topic, None)) is not None:
            sources = old.sources
            self._shut(old)
        name = message_type(type_name).__msgtype__
        # /heartbeat and its like the gateway sends itself; others' go out by the same publisher.
        publisher = next((p for p in self._node.publishers if p.topic == topic), None)
        own = publisher is not None
        if publisher is None:
            publisher = self._node.publisher_raw(topic, name, bus_qos(qos))
        entry = self._topics[topic] = _In(name, qos, publisher, own, always, sources=sources)
        handle = self._handler(topic, entry)
        there = self._namespace.to_ros(topic)
        entry.subscription = RosSubscription(self._own, there, name, type_hash(name), qos, handle)
        self._node.log.debug("%s comes in as %s", there, topic)
        return entry

    def _handler(self, topic: str, entry: _In) -> Callable[[bytes, Attachment], None]:
        publish = entry.publisher.publish_bytes
        merge = StaticTransforms().merge if entry.qos.latched and entry.type_name == _TF else None

        def plain(payload: bytes, attachment: Attachment) -> None:
            self.count += 1
            if merge is None:
                publish(payload, attachment.source_ns)
                return
            try:
                publish(merge(payload), attachment.source_ns)
            except MessageError as error:
                self._tell(topic, ERROR, f"refused: {error}")

        def command(payload: bytes, attachment: Attachment) -> None:
            with self._gate_lock:
                try:
                    self._check(topic, entry, payload, attachment)
                except CommandRefused as error:
                    self._refusing.add(topic)
                    self._tell(topic, ERROR, f"command refused: {error}")
                    return
                if topic in self._refusing:
                    self._refusing.discard(topic)
                    self._tell(topic, OK, "commands come in")
                self.count += 1
                publish(payload, attachment.source_ns)

        return command if topic in self._commands else plain

    def _check(self, topic: str, entry: _In, payload: bytes, attachment: Attachment) -> None:
        now_ns = time.time_ns()
        try:
            message = deserialize(payload, COMMANDS[topic])
        except MessageError as error:
            raise self._gate.refuse("not readable", str(error)) from None
        if topic == "/operator/estop":
            # A stop is never too old, and anybody may stop; only the release has to be fresh.
            if not message.data:
                self._gate.check_age(attachment.source_ns, now_ns)
            return
        if not entry.sources:
            raise self._gate.refuse("no sender", "nobody in the ROS graph sends this topic, or not any more")
        self._gate.check_age(attachment.source_ns, now_ns)
        self._gate.check_drive(attachment.gid.hex()[:8], *twist_values(message), now_ns)

    def _tell(self, topic: str, level: int, words: str) -> None:
        self._node.call_soon(self._node.diagnose, f"in {topic}", level, words)

    def _left(self, topic: str, entry: _In, source: tuple[str, int]) -> None:
        """A publisher there has left; with the last driver the robot stops."""
        with self._gate_lock:  # a command of its that is still on its way must not come after the zero
            entry.sources.remove(source)
            if entry.sources:
                return
            entry.gone_s = time.monotonic()
            if topic == "/operator/cmd_vel" and topic in self._commands:
                # Not after the arbiter's time-out: at once.
                entry.publisher.publish(twist_stamped(0.0, 0.0, time.time_ns()))

    def reconcile(self) -> None:
        """Lets go of topics whose publishers have left for a while."""
        now = time.monotonic()
        for topic, entry in list(self._topics.items()):
            if not entry.always and entry.gone_s is not None and now - entry.gone_s > _GRACE_S:
                self._shut(self._topics.pop(topic))
                self._node.diagnose(f"in {topic}", OK, "has left")

    def _shut(self, entry: _In) -> None:
        if entry.subscription is not None:
            entry.subscription.close()
        if not entry.own_publisher:
            self._node.drop(entry.publisher)
