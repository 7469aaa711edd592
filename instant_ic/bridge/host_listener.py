"""The robot's end of the link: one TCP port with CURVE encryption, open to the hosts of the allow-list."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from typing import Any

import zmq
from zmq.utils import z85

from instant_ic.bridge.host_keys import KeyStore, fingerprint
from instant_ic.bridge.host_link import (
    RECEIVE_MOST,
    Connection,
    HostLink,
    HostLinkError,
    LinkProblem,
    OnEvent,
    Stranger,
    check_endpoint,
)
from instant_ic.bridge.host_protocol import Bye, Hello, HostProtocolError, decode
from instant_ic.bridge.host_session import Event, LinkTimes, Side, Up
from instant_ic.bridge.host_topics import TopicRule

_ZAP = "inproc://zeromq.zap.01"
_ALLOW_LIST_S = 0.25
_STRANGER_S = 60.0
_STRANGERS_A_MINUTE = 10


class ListeningLink(HostLink):
    """The robot's end: accepts all hosts of the allow-list; one of them drives.

    Args:
        endpoint: ``tcp://0.0.0.0:7450``; port 0 takes a free one, available as ``port``.

    See :class:`HostLink` for the other arguments. ``wanted_driver`` names the host that is to drive; if it is empty,
    the first driver that connected drives.
    """

    def __init__(
        self,
        endpoint: str,
        side: Side,
        exports: dict[str, TopicRule],
        store: KeyStore,
        on_event: OnEvent,
        times: LinkTimes | None = None,
    ) -> None:
        host, port = check_endpoint(endpoint, listening=True)
        super().__init__(side, exports, store, on_event, times)
        self._by_route: dict[bytes, Connection] = {}
        self._reported: dict[tuple[str, str], tuple[float, int]] = {}
        self.wanted_driver = ""
        self._next_list_s = 0.0
        self._list_problem = ""
        self._leaving: list[tuple[float, Connection]] = []
        self._zap = self._context.socket(zmq.ROUTER)
        self._zap.bind(_ZAP)  # bind before the port opens: without the ZAP handler every host would be accepted
        self._router = self._socket(zmq.ROUTER)
        self._router.setsockopt(zmq.ROUTER_MANDATORY, 1)
        self._router.setsockopt(zmq.CURVE_SERVER, 1)
        self._router.setsockopt(zmq.ZAP_DOMAIN, b"instant_ic")
        self._router.setsockopt(zmq.IPV6, int(host.startswith("[")))
        try:
            self._router.bind(f"tcp://{host}:{port if port else '*'}")
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            raise HostLinkError(f"cannot listen on {endpoint}: {error}; is another bridge running?") from None
        self.endpoint = self._router.getsockopt_string(zmq.LAST_ENDPOINT)
        self.port = int(self.endpoint.rpartition(":")[2])

    def _connections(self) -> list[Connection]:
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
                self._handle(connection, connection.session.end("closing", f"{self.side.name} ends", inform=True))
                self._send(route, connection)

    # -- the door ----------------------------------------------------------------------------------

    def _answer_door(self) -> None:
        """Answer libzmq's authentication requests (ZAP, RFC 27), one for each host that proves a key."""
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
        """Report a rejected host with its tries: once a minute per address and key, ten times a minute in all."""
        self.strangers += 1
        who = (address, fingerprint(key) if key else "without a key")
        reported_s, times = self._reported.get(who, (-_STRANGER_S, 0))
        now = time.monotonic()
        if len(self._reported) >= 1000:
            self._reported.clear()
        lately = sum(now - other_s < _STRANGER_S for other_s, _ in self._reported.values())
        if now - reported_s < _STRANGER_S or lately >= _STRANGERS_A_MINUTE:
            self._reported[who] = (reported_s, times + 1)
            return
        self._reported[who] = (now, 0)
        self._emit("", Stranger(*who, times + 1))

    def _cut_off_revoked(self) -> None:
        for route, connection in list(self._by_route.items()):
            peer = self.allowed.get(connection.peer.public_key)
            if peer == connection.peer:
                continue
            reason = f"{self.side.name} no longer allows this host's key"
            if peer is not None:  # its role or name has changed: it reconnects with the new one
                reason = f"{self.side.name} has changed what this host may do"
            events = connection.session.end("replaced" if peer else "revoked", reason, inform=True)
            self._handle(connection, events)
            self._send(route, connection)

    def _tell_list(self) -> None:
        problem = self.allowed.problem
        if not problem and not len(self.allowed):
            problem = "no host is allowed yet: run `ic keys list` there, and `ic keys allow NAME KEY` here"
        if problem != self._list_problem:
            self._list_problem = problem
            self._emit("", LinkProblem(problem))

    # -- bytes -------------------------------------------------------------------------------------

    def _receive(self) -> None:
        for _ in range(RECEIVE_MOST):
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

    def _greet(self, route: bytes, frame: zmq.Frame) -> Connection | None:
        """Create the connection of a new route, whose first frame must be Hello."""
        # libzmq has verified the key, but the list may have changed since.
        peer = self.allowed.get(z85.decode(str(frame.get("User-Id")).encode()))
        try:
            hello = isinstance(decode(frame.buffer), Hello)
        except HostProtocolError:
            hello = False
        if peer is None or not hello:
            word = Bye("unknown", f"{self.side.name} does not know this link: reconnect")
            self._send_frame(route, word.encode())
            return None
        for old_route, old in list(self._by_route.items()):
            if old.peer.public_key == peer.public_key:  # the host restarted, or lost its link before we noticed
                self._handle(old, old.session.end("replaced", "a newer link uses the same key", inform=True))
                self._send(old_route, old)
        connection = Connection(peer, self._new_session(peer, connecting=False, may_send=peer.role == "driver"))
        connection.address = str(frame.get("Peer-Address"))
        with contextlib.suppress(zmq.ZMQError):  # libzmq may lack SRCFD; its own heartbeats then end a dead connection
            connection.file = int(frame.get(zmq.SRCFD))
            connection.remote = _remote_of(connection.file)
        self._by_route[route] = connection
        return connection

    def _send(self, route: bytes, connection: Connection) -> None:
        for data in connection.session.outgoing():
            if not self._send_frame(route, data):
                self._handle(connection, connection.session.end("gone", "the connection broke"))
                break
        if connection.session.ended is not None and self._by_route.pop(route, None) is not None:
            # Leave a moment for the final message; nothing else is sent or received.
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

    def _handle(self, connection: Connection, events: list[Event]) -> None:
        for event in events:
            if isinstance(event, Up):
                self._give_latched(connection.session)
            self._emit(connection.peer.name, event)

    # -- who drives --------------------------------------------------------------------------------

    def _choose_driver(self) -> None:
        """Choose the host that drives: the configured one, otherwise the first that connected, until it leaves."""
        drivers = [c for c in self._connections() if c.session.up and c.peer.role == "driver"]
        wanted = [c for c in drivers if c.peer.name == (self.wanted_driver or c.peer.name)]
        holder = min(wanted, key=lambda c: (not c.session.drives, c.session.up_ns), default=None)
        who = holder.peer.name if holder is not None else f"only {self.wanted_driver}"
        for each in drivers:
            if each.session.drives != (each is holder):
                self._handle(each, each.session.set_drives(each is holder))
            text = "" if each is holder else f"{who} drives {self.side.name}; this host's commands are dropped"
            if each.reported != text:
                each.reported = text
                each.session.notify("driver", text)

    @property
    def driver(self) -> str:
        """Name of the host whose commands are accepted; empty if there is none."""
        with self._lock:
            return next((c.peer.name for c in self._connections() if c.session.up and c.session.drives), "")


def _remote_of(file: int) -> Any:
    """Return the remote address of a socket file; None if it is closed."""
    try:
        with socket.socket(fileno=os.dup(file)) as copy:
            return copy.getpeername()
    except OSError:
        return None


def _shut(connection: Connection) -> None:
    """Shut down a connection, so that its host notices immediately instead of waiting for its timeout."""
    try:
        with socket.socket(fileno=os.dup(connection.file)) as copy:
            # libzmq may have closed the file, and the number may belong to another connection.
            if connection.remote is not None and copy.getpeername() == connection.remote:
                copy.shutdown(socket.SHUT_RDWR)
    except OSError:
        return
