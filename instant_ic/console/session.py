"""Send queue of one page. It keeps only the newest message of each kind, so that a slow page does not delay others."""

from __future__ import annotations

import asyncio
import json
import time
from collections import Counter, deque
from dataclasses import dataclass, field, replace
from typing import Any

from aiohttp import web

from instant_ic.console.connections import LimitedConnection
from instant_ic.console.layers import PageLayers
from instant_ic.console.protocol import FrameKind, PageFrame, PendingFrame, encode_frame
from instant_ic.util.web_access import TokenBucket

MAX_REPLIES = 256  # pending replies, about one second of a page's traffic; a client with more does not read
# Smallest first, because an image must not delay the state, nor a map an image.
FRAME_ORDER = (FrameKind.VIEW, FrameKind.PANORAMA, FrameKind.LAYERS, FrameKind.MAP, FrameKind.COSTMAP)
PART_BYTES = 64 * 1024  # larger frames of layers are sent in pieces, which delay pongs less on a slow link


@dataclass(eq=False)
class PageSession:
    """Send queue of one client. Used on the server's loop only.

    Replies are sent in order. A text replaces a pending text of the same key, and a frame a pending frame of the
    same kind. The next frame of a kind is sent once the client has acknowledged the last one.

    Attributes:
        bucket: limits the client's messages.
        cookie: cookie of the sign-in, with which the session ends; empty without a sign-in, or for a sign-in by token.
        closing: closing handshake, once the session has ended.
        chokes: true if too many replies are pending, which means that the client does not read.
        away: true if the page is hidden or its operator is typing.
        drawn: version of the layers that the page renders by itself, and time of the newest state that it has shown
            (server's clock, ms); None if the page needs rendered views.
    """

    number: int
    socket: web.WebSocketResponse
    connection: LimitedConnection
    bucket: TokenBucket
    may_drive: bool = True
    cookie: str = ""
    closing: asyncio.Task[None] | None = None
    chokes: bool = False
    away: bool = False
    drawn: tuple[int, float] | None = None
    _held: frozenset[str] = frozenset()  # digests of the layers that the page holds
    _offered: frozenset[str] = frozenset()  # digests of the layers sent last
    _replies: deque[str] = field(default_factory=deque)
    _texts: dict[str, str] = field(default_factory=dict)
    _frames: dict[FrameKind, PendingFrame | PageLayers] = field(default_factory=dict)
    _sent_frames: Counter[FrameKind] = field(default_factory=Counter)
    _unacknowledged: dict[FrameKind, int] = field(default_factory=dict)
    _parts: deque[PageFrame] = field(default_factory=deque)  # remaining parts of the layers being sent, not numbered
    _last_sent: dict[FrameKind, float] = field(default_factory=dict)
    _foreground: frozenset[FrameKind] = frozenset({FrameKind.PANORAMA})
    _background_period_s: float = 0.0
    _wake: asyncio.Event = field(default_factory=asyncio.Event)

    def reply(self, message: dict[str, Any]) -> None:
        """Queue an answer that must not be lost. If the queue is full, set ``chokes``, and the session must end."""
        if len(self._replies) >= MAX_REPLIES:
            self.chokes = True
            return
        self._replies.append(json.dumps(message, separators=(",", ":"), allow_nan=False))
        self._wake.set()

    def put_text(self, key: str, text: str) -> None:
        """Queue ``text``. It replaces a pending text of the same key."""
        self._texts[key] = text
        self._wake.set()

    def put_frame(self, kind: FrameKind, frame: PendingFrame | PageLayers) -> None:
        """Queue a frame. It replaces a pending frame of the same kind."""
        self._frames[kind] = frame
        self._wake.set()

    def set_foreground(self, kinds: frozenset[FrameKind], background_period_s: float) -> None:
        """Limit images of all other kinds to one every ``background_period_s``."""
        self._foreground = kinds
        self._background_period_s = background_period_s
        self._wake.set()

    def acknowledge(self, kind: FrameKind, sequence: int, loaded: bool = True) -> bool:
        """Record that the client has shown frame ``sequence``; return False if it was not sent, or acknowledged before.

        ``loaded`` means that the client holds the frame's layers from now on. Otherwise the next ones are sent in full.
        """
        if self._unacknowledged.get(kind) != sequence:
            return False
        if kind is FrameKind.LAYERS:
            self._held = self._offered if loaded else frozenset()
        del self._unacknowledged[kind]
        self._wake.set()
        return True

    async def send_forever(self) -> None:
        """Send pending messages until the socket closes."""
        while not self.socket.closed:
            await self._wake.wait()
            self._wake.clear()
            while (item := self._next(time.monotonic())) is not None:
                if isinstance(item, str):
                    await self.socket.send_str(item)
                else:
                    await self.socket.send_bytes(item)

    def _next(self, now: float) -> str | bytes | None:
        if self._replies:
            return self._replies.popleft()
        if self._texts:
            return self._texts.pop(next(iter(self._texts)))
        for kind in FRAME_ORDER:
            if kind is FrameKind.LAYERS and self._parts and FrameKind.PART not in self._unacknowledged:
                return self._next_part()
            if kind not in self._frames or kind in self._unacknowledged or self._held_back(kind, now):
                continue
            pending = self._frames.pop(kind)
            self._sent_frames[kind] += 1
            self._unacknowledged[kind] = self._sent_frames[kind]
            self._last_sent[kind] = now
            if isinstance(pending, PageLayers):
                self._offered = pending.digests
            data = encode_frame(PageFrame(kind, self._sent_frames[kind], *pending.frame(self._held)))
            if kind is not FrameKind.LAYERS or len(data) <= PART_BYTES:
                return data
            self._parts.extend(
                PageFrame(FrameKind.PART, 0, {"start": start, "size": len(data)}, data[start : start + PART_BYTES])
                for start in range(0, len(data), PART_BYTES)
            )
            return self._next_part()
        return None

    def _next_part(self) -> bytes:
        part, sequence = self._parts.popleft(), self._sent_frames[FrameKind.PART] + 1
        self._sent_frames[FrameKind.PART] = self._unacknowledged[FrameKind.PART] = sequence
        return encode_frame(replace(part, sequence=sequence))

    def _held_back(self, kind: FrameKind, now: float) -> bool:
        if kind in self._foreground or kind not in (FrameKind.PANORAMA, FrameKind.VIEW):
            return False
        return now - self._last_sent.get(kind, float("-inf")) < self._background_period_s
