"""Limits on the number, rate and duration of connections to the operator's page.

The module depends on the HTTP server, not on the page. Times are seconds of the monotonic clock.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import socket
import ssl
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable
from typing import Any

from aiohttp import web

from instant_ic.util.web_access import TokenBucket

HEADERS_S = 5.0  # time for a TLS handshake, for a request's headers, and for its body
STALL_S = 30.0  # a client that takes no data for this time is disconnected
LINGER_S = 1.0  # time to read the rest of a refused body
CLOSE_S = 1.0  # time for a closing handshake
RETRY_S = 0.2  # pause after a failed accept
BYTES_PER_S = 48 * 1024  # received on one connection; a page that drives by touch sends about a third
BURST_BYTES = 48 * 1024
CONNECTIONS_PER_S = 20.0  # of one address, without a sign-in; a page opens about six
BURST_CONNECTIONS = 64.0
HANDSHAKES_PER_S = 400.0  # TLS, of one address; each costs about 1 ms of the thread that passes the driver's commands
BURST_HANDSHAKES = 128.0
MOST_NEWCOMERS = 256
MOST_HEADERS = 32 * 1024  # bytes of a request line with its headers; browsers send cookies of all ports of a host
_MOST_ADDRESSES = 1024
_TOO_MANY = b"HTTP/1.1 429 Too Many Requests\r\nRetry-After: 1\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
logger = logging.getLogger("instant_ic.console")


class AddressBuckets:
    """Token bucket for each address; the least recently used address is dropped first."""

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst = rate, burst
        self._buckets: OrderedDict[str, TokenBucket] = OrderedDict()

    def of(self, address: str) -> TokenBucket:
        """Return the bucket of an address."""
        bucket = self._buckets.setdefault(address, TokenBucket(self._rate, self._burst))
        self._buckets.move_to_end(address)
        while len(self._buckets) > _MOST_ADDRESSES:
            self._buckets.popitem(last=False)
        return bucket


def network_of(host: str) -> str:
    """Return the key by which an address is limited: IPv4 in full, IPv6 by its /64, which belongs to one subscriber."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return str(address.ipv4_mapped)
        return str(ipaddress.IPv6Network((int(address) >> 64 << 64, 64)))
    return str(address)


class Newcomer(asyncio.Protocol):
    """A connection whose first request has not arrived: it may send headers, and costs no more than they do.

    Args:
        network: see :func:`network_of`.
        on_headers: called once, when the headers are complete.
        on_gone: called when the connection ends before.
    """

    def __init__(
        self, network: str, on_headers: Callable[[Newcomer], None], on_gone: Callable[[Newcomer], None]
    ) -> None:
        self.network = network
        self.kept = False
        self.received = b""
        """Headers, and what follows them."""
        self.transport: asyncio.Transport | None = None
        self.task: asyncio.Task[None] | None = None
        self._on_headers, self._on_gone = on_headers, on_gone
        self._late: asyncio.TimerHandle | None = None

    def abort(self) -> None:
        """Cut the connection at once, even during its TLS handshake."""
        if self.transport is not None:
            self.transport.abort()
        elif self.task is not None:
            self.task.cancel()

    def become(self, protocol: asyncio.Protocol) -> None:
        """Hand transport and received data over to another protocol."""
        assert self.transport is not None
        self._end_wait()
        self.transport.set_protocol(protocol)
        protocol.connection_made(self.transport)
        protocol.data_received(self.received)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        self._late = asyncio.get_running_loop().call_later(HEADERS_S, transport.abort)

    def data_received(self, data: bytes) -> None:
        self.received += data
        if b"\r\n\r\n" in self.received:
            self._on_headers(self)
        elif len(self.received) > MOST_HEADERS:
            self.abort()

    def connection_lost(self, exc: BaseException | None) -> None:
        self._end_wait()
        self._on_gone(self)

    def _end_wait(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None


class Connection(web.RequestHandler):
    """One client's connection: HTTP, possibly upgraded to a WebSocket. Cut if it floods or takes no data."""

    __slots__ = ("_bucket", "_headers", "_on_flood", "_on_gone", "_stall", "kept", "muted", "network")

    def __init__(
        self,
        server: web.Server,
        network: str,
        headers: dict[str, str],
        on_gone: Callable[[Connection], None],
    ) -> None:
        super().__init__(
            server,
            loop=asyncio.get_running_loop(),
            keepalive_timeout=HEADERS_S,  # from the start of the connection, then from each answer
            lingering_time=LINGER_S,
            access_log=None,  # type: ignore[arg-type]
        )
        self.network = network
        self.kept = False
        """Whether it is a WebSocket; no newer connection displaces one."""
        self.muted = False
        """Whether data from the client is discarded unread."""
        self._headers = headers
        self._on_gone = on_gone
        self._on_flood: Callable[[], None] = self.abort
        self._bucket = TokenBucket(BYTES_PER_S, BURST_BYTES)
        self._stall: asyncio.TimerHandle | None = None

    def keep(self, on_flood: Callable[[], None]) -> None:
        """Mark the connection as a WebSocket; ``on_flood`` is called once if its client sends too much."""
        self.kept, self._on_flood = True, on_flood

    def mute(self) -> None:
        """Stop reading. Pending data still goes to the client, and what the client sends costs nothing."""
        self.muted = True
        if self.transport is not None and not self.transport.is_closing():
            self.transport.pause_reading()

    def abort(self) -> None:
        """Cut the connection at once."""
        if self.transport is not None:
            self.transport.abort()

    def data_received(self, data: bytes) -> None:
        if self.muted:
            return
        # Bytes, not messages: an endless frame is never a message, yet costs as much.
        if self._bucket.take(time.monotonic(), len(data)):
            super().data_received(data)
            return
        self.mute()
        self._on_flood()

    def pause_writing(self) -> None:
        super().pause_writing()
        if self.transport is not None:
            self._stall = asyncio.get_running_loop().call_later(STALL_S, self.transport.abort)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._end_stall()

    def connection_lost(self, exc: BaseException | None) -> None:
        self._end_stall()
        self._on_gone(self)
        super().connection_lost(exc)

    def handle_error(self, *args: Any, **kwargs: Any) -> web.StreamResponse:
        response = super().handle_error(*args, **kwargs)
        for name, value in self._headers.items():
            response.headers.setdefault(name, value)
        return response

    def _end_stall(self) -> None:
        if self._stall is not None:
            self._stall.cancel()
            self._stall = None


class Listener:
    """Accepts connections within limits.

    1. Each starts as a :class:`Newcomer`. Of too many, the oldest one of the address with the most is cut.
    2. With its headers complete it is admitted if ``known`` says so, or within the rate of its address. So nobody
       who is signed in waits for others of his address, which may be a whole building's.
    3. At the limit of an address, its oldest connection that is not a WebSocket makes room. At the total limit, the
       oldest one of the address with the most such connections does. So a client with idle connections displaces
       itself.

    Args:
        server: answers the requests.
        most: largest number of simultaneous connections, newcomers not counted.
        most_per_address: the same for one address.
        tls: context for https; None: http.
        headers: added to error responses that are created below the application.
        known: whether a request with these headers is admitted above the rate.
    """

    def __init__(
        self,
        server: web.Server,
        most: int,
        most_per_address: int,
        tls: ssl.SSLContext | None,
        headers: dict[str, str],
        known: Callable[[bytes], bool],
    ) -> None:
        self._server, self._tls, self._headers, self._known = server, tls, headers, known
        self._most, self._most_per_address = most, most_per_address
        self._newcomers: dict[Newcomer, None] = {}  # oldest first
        self._connections: dict[Connection, None] = {}  # oldest first
        self._rates = AddressBuckets(CONNECTIONS_PER_S, BURST_CONNECTIONS)
        self._handshakes = AddressBuckets(HANDSHAKES_PER_S, BURST_HANDSHAKES)
        self._sockets: list[socket.socket] = []
        self._tasks: list[asyncio.Task[None]] = []
        self.refused = 0

    async def open(self, host: str, port: int) -> int:
        """Listen on every address of ``host`` and return the port.

        Raises:
            OSError: the host is unknown, or the port is in use or not permitted.
        """
        loop = asyncio.get_running_loop()
        found = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        try:
            for family, address in dict.fromkeys((entry[0], entry[4]) for entry in found):
                listener = socket.create_server(address[:2], family=socket.AddressFamily(family), backlog=128)
                listener.setblocking(False)
                self._sockets.append(listener)
        except OSError:
            self._close_sockets()
            raise
        self._tasks = [asyncio.create_task(self._accept_forever(listener)) for listener in self._sockets]
        for task in self._tasks:
            task.add_done_callback(_report_end)
        return int(self._sockets[0].getsockname()[1])

    async def close(self) -> None:
        """Stop accepting; existing connections stay open."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._close_sockets()

    def _close_sockets(self) -> None:
        for listener in self._sockets:
            listener.close()
        self._sockets = []

    async def _accept_forever(self, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                accepted, peer = await loop.sock_accept(listener)
            except ConnectionAbortedError:  # the client left before it was accepted
                continue
            except OSError as error:  # out of file descriptors or memory
                logger.error("cannot accept a connection: %s; an idle one is closed to make room", error.strerror)
                _ = self._displace(self._newcomers) or self._displace(self._connections)
                await asyncio.sleep(RETRY_S)
                continue
            self._receive(accepted, network_of(peer[0]))
            await asyncio.sleep(0)  # existing connections come first

    def _receive(self, accepted: socket.socket, network: str) -> None:
        if self._tls is not None and not self._handshakes.of(network).take(time.monotonic()):
            accepted.close()
            self._refuse(network, f"more than {HANDSHAKES_PER_S:g} new ones a second")
            return
        if len(self._newcomers) >= MOST_NEWCOMERS:
            self._displace(self._newcomers)
        newcomer = Newcomer(network, self._admit, self._forget)
        self._newcomers[newcomer] = None
        newcomer.task = asyncio.create_task(self._serve(accepted, newcomer))

    def _admit(self, newcomer: Newcomer) -> None:
        self._forget(newcomer)
        network = newcomer.network
        own = [connection for connection in self._connections if connection.network == network]
        if not (self._known(newcomer.received) or self._rates.of(network).take(time.monotonic())):
            reason = f"more than {CONNECTIONS_PER_S:g} new ones a second without a sign-in"
        elif len(own) >= self._most_per_address and not self._displace(own):
            reason = f"it has {len(own)} WebSockets"
        elif len(self._connections) >= self._most and not self._displace(self._connections):
            reason = f"all {len(self._connections)} are WebSockets"
        else:
            connection = Connection(self._server, network, self._headers, self._forget)
            self._connections[connection] = None
            newcomer.become(connection)
            return
        assert newcomer.transport is not None
        newcomer.transport.write(_TOO_MANY)
        newcomer.abort()  # a slow goodbye would cost a place
        self._refuse(network, reason)

    def _refuse(self, network: str, reason: str) -> None:
        self.refused += 1
        logger.warning("refused a connection from %s: %s", network, reason)

    def _displace(self, connections: Iterable[Newcomer | Connection]) -> bool:
        """Cut the oldest non-WebSocket of the address that has the most of them; return False if there is none."""
        idle = [connection for connection in connections if not connection.kept]
        if not idle:
            return False
        ((network, _),) = Counter(connection.network for connection in idle).most_common(1)
        oldest = next(connection for connection in idle if connection.network == network)
        self._forget(oldest)
        oldest.abort()
        return True

    def _forget(self, connection: Newcomer | Connection) -> None:
        places: dict[Any, None] = self._newcomers if isinstance(connection, Newcomer) else self._connections
        places.pop(connection, None)

    async def _serve(self, accepted: socket.socket, newcomer: Newcomer) -> None:
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: newcomer, accepted, ssl=self._tls, ssl_handshake_timeout=HEADERS_S if self._tls else None
            )
        except OSError as error:  # includes failed TLS handshakes
            logger.debug("no connection with %s: %s", newcomer.network, error)
        finally:
            if newcomer.transport is None:  # cut or failed before it was set up
                accepted.close()
                self._forget(newcomer)


def _report_end(task: asyncio.Task[None]) -> None:
    if not task.cancelled() and task.exception() is not None:
        logger.critical("no more connections are accepted: %r; restart the console", task.exception())
