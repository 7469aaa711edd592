"""A Foxglove server for a run directory: its topics and its nodes' parameters, to view only.

Payloads pass unchanged. The WebSockets run on an event loop in their own thread. The node's thread only fills bounded
queues, so neither a slow viewer nor a stalled loop blocks the node.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
import secrets
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from aiohttp import WSMsgType, web

from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.metadata import schema_or_unknown
from instant_ic.bridge import foxglove_protocol as protocol
from instant_ic.bridge.foxglove_parameters import read_parameters
from instant_ic.bridge.foxglove_protocol import FoxgloveProtocolError
from instant_ic.bus import ERROR, Node, Subscription
from instant_ic.bus.qos import PRESETS, RELIABLE
from instant_ic.bus.registry import TopicInfo
from instant_ic.bus.transport import Received
from instant_ic.config.ranges import Range, check_ranges
from instant_ic.util.web_access import SIGN_IN, refusal, sign_in_needed

_START_S = 10.0
_END_S = 2.0
_HEARTBEAT_S = 30.0
_MAX_CLIENT_FRAME = 64 * 1024
_MAX_BACKLOG_BYTES = 32 << 20
_MAX_TEXTS = 1000  # unread announcements of topics, after which a viewer is disconnected

log = logging.getLogger(__name__)
_http_log = logging.getLogger(f"{__name__}.http")
_http_log.setLevel(logging.CRITICAL)  # a line per malformed request would let strangers fill the disk


class FoxgloveError(RuntimeError):
    """The server cannot start; the message says what to do."""


@dataclass(frozen=True)
class FoxgloveBridgeConfig:
    """Parameters of ``foxglove_bridge``.

    Attributes:
        host: address to listen on; 0.0.0.0 opens the server to the network.
        port: TCP port; 0: any free port, reported in the log.
        sign_in: whether viewers need the token of this start: ``auto`` (unless ``simulated``), ``always`` or ``never``.
        simulated: there are simulated robots only. Then ``auto`` needs no token on this machine. The simulator's launch
            files set it.
        allowed_origins: web pages that may connect, by their Origin, besides those of this machine; "*" allows every
            page. Programs that are not browsers send no Origin and are allowed.
        allowed_hosts: names under which viewers may reach the server, besides localhost and any address.
        max_clients: largest number of viewers at a time.
        backlog: messages queued for a viewer that cannot keep up; the oldest are dropped first, so that it never gets a
            burst of old ones.
        topics: names or patterns of the topics to offer; empty offers all.
        exclude: names or patterns of the topics to leave out.
        discovery_period_s: seconds between searches for new and removed topics.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, Range(0, 65535)] = 8765
    sign_in: str = "auto"
    simulated: bool = False
    allowed_origins: tuple[str, ...] = ("https://app.foxglove.dev", "file://")
    allowed_hosts: tuple[str, ...] = ()
    max_clients: Annotated[int, Range(1, 256)] = 16
    backlog: Annotated[int, Range(1, 1024)] = 32
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    discovery_period_s: Annotated[float, Range(0.05, 10)] = 0.25

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.sign_in not in SIGN_IN:
            raise ValueError(f"sign_in must be one of {', '.join(SIGN_IN)} (got {self.sign_in!r})")


class FoxgloveServer:
    """Topics and parameters of one run directory.

    Args:
        node: the bridge's node, on whose bus the server subscribes.
        run_dir: run directory whose nodes' parameters are served.
        config: parameters of the bridge.

    Attributes:
        count, bytes: messages of the bus that were passed to viewers, and their size.
        refused: rejected requests: wrong Origin, Host or token, or too many viewers.
        refusal: reason of the last rejection.
        token: token that viewers need in the address; empty: none.
        wake: set when a viewer comes or goes, so that :meth:`reconcile` is due.

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
        self._next_channel = 1
        self._viewers: list[_Viewer] = []
        self._dropped_before = 0
        self._newcomers: set[str] = set()
        self._flush_due = False
        self.wake = threading.Event()
        self.count = self.bytes = self.refused = 0
        self.refusal = ""
        needed = sign_in_needed(config.sign_in, config.host, config.simulated)
        self.token = secrets.token_urlsafe(24) if needed else ""
        self.port = 0
        self._loop = asyncio.new_event_loop()
        self._finish = asyncio.Event()
        self._started = threading.Event()
        self._start_error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="foxglove", daemon=True)
        self._thread.start()
        if not self._started.wait(_START_S) or self._start_error is not None:
            why = self._start_error or f"not started within {_START_S:g} s"
            raise FoxgloveError(f"no server on {config.host}:{config.port}: {why}; set host or port")

    # -- on the node's thread --------------------------------------------------------------------

    @property
    def watched(self) -> list[str]:
        """Topics with at least one viewer."""
        return sorted(topic for topic, channel in self._channels.items() if channel.subscription is not None)

    @property
    def topics(self) -> list[str]:
        """Offered topics."""
        return sorted(self._channels)

    @property
    def dropped(self) -> int:
        """Messages dropped because a viewer was too slow."""
        with self._lock:
            return self._dropped_before + sum(viewer.dropped for viewer in self._viewers)

    def reconcile(self, present: Sequence[TopicInfo]) -> None:
        """Offer new topics, withdraw those that are gone, and subscribe only to topics with viewers."""
        with self._lock:
            newcomers, self._newcomers = self._newcomers, set()
        for topic in newcomers & self._channels.keys():
            self._channels[topic].renew()
        wanted = {info.topic: info for info in present if self._choice.takes(info.topic)}
        for topic, channel in list(self._channels.items()):
            if topic not in wanted or wanted[topic].type_name != channel.type_name:
                self._withdraw(topic)
        for topic, info in wanted.items():
            if topic in self._channels or self._offer(topic, info.type_name):
                self._channels[topic].watch(info)

    def _offer(self, topic: str, type_name: str) -> bool:
        schema = schema_or_unknown(type_name).text
        if not schema:
            self._node.diagnose(f"topic {topic}", ERROR, f"no definition of {type_name} here: not offered to Foxglove")
            return False
        with self._lock:
            channel = _Channel(self, self._node, self._next_channel, type_name)
            channel.advertisement = {
                "id": channel.id,
                "topic": topic,
                "encoding": "cdr",
                "schemaName": type_name,
                "schema": schema,
                "schemaEncoding": "ros2msg",
            }
            self._next_channel += 1
            self._channels[topic] = channel
            self._to_all(protocol.text("advertise", channels=[channel.advertisement]))
        return True

    def _withdraw(self, topic: str) -> None:
        with self._lock:
            channel = self._channels.pop(topic)
            for viewer in list(channel.watchers):
                viewer.unsubscribe(channel.watchers[viewer])
            self._to_all(protocol.text("unadvertise", channelIds=[channel.id]))
        channel.drop()

    def hand_out(self, channel: _Channel, received: Received) -> None:
        """Queue a message for every viewer of its channel."""
        self.count += 1
        self.bytes += len(received.payload)
        with self._lock:
            for viewer, subscription in channel.watchers.items():
                viewer.put(protocol.message_data(subscription, received.publish_ns, received.payload))
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
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        except Exception as error:
            self._start_error = error
            if self._started.is_set():
                log.exception("Foxglove: the server's thread failed")
                self._node.stop()  # the launcher restarts it
        finally:
            with self._lock:  # from here on no thread wakes the loop
                self._loop.close()
            self._started.set()

    async def _serve(self) -> None:
        server = web.Server(self._handle, access_log=None, logger=_http_log)
        listener = await self._loop.create_server(server, self._config.host, self._config.port)
        self.port = listener.sockets[0].getsockname()[1]
        self._started.set()
        try:
            await self._finish.wait()
        finally:
            listener.close()
            for viewer in list(self._viewers):
                viewer.abort()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(server.shutdown(_END_S / 2), _END_S)

    def _refusal(self, request: web.BaseRequest) -> tuple[int, str]:
        """Return HTTP status and reason of a refused request; the reason of an accepted one is empty."""
        headers, config = request.headers, self._config
        if why := refusal(headers.get("Origin"), headers.get("Host"), config.allowed_origins, config.allowed_hosts):
            return 403, f"{why} of foxglove_bridge"
        if self.token and not hmac.compare_digest(request.query.get("token", "").encode(), self.token.encode()):
            return 401, "no token or a wrong one; foxglove_bridge's log names the file that has the address with it"
        if len(self._viewers) >= config.max_clients:
            return 503, f"{config.max_clients} viewers are connected; see max_clients of foxglove_bridge"
        return 200, ""

    async def _handle(self, request: web.BaseRequest) -> web.StreamResponse:
        """Serve one request; for an accepted viewer, until it disconnects."""
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
        viewer = _Viewer(socket, request, self._config.backlog)
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
                self._dropped_before += viewer.dropped
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
                if len(viewer.texts) > _MAX_TEXTS:
                    log.warning("Foxglove: a viewer does not read; disconnected")
                    viewer.abort()
                    return
                while (frame := self._next_frame(viewer)) is not None:
                    if isinstance(frame, str):
                        await viewer.socket.send_str(frame)
                    else:
                        await viewer.socket.send_bytes(frame)
        except (ConnectionError, RuntimeError):  # the viewer is gone; the receiving side cleans up
            viewer.abort()

    def _next_frame(self, viewer: _Viewer) -> str | bytes | None:
        """Take the next frame to send: texts first, then messages."""
        with self._lock:
            return viewer.texts.popleft() if viewer.texts else viewer.take()

    async def _receive(self, viewer: _Viewer) -> None:
        """Answer a viewer's messages until it leaves. A viewer that does not read its answers is not served further."""
        with contextlib.suppress(ConnectionError, RuntimeError):
            async for message in viewer.socket:
                try:
                    if message.type is not WSMsgType.TEXT:
                        raise FoxgloveProtocolError(f"unknown binary message ({len(message.data)} bytes)")
                    answers = await self._answer(viewer, protocol.parse_text(message.data))
                except FoxgloveProtocolError as error:
                    answers = [protocol.status(protocol.ERROR, f"Invalid message: {error}")]
                for answer in answers:
                    await viewer.socket.send_str(answer)

    async def _answer(self, viewer: _Viewer, content: dict[str, Any]) -> list[str]:
        """Handle a message; return the texts to answer.

        Raises:
            FoxgloveProtocolError: the message has another form, or asks for something that a viewer may not do.
        """
        match content["op"]:
            case "subscribe":
                entries = protocol.objects(content, "subscriptions")
                asked = [(protocol.number(entry, "id"), protocol.number(entry, "channelId")) for entry in entries]
                return [answer for each in asked if (answer := self._subscribe(viewer, *each))]
            case "unsubscribe":
                numbers = protocol.numbers(content, "subscriptionIds")
                with self._lock:
                    for number in numbers:
                        viewer.unsubscribe(number)
                self.wake.set()
            case "getParameters":
                names, request = protocol.strings(content, "parameterNames"), content.get("id")
                if not isinstance(request, str | None):
                    raise FoxgloveProtocolError("id must be a string")
                values, problems = await asyncio.to_thread(read_parameters, self._run_dir, names)
                answer = protocol.text("parameterValues", parameters=protocol.parameters(values), id=request)
                return [*(protocol.status(protocol.WARNING, problem) for problem in problems), answer]
            case "setParameters" | "advertise":
                raise FoxgloveProtocolError("this server is for viewing: set parameters with `ic param set`, "
                                            "drive on the operator's page")  # fmt: skip
            case "unadvertise" | "subscribeParameterUpdates" | "unsubscribeParameterUpdates" | "fetchAsset":
                pass  # not offered; Foxglove sends some of them anyway
            case op:
                raise FoxgloveProtocolError(f"unknown op {op!r:.40}")
        return []

    def _subscribe(self, viewer: _Viewer, number: int, channel_id: int) -> str:
        """Subscribe a viewer; return the status text of a refusal, else an empty text."""
        with self._lock:
            channel = next((each for each in self._channels.values() if each.id == channel_id), None)
            if channel is None:
                return protocol.status(protocol.ERROR, f"Unknown channel {channel_id}")
            if number in viewer.subscriptions or viewer in channel.watchers:
                problem = f"Channel {channel_id} or subscription {number} is subscribed already"
                return protocol.status(protocol.WARNING, problem)
            viewer.subscriptions[number] = channel
            channel.watchers[viewer] = number
            self._newcomers.add(str(channel.advertisement["topic"]))
        self.wake.set()
        return ""


class _Viewer:
    """A connected client; the server's lock guards its queues."""

    def __init__(self, socket: web.WebSocketResponse, request: web.BaseRequest, backlog: int) -> None:
        self.socket = socket
        self.awake = asyncio.Event()
        self.texts: deque[str] = deque()
        self.subscriptions: dict[int, _Channel] = {}
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

    def __init__(self, server: FoxgloveServer, node: Node[Any], number: int, type_name: str) -> None:
        self.id = number
        self.type_name = type_name
        self.advertisement: dict[str, Any] = {}
        self.watchers: dict[_Viewer, int] = {}
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
        """End the subscription on the bus."""
        if self.subscription is not None:
            self._node.drop(self.subscription)
            self.subscription = None
