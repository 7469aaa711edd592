"""HTTP server of the operator's page, in its own thread.

The server does not depend on the bus. Data for the page are passed by the methods of :class:`ConsoleServer`, which any
thread may call. :class:`ConsoleServer` answers HTTP requests, :class:`~instant_ic.console.pages.Pages` serves the
WebSockets, and :class:`~instant_ic.console.drive.DriveService` passes commands to the robot. The operator's actions
are passed to a :class:`~instant_ic.console.backend.ConsoleBackend`.
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import json
import logging
import threading
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urlsplit

from aiohttp import web

from instant_ic.console.access import COOKIE, Access, AccessError, Role, tls_context
from instant_ic.console.backend import ConsoleBackend, PageServer
from instant_ic.console.config import ConsoleServerConfig
from instant_ic.console.connections import CLOSE_S, HEADERS_S, Listener, limit_logs
from instant_ic.console.drive import DriveService
from instant_ic.console.layers import PageLayers
from instant_ic.console.pages import Pages, now_ms
from instant_ic.console.protocol import FrameKind, PendingFrame
from instant_ic.util.web_access import AddressBuckets, host_allowed, is_loopback, network_of

STATIC = Path(__file__).parent / "static"
MAX_BODY = 4096  # bytes
REQUESTS_PER_S = 40.0  # per address; a page with its modules needs about 25 requests
BURST_REQUESTS = 150.0
SOCKETS_PER_S = 5.0  # WebSockets opened per address; limited, because each is sent everything that is shown
BURST_SOCKETS = 20.0
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
_PAYER: web.RequestKey[str] = web.RequestKey("payer", str)  # sign-in or address whose rate includes the request
_ROLE: web.RequestKey[Role | None] = web.RequestKey("role", Role | None)  # type: ignore[arg-type]


class ConsoleError(RuntimeError):
    """The server cannot start or stop; the message says why and what to do."""


class ConsoleServer(PageServer):
    """The server of the page and its WebSocket at ``/ws``.

    Args:
        backend: handles the operator's actions.
        config: address and limits.
        page: values for the page (dissolve time, footprint, ...), sent in ``hello``.

    Attributes:
        access: sign-ins.
        drive: lease, commands and emergency stop.
        pages: WebSockets of the pages.
        port: port on which the server listens; 0 before the start.

    Raises:
        ConsoleError: a token or a certificate cannot be used.
    """

    now_ms = staticmethod(now_ms)

    def __init__(
        self, backend: ConsoleBackend, config: ConsoleServerConfig | None = None, page: dict[str, Any] | None = None
    ) -> None:
        self.backend = backend
        self.config = config or ConsoleServerConfig()
        try:
            self.access = Access(self.config.access, self.config.host)
            self._tls = tls_context(self.config.access)
        except AccessError as error:
            raise ConsoleError(f"console: {error}") from error
        self.drive = DriveService(backend, self.config.drive)
        self.pages = Pages(backend, self.config, page or {}, self.drive, self.access)
        self.port = 0
        self._requests = AddressBuckets(REQUESTS_PER_S, BURST_REQUESTS)
        self._sockets = AddressBuckets(SOCKETS_PER_S, BURST_SOCKETS)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self._finish = asyncio.Event()
        self._started: threading.Event = threading.Event()
        self._start_error: Exception | None = None

    # ---- any thread -------------------------------------------------------------------------

    def start(self) -> None:
        """Bind the port and serve. Raise ConsoleError if the port cannot be bound or the server does not start."""
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
            # The loop may have ended between the check and the call.
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
        return self._tls is None and not is_loopback(self.config.host)

    @property
    def warnings(self) -> list[str]:
        """Warnings for the log about access that the parameters leave open."""
        who = "every user of this machine" if is_loopback(self.config.host) else "anyone on the network"
        unguarded = f"{who} may drive, because server.access.sign_in is never"
        return [PLAIN_HTTP] * self.plain_http + [unguarded] * self.access.unguarded

    @property
    def sign_in_url(self) -> str:
        """Address of the page, with the token if this start made one. Opening the address signs in."""
        token = self.access.made_token
        return f"{self.url}?token={quote(token)}" if token else self.url

    def publish(self, kind: str, message: dict[str, Any]) -> None:
        text = json.dumps({"type": kind, **message}, separators=(",", ":"), allow_nan=False)
        self._call(self.pages.publish, kind, text)

    def send_frame(self, kind: FrameKind, header: dict[str, Any], payload: bytes) -> None:
        self._call(self.pages.send_frame, kind, PendingFrame(header, payload))

    def send_layers(self, layers: PageLayers) -> None:
        self._call(self.pages.send_layers, layers)

    def drawn_ms(self) -> float | None:
        return self.pages.drawn_ms()

    def needs_views(self) -> bool:
        return self.pages.needs_views()

    def follow_robot(self, holder: str | None, estop: bool = False) -> None:
        self._call(self.drive.follow, holder, estop)

    def show(self, *kinds: FrameKind) -> None:
        self._call(self.pages.show, frozenset(kinds))

    def _call(self, function: Callable[..., None], *args: Any) -> None:
        if self._loop is None:
            return
        # After stop() the loop is closed, and the call has no receiver.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function, *args)

    # ---- the server's thread ----------------------------------------------------------------

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except (OSError, ValueError) as error:  # ValueError: the host is no name
            self._start_error = error
        finally:
            self._started.set()

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        limit_logs()
        runner = web.AppRunner(
            self._application(),
            access_log=None,
            handle_signals=False,
            shutdown_timeout=1.0,
            keepalive_timeout=HEADERS_S,  # counted from the start of the connection, then from each answer
            lingering_time=CLOSE_S,  # time for the rest of a refused body
        )
        await runner.setup()
        assert runner.server is not None
        limits = self.config.max_connections, self.config.max_connections_per_address
        self.listener = listener = Listener(runner.server, *limits, self._tls, self._known)
        try:
            self.port = await listener.open(self.config.host, self.config.port)
            tasks = [asyncio.create_task(self.drive.run()), asyncio.create_task(self.pages.end_expired())]
            self._started.set()
            await self._finish.wait()
            for task in tasks:
                task.cancel()
            self.drive.stop()
            await listener.close()
            await self.pages.close()
        finally:
            await listener.close()
            await runner.cleanup()

    def _application(self) -> web.Application:
        app = web.Application(middlewares=[self._guard], client_max_size=MAX_BODY)
        app.on_response_prepare.append(_secure_headers)
        app.router.add_get("/", self._index)
        app.router.add_get("/health", self._health)
        app.router.add_post("/sign-in", self._sign_in)
        app.router.add_post("/sign-out", self._sign_out)
        app.router.add_post("/estop", self._estop)
        app.router.add_get("/ws", self._websocket)
        app.router.add_static("/static/", STATIC)
        return app

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        # The sign-in is checked first, so that a signed-in client never waits for others with the same address.
        request[_COOKIE] = request.cookies.get(COOKIE, "")
        request[_PAYER] = network_of(request.remote or "")
        request[_ROLE] = role = self._role(request)
        asked = f"{request.method} {request.path}"
        known_host = host_allowed(request.headers.get("Host", ""), self.config.allowed_hosts)
        stops = role is not None and request.path == "/estop"
        enters = role is None and (asked == "POST /sign-in" or (asked == "GET /" and "token" in request.query))
        if not (known_host and (stops or enters)):
            await _pace(request, self._requests)
        if not known_host:
            raise web.HTTPForbidden(text="Host not allowed; add it to server.allowed_hosts\n")
        open_to_all = request.path == "/sign-in" or request.path.startswith("/static/")
        return await (self._turn_away(request) if role is None and not open_to_all else handler(request))

    def _role(self, request: web.Request) -> Role | None:
        """Return the role of a request. Programs send a token in the header, pages the cookie of their sign-in."""
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
        """Return whether a request's headers contain a valid token or cookie, or without sign-in, whether it is a stop.

        This only admits a connection. :meth:`_guard` decides on the request.
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
        """Answer a request without sign-in: with the form if a browser opens the page, otherwise with 401."""
        if request.path == "/" and request.method == "GET":
            if token := request.query.get("token", ""):
                return await self._enter(request, token)
            return _sign_in_page("Sign in to see the robot.", self.plain_http)
        if _bearer(request.headers.get("Authorization", "")):
            await self._slow_down(request)
        return web.Response(
            status=401, text="sign in first, or send 'Authorization: Bearer TOKEN'\n",
            headers={"WWW-Authenticate": "Bearer"},
        )  # fmt: skip

    async def _enter(self, request: web.Request, token: str) -> web.Response:
        """Sign a browser in: set a cookie and redirect, so that the token disappears from address and history."""
        role = self.access.role_of_token(token)
        if role is None:
            await _pace(request, self._requests)
            await self._slow_down(request)
            return _sign_in_page("Wrong token.", self.plain_http)
        response = web.Response(status=303, headers={"Location": "/"})
        response.set_cookie(
            COOKIE, self.access.open_session(role, time.monotonic()), httponly=True, samesite="Strict",
            secure=self._tls is not None, max_age=round(self.config.access.session_hours * 3600),
        )  # fmt: skip
        self.pages.end_signed_out()  # the new sign-in may have displaced others
        logger.info("%s has signed in to %s", request.remote, role.value)
        return response

    async def _sign_in(self, request: web.Request) -> web.StreamResponse:
        if not self.access.required:
            raise web.HTTPSeeOther("/")
        try:
            async with asyncio.timeout(HEADERS_S):
                token = (await request.post()).get("token", "")
        except TimeoutError:
            raise web.HTTPRequestTimeout(text=f"no token received within {HEADERS_S:g} s\n") from None
        except web.HTTPRequestEntityTooLarge:
            await _pace(request, self._requests)
            raise
        return await self._enter(request, token.strip() if isinstance(token, str) else "")

    async def _sign_out(self, request: web.Request) -> web.StreamResponse:
        if self.access.required:
            self.access.close_session(request[_COOKIE])
            self.pages.end_signed_out()
        response = web.HTTPSeeOther("/")
        response.del_cookie(COOKIE)
        raise response

    async def _index(self, request: web.Request) -> web.StreamResponse:
        if "token" in request.query:  # already signed in, so remove the token from the address
            raise web.HTTPSeeOther("/")
        return web.FileResponse(STATIC / "index.html")

    async def _health(self, request: web.Request) -> web.StreamResponse:
        return web.json_response({"clients": len(self.pages.sessions)})

    async def _estop(self, request: web.Request) -> web.StreamResponse:
        """Set the emergency stop without the page's WebSocket, which may be stuck; only the page can release it."""
        _check_origin(request)
        self.drive.stop_robot(request.remote or "")
        return web.Response(status=204)

    async def _websocket(self, request: web.Request) -> web.StreamResponse:
        _check_origin(request)
        await _pace(request, self._sockets)
        _end_if_left(request)
        return await self.pages.serve(request, request[_ROLE] is Role.DRIVE, request[_COOKIE])


async def _pace(request: web.Request, buckets: AddressBuckets) -> None:
    """Delay requests of a sign-in or address above its rate. The limit of connections bounds the waiting requests."""
    bucket = buckets.of(request[_PAYER])
    while not bucket.take(time.monotonic()):
        await asyncio.sleep(bucket.wait_s())
        _end_if_left(request)


def _sign_in_page(text: str, plain_http: bool) -> web.Response:
    page = (STATIC / "sign-in.html").read_text(encoding="utf-8")
    page = page.replace("{text}", html.escape(text)).replace("{warning}", html.escape(PLAIN_HTTP) if plain_http else "")
    return web.Response(status=401, text=page, content_type="text/html")


def _check_origin(request: web.Request) -> None:
    origin = request.headers.get("Origin")
    if not origin_allowed(origin, request.headers.get("Host", "")):
        logger.warning("refused %s from origin %.200r", request.path, origin)
        raise web.HTTPForbidden(text="Origin does not match Host\n")


def _bearer(authorization: str) -> str:
    """Return the token in an Authorization header; empty if there is none."""
    scheme, _, token = authorization.partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""


def _end_if_left(request: web.Request) -> None:
    """End a request whose client has closed its connection, because no limit counts it any more."""
    if request.transport is None:
        raise web.HTTPRequestTimeout


async def _secure_headers(request: web.Request, response: web.StreamResponse) -> None:
    """Add the security headers to every response, including errors."""
    for name, value in SECURITY_HEADERS.items():
        response.headers.setdefault(name, value)


def origin_allowed(origin: str | None, host: str) -> bool:
    """Return whether a request comes from the page itself. Programs send no Origin and are accepted."""
    if origin is None:
        return True
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower() != ""
