"""Common base of both ends of the link: exports topics, emits events, runs the I/O thread."""

from __future__ import annotations

import itertools
import logging
import re
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zmq
from zmq.utils import z85

from instant_ic.bridge.host_flow import Channel, Item
from instant_ic.bridge.host_keys import AllowList, KeyFileError, KeyStore, Peer
from instant_ic.bridge.host_protocol import MAX_FRAME
from instant_ic.bridge.host_session import Event, LinkTimes, PeerMemory, Session, Side
from instant_ic.bridge.host_topics import TopicCounts, TopicRule

_ENDPOINT = re.compile(r"tcp://(\[[0-9A-Fa-f:.]+(%\w+)?\]|[A-Za-z0-9_.*-]+):(\d{1,5})\Z")
GREETING_S = 4.0  # CURVE and the greeting take four round trips
IDLE_S = 0.1
RECEIVE_MOST = 200

log = logging.getLogger(__name__)


class HostLinkError(RuntimeError):
    """The link cannot be set up as configured; the message says what to change."""


@dataclass(frozen=True)
class Stranger:
    """A host was rejected because its key is not allowed."""

    address: str
    fingerprint: str
    times: int


@dataclass(frozen=True)
class LinkProblem:
    """The reason why there is no link; an empty text once the link is back."""

    text: str


@dataclass(frozen=True)
class Failed:
    """The link's thread has ended because of an internal error; the link no longer works."""

    text: str


LinkEvent = Event | Stranger | LinkProblem | Failed
OnEvent = Callable[[str, LinkEvent], None]
"""Callback with the other host's name in this host's allow-list (empty for the whole link), and the event."""


@dataclass(frozen=True)
class PeerStatus:
    """Current state of the link with one host."""

    name: str
    role: str
    address: str
    fingerprint: str
    up_s: float
    drives: bool
    offset_ms: float
    rtt_ms: float
    jitter_ms: float
    window_bytes: int
    notices: dict[str, str]


@dataclass
class Connection:
    """A session and its connection."""

    peer: Peer
    session: Session
    address: str = ""
    file: int = -1
    remote: Any = None
    reported: str = ""


class HostLink(ABC):
    """Common base of both ends of the link: exports topics, emits events, runs the I/O thread.

    Args:
        side: this host's name and the topics that it imports.
        exports: topics that it exports, by name.
        on_event: called on the link's thread with every event.
        times: ping period and timeouts.

    Raises:
        HostLinkError: the keys or the address cannot be used.
    """

    def __init__(
        self,
        side: Side,
        exports: dict[str, TopicRule],
        store: KeyStore,
        on_event: OnEvent,
        times: LinkTimes | None = None,
    ) -> None:
        self.side, self.exports, self.times = side, exports, times or LinkTimes()
        self._emit = on_event
        try:
            self.identity = store.identity()
        except KeyFileError as error:
            raise HostLinkError(str(error)) from None
        self.allowed = AllowList(store)
        self.strangers = 0
        self._channels: dict[tuple[str, str], Channel] = {}
        self._numbers = itertools.count(1)
        self._memories: dict[bytes, PeerMemory] = {}
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._context = zmq.Context()
        self._wake_in = self._context.socket(zmq.PAIR)
        self._wake_in.bind("inproc://wake")
        self._wake_out = self._context.socket(zmq.PAIR)
        self._wake_out.connect("inproc://wake")
        self._woken = False
        self._thread = threading.Thread(target=self._run, name="link", daemon=True)

    # -- for the node ------------------------------------------------------------------------------

    def start(self) -> None:
        self._thread.start()

    def stop(self, timeout_s: float = 3.0) -> None:
        """Say goodbye to the other hosts and end the thread. Idempotent."""
        if self._context.closed:
            return
        with self._lock:
            self._stop.set()
            self._wake()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        if self._thread.is_alive():
            log.error("the link's thread did not end within %g s; it ends with the process", timeout_s)
            return
        self._wake_out.close(linger=0)
        self._wake_in.close(linger=0)
        self._context.destroy(linger=0)

    def offer(
        self,
        topic: str,
        origin: str,
        type_name: str,
        qos: tuple[str, bool, bool],
        payload: bytes | memoryview,
        publish_ns: int,
        wall_time: bool = True,
    ) -> None:
        """Offer a message to every host that takes its topic; never waits.

        Args:
            topic: one of ``exports``.
            origin: node that published it.
            type_name: type of the message.
            qos: name of the preset, whether latched, whether reliable.
            payload: CDR bytes; copied if a host takes them.
            publish_ns: time of publication.
            wall_time: whether ``publish_ns`` is the machine's time of day, not simulated time.

        Raises:
            ValueError: the type is unknown on this host.
        """
        with self._lock:
            channel = self._channel(topic, origin, type_name, qos)
            channel.sequence += 1
            connections = self._connections()
            if not connections and not channel.latched:
                return
            # Read both clocks now: the time of day may be set later.
            age_ns = max(0, time.time_ns() - publish_ns) if wall_time else 0
            item = Item(bytes(payload), publish_ns, time.monotonic_ns() - age_ns, channel.sequence, wall_time)
            if channel.latched:
                channel.last = item
            for connection in connections:
                connection.session.offer(channel, item)
            self._wake()

    def open(self, topic: str, origin: str, type_name: str, qos: tuple[str, bool, bool]) -> None:
        """Announce a publisher to the other hosts before its first message; see :meth:`offer`."""
        with self._lock:
            channel = self._channel(topic, origin, type_name, qos)
            for connection in self._connections():
                connection.session.open(channel)
            self._wake()

    def forget(self, topic: str, origin: str) -> None:
        """Drop a publisher that is gone: new hosts get neither its announcement nor its latched value."""
        with self._lock:
            self._channels.pop((topic, origin), None)

    def _channel(self, topic: str, origin: str, type_name: str, qos: tuple[str, bool, bool]) -> Channel:
        rule = self.exports[topic]
        name, latched, reliable = qos
        channel = self._channels.get((topic, origin))
        if channel is not None and (channel.type_name, channel.qos) == (type_name, name):
            return channel
        if len(self._channels) >= 4000 and channel is None:
            raise HostLinkError(f"{topic}: more than 4000 publishers over one link")
        digest = self.side.digest(type_name)
        queued = reliable and not latched and not rule.rate_hz
        channel = Channel(next(self._numbers), rule, origin, type_name, digest, name, latched, queued)
        self._channels[topic, origin] = channel
        return channel

    def peers(self) -> list[PeerStatus]:
        with self._lock:
            return [self._status(connection) for connection in self._connections() if connection.session.up]

    def _status(self, connection: Connection) -> PeerStatus:
        session, peer = connection.session, connection.peer
        offset_ns = session.wall_offset_ns
        return PeerStatus(
            name=peer.name,
            role=peer.role,
            address=connection.address,
            fingerprint=peer.fingerprint,
            up_s=(time.monotonic_ns() - session.up_ns) / 1e9,
            drives=session.drives,
            offset_ms=float("nan") if offset_ns is None else offset_ns / 1e6,
            rtt_ms=session.clock.min_rtt_ns / 1e6 if session.clock.ready else float("nan"),
            jitter_ms=session.clock.jitter_ns / 1e6,
            window_bytes=int(session.outbox.window.size),
            notices={name: text for name, text in session.notices.items() if text},
        )

    def counts(self) -> tuple[dict[str, TopicCounts], dict[str, TopicCounts]]:
        """Return the counts by topic, out and in, summed over all hosts and links since the start."""
        out: dict[str, TopicCounts] = {}
        into: dict[str, TopicCounts] = {}
        with self._lock:
            sources = [(out, m.counts_out) for m in self._memories.values()]
            sources += [(into, m.counts_in) for m in self._memories.values()]
            sources += [(out, connection.session.outbox.counts) for connection in self._connections()]
            for target, source in sources:
                for topic, counts in source.items():
                    target.setdefault(topic, TopicCounts()).add(counts)
        return out, into

    # -- the thread --------------------------------------------------------------------------------

    @abstractmethod
    def _connections(self) -> list[Connection]: ...

    @abstractmethod
    def _open(self) -> None:
        """Create what the loop needs, on its thread."""

    @abstractmethod
    def _step(self) -> float:
        """Receive, process and send; return the seconds until the next call is due."""

    @abstractmethod
    def _sockets(self) -> list[zmq.Socket[bytes]]: ...

    @abstractmethod
    def _farewell(self) -> None:
        """Say goodbye to the other hosts."""

    def _run(self) -> None:
        try:
            self._open()
            wait_s = 0.0
            while not self._stop.is_set():
                poller = zmq.Poller()
                for each in (self._wake_in, *self._sockets()):
                    poller.register(each, zmq.POLLIN)
                poller.poll(int(max(0.0, min(wait_s, IDLE_S)) * 1000))
                with self._lock:
                    self._woken = False
                    while int(self._wake_in.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
                        self._wake_in.recv(zmq.NOBLOCK)
                wait_s = self._step()
            self._farewell()
        except Exception as error:
            log.exception("the link's thread failed")
            self._emit("", Failed(f"the link's thread failed: {error!r}"))
        finally:
            for each in self._sockets():
                each.close(linger=200)

    def _wake(self) -> None:
        if not self._woken and threading.current_thread() is not self._thread:
            self._woken = True
            self._wake_out.send(b"", zmq.NOBLOCK)

    def _new_session(self, peer: Peer, connecting: bool, may_send: bool = True) -> Session:
        memory = self._memories.setdefault(peer.public_key, PeerMemory())
        return Session(self.side, connecting, memory, None, self.times, may_send)

    def _give_latched(self, session: Session) -> None:
        """Send the topics and latched values to a host that has just connected."""
        for channel in self._channels.values():
            session.open(channel)
        for channel in self._channels.values():
            if channel.last is not None:
                session.offer(channel, channel.last)

    def _socket(self, kind: int) -> zmq.Socket[bytes]:
        made: zmq.Socket[bytes] = self._context.socket(kind)
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.SNDHWM, 10_000)  # sessions limit the bytes in flight; this is for small replies
        made.setsockopt(zmq.RCVHWM, 10_000)
        made.setsockopt(zmq.MAXMSGSIZE, MAX_FRAME)
        made.setsockopt(zmq.HANDSHAKE_IVL, int(GREETING_S * 1000))
        made.setsockopt(zmq.HEARTBEAT_IVL, max(100, int(self.times.timeout_s * 1000)))
        made.setsockopt(zmq.HEARTBEAT_TIMEOUT, max(300, int(self.times.timeout_s * 3000)))
        made.setsockopt(zmq.CURVE_PUBLICKEY, z85.encode(self.identity.public_key))
        made.setsockopt(zmq.CURVE_SECRETKEY, z85.encode(self.identity.secret_key))
        return made

    def _wait_s(self, connections: list[Connection]) -> float:
        now = time.monotonic_ns()
        return min((max(0, c.session.next_due_ns() - now) / 1e9 for c in connections), default=IDLE_S)


def check_endpoint(endpoint: str, listening: bool) -> tuple[str, int]:
    """Return host and port of ``tcp://HOST:PORT``.

    Raises:
        HostLinkError: the endpoint has another form.
    """
    match = _ENDPOINT.match(endpoint)
    port = int(match[3]) if match else -1
    if match is None or not (0 if listening else 1) <= port <= 65535 or (match[1] == "*" and not listening):
        example = "tcp://0.0.0.0:7450" if listening else "tcp://192.168.1.20:7450"
        raise HostLinkError(f"{endpoint!r} is not an address: it must look like {example}")
    return match[1], port
