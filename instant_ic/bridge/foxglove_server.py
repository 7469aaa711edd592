"""A Foxglove server for a run directory: its topics and its nodes' parameters, to view only.

Payloads pass unchanged. The WebSockets run on an event loop in their own thread. The node's thread only fills bounded
queues, so neither a slow viewer nor a stalled loop blocks the node.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hmac
import itertools
import logging
import secrets
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from aiohttp import WSMsgType, web

from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.metadata import schema_or_unknown
from instant_ic.bridge import foxglove_protocol as protocol
from instant_ic.bus import ERROR, Node, Subscription, registry
from instant_ic.bus.qos import PRESETS, RELIABLE
from instant_ic.bus.registry import TopicInfo
from instant_ic.bus.transport import Received
from instant_ic.config.params import flatten
from instant_ic.config.ranges import Checked, Range
from instant_ic.util.web_access import refusal, sign_in_needed

_END_S = 2.0
_HEARTBEAT_S = 30.0
_BACKLOG = 32
_MAX_CLIENT_FRAME = 64 * 1024
_MAX_BACKLOG_BYTES = 32 << 20

log = logging.getLogger(__name__)
_http_log = logging.getLogger(f"{__name__}.http")
_http_log.setLevel(logging.CRITICAL)  # a line per malformed request would let strangers fill the disk


class FoxgloveError(RuntimeError):
    """The server cannot start; the message says what to do."""


@dataclass(frozen=True)
class FoxgloveBridgeConfig(Checked):
    """Parameters of ``foxglove_bridge``.

    Attributes:
        host: address to listen on; 0.0.0.0 opens the server to the network.
        port: TCP port; 0: any free port, reported in the log.
        sign_in: whether viewers need the token of this start: ``auto`` (unless ``simulated``), ``always`` or ``never``.
        simulated: all robots are simulated. Then ``auto`` needs no token on this machine. The simulator's launch files
            set this parameter.
        allowed_origins: web pages that may connect, by their Origin, besides those of this machine; "*" allows every
            page. Programs that are not browsers send no Origin and are allowed.
        allowed_hosts: names under which viewers may reach the server, besides localhost and any address.
        max_clients: largest number of viewers at a time.
        topics: names or patterns of the topics to offer; empty offers all.
        exclude: names or patterns of the topics to leave out.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, Range(0, 65535)] = 8765
    sign_in: Literal["auto", "always", "never"] = "auto"
    simulated: bool = False
    allowed_origins: tuple[str, ...] = ("https://app.foxglove.dev", "file://")
    allowed_hosts: tuple[str, ...] = ()
    max_clients: Annotated[int, Range(1, 256)] = 16
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()


def read_parameters(run_dir: Path, names: Sequence[str]) -> dict[str, Any]:
    """Return the parameters of the running nodes as ``/node.group.key``; all if ``names`` is empty."""
    values = {
        f"/{node.name}.{key}": value
        for node in registry.list_nodes(run_dir)
        for key, value in flatten(node.params).items()
    }
    return {name: values[name] for name in names if name in values} if names else values


class _Viewer:
    """A connected client; the server's lock guards its queues."""

    def __init__(self, socket: web.WebSocketResponse, request: web.BaseRequest) -> None:
        self.socket = socket
        self.awake = asyncio.Event()
        self.texts: deque[str] = deque()
        self.subscriptions: dict[int, _Channel] = {}
        self._transport = request.transport
        self._messages: deque[bytes] = deque()
        self._bytes = 0

    def put(self, subscription: int, publish_ns: int, payload: bytes | memoryview) -> int:
        """Queue a message. Drop the oldest ones if there is no room; return the number of dropped messages."""
        frame = protocol.message_data(subscription, publish_ns, payload)
        dropped = 0
        while self._messages and (len(self._messages) >= _BACKLOG or self._bytes + len(frame) > _MAX_BACKLOG_BYTES):
            self._bytes -= len(self._messages.popleft())
            dropped += 1
        self._messages.append(frame)
        self._bytes += len(frame)
        return dropped

    def take(self) -> str | bytes | None:
        """Remove and return the next frame to send: texts first, then the oldest message."""
        if self.texts:
            return self.texts.popleft()
        if not self._messages:
            return None
        frame = self._messages.popleft()
        self._bytes -= len(frame)
        return frame

    def unsubscribe(self, subscription: int) -> None:
        """End the subscription with this number, if it exists."""
        channel = self.subscriptions.pop(subscription, None)
        if channel is not None:
            channel.watchers.pop(self, None)

    def abort(self) -> None:
        """Abort the connection and wake all tasks that wait on it."""
        if self._transport is not None:
            self._transport.abort()


@dataclass(eq=False)
class _Channel:
    """One offered topic. The server's lock guards ``watchers`` and ``latched``; the node's thread owns the rest.

    Attributes:
        id: number of the channel.
        type_name: type of the topic.
        advertisement: the channel as it is offered to viewers.
        watchers: number of each viewer's subscription.
        latched: publication time and payload of each publisher's newest message on a latched topic, for viewers that
            subscribe later.
        subscription: subscription on the bus while there are viewers.
    """

    id: int
    type_name: str
    advertisement: dict[str, Any]
    watchers: dict[_Viewer, int] = field(default_factory=dict)
    latched: dict[str, tuple[int, bytes]] = field(default_factory=dict)
    subscription: Subscription | None = None


class FoxgloveServer:
    """Topics and parameters of one run directory.

    Args:
        node: the bridge's node, on whose bus the server subscribes.
        run_dir: run directory whose nodes' parameters are served.
        config: parameters of the bridge.

    Attributes:
        count: messages of the bus that were passed to viewers.
        dropped: messages dropped because a viewer was too slow.
        refused: rejected requests: wrong Origin, Host or token, or too many viewers.
        refusal: reason of the last rejection.
        token: token that viewers need in the address; empty if they need none.
        port: TCP port of the server.
        wake: event that is set when a viewer comes or goes; the node then calls :meth:`reconcile`.

    Raises:
        FoxgloveError: the server cannot start.
    """

    def __init__(self, node: Node[Any], run_dir: Path, config: FoxgloveBridgeConfig) -> None:
        self._node = node
        self._run_dir = run_dir
        self._config = config
        self._choice = TopicChoice(config.topics, config.exclude)
        self._lock = threading.Lock()  # guards channels, watchers, viewers and their queues; held only briefly
        self._channels: dict[str, _Channel] = {}
        self._numbers = itertools.count(1)
        self._viewers: list[_Viewer] = []
        self._flush_due = False
        self.wake = threading.Event()
        self.count = self.dropped = self.refused = 0
        self.refusal = ""
        needed = sign_in_needed(config.sign_in, config.host, config.simulated)
        self.token = secrets.token_urlsafe(24) if needed else ""
        self._loop = asyncio.new_event_loop()
        self._finish = asyncio.Event()
        self._server = web.Server(self._handle, access_log=None, logger=_http_log, loop=self._loop)
        try:
            listening = self._loop.create_server(self._server, config.host, config.port)
            self._listener = self._loop.run_until_complete(listening)
        except (OSError, ValueError) as error:  # ValueError: the host is no name
            self._loop.close()
            raise FoxgloveError(f"no server on {config.host}:{config.port}: {error}; set host or port") from None
        self.port: int = self._listener.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._run, name="foxglove", daemon=True)
        self._thread.start()

    # -- on the node's thread --------------------------------------------------------------------

    @property
    def watched(self) -> list[str]:
        """Topics with at least one viewer."""
        return sorted(topic for topic, channel in self._channels.items() if channel.subscription is not None)

    @property
    def topics(self) -> list[str]:
        """Offered topics."""
        return sorted(self._channels)

    def reconcile(self, present: Sequence[TopicInfo]) -> None:
        """Offer new topics, withdraw those that are gone, and subscribe only to topics with viewers."""
        wanted = {info.topic: info for info in present if self._choice.takes(info.topic)}
        for topic, channel in list(self._channels.items()):
            if topic not in wanted or wanted[topic].type_name != channel.type_name:
                self._withdraw(topic)
        for topic, info in wanted.items():
            if topic in self._channels or self._offer(topic, info.type_name):
                self._watch(self._channels[topic], info)

    def _offer(self, topic: str, type_name: str) -> bool:
        schema = schema_or_unknown(type_name).text
        if not schema:
            self._node.diagnose(f"topic {topic}", ERROR, f"no definition of {type_name} here: not offered to Foxglove")
            return False
        number = next(self._numbers)
        advertisement = {
            "id": number,
            "topic": topic,
            "encoding": "cdr",
            "schemaName": type_name,
            "schema": schema,
            "schemaEncoding": "ros2msg",
        }
        channel = _Channel(number, type_name, advertisement)
        with self._lock:
            self._channels[topic] = channel
            self._to_all(protocol.text("advertise", channels=[advertisement]))
        return True

    def _watch(self, channel: _Channel, info: TopicInfo) -> None:
        """Subscribe on the bus while there are viewers, otherwise unsubscribe."""
        if channel.watchers and channel.subscription is None:
            qos = max(
                (PRESETS.get(p.qos, RELIABLE) for p in info.publishers), key=lambda qos: (qos.latched, qos.reliable)
            )
            hand_out = functools.partial(self._hand_out, channel, qos.latched)
            # ``sensor`` keeps only the newest message: after a stall of this process no backlog arrives.
            channel.subscription = self._node.subscribe_received(info.topic, hand_out, qos)
        elif not channel.watchers:
            self._drop(channel)
        with self._lock:
            for gone in channel.latched.keys() - {publisher.node for publisher in info.publishers}:
                del channel.latched[gone]

    def _withdraw(self, topic: str) -> None:
        with self._lock:
            channel = self._channels.pop(topic)
            for viewer, subscription in list(channel.watchers.items()):
                viewer.unsubscribe(subscription)
            self._to_all(protocol.text("unadvertise", channelIds=[channel.id]))
        self._drop(channel)

    def _drop(self, channel: _Channel) -> None:
        """End a channel's subscription on the bus."""
        if channel.subscription is not None:
            self._node.drop(channel.subscription)
            channel.subscription = None
            with self._lock:
                channel.latched.clear()

    def _hand_out(self, channel: _Channel, latched: bool, received: Received) -> None:
        """Queue a message for every viewer of its channel."""
        if received.type_name != channel.type_name:
            return
        self.count += 1
        with self._lock:
            if latched:
                channel.latched[received.publisher] = (received.publish_ns, bytes(received.payload))
            for viewer, subscription in channel.watchers.items():
                self.dropped += viewer.put(subscription, received.publish_ns, received.payload)
            self._flush_soon()

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

    # -- from any thread -------------------------------------------------------------------------

    def _to_all(self, text: str) -> None:
        """Queue a text for all viewers. The caller holds the lock."""
        for viewer in self._viewers:
            viewer.texts.append(text)
        self._flush_soon()

    def _flush_soon(self) -> None:
        """Wake the senders, at most once until they have run. The caller holds the lock."""
        if not self._flush_due and not self._loop.is_closed():
            self._flush_due = True
            self._loop.call_soon_threadsafe(self._flush)

    # -- on the loop's thread --------------------------------------------------------------------

    def _flush(self) -> None:
        with self._lock:
            self._flush_due = False
        for viewer in self._viewers:
            viewer.awake.set()

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        except Exception:
            log.exception("Foxglove: the server's thread failed")
            self._node.stop()  # the launcher restarts it
        finally:
            with self._lock:  # from here on no thread wakes the loop
                self._loop.close()

    async def _serve(self) -> None:
        await self._finish.wait()
        self._listener.close()
        for viewer in list(self._viewers):
            viewer.abort()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._server.shutdown(_END_S / 2), _END_S)

    def _refusal(self, request: web.BaseRequest) -> tuple[int, str]:
        """Return the HTTP status and the reason for refusing a request; the reason is empty if it is accepted."""
        headers, config = request.headers, self._config
        if why := refusal(headers.get("Origin"), headers.get("Host"), config.allowed_origins, config.allowed_hosts):
            return 403, f"{why} of foxglove_bridge"
        if self.token and not hmac.compare_digest(request.query.get("token", "").encode(), self.token.encode()):
            return 401, "the token is missing or wrong; foxglove_bridge's log names the file with the right address"
        if len(self._viewers) >= config.max_clients:
            return 503, f"{config.max_clients} viewers are connected: close one, or raise foxglove_bridge max_clients"
        return 200, ""

    async def _handle(self, request: web.BaseRequest) -> web.StreamResponse:
        """Serve one request. An accepted viewer is served until it disconnects."""
        code, why = self._refusal(request)
        if why:
            self.refused += 1
            self.refusal = why
            return web.Response(status=code, text=f"{why}\n")
        socket = web.WebSocketResponse(
            protocols=protocol.SUBPROTOCOLS,
            max_msg_size=_MAX_CLIENT_FRAME,
            compress=False,
            heartbeat=_HEARTBEAT_S,
            timeout=_END_S / 2,
        )
        ready = socket.can_prepare(request)
        if not ready.ok or ready.protocol is None:
            return web.Response(status=400, text=f"a WebSocket of {' or '.join(protocol.SUBPROTOCOLS)} is expected\n")
        await socket.prepare(request)
        viewer = _Viewer(socket, request)
        with self._lock:
            channels = [channel.advertisement for channel in self._channels.values()]
            info = {"name": "Instant IC", "capabilities": ["parameters"], "metadata": {}, "sessionId": str(id(self))}
            viewer.texts += (protocol.text("serverInfo", **info), protocol.text("advertise", channels=channels))
            self._viewers.append(viewer)
        viewer.awake.set()
        sender = asyncio.create_task(self._send(viewer))
        try:
            await self._receive(viewer)
        finally:
            sender.cancel()
            with self._lock:
                self._viewers.remove(viewer)
                for subscription in list(viewer.subscriptions):
                    viewer.unsubscribe(subscription)
            self.wake.set()
        return socket

    async def _send(self, viewer: _Viewer) -> None:
        """Send a viewer's queued frames as they come."""
        try:
            while True:
                await viewer.awake.wait()
                viewer.awake.clear()
                while (frame := self._next_frame(viewer)) is not None:
                    if isinstance(frame, str):
                        await viewer.socket.send_str(frame)
                    else:
                        await viewer.socket.send_bytes(frame)
        except (ConnectionError, RuntimeError):  # the viewer is gone; the receiving side cleans up
            viewer.abort()

    def _next_frame(self, viewer: _Viewer) -> str | bytes | None:
        with self._lock:
            return viewer.take()

    async def _receive(self, viewer: _Viewer) -> None:
        """Answer a viewer's messages until it leaves. A viewer that does not read its answers is not served further."""
        with contextlib.suppress(ConnectionError, RuntimeError):
            async for message in viewer.socket:
                if message.type is WSMsgType.TEXT:
                    answers = await self._answer(viewer, message.data)
                else:
                    answers = [protocol.status(protocol.ERROR, f"unknown binary message ({len(message.data)} bytes)")]
                for answer in answers:
                    await viewer.socket.send_str(answer)

    async def _answer(self, viewer: _Viewer, data: str) -> list[str]:
        """Handle a text message; return the texts to answer."""
        try:
            op, arguments, request = protocol.parse(data)
        except protocol.FoxgloveProtocolError as error:
            return [protocol.status(protocol.ERROR, str(error))]
        match op:
            case "subscribe":
                with self._lock:
                    answers = [self._subscribe(viewer, *each) for each in arguments]
                self.wake.set()
                return [answer for answer in answers if answer]
            case "unsubscribe":
                with self._lock:
                    for number in arguments:
                        viewer.unsubscribe(number)
                self.wake.set()
            case "getParameters":
                values = await asyncio.to_thread(read_parameters, self._run_dir, arguments)
                return [protocol.parameter_values(values, request)]
            case "setParameters" | "advertise":
                text = "this server is for viewing: set parameters with `ic param set`, drive on the operator's page"
                return [protocol.status(protocol.ERROR, text)]
            case "unadvertise" | "subscribeParameterUpdates" | "unsubscribeParameterUpdates" | "fetchAsset":
                pass  # not offered; Foxglove sends some of them anyway
            case _:
                return [protocol.status(protocol.ERROR, f"unknown op {op!r:.40}")]
        return []

    def _subscribe(self, viewer: _Viewer, number: int, channel_id: int) -> str:
        """Subscribe a viewer; return the status text of a refusal, or an empty text. The caller holds the lock."""
        channel = next((each for each in self._channels.values() if each.id == channel_id), None)
        if channel is None:
            return protocol.status(protocol.ERROR, f"Unknown channel {channel_id}")
        if number in viewer.subscriptions or viewer in channel.watchers:
            problem = f"Channel {channel_id} or subscription {number} is subscribed already"
            return protocol.status(protocol.WARNING, problem)
        viewer.subscriptions[number] = channel
        channel.watchers[viewer] = number
        for publish_ns, payload in channel.latched.values():
            viewer.put(number, publish_ns, payload)
        self._flush_soon()
        return ""
