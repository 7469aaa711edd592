"""Sockets of the link: one TCP port, CURVE on it, the allow-list at its door; a thread of its own moves the bytes."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import re
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zmq
from zmq.utils import z85
from zmq.utils.monitor import parse_monitor_message

from .host_flow import Channel, Item
from .host_keys import AllowList, KeyFileError, KeyStore, Peer, fingerprint
from .host_protocol import MAX_FRAME, Bye, Hello, ProtocolError, decode
from .host_session import Ended, Event, LinkTimes, Memory, Session, Side, Up
from .host_topics import TopicCounts, TopicRule

_ZAP = "inproc://zeromq.zap.01"
_ENDPOINT = re.compile(r"tcp://(\[[0-9A-Fa-f:.]+(%\w+)?\]|[A-Za-z0-9_.*-]+):(\d{1,5})\Z")
_ALLOW_LIST_S = 0.25
_STRANGER_S = 60.0
_STRANGERS_A_MINUTE = 10
_RETRY_S = 0.2
_REFUSED_RETRY_S = 2.0
_UNPROVED_RETRY_S = 0.7
_GREETING_S = 4.0  # CURVE and the greeting take four round trips
_IDLE_S = 0.1
_RECEIVE_MOST = 200

log = logging.getLogger(__name__)


class LinkError(RuntimeError):
    """The link cannot be made as it is set; the message says what to change."""


@dataclass(frozen=True)
class Stranger:
    """Somebody was turned away at the door."""

    address: str
    fingerprint: str
    times: int


@dataclass(frozen=True)
class Problem:
    """Why there is no link, in words; empty when the trouble is over."""

    text: str


@dataclass(frozen=True)
class Failed:
    """The link's thread has ended by a fault of its own: nothing goes over the link any more."""

    text: str


@dataclass(frozen=True)
class LinkEvent:
    """Something that happened on a link.

    Attributes:
        peer: name of the other host in this host's allow-list; empty for the link as a whole.
        event: what.
    """

    peer: str
    event: Event | Stranger | Problem | Failed


@dataclass(frozen=True)
class PeerStatus:
    """How the link with one host stands now."""

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
class _Connection:
    """A session and the way to it."""

    peer: Peer
    session: Session
    address: str = ""
    file: int = -1
    remote: Any = None
    told: str = ""


class HostLink(ABC):
    """What both ends share: topics out, events in, the thread.

    Args:
        side: this host's name and the topics that it takes.
        exports: topics that it gives, by name.
        store: the keys.
        on_event: called on the link's thread with everything that happens.
        times: pings and timeouts.

    Raises:
        LinkError: the keys or the address cannot be used.
    """

    def __init__(
        self,
        side: Side,
        exports: dict[str, TopicRule],
        store: KeyStore,
        on_event: Callable[[LinkEvent], None],
        times: LinkTimes | None = None,
    ) -> None:
        self.side, self.exports, self.times = side, exports, times or LinkTimes()
        self._on_event = on_event
        try:
            self.identity = store.identity()
        except KeyFileError as error:
            raise LinkError(str(error)) from None
        self.allowed = AllowList(store)
        self.strangers = 0
        self._channels: dict[tuple[str, str], Channel] = {}
        self._numbers = itertools.count(1)
        self._memories: dict[bytes, Memory] = {}
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
        """Starts the thread."""
        self._thread.start()

    def stop(self, timeout_s: float = 3.0) -> None:
        """Says goodbye to the other hosts and ends the thread; twice does no harm."""
        if self._context.closed:
            return
        with self._lock:
            self._stop.set()
            self._wake()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        if self._thread.is_alive():
            log.error("the link's thread does not end within %g s; it goes with the process", timeout_s)
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
        """Gives a message to every host that takes its topic; never waits.

        Args:
            topic: one of ``exports``.
            origin: node that published it.
            type_name: its type.
            qos: preset's name, whether latched, whether reliable.
            payload: CDR bytes; copied where anybody takes them.
            publish_ns: when it was published.
            wall_time: whether that is the machine's time, not a simulated one.

        Raises:
            ValueError: the type is not known here.
        """
        with self._lock:
            channel = self._channel(topic, origin, type_name, qos)
            channel.sequence += 1
            connections = self._connections()
            if not connections and not channel.latched:
                return
            # Both clocks of this host, at one moment: later its time of day may be set anew.
            age_ns = max(0, time.time_ns() - publish_ns) if wall_time else 0
            item = Item(bytes(payload), publish_ns, time.monotonic_ns() - age_ns, channel.sequence, wall_time)
            if channel.latched:
                channel.last = item
            for connection in connections:
                connection.session.offer(channel, item)
            self._wake()

    def open(self, topic: str, origin: str, type_name: str, qos: tuple[str, bool, bool]) -> None:
        """Tells the other hosts of a publisher before its first message; see :meth:`offer`."""
        with self._lock:
            channel = self._channel(topic, origin, type_name, qos)
            for connection in self._connections():
                connection.session.open(channel)
            self._wake()

    def forget(self, topic: str, origin: str) -> None:
        """A publisher has gone: hosts that come later are told nothing of it, nor given its latched value."""
        with self._lock:
            self._channels.pop((topic, origin), None)

    def _channel(self, topic: str, origin: str, type_name: str, qos: tuple[str, bool, bool]) -> Channel:
        rule = self.exports[topic]
        name, latched, reliable = qos
        channel = self._channels.get((topic, origin))
        if channel is not None and (channel.type_name, channel.qos) == (type_name, name):
            return channel
        if len(self._channels) >= 4000 and channel is None:
            raise LinkError(f"{topic}: more than 4000 publishers over one link")
        digest = self.side.digest(type_name)
        queued = reliable and not latched and not rule.rate_hz
        channel = Channel(next(self._numbers), rule, origin, type_name, digest, name, latched, queued)
        self._channels[topic, origin] = channel
        return channel

    def peers(self) -> list[PeerStatus]:
        """The links that stand now."""
        with self._lock:
            return [self._status(connection) for connection in self._connections() if connection.session.up]

    def _status(self, connection: _Connection) -> PeerStatus:
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
        """Numbers by topic, out and in, over all hosts and all links since the start."""
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
    def _connections(self) -> list[_Connection]: ...

    @abstractmethod
    def _open(self) -> None:
        """Makes what the loop needs, on its thread."""

    @abstractmethod
    def _step(self) -> float:
        """Receives, decides and sends; gives the seconds until it must be called again."""

    @abstractmethod
    def _sockets(self) -> list[zmq.Socket[bytes]]: ...

    @abstractmethod
    def _farewell(self) -> None:
        """Says goodbye."""

    def _run(self) -> None:
        try:
            self._open()
            wait_s = 0.0
            while not self._stop.is_set():
                poller = zmq.Poller()
                for each in (self._wake_in, *self._sockets()):
                    poller.register(each, zmq.POLLIN)
                poller.poll(int(max(0.0, min(wait_s, _IDLE_S)) * 1000))
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

    def _emit(self, peer: str, event: Event | Stranger | Problem | Failed) -> None:
        self._on_event(LinkEvent(peer, event))

    def _new_session(self, peer: Peer, connecting: bool, may_send: bool = True) -> Session:
        memory = self._memories.setdefault(peer.public_key, Memory())
        return Session(self.side, connecting, memory, None, self.times, may_send)

    def _give_latched(self, session: Session) -> None:
        """The topics and the last values for a host that has just come."""
        for channel in self._channels.values():
            session.open(channel)
        for channel in self._channels.values():
            if channel.last is not None:
                session.offer(channel, channel.last)

    def _socket(self, kind: int) -> zmq.Socket[bytes]:
        made: zmq.Socket[bytes] = self._context.socket(kind)
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.SNDHWM, 10_000)  # bytes on their way are limited by the sessions; this is for small answers
        made.setsockopt(zmq.RCVHWM, 10_000)
        made.setsockopt(zmq.MAXMSGSIZE, MAX_FRAME)
        made.setsockopt(zmq.HANDSHAKE_IVL, int(_GREETING_S * 1000))
        made.setsockopt(zmq.HEARTBEAT_IVL, max(100, int(self.times.timeout_s * 1000)))
        made.setsockopt(zmq.HEARTBEAT_TIMEOUT, max(300, int(self.times.timeout_s * 3000)))
        made.setsockopt(zmq.CURVE_PUBLICKEY, z85.encode(self.identity.public_key))
        made.setsockopt(zmq.CURVE_SECRETKEY, z85.encode(self.identity.secret_key))
        return made

    def _wait_s(self, connections: list[_Connection]) -> float:
        now = time.monotonic_ns()
        return min((max(0, c.session.next_due_ns() - now) / 1e9 for c in connections), default=_IDLE_S)


class ListeningLink(HostLink):
    """The robot's end: many hosts may come, those of the allow-list are let in, one of them drives.

    Args:
        endpoint: ``tcp://0.0.0.0:7450``; port 0 takes a free one, told by ``port``.

    See :class:`HostLink` for the others. ``wanted_driver`` names the host that is to drive; empty leaves it to who came
    first.
    """

    def __init__(
        self,
        endpoint: str,
        side: Side,
        exports: dict[str, TopicRule],
        store: KeyStore,
        on_event: Callable[[LinkEvent], None],
        times: LinkTimes | None = None,
    ) -> None:
        host, port = check_endpoint(endpoint, listening=True)
        super().__init__(side, exports, store, on_event, times)
        self._by_route: dict[bytes, _Connection] = {}
        self._told: dict[tuple[str, str], tuple[float, int]] = {}
        self.wanted_driver = ""
        self._next_list_s = 0.0
        self._list_problem = ""
        self._leaving: list[tuple[float, _Connection]] = []
        self._zap = self._context.socket(zmq.ROUTER)
        self._zap.bind(_ZAP)  # before the door opens: without a keeper everybody would be let in
        self._router = self._socket(zmq.ROUTER)
        self._router.setsockopt(zmq.ROUTER_MANDATORY, 1)
        self._router.setsockopt(zmq.CURVE_SERVER, 1)
        self._router.setsockopt(zmq.ZAP_DOMAIN, b"instant_ic")
        self._router.setsockopt(zmq.IPV6, int(host.startswith("[")))
        try:
            self._router.bind(f"tcp://{host}:{port if port else '*'}")
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            raise LinkError(f"cannot listen on {endpoint}: {error}; is another bridge running?") from None
        self.endpoint = self._router.getsockopt_string(zmq.LAST_ENDPOINT)
        self.port = int(self.endpoint.rpartition(":")[2])

    def _connections(self) -> list[_Connection]:
        return list(self._by_route.values())

    def _sockets(self) -> list[zmq.Socket[bytes]]:
        return [self._router, self._zap]

    def _open(self) -> None:
        self.allowed.refresh()
        self._tell_list()

    def _step(self) -> float:
        with self._lock:
            now = time.monotonic()
            if now >= self._next_list_s:
                self._next_list_s = now + _ALLOW_LIST_S
                if self.allowed.refresh():
                    self._cut_off_revoked()
                self._tell_list()
            self._answer_door()
            self._receive()
            for route, connection in list(self._by_route.items()):
                self._handle(connection, connection.session.check())
                self._send(route, connection)
            self._choose_driver()
            for due_s, connection in [entry for entry in self._leaving if entry[0] <= now]:
                self._leaving.remove((due_s, connection))
                _shut(connection)
            return self._wait_s(self._connections())

    def _farewell(self) -> None:
        with self._lock:
            for route, connection in list(self._by_route.items()):
                self._handle(connection, connection.session.end("closing", f"{self.side.name} ends", tell=True))
                self._send(route, connection)

    # -- the door ----------------------------------------------------------------------------------

    def _answer_door(self) -> None:
        """The keeper (ZAP, RFC 27): libzmq asks it about everybody who proves a key."""
        while int(self._zap.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            frames = self._zap.recv_multipart(zmq.NOBLOCK)
            if len(frames) < 8:
                continue
            back, empty, version, request, _, address, _, mechanism = frames[:8]
            key = frames[8] if mechanism == b"CURVE" and len(frames) == 9 else b""
            known = self.allowed.get(key) if version == b"1.0" else None
            if known is None:
                self._turn_away(address.decode(errors="replace"), key)
            code, text = (b"200", b"OK") if known is not None else (b"400", b"key is not allowed")
            user = z85.encode(key) if known is not None else b""
            self._zap.send_multipart([back, empty, version, request, code, text, user, b""])

    def _turn_away(self, address: str, key: bytes) -> None:
        """Told once a minute for each address and key, and ten times a minute in all, with the tries in between."""
        self.strangers += 1
        who = (address, fingerprint(key) if key else "without a key")
        told_s, times = self._told.get(who, (-_STRANGER_S, 0))
        now = time.monotonic()
        if len(self._told) >= 1000:
            self._told.clear()
        lately = sum(now - other_s < _STRANGER_S for other_s, _ in self._told.values())
        if now - told_s < _STRANGER_S or lately >= _STRANGERS_A_MINUTE:
            self._told[who] = (told_s, times + 1)
            return
        self._told[who] = (now, 0)
        self._emit("", Stranger(*who, times + 1))

    def _cut_off_revoked(self) -> None:
        for route, connection in list(self._by_route.items()):
            peer = self.allowed.get(connection.peer.public_key)
            if peer == connection.peer:
                continue
            reason = f"{self.side.name} no longer allows this host's key"
            if peer is not None:  # its role or name is another one now: it comes back with it
                reason = f"{self.side.name} has changed what this host may do"
            events = connection.session.end("replaced" if peer else "revoked", reason, tell=True)
            self._handle(connection, events)
            self._send(route, connection)

    def _tell_list(self) -> None:
        problem = self.allowed.problem
        if not problem and not len(self.allowed):
            problem = "no host is allowed yet: run `ic keys list` there, and `ic keys allow NAME KEY` here"
        if problem != self._list_problem:
            self._list_problem = problem
            self._emit("", Problem(problem))

    # -- bytes -------------------------------------------------------------------------------------

    def _receive(self) -> None:
        for _ in range(_RECEIVE_MOST):
            try:
                frames = self._router.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            if len(frames) != 2:
                continue
            route, frame = frames[0].bytes, frames[1]
            connection = self._by_route.get(route) or self._greet(route, frame)
            if connection is not None:
                self._handle(connection, connection.session.receive(frame.buffer))

    def _greet(self, route: bytes, frame: zmq.Frame) -> _Connection | None:
        """A connection that has said nothing yet: it must say Hello."""
        # libzmq has proved the key; the list may have changed since it asked.
        peer = self.allowed.get(z85.decode(str(frame.get("User-Id")).encode()))
        try:
            hello = isinstance(decode(frame.buffer), Hello)
        except ProtocolError:
            hello = False
        if peer is None or not hello:
            word = Bye("unknown", f"{self.side.name} knows no such link: greet again")
            self._send_frame(route, word.encode())
            return None
        for old_route, old in list(self._by_route.items()):
            if old.peer.public_key == peer.public_key:  # it has started anew, or lost a link that we had not missed yet
                self._handle(old, old.session.end("replaced", "this key has made a newer link", tell=True))
                self._send(old_route, old)
        connection = _Connection(peer, self._new_session(peer, connecting=False, may_send=peer.role == "driver"))
        connection.address = str(frame.get("Peer-Address"))
        with contextlib.suppress(zmq.ZMQError):  # libzmq may be built without it: then its own heartbeats end the rest
            connection.file = int(frame.get(zmq.SRCFD))
            connection.remote = _remote_of(connection.file)
        self._by_route[route] = connection
        return connection

    def _send(self, route: bytes, connection: _Connection) -> None:
        for data in connection.session.outgoing():
            if not self._send_frame(route, data):
                self._handle(connection, connection.session.end("gone", "the connection broke"))
                break
        if connection.session.ended is not None and self._by_route.pop(route, None) is not None:
            # The last word gets a moment to leave; nothing else goes in or out from now on.
            self._leaving.append((time.monotonic() + 0.1, connection))

    def _send_frame(self, route: bytes, data: bytes) -> bool:
        try:
            self._router.send_multipart([route, data], zmq.NOBLOCK)
        except zmq.Again:
            return False
        except zmq.ZMQError as error:
            if error.errno != zmq.EHOSTUNREACH:
                raise
            return False
        return True

    def _handle(self, connection: _Connection, events: list[Event]) -> None:
        for event in events:
            if isinstance(event, Up):
                self._give_latched(connection.session)
            self._emit(connection.peer.name, event)

    # -- who drives --------------------------------------------------------------------------------

    def _choose_driver(self) -> None:
        """One host's commands at a time: the one that is wanted, else the first that came, until it leaves."""
        drivers = [c for c in self._connections() if c.session.up and c.peer.role == "driver"]
        wanted = [c for c in drivers if c.peer.name == (self.wanted_driver or c.peer.name)]
        holder = min(wanted, key=lambda c: (not c.session.drives, c.session.up_ns), default=None)
        who = holder.peer.name if holder is not None else f"only {self.wanted_driver}"
        for each in drivers:
            if each.session.drives != (each is holder):
                self._handle(each, each.session.set_drives(each is holder))
            text = "" if each is holder else f"{who} drives {self.side.name}; this host's commands are not taken"
            if each.told != text:
                each.told = text
                each.session.notify("driver", text)

    @property
    def driver(self) -> str:
        """Name of the host whose commands are taken; empty when there is none."""
        with self._lock:
            return next((c.peer.name for c in self._connections() if c.session.up and c.session.drives), "")


class ConnectingLink(HostLink):
    """The station's end: one robot, to which it comes back by itself.

    Args:
        endpoint: ``tcp://192.168.1.20:7450``.
        peer: the robot in the allow-list, which says the key that it must prove.

    See :class:`HostLink` for the others.
    """

    def __init__(
        self,
        endpoint: str,
        peer: Peer,
        side: Side,
        exports: dict[str, TopicRule],
        store: KeyStore,
        on_event: Callable[[LinkEvent], None],
        times: LinkTimes | None = None,
    ) -> None:
        check_endpoint(endpoint, listening=False)
        super().__init__(side, exports, store, on_event, times)
        self.endpoint = endpoint
        self.peer = peer
        self._connection: _Connection | None = None
        self._dealer: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None
        self._next_try_s = 0.0
        self._connected_s: float | None = None
        self._problem = ""
        self._failures = 0

    def _connections(self) -> list[_Connection]:
        return [self._connection] if self._connection is not None else []

    def _sockets(self) -> list[zmq.Socket[bytes]]:
        return [s for s in (self._dealer, self._monitor) if s is not None]

    def _open(self) -> None:
        self._say(f"no answer from {self.endpoint} yet")

    def _dial(self) -> None:
        dealer = self._socket(zmq.DEALER)
        dealer.setsockopt(zmq.CURVE_SERVERKEY, z85.encode(self.peer.public_key))
        dealer.setsockopt(zmq.RECONNECT_IVL, int(_RETRY_S * 1000))
        dealer.setsockopt(zmq.CONNECT_TIMEOUT, 1000)  # a try that fell into a hole of the link is not waited for
        dealer.setsockopt(zmq.IPV6, int("[" in self.endpoint))
        self._monitor = dealer.get_monitor_socket()
        dealer.connect(self.endpoint)
        self._dealer = dealer
        self._connected_s = None
        session = self._new_session(self.peer, connecting=True)
        self._connection = _Connection(self.peer, session, self.endpoint.removeprefix("tcp://"))
        self._flush()

    def _hang_up(self, wait_s: float) -> None:
        """Nothing of the old connection is kept: what it still held would only be old."""
        if self._dealer is not None:
            with contextlib.suppress(zmq.ZMQError):
                self._dealer.disable_monitor()
            self._dealer.close(linger=0)
        if self._monitor is not None:
            self._monitor.close(linger=0)
        self._dealer = self._monitor = self._connection = None
        self._next_try_s = time.monotonic() + wait_s

    def _step(self) -> float:
        with self._lock:
            now = time.monotonic()
            if self._dealer is None:
                if now < self._next_try_s:
                    return self._next_try_s - now
                self._dial()
            self._watch()
            self._receive()
            connection = self._connection
            if connection is None:
                return 0.0
            if connection.session.up:
                self._handle(connection.session.check())
                self._flush()
            elif self._connected_s is not None and now - self._connected_s > _GREETING_S:
                self._say(f"{self.endpoint} answers, but does not greet: is it a bridge?")
                self._hang_up(_RETRY_S)
            return self._wait_s(self._connections()) if connection.session.up else 0.05

    def _farewell(self) -> None:
        with self._lock:
            if self._connection is not None and self._connection.session.up:
                self._connection.session.end("closing", f"{self.side.name} ends", tell=True)
                self._flush()
            if self._dealer is not None:
                self._dealer.disable_monitor()

    def _watch(self) -> None:
        """What libzmq tells of the connection: why it is refused is known only here."""
        while self._monitor is not None and int(self._monitor.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            report = parse_monitor_message(self._monitor.recv_multipart(zmq.NOBLOCK))
            kind, value = report["event"], report["value"]
            up = self._connection is not None and self._connection.session.up
            if kind == zmq.EVENT_CONNECTED:
                self._connected_s = time.monotonic()
            elif kind == zmq.EVENT_DISCONNECTED and up:
                assert self._connection is not None
                self._handle(self._connection.session.end("gone", "the connection broke"))
            elif kind == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
                mine = fingerprint(self.identity.public_key)
                self._say(
                    f"{self.peer.name} at {self.endpoint} does not allow this host's key {mine} (status {value}): "
                    f"run there `ic keys allow {self.identity.name} KEY`, with the key that `ic keys list` shows here"
                )
                self._hang_up(_REFUSED_RETRY_S)
            elif kind in (zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL, zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL):
                self._failures += 1
                if self._failures < 2:  # once may be a connection that broke in the middle of it
                    self._hang_up(_RETRY_S)
                    return
                self._say(
                    f"{self.endpoint} hangs up before it has proved the key of {self.peer.name} "
                    f"({self.peer.fingerprint}): another machine, a new key (`ic keys list` there, "
                    f"`ic keys allow {self.peer.name} KEY` here), or a network that breaks off"
                )
                self._hang_up(_UNPROVED_RETRY_S)
            elif kind == zmq.EVENT_CONNECT_RETRIED and not up:
                self._say(f"{self.endpoint} cannot be reached: is the robot's bridge running, is the address right?")

    def _receive(self) -> None:
        for _ in range(_RECEIVE_MOST):
            if self._dealer is None or self._connection is None:
                return
            try:
                frames = self._dealer.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            if len(frames) == 1:
                self._handle(self._connection.session.receive(frames[0].buffer))

    def _flush(self) -> None:
        if self._connection is None or self._dealer is None:
            return
        for data in self._connection.session.outgoing():
            try:
                self._dealer.send(data, zmq.NOBLOCK)
            except zmq.Again:
                self._handle(self._connection.session.end("gone", "the link takes nothing any more"))
                return

    def _handle(self, events: list[Event]) -> None:
        assert self._connection is not None
        connection = self._connection
        for event in events:
            if isinstance(event, Up):
                self._failures = 0
                self._give_latched(connection.session)
                self._say("")
            self._emit(connection.peer.name, event)
            if isinstance(event, Ended):
                self._flush()  # a last word, where there is one
                self._say(f"{connection.peer.name}: {event.reason}")
                self._hang_up(_REFUSED_RETRY_S if event.code in ("version", "revoked", "replaced") else _RETRY_S)
                return

    def _say(self, problem: str) -> None:
        if problem != self._problem:
            self._problem = problem
            self._emit("", Problem(problem))


def check_endpoint(endpoint: str, listening: bool) -> tuple[str, int]:
    """Host and port of ``tcp://HOST:PORT``.

    Raises:
        LinkError: it has another form.
    """
    match = _ENDPOINT.match(endpoint)
    port = int(match[3]) if match else -1
    if match is None or not (0 if listening else 1) <= port <= 65535 or (match[1] == "*" and not listening):
        example = "tcp://0.0.0.0:7450" if listening else "tcp://192.168.1.20:7450"
        raise LinkError(f"{endpoint!r} is no address: it must look like {example}")
    return match[1], port


def _remote_of(file: int) -> Any:
    """The other end of a connection's file; None when it is gone."""
    try:
        with socket.socket(fileno=os.dup(file)) as copy:
            return copy.getpeername()
    except OSError:
        return None


def _shut(connection: _Connection) -> None:
    """Cuts a connection off, so that its host hears of it at once and does not wait for its timeout."""
    try:
        with socket.socket(fileno=os.dup(connection.file)) as copy:
            # libzmq may have closed it and the number may be somebody else's by now.
            if connection.remote is not None and copy.getpeername() == connection.remote:
                copy.shutdown(socket.SHUT_RDWR)
    except OSError:
        return
