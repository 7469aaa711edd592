"""WebSockets of the operators' pages: sending of data, and handling of the pages' messages."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web

from instant_ic.console.access import Access
from instant_ic.console.backend import ConsoleBackend
from instant_ic.console.config import ConsoleServerConfig
from instant_ic.console.connections import CLOSE_S, LimitedConnection
from instant_ic.console.drive import DriveService
from instant_ic.console.layers import PageLayers
from instant_ic.console.protocol import FrameKind, PageProtocolError, PendingFrame, flag, number, parse_text, whole
from instant_ic.console.session import PageSession
from instant_ic.console.view import MAX_FOV_RAD, Look
from instant_ic.control.robot_lease import Verdict
from instant_ic.util.pace import current
from instant_ic.util.web_access import TokenBucket

EXPIRY_S = 1.0  # time between two searches for expired sign-ins
MAX_CLIENT_MESSAGE = 4096  # bytes
BURST_S = 2.0  # messages of this many seconds may arrive at once, after a radio link has stalled
FIRST_S = 0.25  # as BURST_S, for a new page
WATCHER_SHARE = 0.4  # share of max_messages_per_s for a page that does not drive
RESERVED_FOR_DRIVERS = 2  # number of max_clients reserved for pages that may drive
SILENT_CLIENT_S = 15.0
SUPERSEDED_S = 5.0  # time for a page to load new layers; images of older layers then no longer count as views
logger = logging.getLogger("instant_ic.console")


def now_ms() -> float:
    """Return the server's clock for the page, monotonic milliseconds."""
    return time.monotonic() * 1000.0


class Pages:
    """The pages' WebSockets, which send data and handle messages. Used on the server's loop, unless noted.

    Args:
        backend: handles the operators' actions.
        config: limits.
        page: values for the page (dissolve time, footprint, ...), sent in ``hello``.
        drive: lease, commands and emergency stop.
        access: sign-ins.

    Attributes:
        sessions: connected pages by number, oldest first.
    """

    def __init__(
        self,
        backend: ConsoleBackend,
        config: ConsoleServerConfig,
        page: dict[str, Any],
        drive: DriveService,
        access: Access,
    ) -> None:
        self.page = page
        self.sessions: dict[int, PageSession] = {}
        self._backend, self._config, self._drive, self._access = backend, config, drive, access
        drive.on_change = self._send_session
        self._next_number = 1
        self._texts: dict[str, str] = {}
        self._frames: dict[FrameKind, PendingFrame | PageLayers] = {}
        self._versions: dict[int, float] = {}  # version of layers → time of the next version; inf: none yet
        self._foreground = frozenset({FrameKind.PANORAMA})

    # ---- to the pages -----------------------------------------------------------------------

    def publish(self, kind: str, text: str) -> None:
        """Send a text message to every page. It replaces a pending message of the same kind."""
        self._texts[kind] = text
        for session in self.sessions.values():
            session.put_text(kind, text)

    def send_frame(self, kind: FrameKind, frame: PendingFrame) -> None:
        """Send an image or map to every page that needs it. It replaces a pending frame of the same kind."""
        self._frames[kind] = frame
        for session in self.sessions.values():
            if kind is not FrameKind.VIEW or session.drawn is None:
                session.put_frame(kind, frame)

    def send_layers(self, layers: PageLayers) -> None:
        """Send a version of the virtual space to every page. It replaces a pending version."""
        now = time.monotonic()
        self._versions = {
            version: min(since, now)
            for version, since in self._versions.items()
            if version != layers.version and now - since < 2 * SUPERSEDED_S
        }
        self._versions[layers.version] = float("inf")
        self._frames[FrameKind.LAYERS] = layers
        for session in self.sessions.values():
            session.put_frame(FrameKind.LAYERS, layers)

    def show(self, kinds: frozenset[FrameKind]) -> None:
        """Set which of PANORAMA and VIEW the pages show. The other is sent at a low rate."""
        if kinds == self._foreground:
            return
        self._foreground = kinds
        for session in self.sessions.values():
            session.set_foreground(kinds, 1.0 / self._config.background_picture_hz)

    def drawn_ms(self) -> float | None:
        """Return the time (:func:`now_ms`) of the newest state that the driver's page has rendered by itself.

        Without a driver, the oldest page counts. None if the page needs rendered views. Any thread may call this.
        """
        sessions = self.sessions.copy()
        driver = sessions.get(self._drive.gate.driver or 0) or next(iter(sessions.values()), None)
        return None if driver is None or driver.drawn is None else driver.drawn[1]

    def needs_views(self) -> bool:
        """Return whether there is a page that does not render the virtual space by itself. Any thread may call this."""
        return any(session.drawn is None for session in self.sessions.copy().values())

    # ---- connections ------------------------------------------------------------------------

    async def serve(self, request: web.Request, may_drive: bool, cookie: str) -> web.StreamResponse:
        """Serve a page's WebSocket until it closes.

        Args:
            request: the upgrade request, whose sign-in and origin have been checked.
            may_drive: True if the sign-in permits more than to watch and stop.
            cookie: cookie of the sign-in; empty without a sign-in, or for a sign-in by token.
        """
        places = self._config.max_clients if may_drive else max(1, self._config.max_clients - RESERVED_FOR_DRIVERS)
        if len(self.sessions) >= places:
            raise web.HTTPServiceUnavailable(text=f"too many pages: {len(self.sessions)} are connected\n")
        assert request.transport is not None
        connection = request.transport.get_protocol()
        assert isinstance(connection, LimitedConnection)
        # Without autoping the reader receives the protocol's pings too, so that the message limit covers them.
        socket = web.WebSocketResponse(max_msg_size=MAX_CLIENT_MESSAGE, compress=False, timeout=CLOSE_S, autoping=False)
        limit = self._config.max_messages_per_s
        # A new connection has no delayed messages, and a client must not gain a new burst by reconnecting.
        bucket = TokenBucket(limit, limit * BURST_S, limit * FIRST_S)
        session = PageSession(self._next_number, socket, connection, bucket, may_drive, cookie)
        self._next_number += 1
        self.sessions[session.number] = session  # before the first await, so that the place is taken
        if len(self.sessions) == 1:
            self._backend.on_watched(True)
        sender: asyncio.Task[None] | None = None
        try:
            await socket.prepare(request)  # raises if the request is not a WebSocket upgrade
            connection.keep(lambda: self._end_flood(session))
            self._greet(session)
            sender = asyncio.create_task(session.send_forever())
            await self._read_forever(session)
        finally:
            self._drop(session)
            if sender is not None:
                sender.cancel()
                with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                    await sender
            if session.closing is not None:
                await asyncio.wait({session.closing})
        return socket

    async def close(self) -> None:
        """Close the WebSockets of all pages."""
        sessions = list(self.sessions.values())
        for session in sessions:
            self._end(session, WSCloseCode.GOING_AWAY, "console shuts down")
        await asyncio.gather(*(session.closing for session in sessions if session.closing is not None))

    def end_signed_out(self) -> None:
        """End the sessions whose sign-in has ended: signed out, expired or displaced by newer sign-ins."""
        now = time.monotonic()
        for session in list(self.sessions.values()):
            if self._access.required and session.cookie and self._access.role_of_session(session.cookie, now) is None:
                logger.info("client %d closed: its sign-in has ended", session.number)
                self._end(session, WSCloseCode.POLICY_VIOLATION, "signed out")

    async def end_expired(self) -> None:
        """End the sessions whose sign-in has expired, for ever; a timer for each sign-in could fill the memory."""
        while self._access.required:
            await asyncio.sleep(EXPIRY_S)
            self.end_signed_out()

    def _drop(self, session: PageSession) -> None:
        """Remove a session, which loses the lease and receives nothing more."""
        if self.sessions.pop(session.number, None) is None:
            return
        self._drive.gate.forget(session.number, current().steady_s())
        self._drive.settle()
        self._send_session()
        if not self.sessions:
            self._backend.on_watched(False)

    def _end(self, session: PageSession, code: WSCloseCode, reason: str) -> None:
        """Drop a session at once, then close its socket even if the client does not respond."""
        self._drop(session)
        if session.closing is None:
            session.closing = asyncio.create_task(_close(session, code, reason))

    def _end_flood(self, session: PageSession) -> None:
        """End a session that sends more than a page would."""
        logger.warning("client %d closed: it sends too many messages", session.number)
        session.connection.mute()
        self._end(session, WSCloseCode.POLICY_VIOLATION, "too many messages")

    def _greet(self, session: PageSession) -> None:
        """Send a new page everything that the other pages have received."""
        drive = self._config.drive
        session.reply(
            {
                "type": "hello",
                "max_linear": drive.max_linear_mps,
                "max_angular": drive.max_angular_rps,
                "may_drive": session.may_drive,
                "page": self.page,
            }
        )
        for key, text in self._texts.items():
            session.put_text(key, text)
        for kind, frame in self._frames.items():
            session.put_frame(kind, frame)
        session.set_foreground(self._foreground, 1.0 / self._config.background_picture_hz)
        self._send_session()

    def _send_session(self, only: PageSession | None = None) -> None:
        """Send the state of the lease to all pages, or to one page."""
        for session in list(self.sessions.values()) if only is None else [only]:
            message = {
                "type": "session",
                "driver": self._drive.role_of(session.number),
                "door": self._drive.door(self.sessions),
                "clients": len(self.sessions),
                "estop": self._drive.gate.estop,
            }
            session.put_text("session", json.dumps(message))

    # ---- from the pages ---------------------------------------------------------------------

    async def _read_forever(self, session: PageSession) -> None:
        limit = self._config.max_messages_per_s
        while session.number in self.sessions:
            try:
                message = await session.socket.receive(timeout=SILENT_CLIENT_S)
            except TimeoutError:
                self._end(session, WSCloseCode.POLICY_VIOLATION, "silent")
                return
            if session.number not in self.sessions:  # the session has ended in the meantime
                return
            # A watcher sends no commands, only pings and look directions.
            session.bucket.rate = limit if session.number == self._drive.gate.driver else limit * WATCHER_SHARE
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
                self._end_flood(session)
            elif session.chokes:
                session.connection.mute()
                self._end(session, WSCloseCode.POLICY_VIOLATION, "does not read its answers")
            await asyncio.sleep(0)  # one message per turn, so that clients take turns

    def _take(self, session: PageSession, text: str, now: float, *, only_a_stop: bool) -> None:
        """Handle one message. An emergency stop is handled even above the message limit."""
        self._drive.look(now)
        try:
            message = parse_text(text)
            if not only_a_stop or message["type"] == "estop":
                self.handle(session, message, now)
        except PageProtocolError as error:
            logger.warning("client %d: %s", session.number, error)
            session.reply({"type": "error", "text": str(error)})

    def handle(self, session: PageSession, message: dict[str, Any], now: float) -> None:
        """Handle a page's message at a steady time. Raise PageProtocolError if the message is wrong."""
        kind = message["type"]
        handler = {
            "ping": self._on_ping,
            "drive": self._on_drive,
            "lease": self._on_lease,
            "yield": self._on_yield,
            "estop": self._on_estop,
            "estop_release": self._on_estop_release,
            "look": self._on_look,
            "record": self._on_recorder,
            "snapshot": self._on_recorder,
            "bookmark": self._on_recorder,
            "ack": self._on_ack,
            "drawn": self._on_drawn,
        }.get(kind)
        if handler is None:
            raise PageProtocolError(f"unknown message type {kind!r:.40}")
        if kind == "ping":
            session.away = flag(message, "away", False)
        # A hidden page keeps acknowledging images, so acknowledgements do not show that an operator is present.
        if self._drive.gate.touch(session.number, now, away=session.away):
            self._drive.settle()
        handler(session, message, now)

    def _on_ping(self, session: PageSession, message: dict[str, Any], now: float) -> None:
        age_s, factor = self._drive.gate.last_age_s, current().factor
        session.reply(
            {
                "type": "pong",
                "client_ms": number(message, "client_ms"),
                "server_ms": now_ms(),
                "command_age_ms": None if age_s is None else max(age_s, 0.0) * 1000.0 / factor,
                "command_hz": round(self._drive.gate.rate_hz(now) * factor),
            }
        )

    def _on_drive(self, session: PageSession, message: dict[str, Any], now: float) -> None:
        age_s = (now_ms() - number(message, "time_ms")) / 1000.0 * current().factor
        linear, angular = number(message, "linear"), number(message, "angular")
        verdict = self._drive.command(session.number, whole(message, "seq"), age_s, linear, angular, now)
        # Zero needs no permission and is harmless out of order, so only refused motion is reported.
        if verdict is not Verdict.ACCEPTED and (linear, angular) != (0.0, 0.0):
            _refuse(session, verdict.name.lower(), verdict.value)

    def _on_lease(self, session: PageSession, message: dict[str, Any], now: float) -> None:
        take = flag(message, "take", False)
        if _may_drive(session):
            self._drive.gate.request(session.number, now, take=take)
            self._drive.settle()
            self._send_session(session)

    def _on_yield(self, session: PageSession, message: dict[str, Any], now: float) -> None:
        self._drive.gate.leave(session.number, now)
        self._drive.settle()
        self._send_session(session)

    def _on_estop(self, session: PageSession, message: dict[str, Any], now: float) -> None:
        self._drive.stop_robot(f"client {session.number}")

    def _on_estop_release(self, session: PageSession, message: dict[str, Any], now: float) -> None:
        if not self._drive.release_estop(session.number):
            _refuse(session, "not_driver", Verdict.RELEASE.value)

    def _on_look(self, session: PageSession, message: dict[str, Any], now: float) -> None:
        look = Look(
            yaw=number(message, "yaw", -6.3, 6.3),
            pitch=number(message, "pitch", -1.6, 1.6),
            hfov=number(message, "hfov", 0.01, MAX_FOV_RAD),
            vfov=number(message, "vfov", 0.01, MAX_FOV_RAD),
        )
        # Views follow the driver, or any page while nobody drives.
        if self._drive.gate.driver in (session.number, None):
            self._backend.on_look(look)

    def _on_recorder(self, session: PageSession, message: dict[str, Any], now: float) -> None:
        on = flag(message, "on", None if message["type"] == "record" else False)
        if _may_drive(session):
            self._backend.on_recorder(message["type"], on)

    def _on_ack(self, session: PageSession, message: dict[str, Any], now: float) -> None:
        try:
            kind = FrameKind(whole(message, "kind"))
        except ValueError as error:
            raise PageProtocolError(f"ack.kind: {error}") from None
        if session.acknowledge(kind, whole(message, "seq"), flag(message, "loaded", True)):
            session.bucket.give_back()  # acknowledgements are already limited by the server's frames

    def _on_drawn(self, session: PageSession, message: dict[str, Any], now: float) -> None:
        version, state_ms = whole(message, "version"), number(message, "state_ms", 0.0, now_ms())
        before = self.drawn_ms()
        if version == 0:
            session.drawn = None
        else:
            current_version = time.monotonic() - self._versions.get(version, float("-inf")) < SUPERSEDED_S
            # No new state counts as shown with outdated layers, so that the view ages until it is stale.
            shown_ms = state_ms if current_version else 0.0 if session.drawn is None else session.drawn[1]
            session.drawn = version, shown_ms
        if self.drawn_ms() != before:
            self._backend.on_drawn()


def _refuse(session: PageSession, reason: str, text: str) -> None:
    session.reply({"type": "refused", "reason": reason, "text": text})


def _may_drive(session: PageSession) -> bool:
    """Return whether the sign-in permits more than to watch and stop; if not, send a refusal."""
    if not session.may_drive:
        _refuse(session, "watch_only", "this sign-in may only watch")
    return session.may_drive


async def _close(session: PageSession, code: WSCloseCode, reason: str) -> None:
    """Close a socket, or cut it if the client accepts no closing frame."""
    try:
        async with asyncio.timeout(2 * CLOSE_S):
            await session.socket.close(code=code, message=reason.encode())
    except (TimeoutError, ConnectionError, RuntimeError) as error:
        logger.debug("client %d accepted no closing frame: %s", session.number, error)
    finally:
        session.connection.abort()
