"""Console client in Python: drives through the page's WebSocket, for system tests and scripts."""

from __future__ import annotations

import asyncio
import math
import ssl
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self
from urllib.parse import parse_qs, urlsplit

import aiohttp

from instant_ic.console.protocol import FrameKind, PageFrame, Parts, decode_frame, parse_text


class ConsoleClient:
    """An operator without a browser.

    Example::

        async with ConsoleClient("http://127.0.0.1:8080/") as console:
            await console.acquire()
            console.drive(0.3, 0.0)
            await console.wait_for(lambda c: c.mode == "virtual", timeout_s=60)

    ``state``, ``plan``, ``health``, ``session`` and ``hello`` are the newest messages of these types, and
    ``frames[FrameKind.PANORAMA]`` is the newest panorama. ``socket`` is the WebSocket, and ``beats`` the task that
    sends pings and repeats the command.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8080/",
        *,
        acknowledge: bool = True,
        token: str = "",
        ca_file: str | Path | None = None,
    ) -> None:
        """Create the client; :meth:`connect` connects it.

        Args:
            url: the page's address; its ``?token=`` is used if ``token`` is empty.
            acknowledge: acknowledge frames; without acknowledgement the server sends no further frames.
            token: sign-in token, if the server requires one.
            ca_file: for ``https``, PEM file of the authority's or the server's certificate.
        """
        parts = urlsplit(url)
        self.url = parts._replace(query="").geturl()
        self._token = token or parse_qs(parts.query).get("token", [""])[0]
        self._ssl = ssl.create_default_context(cafile=ca_file) if parts.scheme == "https" else True
        self.acknowledge = acknowledge
        self.messages: dict[str, dict[str, Any]] = {}
        self.frames: dict[FrameKind, PageFrame] = {}
        self._parts = Parts()
        self.frame_counts: dict[FrameKind, int] = dict.fromkeys(FrameKind, 0)
        self.refused: list[str] = []
        self.errors: list[str] = []
        self.round_trip_s: float | None = None
        self._offset_ms = math.nan  # server's clock minus this clock; known after the first pong
        self._sequence = 0
        self._command = (0.0, 0.0)
        self._http: aiohttp.ClientSession | None = None
        self.socket: aiohttp.ClientWebSocketResponse | None = None
        self._beats: asyncio.Task[None] | None = None
        self._reader: asyncio.Task[None] | None = None
        self._news = asyncio.Condition()

    async def __aenter__(self) -> Self:
        await self.connect()
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    async def connect(self, timeout_s: float = 10.0) -> None:
        """Connect, and wait until the clock offset to the server is known.

        Raises:
            aiohttp.WSServerHandshakeError: the server refuses the connection; 401 if the token is missing or wrong.
            TimeoutError: the server does not answer.
        """
        self._http = aiohttp.ClientSession()
        parts = urlsplit(self.url)
        origin = f"{parts.scheme}://{parts.netloc}"
        headers = {"Origin": origin} | ({"Authorization": f"Bearer {self._token}"} if self._token else {})
        try:
            async with asyncio.timeout(timeout_s):
                self.socket = await self._http.ws_connect(
                    f"{origin}/ws", headers=headers, ssl=self._ssl, max_msg_size=32 << 20
                )
        except BaseException:
            await self._http.close()
            raise
        self._reader, self._beats = asyncio.create_task(self._read()), asyncio.create_task(self._beat())
        await self.wait_for(lambda c: {"hello", "pong"} <= c.messages.keys(), timeout_s)

    def silence(self) -> None:
        """Send no heartbeats and commands any more, as a page whose script hangs."""
        if self._beats is not None:
            self._beats.cancel()

    async def close(self) -> None:
        """Stop and disconnect."""
        tasks = [task for task in (self._reader, self._beats) if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self.socket is not None:
            await self.socket.close()
        if self._http is not None:
            await self._http.close()

    @property
    def state(self) -> dict[str, Any]:
        """Newest ``state`` message; empty before the first."""
        return self.messages.get("state", {})

    @property
    def session(self) -> dict[str, Any]:
        """Newest ``session`` message; empty before the first."""
        return self.messages.get("session", {})

    @property
    def mode(self) -> str | None:
        """Mode of the newest ``state`` message; None before the first."""
        return self.state.get("mode")

    @property
    def closed(self) -> bool:
        """True if the socket is closed."""
        return self.socket is None or self.socket.closed

    async def acquire(self, *, take: bool = False, timeout_s: float = 5.0) -> None:
        """Become the driver. Raise TimeoutError if another client keeps the lease."""
        await self.send({"type": "lease", "take": take})
        await self.wait_for(lambda c: c.session.get("driver") == "you", timeout_s)

    def drive(self, linear: float, angular: float) -> None:
        """Send a command (m/s, rad/s) at 20 Hz until :meth:`stop`."""
        self._command = (linear, angular)

    async def stop(self) -> None:
        """Send one zero command at once, and no command after it."""
        self._command = (0.0, 0.0)
        await self.send_drive(0.0, 0.0)

    async def estop(self) -> None:
        """Set the emergency stop."""
        await self.send({"type": "estop"})

    async def release_estop(self) -> None:
        """Release the emergency stop (driver only)."""
        await self.send({"type": "estop_release"})

    async def look(self, yaw: float, pitch: float = 0.0, hfov: float = 1.57, vfov: float = 1.02) -> None:
        """Set the look direction in rad relative to the robot's heading; left and up are positive."""
        await self.send({"type": "look", "yaw": yaw, "pitch": pitch, "hfov": hfov, "vfov": vfov})

    async def send_drive(self, linear: float, angular: float, *, age_s: float = 0.0) -> None:
        """Send one drive command with a stamp ``age_s`` in the past."""
        self._sequence += 1
        stamp = time.monotonic() * 1000 + self._offset_ms - age_s * 1000
        await self.send(
            {"type": "drive", "seq": self._sequence, "time_ms": stamp, "linear": linear, "angular": angular}
        )

    async def send(self, message: dict[str, Any]) -> None:
        """Send a text message."""
        await self._connected.send_json(message)

    @property
    def _connected(self) -> aiohttp.ClientWebSocketResponse:
        if self.socket is None:
            raise RuntimeError("console client: connect() first")
        return self.socket

    async def wait_for(self, predicate: Callable[[ConsoleClient], object], timeout_s: float = 10.0) -> None:
        """Wait until ``predicate(self)`` is true; it is checked after each message.

        Raises:
            TimeoutError: the condition was not met in time; the message contains the newest state.
            ConnectionError: the server closed the connection.
        """
        try:
            async with asyncio.timeout(timeout_s):
                async with self._news:
                    while not predicate(self):
                        if self.closed:
                            raise ConnectionError(f"console client: {self.url} closed the connection")
                        await self._news.wait()
        except TimeoutError:
            raise TimeoutError(
                f"console client: condition not met within {timeout_s:g} s; state {self.state}, session {self.session}"
            ) from None

    async def _read(self) -> None:
        try:
            async for message in self._connected:
                if message.type is aiohttp.WSMsgType.BINARY:
                    await self._on_frame(decode_frame(message.data))
                elif message.type is aiohttp.WSMsgType.TEXT:
                    self._on_text(parse_text(message.data))
                async with self._news:
                    self._news.notify_all()
        finally:
            async with self._news:
                self._news.notify_all()

    async def _on_frame(self, frame: PageFrame) -> None:
        if frame.kind is FrameKind.PART:
            await self.send({"type": "ack", "kind": int(frame.kind), "seq": frame.sequence})
            if (whole := self._parts.take(frame)) is None:
                return
            frame = whole
        self.frames[frame.kind] = frame
        self.frame_counts[frame.kind] += 1
        if self.acknowledge:
            await self.send({"type": "ack", "kind": int(frame.kind), "seq": frame.sequence})

    def _on_text(self, message: dict[str, Any]) -> None:
        kind = message["type"]
        self.messages[kind] = message
        if kind == "pong":
            now_ms = time.monotonic() * 1000
            round_trip_ms = now_ms - message["client_ms"]
            self.round_trip_s = round_trip_ms / 1000
            self._offset_ms = message["server_ms"] + round_trip_ms / 2 - now_ms
        elif kind == "refused":
            self.refused.append(message["reason"])
        elif kind == "error":
            self.errors.append(message["text"])

    async def _beat(self) -> None:
        while not self.closed:
            # Well below the server's drive.beat_timeout_s.
            await self.send({"type": "ping", "client_ms": time.monotonic() * 1000})
            if self._command != (0.0, 0.0) and "pong" in self.messages:
                await self.send_drive(*self._command)
            await asyncio.sleep(0.05)
