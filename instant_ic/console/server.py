"""HTTP and WebSocket server of the operator's page, in its own thread.

It does not depend on the bus. The operator's actions go to a :class:`Backend`. Data for the page comes through
:meth:`ConsoleServer.publish` and :meth:`ConsoleServer.send_frame`, which any thread may call.
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import json
import logging
import secrets
import threading
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Protocol
from urllib.parse import quote, unquote, urlsplit

from aiohttp import WSCloseCode, WSMsgType, web

from instant_ic.config.ranges import Checked, Positive, PositiveInt, Range
from instant_ic.console.access import COOKIE, Access, AccessConfig, AccessError, Role, tls_context
from instant_ic.console.connections import (
    CLOSE_S,
    HEADERS_S,
    AddressBuckets,
    LimitedConnection,
    Listener,
    network_of,
)
from instant_ic.console.drive import LOOK_S, DriveConfig, DriveGate
from instant_ic.console.layers import PageLayers
from instant_ic.console.log_rate import limit_logs
from instant_ic.console.protocol import FrameKind, ProtocolError, flag, number, parse_text, whole
from instant_ic.console.session import PendingFrame, Session
from instant_ic.console.view import MAX_FOV_RAD, Look
from instant_ic.control.robot_lease import Verdict, sender_name
from instant_ic.util.pace import current, suspended_ns
from instant_ic.util.web_access import TokenBucket, host_allowed, is_loopback

STATIC = Path(__file__).parent / "static"
MAX_CLIENT_MESSAGE = 4096
MAX_BODY = 4096
MAX_BAD_MESSAGES = 20
BURST_S = 2.0  # seconds' worth of messages that may arrive at once, after a radio link has stalled
WATCHER_SHARE = 0.4  # share of max_messages_per_s for a page that does not drive
FIRST_S = 0.25  # as BURST_S, for a new page
REQUESTS_PER_S = 40.0  # of one address; a page with its modules takes about 25
BURST_REQUESTS = 150.0
SOCKETS_PER_S = 5.0  # WebSockets opened by one address; a new one is sent everything that is shown
BURST_SOCKETS = 20.0
RESERVED_FOR_DRIVERS = 2  # share of max_clients that pages that may only watch cannot take
SILENT_CLIENT_S = 15.0
SUPERSEDED_S = 5.0  # time for a page to load new layers; what it still renders from older ones does not count as a view
START_TIMEOUT_S = 10.0
SECURITY_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; form-action 'self'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",  # a new page must not load old modules from the cache
}
PLAIN_HTTP = "Plain HTTP: anyone on the network can read the traffic and take over. Set server.access.tls_certificate."
logger = logging.getLogger("instant_ic.console")
_COOKIE: web.RequestKey[str] = web.RequestKey("cookie", str)
_PAYER: web.RequestKey[str] = web.RequestKey("payer", str)  # whose rate a request counts against
_ROLE: web.RequestKey[Role | None] = web.RequestKey("role", Role | None)  # type: ignore[arg-type]


class ConsoleError(RuntimeError):
    """The server cannot start or stop; the text says why and what to do."""


class Backend(Protocol):
    """Handler of the operator's actions. Called on the server's thread; every method must return at once."""

    def on_drive(self, linear: float, angular: float) -> None:
        """Publish a command, m/s and rad/s: at 20 Hz while driving, zeros while the driver is present and idle."""

    def on_operator(self, there: bool) -> None:
        """A driver is present, or lost: his page is silent, hidden or closed, or he gave the lease back."""

    def on_estop(self, stop: bool) -> None:
        """Emergency stop set (by any client) or released (by the driver)."""

    def on_look(self, look: Look) -> None:
        """New look direction and field of view of the driver."""

    def on_record(self, on: bool) -> None:
        """Start or stop a recording."""

    def on_snapshot(self) -> None:
        """Save the last minute."""

    def on_bookmark(self) -> None:
        """Set a bookmark at the present moment."""


@dataclass(frozen=True)
class ServerConfig(Checked):
    """Address, limits and access of the server.

    Attributes:
        host: listen address; any but loopback (e.g. 0.0.0.0) opens the page to the network.
        port: 0 = any free port; the log states it.
        allowed_hosts: host names by which browsers may reach the page, besides localhost and IP addresses.
        max_clients: simultaneous pages; two places are reserved for pages that may drive.
        max_connections: simultaneous connections; at the limit the address with the most idle ones loses its oldest.
        max_connections_per_address: the same for one address (IPv6: one /64).
        max_messages_per_s: limit for the driver's page, with bursts of twice this number; 0.4 of it for others; above,
            the WebSocket is closed.
        background_picture_hz: rate of images that are not shown (the camera while in the virtual space).
    """

    host: str = "127.0.0.1"
    port: Annotated[int, Range(0, 65535)] = 8080  # 0 = any free port
    allowed_hosts: tuple[str, ...] = ()  # host names by which browsers may reach the page besides localhost
    max_clients: PositiveInt = 16
    max_connections: PositiveInt = 128
    max_connections_per_address: PositiveInt = 32
    max_messages_per_s: Positive = 300.0  # of one page; above, its WebSocket is closed; see BURST_S
    background_picture_hz: Positive = 2.0  # images that are not shown (camera in the v-space)
    access: AccessConfig = field(default_factory=AccessConfig)
    drive: DriveConfig = field(default_factory=DriveConfig)


class ConsoleServer:
    """Serves the page and its WebSocket at ``/ws``.

    Args:
        backend: handles the operator's actions.
        config: address and limits.
        page: values for the page (dissolve time, footprint, ...), sent in ``hello``.
    """

    def __init__(
        self, backend: Backend, config: ServerConfig | None = None, page: dict[str, Any] | None = None
    ) -> None:
        self.backend = backend
        self.config = config or ServerConfig()
        self.page = page or {}
        self.on_watched: Callable[[bool], None] = lambda watched: None
        """Called on the server's thread when the first page comes (True) and when the last one has gone (False)."""
        self.on_renders: Callable[[], None] = lambda: None
        """Called on the server's thread when a page says for the first time that it can render the virtual space."""
        self.on_drawn: Callable[[], None] = lambda: None
        """Called on the server's thread when :meth:`drawn_ms` has changed."""
        self.on_released: Callable[[str], None] = lambda client: None
        """Called on the server's thread when a client that drove gives its lease back; see :attr:`client`."""
        self.gate = DriveGate(self.config.drive)
        try:
            self.access = Access(self.config.access, self.config.host)
            self._tls = tls_context(self.config.access)
        except AccessError as error:
            raise ConsoleError(f"console: {error}") from error
        self.port = 0
        self._sessions: dict[int, Session] = {}
        self._next_number = 1
        self._requests = AddressBuckets(REQUESTS_PER_S, BURST_REQUESTS)
        self._sockets = AddressBuckets(SOCKETS_PER_S, BURST_SOCKETS)
        self._texts: dict[str, str] = {}
        self._frames: dict[FrameKind, PendingFrame | PageLayers] = {}
        self._versions: dict[int, float] = {}  # of layers -> when the next one superseded it; inf: not yet
        self._foreground = frozenset({FrameKind.PANORAMA})
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self._operator = False  # whether the backend knows that a driver is present
        self._instance = secrets.token_hex(4)  # other consoles, and the next start, have clients of the same numbers
        self._commanding: int | None = None  # client in whose name the backend commands
        self._holder: str | None = None  # who has the robot's lease; empty: nobody; None: unknown
        self._gate_wake = asyncio.Event()
        self._finish = asyncio.Event()
        self._started: threading.Event = threading.Event()
        self._start_error: Exception | None = None

    # ---- any thread -------------------------------------------------------------------------

    def start(self) -> None:
        """Bind the port and serve; raise ConsoleError if that fails."""
        self._thread = threading.Thread(target=self._run, name="console-server", daemon=True)
        self._thread.start()
        if not self._started.wait(START_TIMEOUT_S):
            raise ConsoleError(f"console: server did not start within {START_TIMEOUT_S:g} s")
        if self._start_error is not None:
            raise ConsoleError(
                f"console: cannot listen on {self.config.host}:{self.config.port}: {self._start_error}; "
                "stop the other program or set server.port"
            ) from self._start_error

    def stop(self) -> None:
        """Command zero, close every client and end the thread."""
        if self._thread is None:
            return
        if self._loop is not None and self._thread.is_alive():
            # The loop may end between the check and the call.
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._finish.set)
        self._thread.join(timeout=5.0)
        if self._thread.is_alive():
            raise ConsoleError("console: server thread did not end within 5 s")
        self._thread = None

    @property
    def url(self) -> str:
        """Address of the page."""
        host = "127.0.0.1" if self.config.host in ("0.0.0.0", "::") else self.config.host
        scheme = "http" if self._tls is None else "https"
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{self.port}/"

    @property
    def plain_http(self) -> bool:
        """Whether token, cookie and commands go over the network unencrypted."""
        return self._tls is None and not is_loopback(self.config.host)

    @property
    def warnings(self) -> list[str]:
        """Warnings for the log: access that the parameters leave open."""
        who = "every user of this machine" if is_loopback(self.config.host) else "anyone on the network"
        unguarded = f"{who} may drive, because server.access.sign_in is never"
        return [PLAIN_HTTP] * self.plain_http + [unguarded] * self.access.unguarded

    @property
    def sign_in_url(self) -> str:
        """Address of the page, with the token if this start made one; opening it signs in."""
        token = self.access.made_token
        return f"{self.url}?token={quote(token)}" if token else self.url

    @property
    def client(self) -> str:
        """Name of the client in whose name the backend commands, unique among all pages of all consoles."""
        return self._name_of(self._commanding or 0)

    def _name_of(self, number: int) -> str:
        return sender_name(f"page {number} {self._instance}")

    @staticmethod
    def now_ms() -> float:
        """Server's clock for the page: monotonic milliseconds."""
        return time.monotonic() * 1000.0

    def publish(self, kind: str, message: dict[str, Any]) -> None:
        """Send a text message of type ``kind`` to every client; it replaces a pending one of this kind."""
        text = json.dumps({"type": kind, **message}, separators=(",", ":"), allow_nan=False)
        self._call(self._publish, kind, text)

    def send_frame(self, kind: FrameKind, header: dict[str, Any], payload: bytes) -> None:
        """Send an image or map to every client; it replaces a pending one of this kind.

        Args:
            kind: content of the frame.
            header: JSON header of the frame.
            payload: JPEG or PNG.
        """
        self._call(self._send_frame, kind, PendingFrame(header, payload))

    def send_layers(self, layers: PageLayers) -> None:
        """Send a version of the virtual space to every client; it replaces a pending one.

        Raises:
            ProtocolError: a layer that no page could render.
        """
        layers.check()
        _ = layers.digests  # on this thread: hashing takes milliseconds
        self._call(self._send_layers, layers)

    def drawn_ms(self) -> float | None:
        """Return the time (:meth:`now_ms`) of the newest state that a page has shown, rendering the v-space by itself.

        The page is the driver's, or without a driver the oldest. None: it needs rendered views.
        """
        sessions = self._sessions.copy()
        driver = sessions.get(self.gate.driver or 0) or next(iter(sessions.values()), None)
        return None if driver is None or driver.drawn is None else driver.drawn[1]

    def needs_views(self) -> bool:
        """Whether a page does not render the virtual space by itself."""
        return any(session.drawn is None for session in self._sessions.copy().values())

    def follow_robot(self, holder: str | None, estop: bool = False) -> None:
        """Take over who has the robot's lease (empty: nobody) and its emergency stop; None: no robot reports."""
        self._call(self._follow, holder, None if holder is None else estop)

    def show(self, *kinds: FrameKind) -> None:
        """Set which of PANORAMA and VIEW the page shows or soon will; the other is sent at a low rate."""
        if (shown := frozenset(kinds)) != self._foreground:
            self._call(self._show, shown)

    def _call(self, function: Callable[..., None], *args: Any) -> None:
        if self._loop is None:
            return
        # After stop() the loop is closed and nobody listens.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function, *args)

    # ---- the server's thread ----------------------------------------------------------------

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except OSError as error:
            self._start_error = error
        finally:
            self._started.set()

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        limit_logs()
        app = web.Application(middlewares=[self._guard], client_max_size=MAX_BODY)
        app.on_response_prepare.append(_secure_headers)
        app.router.add_get("/", self._index)
        app.router.add_get("/health", self._health)
        app.router.add_post("/sign-in", self._sign_in)
        app.router.add_post("/sign-out", self._sign_out)
        app.router.add_post("/estop", self._estop)
        app.router.add_get("/ws", self._websocket)
        app.router.add_static("/static/", STATIC)
        runner = web.AppRunner(
            app,
            access_log=None,
            handle_signals=False,
            shutdown_timeout=1.0,
            keepalive_timeout=HEADERS_S,  # from the start of the connection, then from each answer
            lingering_time=CLOSE_S,  # for the rest of a refused body
        )
        await runner.setup()
        assert runner.server is not None
        limits = self.config.max_connections, self.config.max_connections_per_address
        self.listener = listener = Listener(runner.server, *limits, self._tls, self._known)
        try:
            self.port = await listener.open(self.config.host, self.config.port)
            drive_task = asyncio.create_task(self._drive_forever())
            self._started.set()
            await self._finish.wait()
            drive_task.cancel()
            self.gate.stop(current().steady_s())
            self._emit_due()
            await listener.close()
            sessions = list(self._sessions.values())
            for session in sessions:
                self._end(session, WSCloseCode.GOING_AWAY, "console shuts down")
            await asyncio.gather(*(session.closing for session in sessions if session.closing is not None))
        finally:
            await listener.close()
            await runner.cleanup()

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        # The sign-in comes first: a signed-in client never waits for others of the same address.
        request[_COOKIE] = request.cookies.get(COOKIE, "")
        request[_PAYER] = network_of(request.remote or "")
        request[_ROLE] = role = self._role(request)
        asked, known_host = f"{request.method} {request.path}", self._host_allowed(request)
        stops = role is not None and request.path == "/estop"
        enters = role is None and (asked == "POST /sign-in" or (asked == "GET /" and "token" in request.query))
        if not (known_host and (stops or enters)):
            await self._pace(request, self._requests)
        if not known_host:
            raise web.HTTPForbidden(text="Host not allowed; add it to server.allowed_hosts\n")
        open_to_all = request.path == "/sign-in" or request.path.startswith("/static/")
        return await (self._turn_away(request) if role is None and not open_to_all else handler(request))

    def _host_allowed(self, request: web.Request) -> bool:
        return host_allowed(request.headers.get("Host", ""), self.config.allowed_hosts)

    @staticmethod
    async def _pace(request: web.Request, buckets: AddressBuckets) -> None:
        """Delay requests of a sign-in or address above its rate; the connection limit bounds how many wait."""
        bucket = buckets.of(request[_PAYER])
        while not bucket.take(time.monotonic()):
            await asyncio.sleep(bucket.wait_s())
            _end_if_left(request)

    def _role(self, request: web.Request) -> Role | None:
        """Return the role of a request: programs send a token in the header, pages the cookie of their sign-in."""
        if not self.access.required:
            return Role.DRIVE
        token = _bearer(request.headers.get("Authorization", ""))
        role = self.access.role_of(token, request[_COOKIE], time.monotonic())
        if role is not None:
            request[_PAYER] = token or request[_COOKIE]
        if token:
            request[_COOKIE] = ""
        return role

    def _known(self, received: bytes) -> bool:
        """Return whether a request has a right token or cookie in its headers; without sign-in, whether it is a stop.

        This only admits a connection: :meth:`_guard` decides on the request.
        """
        if not self.access.required:
            return received.startswith(b"POST /estop ")
        start, *lines = received.partition(b"\r\n\r\n")[0].decode("latin-1").split("\r\n")
        fields = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
        cookies = dict(pair.strip().partition("=")[::2] for pair in fields.get("cookie", "").split(";"))
        token = _bearer(fields.get("authorization", "")) or unquote(start.partition("?token=")[2].partition(" ")[0])
        return self.access.role_of(token, cookies.get(COOKIE, ""), time.monotonic()) is not None

    async def _slow_down(self, request: web.Request) -> None:
        """Delay the answer to a wrong token."""
        address = request[_PAYER]
        logger.warning("wrong token from %s", address)
        await asyncio.sleep(self.access.count_wrong_token(address, time.monotonic()))

    async def _turn_away(self, request: web.Request) -> web.StreamResponse:
        """Answer a request without sign-in: the form for browsers that open the page, 401 for everything else."""
        if request.path == "/" and request.method == "GET":
            if token := request.query.get("token", ""):
                return await self._enter(request, token)
            return self._sign_in_page("Sign in to see the robot.")
        if _bearer(request.headers.get("Authorization", "")):
            await self._slow_down(request)
        return web.Response(
            status=401, text="sign in first, or send 'Authorization: Bearer TOKEN'\n",
            headers={"WWW-Authenticate": "Bearer"},
        )  # fmt: skip

    async def _enter(self, request: web.Request, token: str) -> web.Response:
        """Sign a browser in: set a cookie and redirect, so that the token leaves address and history."""
        role = self.access.role_of_token(token)
        if role is None:
            await self._pace(request, self._requests)
            await self._slow_down(request)
            return self._sign_in_page("Wrong token.")
        now = time.monotonic()
        response = web.Response(status=303, headers={"Location": "/"})
        response.set_cookie(
            COOKIE, self.access.open_session(role, now), httponly=True, samesite="Strict",
            secure=self._tls is not None, max_age=round(self.config.access.session_hours * 3600),
        )  # fmt: skip
        self._end_signed_out()  # pages whose sign-in the new one displaced
        logger.info("%s has signed in to %s", request.remote, role.value)
        return response

    def _sign_in_page(self, text: str) -> web.Response:
        page = (STATIC / "sign-in.html").read_text(encoding="utf-8")
        warning = PLAIN_HTTP if self.plain_http else ""
        page = page.replace("{text}", html.escape(text)).replace("{warning}", html.escape(warning))
        return web.Response(status=401, text=page, content_type="text/html")

    async def _sign_in(self, request: web.Request) -> web.StreamResponse:
        if not self.access.required:
            raise web.HTTPSeeOther("/")
        try:
            async with asyncio.timeout(HEADERS_S):
                token = (await request.post()).get("token", "")
        except TimeoutError:
            raise web.HTTPRequestTimeout(text=f"no token received within {HEADERS_S:g} s\n") from None
        except web.HTTPRequestEntityTooLarge:
            await self._pace(request, self._requests)
            raise
        return await self._enter(request, token.strip() if isinstance(token, str) else "")

    async def _sign_out(self, request: web.Request) -> web.StreamResponse:
        if self.access.required:
            self.access.close_session(request[_COOKIE])
            self._end_signed_out()
        response = web.HTTPSeeOther("/")
        response.del_cookie(COOKIE)
        raise response

    async def _index(self, request: web.Request) -> web.StreamResponse:
        if "token" in request.query:  # already signed in: remove the token from the address
            raise web.HTTPSeeOther("/")
        return web.FileResponse(STATIC / "index.html")

    async def _health(self, request: web.Request) -> web.StreamResponse:
        return web.json_response(
            {
                "clients": len(self._sessions),
                "driver": self.gate.driver,
                "estop": self.gate.estop,
                "watchdog_trips": self.gate.watchdog_trips,
                "commands": {verdict.name.lower(): count for verdict, count in self.gate.counts.items()},
            }
        )

    async def _estop(self, request: web.Request) -> web.StreamResponse:
        """Set the emergency stop without the page's WebSocket, which may be stuck but alone can release it."""
        self._check_origin(request)
        self._stop_robot(request.remote or "")
        return web.Response(status=204)

    @staticmethod
    def _check_origin(request: web.Request) -> None:
        origin = request.headers.get("Origin")
        if not origin_allowed(origin, request.headers.get("Host", "")):
            logger.warning("refused %s from origin %.200r", request.path, origin)
            raise web.HTTPForbidden(text="Origin does not match Host\n")

    async def _websocket(self, request: web.Request) -> web.StreamResponse:
        self._check_origin(request)
        await self._pace(request, self._sockets)
        if request.transport is None:  # the client did not wait
            return web.Response(status=408)
        may_drive = request[_ROLE] is Role.DRIVE
        places = self.config.max_clients if may_drive else max(1, self.config.max_clients - RESERVED_FOR_DRIVERS)
        if len(self._sessions) >= places:
            raise web.HTTPServiceUnavailable(text=f"too many pages: {len(self._sessions)} are connected\n")
        connection = request.transport.get_protocol()
        assert isinstance(connection, LimitedConnection)
        # Without autoping the reader sees the protocol's pings too, so that the message limit covers them.
        socket = web.WebSocketResponse(max_msg_size=MAX_CLIENT_MESSAGE, compress=False, timeout=CLOSE_S, autoping=False)
        limit = self.config.max_messages_per_s
        # A new connection has no delayed messages: a client must not gain a new burst by reconnecting.
        bucket = TokenBucket(limit, limit * BURST_S, limit * FIRST_S)
        session = Session(self._next_number, socket, connection, bucket, may_drive, request[_COOKIE])
        self._next_number += 1
        self._sessions[session.number] = session  # before the first await, so that the place is taken
        if len(self._sessions) == 1:
            self.on_watched(True)
        loop = asyncio.get_running_loop()
        sender: asyncio.Task[None] | None = None
        expiry: asyncio.TimerHandle | None = None
        try:
            await socket.prepare(request)  # raises if the request is no WebSocket upgrade
            connection.keep(lambda: self._flooded(session))
            self._greet(session)
            sender = asyncio.create_task(session.send_forever())
            if self.access.required and session.cookie:
                # 10 ms late: a timer that fires early would find the sign-in still valid.
                expiry = loop.call_at(self.access.end_of_session_s(session.cookie) + 0.01, self._end_signed_out)
            await self._read_forever(session)
        finally:
            if expiry is not None:
                expiry.cancel()
            self._drop(session)
            if sender is not None:
                sender.cancel()
                with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                    await sender
            if session.closing is not None:
                await asyncio.wait({session.closing})
        return socket

    def _drop(self, session: Session) -> None:
        """Remove a session: it loses the lease and receives nothing more."""
        if self._sessions.pop(session.number, None) is None:
            return
        self.gate.forget(session.number, current().steady_s())
        self._emit_due()
        self._send_session()
        if not self._sessions:
            self.on_watched(False)

    def _end(self, session: Session, code: WSCloseCode, reason: str) -> None:
        """Drop a session at once, then close its socket whatever the client does."""
        self._drop(session)
        if session.closing is None:
            session.closing = asyncio.create_task(self._close(session, code, reason))

    @staticmethod
    async def _close(session: Session, code: WSCloseCode, reason: str) -> None:
        try:
            async with asyncio.timeout(2 * CLOSE_S):
                await session.socket.close(code=code, message=reason.encode())
        except (TimeoutError, ConnectionError, RuntimeError) as error:  # the client does not read or has gone
            logger.debug("client %d took no closing frame: %s", session.number, error)
        finally:
            session.connection.abort()

    def _end_signed_out(self) -> None:
        """End the sessions whose sign-in has ended: signed out, expired or displaced by newer ones."""
        now = time.monotonic()
        for session in list(self._sessions.values()):
            if self.access.required and session.cookie and self.access.role_of_session(session.cookie, now) is None:
                logger.info("client %d closed: its sign-in has ended", session.number)
                self._end(session, WSCloseCode.POLICY_VIOLATION, "signed out")

    def _flooded(self, session: Session) -> None:
        """End a session that sends more than a page ever does."""
        logger.warning("client %d closed: it sends too many messages", session.number)
        session.connection.mute()
        self._end(session, WSCloseCode.POLICY_VIOLATION, "too many messages")

    def _greet(self, session: Session) -> None:
        drive = self.config.drive
        session.reply(
            {
                "type": "hello",
                "client": session.number,
                "server_ms": self.now_ms(),
                "max_linear": drive.max_linear_mps,
                "max_angular": drive.max_angular_rps,
                "rate_hz": drive.rate_hz,
                "may_drive": session.may_drive,
                "page": self.page,
            }
        )
        for key, text in self._texts.items():
            session.put_text(key, text)
        for kind, frame in self._frames.items():
            session.put_frame(kind, frame)
        session.set_foreground(self._foreground, 1.0 / self.config.background_picture_hz)
        self._send_session()

    async def _read_forever(self, session: Session) -> None:
        limit = self.config.max_messages_per_s
        while session.number in self._sessions:
            try:
                message = await session.socket.receive(timeout=SILENT_CLIENT_S)
            except TimeoutError:
                self._end(session, WSCloseCode.POLICY_VIOLATION, "silent")
                return
            if session.number not in self._sessions:  # ended meanwhile
                return
            # A watcher sends no commands, only pings and looks.
            session.bucket.rate = limit if session.number == self.gate.driver else limit * WATCHER_SHARE
            within = session.bucket.take(time.monotonic())
            if message.type is WSMsgType.TEXT:
                self._take(session, message.data, current().steady_s(), only_a_stop=not within)
            elif message.type is WSMsgType.PING:
                if within:
                    await session.socket.pong(message.data)
            elif message.type is not WSMsgType.PONG:
                if message.type is WSMsgType.BINARY:
                    self._end(session, WSCloseCode.UNSUPPORTED_DATA, "binary message")
                return
            if not within:
                self._flooded(session)
            elif session.chokes:
                session.connection.mute()
                self._end(session, WSCloseCode.POLICY_VIOLATION, "does not read its answers")
            await asyncio.sleep(0)  # one message a turn, so that clients take turns

    def _take(self, session: Session, text: str, now: float, *, only_a_stop: bool) -> None:
        """Handle one message; an emergency stop is handled even above the message limit."""
        self._look(now)
        try:
            message = parse_text(text)
            if not only_a_stop or message["type"] == "estop":
                self._handle(session, message, now)
        except ProtocolError as error:
            session.bad_messages += 1
            logger.warning("client %d: %s", session.number, error)
            if session.bad_messages >= MAX_BAD_MESSAGES:
                self._end(session, WSCloseCode.POLICY_VIOLATION, "bad messages")
            else:
                session.reply({"type": "error", "text": str(error)})

    def _handle(self, session: Session, message: dict[str, Any], now: float) -> None:
        kind = message["type"]
        handler = {
            "ping": self._on_ping,
            "drive": self._on_drive,
            "lease": self._on_lease,
            "yield": self._on_yield,
            "estop": self._on_estop,
            "estop_release": self._on_estop_release,
            "look": self._on_look,
            "record": self._on_record,
            "snapshot": self._on_snapshot,
            "bookmark": self._on_bookmark,
            "ack": self._on_ack,
            "drawn": self._on_drawn,
        }.get(kind)
        if handler is None:
            raise ProtocolError(f"unknown message type {kind!r:.40}")
        if kind == "ping":
            session.away = flag(message, "away", False)
        # A hidden page keeps acknowledging images; that is no sign of an operator either.
        if self.gate.touch(session.number, now, away=session.away):
            self._emit_due()
        handler(session, message, now)

    def _on_ping(self, session: Session, message: dict[str, Any], now: float) -> None:
        age_s, factor = self.gate.last_age_s, current().factor
        session.reply(
            {
                "type": "pong",
                "client_ms": number(message, "client_ms"),
                "server_ms": self.now_ms(),
                "command_age_ms": None if age_s is None else max(age_s, 0.0) * 1000.0 / factor,
                "command_hz": round(self.gate.rate_hz(now) * factor),
            }
        )

    def _on_drive(self, session: Session, message: dict[str, Any], now: float) -> None:
        age_s = (self.now_ms() - number(message, "time_ms")) / 1000.0 * current().factor
        linear, angular = number(message, "linear"), number(message, "angular")
        verdict = self.gate.receive(session.number, whole(message, "seq"), age_s, linear, angular, now)
        if verdict is Verdict.ACCEPTED and self._role_of(session.number) == "other":
            verdict = Verdict.NOT_DRIVER  # published all the same: the robot refuses it, and sees that a key is held
        # A zero needs no permission and is harmless out of order, so only refused motion is reported.
        if verdict is not Verdict.ACCEPTED and (linear, angular) != (0.0, 0.0):
            session.reply({"type": "refused", "reason": verdict.name.lower(), "text": verdict.value})
        self._emit_due()

    def _on_lease(self, session: Session, message: dict[str, Any], now: float) -> None:
        take = flag(message, "take", False)
        if not self._may_drive(session):
            return
        before = self.gate.driver
        self.gate.request(session.number, now, take=take)
        self._emit_due()
        self._send_session(None if self.gate.driver != before else session)

    def _on_yield(self, session: Session, message: dict[str, Any], now: float) -> None:
        before = self.gate.driver
        self.gate.leave(session.number, now)
        self._emit_due()
        self._send_session(None if self.gate.driver != before else session)

    def _on_estop(self, session: Session, message: dict[str, Any], now: float) -> None:
        self._stop_robot(f"client {session.number}")

    def _stop_robot(self, who: str) -> None:
        """Set the emergency stop; it is published before this returns."""
        news = not self.gate.estop
        self.gate.set_estop(current().steady_s())
        self.backend.on_estop(True)
        self._emit_due()
        if news:
            self._send_session()
        logger.warning("emergency stop from %s", who)

    def _on_estop_release(self, session: Session, message: dict[str, Any], now: float) -> None:
        if self._role_of(session.number) == "other" or not self.gate.release_estop(session.number):
            session.reply(
                {"type": "refused", "reason": "not_driver", "text": "only the driver may release the emergency stop"}
            )
            return
        self.backend.on_estop(False)
        self._send_session()
        logger.warning("emergency stop released by client %d", session.number)

    def _on_look(self, session: Session, message: dict[str, Any], now: float) -> None:
        look = Look(
            yaw=number(message, "yaw", -6.3, 6.3),
            pitch=number(message, "pitch", -1.6, 1.6),
            hfov=number(message, "hfov", 0.01, MAX_FOV_RAD),
            vfov=number(message, "vfov", 0.01, MAX_FOV_RAD),
        )
        # Views follow the driver, or any page while nobody drives.
        if self.gate.driver in (session.number, None):
            self.backend.on_look(look)

    @staticmethod
    def _may_drive(session: Session) -> bool:
        """Whether the sign-in may do more than watch and stop; if not, send a refusal."""
        if not session.may_drive:
            session.reply({"type": "refused", "reason": "watch_only", "text": "this sign-in may only watch"})
        return session.may_drive

    def _on_record(self, session: Session, message: dict[str, Any], now: float) -> None:
        on = flag(message, "on")
        if self._may_drive(session):
            self.backend.on_record(on)

    def _on_snapshot(self, session: Session, message: dict[str, Any], now: float) -> None:
        if self._may_drive(session):
            self.backend.on_snapshot()

    def _on_bookmark(self, session: Session, message: dict[str, Any], now: float) -> None:
        if self._may_drive(session):
            self.backend.on_bookmark()

    def _on_ack(self, session: Session, message: dict[str, Any], now: float) -> None:
        try:
            kind = FrameKind(whole(message, "kind"))
        except ValueError as error:
            raise ProtocolError(f"ack.kind: {error}") from None
        if session.acknowledge(kind, whole(message, "seq"), flag(message, "loaded", True)):
            session.bucket.give_back()  # acknowledgements are limited by the server's own frames

    def _on_drawn(self, session: Session, message: dict[str, Any], now: float) -> None:
        version, state_ms = whole(message, "version"), number(message, "state_ms", 0.0, self.now_ms())
        before = self.drawn_ms()
        if not session.renders:
            session.renders = True
            self.on_renders()
        if version == 0:
            session.drawn = None
        else:
            current_version = time.monotonic() - self._versions.get(version, float("-inf")) < SUPERSEDED_S
            # Of outdated layers no new state counts as shown: the view ages until it is stale.
            shown_ms = state_ms if current_version else 0.0 if session.drawn is None else session.drawn[1]
            session.drawn = version, shown_ms
        if self.drawn_ms() != before:
            self.on_drawn()

    async def _drive_forever(self) -> None:
        pace = current()
        while True:
            driver, trips = self.gate.driver, self.gate.watchdog_trips
            now = pace.steady_s()
            deadline = self.gate.next_deadline(now)
            if driver is not None and deadline is not None:  # the gate looks at the time between its steps
                deadline = min(deadline, now + LOOK_S)
            self._gate_wake.clear()
            with contextlib.suppress(TimeoutError):
                delay = None if deadline is None else max(pace.wait_s(deadline - pace.steady_s()), 0.001)
                await asyncio.wait_for(self._gate_wake.wait(), delay)
                continue  # woken: the deadline may have changed
            self._emit_due(wake=False)
            if self.gate.watchdog_trips != trips:
                logger.warning("no drive command for %.2f s: published zero", self.config.drive.watchdog_s)
            if (self.gate.driver, self.gate.watchdog_trips) != (driver, trips):
                self._send_session()

    def _look(self, now: float) -> None:
        """Let the gate look whether this process has stood still, before it handles anything."""
        self.gate.look(now, suspended_ns())

    def _emit_due(self, *, wake: bool = True) -> None:
        now = current().steady_s()
        self._look(now)
        command = self.gate.take_due(now)
        if self._commanding is None:
            self._commanding = self.gate.driver
        if command is not None:
            self.backend.on_drive(*command)
        if self._commanding != self.gate.driver:
            self.on_released(self.client)
            self._commanding = self.gate.driver
        if (there := self.gate.driver_alive(now)) != self._operator:
            self._operator = there
            self.backend.on_operator(there)
        if wake:
            self._gate_wake.set()

    def _send_session(self, only: Session | None = None) -> None:
        """Send the state of the lease to all clients, or to one."""
        for session in list(self._sessions.values()) if only is None else [only]:
            message = {
                "type": "session",
                "driver": self._role_of(session.number),
                "door": self._door(),
                "clients": len(self._sessions),
                "estop": self.gate.estop,
                "watchdog_trips": self.gate.watchdog_trips,
            }
            session.put_text("session", json.dumps(message))

    def _role_of(self, number: int) -> str:
        """Return who drives, as client ``number`` sees it: the robot decides, where one reports."""
        driver = self.gate.driver
        if self._holder and not (driver == number and self._holds(number)):
            return "other"
        if driver is None or (driver == number and self._holder == ""):
            return "none"
        return "you" if driver == number else "other"

    def _holds(self, number: int) -> bool:
        """Whether client ``number`` has the robot's lease."""
        return self._holder is not None and self._holder.endswith(f"/{self._name_of(number)}")

    def _door(self) -> str:
        """Return the node, and host, through which somebody drives who is no client of this server; else empty."""
        if not self._holder or any(self._holds(number) for number in self._sessions):
            return ""
        return self._holder.rpartition("/")[0]

    def _follow(self, holder: str | None, estop: bool | None) -> None:
        changed = self.gate.follow_estop(estop, current().steady_s()) or holder != self._holder
        self._holder = holder
        if changed:
            self._emit_due()
            self._send_session()

    def _publish(self, kind: str, text: str) -> None:
        self._texts[kind] = text
        for session in self._sessions.values():
            session.put_text(kind, text)

    def _send_frame(self, kind: FrameKind, frame: PendingFrame) -> None:
        self._frames[kind] = frame
        for session in self._sessions.values():
            if kind is not FrameKind.VIEW or session.drawn is None:
                session.put_frame(kind, frame)

    def _send_layers(self, layers: PageLayers) -> None:
        now = time.monotonic()
        self._versions = {
            version: min(since, now)
            for version, since in self._versions.items()
            if version != layers.version and now - since < 2 * SUPERSEDED_S
        }
        self._versions[layers.version] = float("inf")
        self._frames[FrameKind.LAYERS] = layers
        for session in self._sessions.values():
            session.put_frame(FrameKind.LAYERS, layers)

    def _show(self, kinds: frozenset[FrameKind]) -> None:
        self._foreground = kinds
        for session in self._sessions.values():
            session.set_foreground(kinds, 1.0 / self.config.background_picture_hz)


def _bearer(authorization: str) -> str:
    """Return the token in an Authorization header; empty if there is none."""
    scheme, _, token = authorization.partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""


def _end_if_left(request: web.Request) -> None:
    """End a request whose client has closed its connection: no limit counts it any more."""
    if request.transport is None:
        raise web.HTTPRequestTimeout


async def _secure_headers(request: web.Request, response: web.StreamResponse) -> None:
    """Add the security headers to every response, errors included."""
    for name, value in SECURITY_HEADERS.items():
        response.headers.setdefault(name, value)


def origin_allowed(origin: str | None, host: str) -> bool:
    """Whether a request comes from the page itself; programs send no Origin and are accepted."""
    if origin is None:
        return True
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower() != ""
