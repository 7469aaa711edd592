"""The station's end of the link: connects, reports why it cannot, and reconnects."""

from __future__ import annotations

import contextlib
import time

import zmq
from zmq.utils import z85
from zmq.utils.monitor import parse_monitor_message

from instant_ic.bridge.host_keys import KeyStore, Peer, fingerprint
from instant_ic.bridge.host_link import (
    GREETING_S,
    RECEIVE_MOST,
    Connection,
    HostLink,
    LinkProblem,
    OnEvent,
    check_endpoint,
)
from instant_ic.bridge.host_session import Ended, Event, LinkTimes, Side, Up
from instant_ic.bridge.host_topics import TopicRule

_RETRY_S = 0.2
_UNPROVED_RETRY_S = 0.7
_REFUSED_RETRY_S = 2.0


class ConnectingLink(HostLink):
    """The station's end of the link; reconnects to its robot by itself.

    Args:
        endpoint: ``tcp://192.168.1.20:7450``.
        peer: the robot's entry in the allow-list, with the key that the robot must prove.

    See :class:`HostLink` for the other arguments.
    """

    def __init__(
        self,
        endpoint: str,
        peer: Peer,
        side: Side,
        exports: dict[str, TopicRule],
        store: KeyStore,
        on_event: OnEvent,
        times: LinkTimes | None = None,
    ) -> None:
        check_endpoint(endpoint, listening=False)
        super().__init__(side, exports, store, on_event, times)
        self.endpoint = endpoint
        self.peer = peer
        self._connection: Connection | None = None
        self._dealer: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None
        self._next_try_s = 0.0
        self._connected_s: float | None = None
        self._problem = ""
        self._failures = 0

    def _connections(self) -> list[Connection]:
        return [self._connection] if self._connection is not None else []

    def _sockets(self) -> list[zmq.Socket[bytes]]:
        return [s for s in (self._dealer, self._monitor) if s is not None]

    def _open(self) -> None:
        self._say(f"no answer from {self.endpoint} yet")

    def _dial(self) -> None:
        dealer = self._socket(zmq.DEALER)
        dealer.setsockopt(zmq.CURVE_SERVERKEY, z85.encode(self.peer.public_key))
        dealer.setsockopt(zmq.RECONNECT_IVL, int(_RETRY_S * 1000))
        dealer.setsockopt(zmq.CONNECT_TIMEOUT, 1000)  # do not wait longer for an attempt made during an outage
        dealer.setsockopt(zmq.IPV6, int("[" in self.endpoint))
        self._monitor = dealer.get_monitor_socket()
        dealer.connect(self.endpoint)
        self._dealer = dealer
        self._connected_s = None
        session = self._new_session(self.peer, connecting=True)
        self._connection = Connection(self.peer, session, self.endpoint.removeprefix("tcp://"))
        self._flush()

    def _hang_up(self, wait_s: float) -> None:
        """Drop the connection with everything queued in it, which would be outdated later."""
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
            elif self._connected_s is not None and now - self._connected_s > GREETING_S:
                self._say(f"{self.endpoint} accepts connections but does not answer as a bridge: is the port right?")
                self._hang_up(_RETRY_S)
            return self._wait_s(self._connections()) if connection.session.up else 0.05

    def _farewell(self) -> None:
        with self._lock:
            if self._connection is not None and self._connection.session.up:
                self._connection.session.end("closing", f"{self.side.name} ends", inform=True)
                self._flush()
            if self._dealer is not None:
                self._dealer.disable_monitor()

    def _watch(self) -> None:
        """Handle libzmq's connection events; only they give the reason for a refusal."""
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
                    f"run `ic keys allow {self.identity.name} KEY` there, with the key from `ic keys list` here"
                )
                self._hang_up(_REFUSED_RETRY_S)
            elif kind in (zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL, zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL):
                self._failures += 1
                if self._failures < 2:  # a single failure may be a connection that broke during the handshake
                    self._hang_up(_RETRY_S)
                    return
                self._say(
                    f"{self.endpoint} closes the connection before it proves the key of {self.peer.name} "
                    f"({self.peer.fingerprint}): another machine, a new key (`ic keys list` there, "
                    f"`ic keys allow {self.peer.name} KEY` here), or an unstable network"
                )
                self._hang_up(_UNPROVED_RETRY_S)
            elif kind == zmq.EVENT_CONNECT_RETRIED and not up:
                self._say(f"{self.endpoint} cannot be reached: is the robot's bridge running, is the address right?")

    def _receive(self) -> None:
        for _ in range(RECEIVE_MOST):
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
                self._handle(self._connection.session.end("gone", "the connection accepts no more data"))
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
                self._flush()  # send a final message, if there is one
                self._say(f"{connection.peer.name}: {event.reason}")
                self._hang_up(_REFUSED_RETRY_S if event.code in ("version", "revoked", "replaced") else _RETRY_S)
                return

    def _say(self, problem: str) -> None:
        if problem != self._problem:
            self._problem = problem
            self._emit("", LinkProblem(problem))
