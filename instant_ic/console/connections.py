"""Limits on the cost of the page's clients: number, rate and duration of connections, and log messages.

The module depends on the HTTP server, but not on the page. Times are seconds of the monotonic clock.
"""

from __future__ import annotations

import asyncio
import logging
import math
import socket
import ssl
import time
from collections import Counter
from collections.abc import Callable, Iterable

from aiohttp import web

from instant_ic.util.web_access import AddressBuckets, TokenBucket, network_of

HEADERS_S = 5.0  # time limit for each of a TLS handshake, a request's headers, and its body
STALL_S = 30.0  # time without accepting any data after which a client is disconnected
CLOSE_S = 1.0  # time for a closing handshake
RETRY_S = 0.2  # pause after a failed accept
BYTES_PER_S = 48 * 1024  # received on one connection; a page that drives by touch sends about a third of it
BURST_BYTES = 48 * 1024
CONNECTIONS_PER_S = 20.0  # per address, without a sign-in; a page opens about six connections
BURST_CONNECTIONS = 64.0
HANDSHAKES_PER_S = 400.0  # TLS, per address; each costs about 1 ms of the thread that passes the driver's commands
BURST_HANDSHAKES = 128.0
MOST_NEWCOMERS = 256  # connections whose first request has not arrived
MOST_HEADERS = 32 * 1024  # bytes of request line and headers, in which browsers send the cookies of all ports of a host
_TOO_MANY = b"HTTP/1.1 429 Too Many Requests\r\nRetry-After: 1\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
NOISY = ("instant_ic.console", "asyncio", "aiohttp.server", "aiohttp.web", "aiohttp.websocket", "aiohttp.internal")
LOG_PERIOD_S = 1.0
logger = logging.getLogger("instant_ic.console")


class LimitedConnection(asyncio.Protocol):
    """One client's connection, which passes data to aiohttp's protocol. A client that floods or stalls is cut.

    The connection is a newcomer until its first request's headers are complete and the listener admits it. A newcomer
    costs only the memory of these headers.

    Attributes:
        network: see :func:`network_of`.
        http: aiohttp's protocol; None for a newcomer.
        kept: True for a WebSocket, which no newer connection displaces.
    """

    def __init__(self, listener: Listener, network: str) -> None:
        self.network = network
        self.http: web.RequestHandler | None = None
        self.kept = False
        self.transport: asyncio.Transport | None = None
        self.task: asyncio.Task[None] | None = None
        self._listener = listener
        self._muted = False
        self._received = b""
        self._on_flood: Callable[[], None] = self.abort
        self._bucket = TokenBucket(BYTES_PER_S, BURST_BYTES)
        self._deadline: asyncio.TimerHandle | None = None

    def keep(self, on_flood: Callable[[], None]) -> None:
        """Mark the connection as a WebSocket. ``on_flood`` is called once if the client sends too much."""
        self.kept, self._on_flood = True, on_flood

    def mute(self) -> None:
        """Stop reading, so that data from the client cost nothing. Pending data are still sent to the client."""
        self._muted = True
        if self.transport is not None and not self.transport.is_closing():
            self.transport.pause_reading()

    def abort(self) -> None:
        """Cut the connection at once, even during its TLS handshake."""
        if self.transport is not None:
            self.transport.abort()
        elif self.task is not None:
            self.task.cancel()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        self._cut_after(HEADERS_S)

    def data_received(self, data: bytes) -> None:
        if self.http is None:
            self._received += data
            if b"\r\n\r\n" in self._received:
                self._end_deadline()
                self._listener.take_headers(self, self._received)
            elif len(self._received) > MOST_HEADERS:
                self.abort()
        # Count bytes, not messages, because an endless frame costs as much but never becomes a message.
        elif not self._muted and self._bucket.take(time.monotonic(), len(data)):
            self.http.data_received(data)
        elif not self._muted:
            self.mute()
            self._on_flood()

    def admit(self, http: web.RequestHandler) -> None:
        """Let aiohttp answer the received request and the following ones."""
        assert self.transport is not None
        self.http = http
        http.connection_made(self.transport)
        self.data_received(self._received)

    def pause_writing(self) -> None:
        if self.http is not None:
            self.http.pause_writing()
            self._cut_after(STALL_S)

    def resume_writing(self) -> None:
        if self.http is not None:
            self.http.resume_writing()
            self._end_deadline()

    def connection_lost(self, exc: BaseException | None) -> None:
        self._end_deadline()
        self._listener.forget(self)
        self.transport = None
        if self.http is not None:
            self.http.connection_lost(exc)

    def _cut_after(self, seconds: float) -> None:
        assert self.transport is not None
        self._deadline = asyncio.get_running_loop().call_later(seconds, self.transport.abort)

    def _end_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


class Listener:
    """Acceptance of connections within limits.

    1. Each connection starts as a newcomer. If there are too many newcomers, the address with the most of them loses
       its oldest.
    2. A newcomer with complete headers is admitted if ``known`` returns true for them, or if its address is below its
       rate. A signed-in user thus never waits for others with his address, which a whole building may share.
    3. At the limit of an address, its oldest connection that is not a WebSocket is cut. At the total limit, the address
       with the most such connections loses its oldest. A client with idle connections thus displaces its own.

    Args:
        server: makes aiohttp's protocol for each connection.
        most: largest number of simultaneous connections, without newcomers.
        most_per_address: largest number of simultaneous connections of one address, without newcomers.
        tls: context for https; None for http.
        known: returns whether a request with these headers is admitted above the rate.

    Attributes:
        refused: number of connections that were not admitted.
    """

    def __init__(
        self,
        server: web.Server,
        most: int,
        most_per_address: int,
        tls: ssl.SSLContext | None,
        known: Callable[[bytes], bool],
    ) -> None:
        self._server, self._tls, self._known = server, tls, known
        self._most, self._most_per_address = most, most_per_address
        self._connections: dict[LimitedConnection, None] = {}  # oldest first
        self._rates = AddressBuckets(CONNECTIONS_PER_S, BURST_CONNECTIONS)
        self._handshakes = AddressBuckets(HANDSHAKES_PER_S, BURST_HANDSHAKES)
        self._sockets: list[socket.socket] = []
        self._tasks: list[asyncio.Task[None]] = []
        self.refused = 0

    @property
    def admitted(self) -> list[LimitedConnection]:
        """Admitted connections, oldest first."""
        return [connection for connection in self._connections if connection.http is not None]

    @property
    def _newcomers(self) -> list[LimitedConnection]:
        return [connection for connection in self._connections if connection.http is None]

    async def open(self, host: str, port: int) -> int:
        """Listen on every address of ``host`` and return the port.

        Raises:
            OSError: the host is unknown, or the port is in use or not permitted.
        """
        loop = asyncio.get_running_loop()
        found = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, address in dict.fromkeys((entry[0], entry[4]) for entry in found):
            listener = socket.create_server(address[:2], family=socket.AddressFamily(family), backlog=128)
            listener.setblocking(False)
            self._sockets.append(listener)
        self._tasks = [asyncio.create_task(self._accept_forever(listener)) for listener in self._sockets]
        for task in self._tasks:
            task.add_done_callback(_report_end)
        return int(self._sockets[0].getsockname()[1])

    async def close(self) -> None:
        """Stop accepting; existing connections stay open."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for listener in self._sockets:
            listener.close()
        self._sockets = []

    def take_headers(self, newcomer: LimitedConnection, headers: bytes) -> None:
        """Admit a newcomer whose headers are complete, or refuse it."""
        network = newcomer.network
        own = [connection for connection in self.admitted if connection.network == network]
        if not (self._known(headers) or self._rates.of(network).take(time.monotonic())):
            reason = f"more than {CONNECTIONS_PER_S:g} new connections per second without a sign-in"
        elif len(own) >= self._most_per_address and not self._displace(own):
            reason = f"the address has {len(own)} WebSockets"
        elif len(self.admitted) >= self._most and not self._displace(self.admitted):
            reason = f"all {self._most} connections are WebSockets"
        else:
            newcomer.admit(self._server())
            return
        assert newcomer.transport is not None
        newcomer.transport.write(_TOO_MANY)
        newcomer.abort()  # a closing handshake would occupy a place
        self._refuse(network, reason)

    def forget(self, connection: LimitedConnection) -> None:
        """Free the place of a connection that has ended."""
        self._connections.pop(connection, None)

    async def _accept_forever(self, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                accepted, peer = await loop.sock_accept(listener)
            except ConnectionAbortedError:  # the client left before it was accepted
                continue
            except OSError as error:  # out of file descriptors or memory
                logger.error("cannot accept a connection: %s; an idle connection is closed", error.strerror)
                _ = self._displace(self._newcomers) or self._displace(self.admitted)
                await asyncio.sleep(RETRY_S)
                continue
            self._receive(accepted, network_of(peer[0]))
            await asyncio.sleep(0)  # serve existing connections first

    def _receive(self, accepted: socket.socket, network: str) -> None:
        if self._tls is not None and not self._handshakes.of(network).take(time.monotonic()):
            accepted.close()
            self._refuse(network, f"more than {HANDSHAKES_PER_S:g} new connections per second")
            return
        if len(self._newcomers) >= MOST_NEWCOMERS:
            self._displace(self._newcomers)
        newcomer = LimitedConnection(self, network)
        self._connections[newcomer] = None
        newcomer.task = asyncio.create_task(self._serve(accepted, newcomer))

    def _refuse(self, network: str, reason: str) -> None:
        self.refused += 1
        logger.warning("refused a connection from %s: %s", network, reason)

    def _displace(self, connections: Iterable[LimitedConnection]) -> bool:
        """Cut the oldest non-WebSocket of the address with the most non-WebSockets; return False if there is none."""
        idle = [connection for connection in connections if not connection.kept]
        if not idle:
            return False
        ((network, _),) = Counter(connection.network for connection in idle).most_common(1)
        oldest = next(connection for connection in idle if connection.network == network)
        self.forget(oldest)
        oldest.abort()
        return True

    async def _serve(self, accepted: socket.socket, newcomer: LimitedConnection) -> None:
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: newcomer, accepted, ssl=self._tls, ssl_handshake_timeout=HEADERS_S if self._tls else None
            )
        except OSError as error:  # includes failed TLS handshakes
            logger.debug("no connection with %s: %s", newcomer.network, error)
        finally:
            if newcomer.transport is None:  # cut or failed before it was set up
                accepted.close()
                self.forget(newcomer)


def _report_end(task: asyncio.Task[None]) -> None:
    if not task.cancelled() and task.exception() is not None:
        logger.critical("no more connections are accepted: %r; restart the console", task.exception())


class LogRate(logging.Filter):
    """Filter that passes one record per place in the code every ``LOG_PERIOD_S``, with the number of dropped records.

    Args:
        clock: returns the monotonic time in seconds; replaced in tests.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._last: dict[tuple[str, int], float] = {}
        self._left_out: dict[tuple[str, int], int] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether the record is logged."""
        place, now = (record.pathname, record.lineno), self._clock()
        if now - self._last.get(place, -math.inf) < LOG_PERIOD_S:
            self._left_out[place] = self._left_out.get(place, 0) + 1
            return False
        self._last[place] = now
        if left_out := self._left_out.pop(place, 0):
            record.msg, record.args = f"{record.getMessage()} ({left_out} similar messages dropped)", ()
        return True


_FILTER = LogRate()


def limit_logs() -> None:
    """Limit the loggers of the console, asyncio and aiohttp's server. Idempotent."""
    for name in NOISY:
        logging.getLogger(name).addFilter(_FILTER)
