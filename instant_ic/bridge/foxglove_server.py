"""A Foxglove server that follows a run directory: its topics, its nodes' parameters, its graph.

Bytes go through unchanged. Foxglove's SDK is an extra, imported when the server starts; its callbacks come on threads
of its own.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..bus import ERROR, OK, WARN, Node, Subscription
from ..bus.qos import PRESETS, RELIABLE
from ..bus.registry import NodeInfo, TopicInfo
from ..bus.transport import Received
from ..msg import MessageError, typestore
from .commands import CommandGate
from .foxglove_commands import Commands
from .foxglove_parameters import Parameters

_SETTLE_S = 0.1


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
