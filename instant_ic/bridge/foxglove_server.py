"""A Foxglove server for a run directory: its topics, its nodes' parameters, its graph.

Payloads pass unchanged. The WebSockets run on an event loop in their own thread. The node's thread passes data to it
through bounded queues, so neither a slow viewer nor a stalled loop blocks the node.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
import secrets
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from aiohttp import WSCloseCode, WSMsgType, web

from instant_ic.bag.metadata import schema_or_unknown
from instant_ic.bridge import foxglove_protocol as protocol
from instant_ic.bridge.foxglove_commands import Commands
from instant_ic.bridge.foxglove_parameters import Parameters
from instant_ic.bus import ERROR, OK, WARN, Node, Subscription
from instant_ic.bus.qos import PRESETS, RELIABLE
from instant_ic.bus.registry import NodeInfo, TopicInfo
from instant_ic.bus.transport import Received
from instant_ic.config.ranges import Range, check_ranges
from instant_ic.control.command_gate import CommandGate
from instant_ic.util.web_access import SIGN_IN, TokenBucket, refusal, sign_in_needed

_START_S = 10.0
_END_S = 2.0
_HANDSHAKE_S = 5.0
_HEARTBEAT_S = 30.0
_MAX_CLIENT_FRAME = 64 * 1024
_MAX_TEXTS = 1000  # unread answers of a client; above this it is disconnected
_MAX_BACKLOG_BYTES = 32 << 20
_MAX_CHANNELS = 16  # channels that one client may publish on
_MAX_PARAMETER_REQUESTS = 16
_MAX_MESSAGES_PER_S = 200.0
_WAITING_CONNECTIONS = 16  # connections that have not become a WebSocket yet, in addition to the clients'
_UNSUPPORTED = ("subscribeParameterUpdates", "unsubscribeParameterUpdates", "fetchAsset")
_STATUS = {OK: protocol.INFO, WARN: protocol.WARNING}

log = logging.getLogger(__name__)
_http_log = logging.getLogger(f"{__name__}.http")
_http_log.setLevel(logging.CRITICAL)  # a line per malformed request would let strangers fill the disk


class FoxgloveError(RuntimeError):
    """The server cannot start; the message says what to do."""


@dataclass(frozen=True)
class ServerConfig:
    """Parameters of the server.

    Attributes:
        host: address to listen on; 0.0.0.0 opens the server to the network.
        sign_in: whether viewers need the token of this start: ``auto`` (unless ``simulated``), ``always`` or ``never``.
        simulated: there are simulated robots only. Then ``auto`` needs no token on this machine. The simulator's launch
            files set it.
        port: TCP port; 0: any free port, reported in the log.
        tls_cert: certificate in PEM; with tls_key the server speaks wss:// only.
        tls_key: its private key, PKCS#8 in PEM.
        allowed_origins: web pages that may connect, by their Origin, besides those of this machine; "*" allows every
            page. Programs that are not browsers send no Origin and are allowed.
        allowed_hosts: names under which clients may reach the server, besides localhost and any address.
        max_clients: largest number of clients at a time.
        backlog: messages queued for a client that cannot keep up; the oldest are dropped first, so that it never gets a
            burst of old ones.
        accept_operator: whether clients may drive (/operator/cmd_vel) and stop (/operator/estop) the robot.
        set_parameters: whether clients may change parameters, except safety parameters.
    """

    host: str = "127.0.0.1"
    sign_in: str = "auto"
    simulated: bool = False
    port: Annotated[int, Range(0, 65535)] = 8765
    tls_cert: str = ""
    tls_key: str = ""
    allowed_origins: tuple[str, ...] = ("https://app.foxglove.dev", "file://")
    allowed_hosts: tuple[str, ...] = ()
    max_clients: Annotated[int, Range(1, 256)] = 16
    backlog: Annotated[int, Range(1, 1024)] = 32
    accept_operator: bool = False
    set_parameters: bool = False

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.sign_in not in SIGN_IN:
            raise ValueError(f"sign_in must be one of {', '.join(SIGN_IN)} (got {self.sign_in!r})")
        if bool(self.tls_cert) != bool(self.tls_key):
            raise ValueError("tls_cert and tls_key go together: give both or none")


class FoxgloveServer:
    """Channels, parameters, graph and commands of one run directory.

    Args:
        node: the bridge's node, on whose bus the server subscribes.
        takes: whether to offer a topic.
        gate: checks the clients' commands.
        server_time: whether to send the time to clients (for simulated time).

    Attributes:
        count, bytes: messages of the bus that were passed to clients, and their size.
        refused: rejected requests: wrong Origin or Host, or too many clients.
        refusal: reason of the last rejection.
        token: token that viewers need in the address; empty: none.

    Raises:
        FoxgloveError: the server cannot start.
    """

    def __init__(
        self,
        node: Node[Any],
        run_dir: Path,
        config: ServerConfig,
        takes: Callable[[str], bool],
        gate: CommandGate,
        server_time: bool = False,
    ) -> None:
        tls = _tls(config)
        self._node = node
        self._takes = takes
        self._config = config
        self._server_time = server_time
        self._lock = threading.Lock()  # guards channels, watchers, clients and their queues; held only briefly
        self._channels: dict[str, _Channel] = {}
        self._next_channel = 1
        self._clients: list[_Client] = []
        self._next_client = 1
        self._dropped_before = 0
        self._newcomers: set[str] = set()
        self._graph = protocol.Graph({}, {})
        self._time_ns: int | None = None
        self._flush_due = False
        self.parameters = Parameters(run_dir)
        self.commands = Commands(node, gate, self._tell_client) if config.accept_operator else None
        self.wake = threading.Event()
        self.count = 0
        self.bytes = 0
        self.refused = 0
        self.refusal = ""
        needed = sign_in_needed(config.sign_in, config.host, config.simulated)
        self.token = secrets.token_urlsafe(24) if needed else ""
        self.port = 0
        self._loop = asyncio.new_event_loop()
        self._finish = asyncio.Event()
        self._started = threading.Event()
        self._start_error: Exception | None = None
        self._thread = threading.Thread(target=self._run, args=(tls,), name="foxglove", daemon=True)
        self._start()

    def _start(self) -> None:
        where = f"{self._config.host}:{self._config.port}"
        self._thread.start()
        if not self._started.wait(_START_S):
            raise FoxgloveError(f"no server on {where}: not started within {_START_S:g} s; set host or port")
        if self._start_error is not None:
            self.parameters.close()
            raise FoxgloveError(f"no server on {where}: {self._start_error}; set host or port") from None

    # -- on the node's thread --------------------------------------------------------------------

    @property
    def watched(self) -> list[str]:
        """Topics with at least one viewer."""
        return sorted(topic for topic, channel in self._channels.items() if channel.subscription is not None)

    @property
    def topics(self) -> list[str]:
        return sorted(self._channels)

    @property
    def dropped(self) -> int:
        """Messages dropped because a client was too slow."""
        with self._lock:
            return self._dropped_before + sum(client.dropped for client in self._clients)

    def reconcile(self, present: Sequence[TopicInfo], nodes: Sequence[NodeInfo]) -> None:
        """Offer new topics, withdraw those that are gone, and subscribe only to topics with viewers."""
        with self._lock:
            newcomers, self._newcomers = self._newcomers, set()
        for topic in newcomers & self._channels.keys():
            self._channels[topic].renew()
        wanted = {info.topic: info for info in present if self._takes(info.topic)}
        for topic, info in wanted.items():
            channel = self._channels.get(topic)
            if channel is not None and channel.type_name != info.type_name:
                self._withdraw(topic)
                channel = None
            if channel is None and not self._offer(topic, info.type_name):
                continue
            self._channels[topic].watch(info)
        for topic in [topic for topic in self._channels if topic not in wanted]:
            self._withdraw(topic)
        self._tell_graph(present, nodes)

    def _offer(self, topic: str, type_name: str) -> bool:
        schema = schema_or_unknown(type_name).text
        if not schema:
            self._node.diagnose(f"topic {topic}", ERROR, f"no definition of {type_name} here: not offered to Foxglove")
            return False
        with self._lock:
            channel = _Channel(self, self._node, self._next_channel, topic, type_name, schema)
            self._next_channel += 1
            self._channels[topic] = channel
            self._to_all(protocol.text("advertise", channels=[channel.advertisement]))
        return True

    def _withdraw(self, topic: str) -> None:
        with self._lock:
            channel = self._channels.pop(topic)
            for client in list(channel.watchers):
                client.unsubscribe(channel.watchers[client])
            self._to_all(protocol.text("unadvertise", channelIds=[channel.id]))
        channel.drop()

    def _tell_graph(self, present: Sequence[TopicInfo], nodes: Sequence[NodeInfo]) -> None:
        published = {info.topic: sorted({p.node for p in info.publishers}) for info in present}
        subscribed: dict[str, list[str]] = {}
        for node in nodes:
            for topic in node.subscribes:
                subscribed.setdefault(topic, []).append(node.name)
        now = protocol.Graph(published, {topic: sorted(names) for topic, names in subscribed.items()})
        with self._lock:
            update = protocol.graph_update(self._graph, now)
            self._graph = now
            if update is not None:
                self._to_all(update, lambda client: client.wants_graph)

    def hand_out(self, channel: _Channel, received: Received) -> None:
        """Queue a message for every viewer of its channel."""
        self.count += 1
        self.bytes += len(received.payload)
        with self._lock:
            for client, subscription in channel.watchers.items():
                client.put(protocol.message_data(subscription, received.publish_ns, received.payload))
            self._flush_soon()

    # -- from any thread -------------------------------------------------------------------------

    def send_time(self, now_ns: int) -> None:
        """Send the simulated time to the clients."""
        with self._lock:
            self._time_ns = now_ns
            for client in self._clients:
                client.time = protocol.time_data(now_ns)
            self._flush_soon()

    def _tell_client(self, number: int, words: str, level: int) -> None:
        """Show a text in one client's list of problems."""
        with self._lock:
            self._to_all(_status(words, level), lambda client: client.number == number)

    def _to_all(self, text: str, which: Callable[[_Client], bool] = lambda client: True) -> None:
        """Queue a text for clients. The caller holds the lock."""
        for client in self._clients:
            if which(client):
                client.texts.append(text)
        self._flush_soon()

    def _flush_soon(self) -> None:
        """Wake the senders, at most once until they have run. The caller holds the lock."""
        if not self._flush_due and not self._loop.is_closed():
            self._flush_due = True
            self._loop.call_soon_threadsafe(self._flush)

    def close(self) -> None:
        """Stop the server and all subscriptions. Idempotent."""
        for topic in list(self._channels):
            self._withdraw(topic)
        if self._thread.is_alive():
            with contextlib.suppress(RuntimeError):  # the loop is just ending by itself
                self._loop.call_soon_threadsafe(self._finish.set)
            self._thread.join(2 * _END_S)
            if self._thread.is_alive():
                log.error("Foxglove: the server's thread did not end within %g s; it ends with the process", 2 * _END_S)
        self.parameters.close()

    # -- on the loop's thread --------------------------------------------------------------------

    def _run(self, tls: ssl.SSLContext | None) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.set_exception_handler(_Quiet())
        try:
            self._loop.run_until_complete(self._serve(tls))
        except Exception as error:
            self._start_error = error
            if self._started.is_set():
                log.exception("Foxglove: the server's thread failed")
                self._node.stop()  # the launcher restarts it
        finally:
            with self._lock:  # from here on no thread wakes the loop
                self._loop.close()
            self._started.set()

    async def _serve(self, tls: ssl.SSLContext | None) -> None:
        server = web.Server(self._handle, access_log=None, logger=_http_log, keepalive_timeout=_HANDSHAKE_S)

        def accept() -> asyncio.Protocol:
            if len(server.connections) >= self._config.max_clients + _WAITING_CONNECTIONS:
                self._refuse("too many connections")
                return _Refusing()
            connection = server()
            self._loop.call_later(_HANDSHAKE_S, self._end_idle, connection)
            return connection

        listener = await self._loop.create_server(
            accept,
            self._config.host,
            self._config.port,
            ssl=tls,
            ssl_handshake_timeout=_HANDSHAKE_S if tls else None,
        )
        self.port = listener.sockets[0].getsockname()[1]
        self._started.set()
        try:
            await self._finish.wait()
        finally:
            listener.close()
            for client in list(self._clients):
                client.abort()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(server.shutdown(_END_S / 2), _END_S)

    def _end_idle(self, connection: web.RequestHandler) -> None:
        """Close a connection that has not become a client in time."""
        if all(client.connection is not connection for client in self._clients):
            connection.force_close()

    def _refuse(self, why: str) -> None:
        self.refused += 1
        self.refusal = why

    async def _handle(self, request: web.BaseRequest) -> web.StreamResponse:
        """Serve one request; for an accepted client, until it disconnects."""
        config = self._config
        why = refusal(
            request.headers.get("Origin"), request.headers.get("Host"), config.allowed_origins, config.allowed_hosts
        )
        if why:
            self._refuse(why)
            return web.Response(status=403, text=f"{why} of foxglove_bridge\n")
        given = request.query.get("token", "").encode()
        if self.token and not hmac.compare_digest(given, self.token.encode()):
            why = "no token or a wrong one; foxglove_bridge's log names the file that has the address with it"
            self._refuse(why)
            return web.Response(status=401, text=f"{why}\n")
        if len(self._clients) >= config.max_clients:
            self._refuse("too many clients")
            return web.Response(status=503, text=f"{config.max_clients} clients are connected; see max_clients\n")
        socket = web.WebSocketResponse(
            protocols=protocol.SUBPROTOCOLS,
            max_msg_size=_MAX_CLIENT_FRAME,
            compress=False,
            heartbeat=_HEARTBEAT_S,
            autoping=False,
            timeout=_END_S / 2,
        )
        if not socket.can_prepare(request).ok or not _asks_for_protocol(request):
            return web.Response(status=400, text=f"a WebSocket of {' or '.join(protocol.SUBPROTOCOLS)} is expected\n")
        await socket.prepare(request)
        client = _Client(self._next_client, socket, request, config.backlog)
        self._next_client += 1
        with self._lock:
            client.texts.append(self._server_info())
            channels = [channel.advertisement for channel in self._channels.values()]
            client.texts.append(protocol.text("advertise", channels=channels))
            client.time = None if self._time_ns is None else protocol.time_data(self._time_ns)
            self._clients.append(client)
        client.awake.set()
        tasks = [asyncio.create_task(work) for work in (self._send(client), self._answer_parameters(client))]
        try:
            await self._receive(client)
        finally:
            for task in tasks:
                task.cancel()
            self._leave(client)
        return socket

    def _leave(self, client: _Client) -> None:
        with self._lock:
            self._clients.remove(client)
            self._dropped_before += client.dropped
            for subscription in list(client.subscriptions):
                client.unsubscribe(subscription)
        self.wake.set()
        if self.commands is not None:
            self.commands.left(client.number)

    def _server_info(self) -> str:
        config = self._config
        capabilities = ["parameters", "connectionGraph"]
        capabilities += ["clientPublish"] * config.accept_operator + ["time"] * self._server_time
        return protocol.text(
            "serverInfo",
            name="Instant IC",
            capabilities=capabilities,
            supportedEncodings=["cdr", "json"] if config.accept_operator else None,
            metadata={},
            sessionId=str(id(self)),
        )

    def _flush(self) -> None:
        with self._lock:
            self._flush_due = False
        for client in self._clients:
            client.awake.set()

    async def _send(self, client: _Client) -> None:
        """Send a client's queued data: texts first, then time, then messages."""
        try:
            while True:
                await client.awake.wait()
                client.awake.clear()
                if len(client.texts) > _MAX_TEXTS:
                    log.warning("Foxglove: client %d does not read its replies; disconnected", client.number)
                    client.abort()
                    return
                while (frame := self._next_frame(client)) is not None:
                    if isinstance(frame, str):
                        await client.socket.send_str(frame)
                    else:
                        await client.socket.send_bytes(frame)
        except (ConnectionError, RuntimeError):  # the client is gone; the receiving side cleans up
            client.abort()

    def _next_frame(self, client: _Client) -> str | bytes | None:
        with self._lock:
            if client.texts:
                return client.texts.popleft()
            if client.time is not None:
                frame, client.time = client.time, None
                return frame
            return client.take()

    async def _receive(self, client: _Client) -> None:
        """Receive a client's messages until it leaves, or exceeds the message rate or size."""
        bucket = TokenBucket(_MAX_MESSAGES_PER_S, _MAX_MESSAGES_PER_S)
        while True:
            message = await client.socket.receive()
            if not bucket.take(time.monotonic()):
                await self._end(client, f"more than {_MAX_MESSAGES_PER_S:g} messages a second")
                return
            try:
                if message.type is WSMsgType.TEXT:
                    self._on_text(client, protocol.parse_text(message.data))
                elif message.type is WSMsgType.BINARY:
                    self._on_data(client, *protocol.parse_data(message.data))
                elif message.type is WSMsgType.PING:
                    await client.socket.pong(message.data)
                elif message.type is not WSMsgType.PONG:
                    return
            except protocol.ProtocolError as error:
                self._tell_client(client.number, f"Invalid message: {error}", ERROR)
            except ConnectionError:
                return

    async def _end(self, client: _Client, why: str) -> None:
        log.warning("Foxglove: client %d sends %s; disconnected", client.number, why)
        with contextlib.suppress(TimeoutError, ConnectionError):
            await asyncio.wait_for(client.socket.close(code=WSCloseCode.POLICY_VIOLATION, message=why.encode()), _END_S)
        client.abort()

    def _on_text(self, client: _Client, content: dict[str, Any]) -> None:
        op = content["op"]
        match op:
            case "subscribe":
                for entry in protocol.objects(content, "subscriptions"):
                    self._subscribe(client, protocol.number(entry, "id"), protocol.number(entry, "channelId"))
            case "unsubscribe":
                with self._lock:
                    for number in protocol.numbers(content, "subscriptionIds"):
                        client.unsubscribe(number)
                self.wake.set()
            case "getParameters" | "setParameters":
                if len(client.requests) >= _MAX_PARAMETER_REQUESTS:
                    raise protocol.ProtocolError(f"more than {_MAX_PARAMETER_REQUESTS} parameter requests wait")
                client.requests.append(content)
                client.asked.set()
            case "subscribeConnectionGraph" | "unsubscribeConnectionGraph":
                with self._lock:
                    client.wants_graph = op == "subscribeConnectionGraph"
                    if client.wants_graph:
                        client.texts.append(self._graph.encode())
                client.awake.set()
            case "advertise" | "unadvertise" if self.commands is not None:
                self._on_advertise(client, op, content)
            case "advertise" | "unadvertise":
                raise protocol.ProtocolError("this server accepts no messages (accept_operator: false)")
            case _ if op not in _UNSUPPORTED:
                raise protocol.ProtocolError(f"unknown op {op!r:.40}")

    def _subscribe(self, client: _Client, number: int, channel_id: int) -> None:
        with self._lock:
            channel = next((each for each in self._channels.values() if each.id == channel_id), None)
            if channel is None:
                problem = f"Unknown channel {channel_id}"
            elif number in client.subscriptions or client in channel.watchers:
                problem = f"Channel {channel_id} or subscription {number} is subscribed already"
            else:
                problem = ""
                client.subscriptions[number] = channel
                channel.watchers[client] = number
                self._newcomers.add(channel.topic)
        if channel is None or problem:
            self._tell_client(client.number, problem, ERROR if channel is None else WARN)
            return
        self.wake.set()

    def _on_advertise(self, client: _Client, op: str, content: dict[str, Any]) -> None:
        assert self.commands is not None
        if op == "unadvertise":
            for number in protocol.numbers(content, "channelIds"):
                if client.channels.pop(number, None) is not None:
                    self.commands.unadvertised(client.number, number)
            return
        for entry in protocol.objects(content, "channels"):
            channel = protocol.client_channel(entry)
            if channel.id not in client.channels and len(client.channels) >= _MAX_CHANNELS:
                raise protocol.ProtocolError(f"more than {_MAX_CHANNELS} channels of one client")
            if channel.id in client.channels:
                raise protocol.ProtocolError(f"channel {channel.id} is advertised already")
            client.channels[channel.id] = channel
            self.commands.advertised(client.number, channel)

    def _on_data(self, client: _Client, channel_id: int, payload: bytes) -> None:
        if self.commands is None or channel_id not in client.channels:
            raise protocol.ProtocolError(f"Unknown channel {channel_id}")
        self.commands.message(client.number, channel_id, payload)

    # -- parameters: asked on a thread, as a node may take its time ------------------------------

    async def _answer_parameters(self, client: _Client) -> None:
        """Answer parameter requests one at a time, concurrently with the client's other messages."""
        while True:
            await client.asked.wait()
            client.asked.clear()
            while client.requests:
                request = client.requests.popleft()
                try:
                    answer, problems = await asyncio.to_thread(self._parameters, request)
                except protocol.ProtocolError as error:
                    self._tell_client(client.number, f"Invalid message: {error}", ERROR)
                    continue
                for level, words in problems:
                    self._tell_client(client.number, words, level)
                with self._lock:
                    client.texts.append(answer)
                client.awake.set()

    def _parameters(self, request: dict[str, Any]) -> tuple[str, list[tuple[int, str]]]:
        problems: list[tuple[int, str]] = []
        if request["op"] == "setParameters":
            entries = protocol.objects(request, "parameters")
            names = protocol.strings({"names": [entry.get("name") for entry in entries]}, "names")
            if self._config.set_parameters:
                refused = self.parameters.set({name: _value(e) for name, e in zip(names, entries, strict=True)})
            else:
                refused = ["parameters are read-only (set_parameters: false)"]
            problems += [(ERROR, words) for words in refused]
        else:
            names = protocol.strings(request, "parameterNames")
        # An empty list requests everything, so an empty change must not be looked up.
        values, silent = ({}, []) if not names and request["op"] == "setParameters" else self.parameters.get(names)
        problems += [(WARN, words) for words in silent]
        request_id = request.get("id")
        if request_id is not None and not isinstance(request_id, str):
            raise protocol.ProtocolError("id must be a string")
        return protocol.text("parameterValues", parameters=protocol.parameters(values), id=request_id), problems


class _Client:
    """A viewer; the server's lock guards its queues."""

    def __init__(self, number: int, socket: web.WebSocketResponse, request: web.BaseRequest, backlog: int) -> None:
        self.number = number
        self.socket = socket
        self.connection = request.protocol
        self.awake = asyncio.Event()
        self.asked = asyncio.Event()
        self.texts: deque[str] = deque()
        self.time: bytes | None = None
        self.requests: deque[dict[str, Any]] = deque()
        self.subscriptions: dict[int, _Channel] = {}
        self.channels: dict[int, protocol.ClientChannel] = {}
        self.wants_graph = False
        self.dropped = 0
        self._transport = request.transport
        self._backlog = backlog
        self._messages: deque[bytes] = deque()
        self._bytes = 0

    def put(self, frame: bytes) -> None:
        """Queue a message; drop the oldest to make room."""
        while self._messages and (
            len(self._messages) >= self._backlog or self._bytes + len(frame) > _MAX_BACKLOG_BYTES
        ):
            self.take()
            self.dropped += 1
        self._messages.append(frame)
        self._bytes += len(frame)

    def take(self) -> bytes | None:
        """Remove and return the oldest queued message."""
        if not self._messages:
            return None
        frame = self._messages.popleft()
        self._bytes -= len(frame)
        return frame

    def unsubscribe(self, subscription: int) -> None:
        """End a subscription, if there is one with this number."""
        channel = self.subscriptions.pop(subscription, None)
        if channel is not None:
            channel.watchers.pop(self, None)

    def abort(self) -> None:
        """Abort the connection and wake all tasks that wait on it."""
        if self._transport is not None:
            self._transport.abort()


class _Channel:
    """One offered topic. The server's lock guards ``watchers``; everything else belongs to the node's thread."""

    def __init__(
        self, server: FoxgloveServer, node: Node[Any], number: int, topic: str, type_name: str, schema: str
    ) -> None:
        self.id = number
        self.topic = topic
        self.type_name = type_name
        self.advertisement = {
            "id": number,
            "topic": topic,
            "encoding": "cdr",
            "schemaName": type_name,
            "schema": schema,
            "schemaEncoding": "ros2msg",
        }
        self.watchers: dict[_Client, int] = {}
        self.subscription: Subscription | None = None
        self._server = server
        self._node = node
        self._latched = False

    def watch(self, info: TopicInfo) -> None:
        """Subscribe on the bus while there are viewers, otherwise unsubscribe."""
        if self.watchers and self.subscription is None:
            qos = max(
                (PRESETS.get(p.qos, RELIABLE) for p in info.publishers), key=lambda qos: (qos.latched, qos.reliable)
            )
            self._latched = qos.latched
            # ``sensor`` keeps only the newest message: after a stall of this process no backlog arrives.
            self.subscription = self._node.subscribe_received(info.topic, self._forward, qos)
        elif not self.watchers:
            self.drop()

    def renew(self) -> None:
        """Subscribe again to a latched topic: all viewers, also new ones, get every publisher's value."""
        if self._latched and (old := self.subscription) is not None:
            self.subscription = self._node.subscribe_received(old.raw.topic, self._forward, old.raw.qos)
            self._node.drop(old)

    def _forward(self, received: Received) -> None:
        if received.type_name == self.type_name:
            self._server.hand_out(self, received)

    def drop(self) -> None:
        if self.subscription is not None:
            self._node.drop(self.subscription)
            self.subscription = None


class _Refusing(asyncio.Protocol):
    """A connection beyond the limit."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.abort()


class _Quiet:
    """Logs connection errors at most once a second, so that strangers cannot fill the disk."""

    def __init__(self) -> None:
        self._next_s = 0.0
        self._left_out = 0

    def __call__(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        now_s = time.monotonic()
        if now_s < self._next_s:
            self._left_out += 1
            return
        self._next_s = now_s + 1.0
        log.warning("Foxglove: %s (%d more like it)", context.get("exception", context.get("message")), self._left_out)
        self._left_out = 0


def _tls(config: ServerConfig) -> ssl.SSLContext | None:
    if not config.tls_cert:
        return None
    files = [Path(name).expanduser() for name in (config.tls_cert, config.tls_key)]
    for path in files:
        try:
            path.read_bytes()
        except OSError as error:
            raise FoxgloveError(f"{path}: cannot be read: {error.strerror}") from None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(files[0], files[1])
    except ssl.SSLError as error:
        raise FoxgloveError(f"{files[0]} and {files[1]}: not a certificate with its key: {error}") from None
    return context


def _asks_for_protocol(request: web.BaseRequest) -> bool:
    asked = ",".join(request.headers.getall("Sec-WebSocket-Protocol", ())).split(",")
    return any(name.strip() in protocol.SUBPROTOCOLS for name in asked)


def _status(words: str, level: int) -> str:
    return protocol.text("status", level=_STATUS.get(level, protocol.ERROR), message=words[:1000])


def _value(entry: dict[str, Any]) -> Any:
    """Return a parameter's value; a whole number is accepted for a float."""
    value = entry.get("value")
    if entry.get("type") == "float64" and type(value) is int:
        return float(value)
    return value
