"""A Foxglove server that follows a run directory: its topics, its nodes' parameters, its graph.

Bytes go through unchanged. Foxglove's SDK is an extra, imported when the server starts; its callbacks come on threads
of its own.
"""

from __future__ import annotations

import concurrent.futures
import json
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..bus import ERROR, LATCHED, OK, SENSOR, WARN, Node, ParameterError, Publisher, Subscription
from ..bus.control import ControlError, NodeControl
from ..bus.qos import PRESETS, RELIABLE
from ..bus.registry import NodeInfo, TopicInfo
from ..bus.transport import Received
from ..msg import MessageError, deserialize, message_type, stamp_ns, twist_stamped, twist_values, typestore
from .commands import CommandGate, CommandRefused

_PARAMETER_TIMEOUT_S = 1.0
_SETTLE_S = 0.1
_PARAMETER_FIELDS = {
    1: "bool_value",
    2: "integer_value",
    3: "double_value",
    4: "string_value",
    6: "bool_array_value",
    7: "integer_array_value",
    8: "double_array_value",
    9: "string_array_value",
}
DRIVE, STOP = "/operator/cmd_vel", "/operator/estop"
_COMMAND_TYPES = {DRIVE: ("TwistStamped", "Twist"), STOP: ("Bool",)}


class FoxgloveError(RuntimeError):
    """The SDK is not installed, or the server cannot start; the message says what to do."""


def sdk() -> Any:
    """Foxglove's SDK.

    Raises:
        FoxgloveError: the extra is not installed.
    """
    try:
        import foxglove
        import foxglove.websocket
    except ImportError as error:
        raise FoxgloveError(f"Foxglove's SDK is not installed ({error}): pip install 'instant-ic[foxglove]'") from None
    return foxglove


def schema_text(type_name: str) -> bytes:
    """Definition of a type with all that it holds, as ``ros2msg`` has it.

    Raises:
        MessageError: the type is not known.
    """
    try:
        return typestore().generate_msgdef(type_name, ros_version=2)[0].encode()
    except Exception as error:  # rosbags raises its own error and KeyError
        raise MessageError(f"no definition of {type_name}: {error}") from error


@dataclass(frozen=True)
class ServerSettings:
    """What the server is started with.

    Attributes:
        title: shown by Foxglove.
        host, port: where to listen; port 0 takes a free one.
        tls_cert, tls_key: files in PEM; with them the server speaks wss:// only.
        backlog: messages kept for a client that does not keep up; the oldest goes first.
        accept_operator: whether clients may drive and stop the robot.
        set_parameters: whether clients may change parameters.
        server_time: whether to tell clients the time (for simulated time).
    """

    title: str
    host: str
    port: int
    tls_cert: Path | None = None
    tls_key: Path | None = None
    backlog: int = 32
    accept_operator: bool = False
    set_parameters: bool = True
    server_time: bool = False


class FoxgloveServer:
    """Channels, parameters, graph and commands of one run directory.

    Args:
        node: the bridge's node; its bus is listened to.
        run_dir: its run directory.
        settings: see there.
        takes: which topics to offer.
        gate: what commands have to pass.

    Raises:
        FoxgloveError: see there.
    """

    def __init__(
        self, node: Node[Any], run_dir: Path, settings: ServerSettings, takes: Callable[[str], bool], gate: CommandGate
    ) -> None:
        self._sdk = sdk()
        self._node = node
        self._takes = takes
        self._context = self._sdk.Context()
        self._channels: dict[str, _Channel] = {}
        self._graph: tuple[Any, ...] | None = None
        self._newcomers: dict[str, float] = {}
        self.parameters = Parameters(run_dir)
        self.may_set = settings.set_parameters
        self.commands = Commands(node, gate, self.status) if settings.accept_operator else None
        self.wake = threading.Event()
        self.count = 0
        self.bytes = 0
        self._server = self._start(settings)
        self.port: int = self._server.port

    def _start(self, settings: ServerSettings) -> Any:
        capability = self._sdk.websocket.Capability
        capabilities = [capability.Parameters, capability.ConnectionGraph]
        if settings.accept_operator:
            capabilities.append(capability.ClientPublish)
        if settings.server_time:
            capabilities.append(capability.Time)
        try:
            tls = {
                name: path.read_bytes()
                for name, path in (("tls_cert", settings.tls_cert), ("tls_key", settings.tls_key))
                if path is not None
            }
            return self._sdk.start_server(
                name=settings.title,
                host=settings.host,
                port=settings.port,
                capabilities=capabilities,
                server_listener=_listener(self),
                supported_encodings=["cdr", "json"] if settings.accept_operator else None,
                context=self._context,
                message_backlog_size=settings.backlog,
                **tls,
            )
        except OSError as error:
            raise FoxgloveError(f"{error.filename}: cannot be read: {error.strerror}") from None
        except (RuntimeError, ValueError) as error:
            raise FoxgloveError(f"no server on {settings.host}:{settings.port}: {error}; set host or port") from None

    # -- on the node's thread --------------------------------------------------------------------

    @property
    def watched(self) -> list[str]:
        """Topics that somebody watches now."""
        return sorted(topic for topic, channel in self._channels.items() if channel.subscription is not None)

    @property
    def topics(self) -> list[str]:
        """Topics on offer."""
        return sorted(self._channels)

    def reconcile(self, present: Sequence[TopicInfo], nodes: Sequence[NodeInfo]) -> None:
        """Offers what has appeared, takes back what has left, listens to what is watched and to nothing else."""
        wanted = {info.topic: info for info in present if self._takes(info.topic)}
        for topic, info in wanted.items():
            channel = self._channels.get(topic)
            if channel is not None and channel.type_name != info.type_name:
                self._withdraw(topic)
                channel = None
            if channel is None and not self._offer(topic, info.type_name):
                continue
            self._channels[topic].watch(info)
        self._welcome()
        for topic in [topic for topic in self._channels if topic not in wanted]:
            self._withdraw(topic)
        self._tell_graph(present, nodes)

    def _offer(self, topic: str, type_name: str) -> bool:
        try:
            definition = schema_text(type_name)
        except MessageError as error:
            self._node.diagnose(f"topic {topic}", ERROR, str(error))
            return False
        schema = self._sdk.Schema(name=type_name, encoding="ros2msg", data=definition)
        channel = self._sdk.Channel(topic, message_encoding="cdr", schema=schema, context=self._context)
        self._channels[topic] = _Channel(self, self._node, type_name, channel)
        return True

    def _withdraw(self, topic: str) -> None:
        self._channels.pop(topic).close()

    def _tell_graph(self, present: Sequence[TopicInfo], nodes: Sequence[NodeInfo]) -> None:
        published = {info.topic: sorted({p.node for p in info.publishers}) for info in present}
        subscribed: dict[str, list[str]] = {}
        for node in nodes:
            for topic in node.subscribes:
                subscribed.setdefault(topic, []).append(node.name)
        now = (published, subscribed)
        if now == self._graph:
            return
        self._graph = now
        graph = self._sdk.ConnectionGraph()
        for topic, names in published.items():
            graph.set_published_topic(topic, names)
        for topic, names in subscribed.items():
            graph.set_subscribed_topic(topic, sorted(names))
        self._server.publish_connection_graph(graph)

    def joined(self, topic: str) -> None:
        """Somebody watches a topic from now on, maybe beside others."""
        self._newcomers[topic] = time.monotonic()

    def _welcome(self) -> None:
        """Fetches latched values again, so that newcomers have them too."""
        now = time.monotonic()
        # The SDK tells of a newcomer a little before it would get messages.
        for topic in [topic for topic, since in self._newcomers.items() if now - since > _SETTLE_S]:
            del self._newcomers[topic]
            if topic in self._channels:
                self._channels[topic].renew()

    def parameter_event(self, event: Any) -> None:
        """Tells clients of parameters that somebody else has changed."""
        values = []
        for parameter in [*event.new_parameters, *event.changed_parameters]:
            if (name := _PARAMETER_FIELDS.get(int(parameter.value.type))) is not None:
                value = getattr(parameter.value, name)
                plain = value.tolist() if hasattr(value, "tolist") else value
                values.append(self._sdk.Parameter(f"/{event.node.strip('/')}.{parameter.name}", value=plain))
        if values:
            self._server.publish_parameter_values(values)

    # -- from any thread -------------------------------------------------------------------------

    def tell_time(self, now_ns: int) -> None:
        """Tells clients the simulated time."""
        self._server.broadcast_time(now_ns)

    def status(self, words: str, level: int = ERROR) -> None:
        """Shows words in Foxglove's list of problems."""
        levels = self._sdk.StatusLevel
        self._server.publish_status(words, {OK: levels.Info, WARN: levels.Warning}.get(level, levels.Error))

    def close(self) -> None:
        """Ends the server and every listening."""
        for topic in list(self._channels):
            self._withdraw(topic)
        self._server.stop()
        self.parameters.close()


class _Channel:
    """One topic on offer."""

    def __init__(self, server: FoxgloveServer, node: Node[Any], type_name: str, channel: Any) -> None:
        self.type_name = type_name
        self.subscription: Subscription | None = None
        self._server = server
        self._node = node
        self._channel = channel
        self._latched = False

    def watch(self, info: TopicInfo) -> None:
        """Listens on our bus if somebody watches, else lets go."""
        watched = self._channel.has_sinks()
        if watched and self.subscription is None:
            qos = max(
                (PRESETS.get(p.qos, RELIABLE) for p in info.publishers), key=lambda qos: (qos.latched, qos.reliable)
            )
            self._latched = qos.latched
            # With ``sensor`` the bus keeps the newest only: a stall of this process cannot end in a flood of old ones.
            self.subscription = self._node.subscribe_received(info.topic, self._forward, qos)
        elif not watched and self.subscription is not None:
            self._node.drop(self.subscription)
            self.subscription = None

    def renew(self) -> None:
        """Subscribes anew, which brings the latched value of every publisher once more."""
        if self._latched and (old := self.subscription) is not None:
            self.subscription = self._node.subscribe_received(old.raw.topic, self._forward, old.raw.qos)
            self._node.drop(old)

    def _forward(self, received: Received) -> None:
        if received.type_name == self.type_name:
            self._server.count += 1
            self._server.bytes += len(received.payload)
            self._channel.log(bytes(received.payload), log_time=received.publish_ns)

    def close(self) -> None:
        if self.subscription is not None:
            self._node.drop(self.subscription)
            self.subscription = None
        self._channel.close()


class Parameters:
    """Parameters of all nodes of a run directory, as ``/node.key``; asked of the nodes themselves.

    Args:
        run_dir: the run directory.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._pool = concurrent.futures.ThreadPoolExecutor(8, thread_name_prefix="parameters")
        self.nodes: tuple[str, ...] = ()

    def _control(self, node: str) -> NodeControl:
        return NodeControl(self._run_dir, node, _PARAMETER_TIMEOUT_S)

    def _of(self, node: str) -> tuple[dict[str, Any], str]:
        try:
            return {f"/{node}.{key}": value for key, value in self._control(node).get().items()}, ""
        except (ControlError, ParameterError) as error:
            return {}, str(error)

    def get(self, names: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
        """Values by name, of all parameters of all nodes without names; and which nodes did not answer, in words."""
        nodes = {_split(name)[0] for name in names} if names else set(self.nodes)
        values: dict[str, Any] = {}
        silent = []
        for found, words in self._pool.map(self._of, sorted(nodes)):
            values.update(found)
            silent += [words] if words else []
        return {name: values[name] for name in names if name in values} if names else values, silent

    def set(self, wanted: dict[str, Any]) -> list[str]:
        """Changes parameters, those of one node together; returns what was refused, in words."""
        by_node: dict[str, dict[str, Any]] = {}
        for name, value in wanted.items():
            node, key = _split(name)
            by_node.setdefault(node, {})[key] = value
        refused = []
        for node, values in by_node.items():
            try:
                self._control(node).set(values)
            except (ControlError, ParameterError) as error:
                refused.append(f"{node}: {error}")
        return refused

    def close(self) -> None:
        """Ends the threads."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def _split(name: str) -> tuple[str, str]:
    """``/node.group.key`` as node and key."""
    node, _, key = name.strip("/").partition(".")
    return node, key


class Commands:
    """Commands of clients: checked, then published as the console's would be.

    Args:
        node: publishes them.
        gate: what they have to pass.
        tell: words for the client.
    """

    def __init__(self, node: Node[Any], gate: CommandGate, tell: Callable[[str], None]) -> None:
        self._node = node
        self._gate = gate
        self._tell = tell
        self._lock = threading.Lock()
        self._channels: dict[tuple[int, int], Any] = {}
        self._told: set[str] = set()
        self._drive: Publisher = node.publisher(DRIVE, message_type("TwistStamped"), SENSOR)
        self._stop: Publisher = node.publisher(STOP, message_type("Bool"), LATCHED)

    def advertised(self, client: int, channel: Any) -> None:
        """A client is going to publish."""
        kinds = _COMMAND_TYPES.get(channel.topic)
        name = channel.schema_name.rsplit("/", 1)[-1]
        if kinds is None or name not in kinds or channel.encoding not in ("cdr", "json"):
            known = "; ".join(f"{topic} ({' or '.join(names)})" for topic, names in _COMMAND_TYPES.items())
            self._tell(
                f"{channel.topic} {channel.schema_name} {channel.encoding} is not taken; only {known}, cdr or json"
            )
            return
        self._channels[client, channel.id] = channel

    def unadvertised(self, client: int, channel_id: int) -> None:
        """A client has left, or publishes no more: the robot it drove stands at once."""
        channel = self._channels.pop((client, channel_id), None)
        if channel is None or channel.topic != DRIVE:
            return
        with self._lock:
            driving = self._gate.release(f"client {client}")
        if driving:
            self._drive.publish(twist_stamped(0.0, 0.0, self._node.clock.now_ns()))

    def message(self, client: int, channel_id: int, data: bytes) -> None:
        """A client's message."""
        channel = self._channels.get((client, channel_id))
        if channel is None:  # told at its advertisement
            return
        name = channel.schema_name.rsplit("/", 1)[-1]
        try:
            with self._lock:
                if channel.topic == STOP:
                    value = _json(data)["data"] if channel.encoding == "json" else deserialize(data, "Bool").data
                    if not isinstance(value, bool):
                        raise MessageError(f"data must be true or false (got {value!r})")
                    self._stop.publish(message_type("Bool")(value))
                    return
                self._drive_by(client, name, channel.encoding, data)
        except CommandRefused as error:
            self._refused(f"command refused: {error}")
        except (MessageError, AttributeError, KeyError, TypeError, ValueError) as error:  # JSON of any shape
            self._refused(f"command refused: {channel.topic}: {type(error).__name__}: {error}")

    def _drive_by(self, client: int, name: str, encoding: str, data: bytes) -> None:
        now_ns = self._node.clock.now_ns()
        sent_ns = 0
        if encoding == "cdr":
            message = deserialize(data, name)
            v, w = twist_values(message)
            sent_ns = stamp_ns(message) if name == "TwistStamped" else 0
        else:
            content = _json(data)
            twist = content["twist"] if name == "TwistStamped" else content
            v, w = float(twist["linear"]["x"]), float(twist["angular"]["z"])
            stamp = content.get("header", {}).get("stamp", {})
            sent_ns = int(stamp.get("sec", 0)) * 1_000_000_000 + int(stamp.get("nanosec", stamp.get("nsec", 0)))
        if sent_ns:  # a client without a clock (Foxglove's teleop panel) stamps nothing: its arrival counts
            self._gate.check_age(sent_ns, now_ns)
        self._gate.check_drive(f"client {client}", v, w, now_ns)
        self._drive.publish(twist_stamped(v, w, sent_ns or now_ns))
        if self._told:
            self._told.clear()
            self._node.call_soon(self._node.diagnose, "commands", OK, "commands come in")

    def _refused(self, words: str) -> None:
        if words not in self._told:
            self._told.add(words)
            self._tell(words)
        self._node.call_soon(self._node.diagnose, "commands", ERROR, words)


def _json(data: bytes) -> dict[str, Any]:
    content = json.loads(data)
    if not isinstance(content, dict):
        raise MessageError("not a JSON object")
    return content


def _listener(server: FoxgloveServer) -> Any:
    """What the SDK calls, on its own threads; nothing of the bus is touched there."""
    foxglove = server._sdk
    node = server._node

    class Listener(foxglove.websocket.ServerListener):  # type: ignore[name-defined]
        def on_subscribe(self, client: Any, channel: Any) -> None:
            node.call_soon(server.joined, channel.topic)
            server.wake.set()

        def on_unsubscribe(self, client: Any, channel: Any) -> None:
            server.wake.set()

        def on_client_advertise(self, client: Any, channel: Any) -> None:
            if server.commands is not None:
                server.commands.advertised(client.id, channel)

        def on_client_unadvertise(self, client: Any, client_channel_id: int) -> None:
            if server.commands is not None:
                server.commands.unadvertised(client.id, client_channel_id)

        def on_message_data(self, client: Any, client_channel_id: int, data: bytes) -> None:
            if server.commands is not None:
                server.commands.message(client.id, client_channel_id, data)

        def on_get_parameters(self, client: Any, param_names: list[str], request_id: str | None = None) -> list[Any]:
            return self._parameters(param_names)

        def on_set_parameters(self, client: Any, parameters: list[Any], request_id: str | None = None) -> list[Any]:
            wanted = {parameter.name: parameter.get_value() for parameter in parameters}
            refused = server.parameters.set(wanted) if server.may_set else ["parameters can only be read here"]
            for words in refused:
                server.status(words)
            return self._parameters(list(wanted))

        def _parameters(self, names: list[str]) -> list[Any]:
            values, silent = server.parameters.get(names)
            for words in silent:
                server.status(words, WARN)
            return [foxglove.Parameter(name, value=value) for name, value in values.items() if value is not None]

    return Listener()


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a host name or address."""
    try:
        addresses = {str(entry[4][0]) for entry in socket.getaddrinfo(host, None)}
    except OSError:
        return False
    return all(address == "::1" or address.startswith("127.") for address in addresses)
