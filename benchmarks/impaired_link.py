"""Simulated bad network in user space: a TCP proxy with delay, jitter, limited rate, stalls and outages.

It acts on the byte stream. TCP users see a lost packet as a stall: everything behind it waits.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import random
import socket
import threading
from dataclasses import dataclass

from instant_ic.util.closing import Closing

STALL_S = 0.2
"""Duration of a stall, as of a TCP retransmission."""
QUEUE_SEGMENTS, SEGMENT_BYTES = 64, 4096
"""Router queue of each direction; when it is full the sender is blocked."""


@dataclass(frozen=True)
class Impairment:
    """Impairment of each direction.

    Attributes:
        delay_s: one-way delay.
        jitter_s: largest deviation from the delay, uniform in ±; the order of bytes is kept.
        rate_bytes_s: largest rate; 0 is unlimited.
        stall_share: share of segments delayed by ``STALL_S``, like a segment whose packet was lost.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    rate_bytes_s: float = 0.0
    stall_share: float = 0.0


class ImpairedLink(Closing):
    """Listens on a port of 127.0.0.1 (0: a free one) and forwards to ``target`` (host, port), on its own thread."""

    def __init__(self, target: tuple[str, int], impairment: Impairment | None = None, port: int = 0) -> None:
        self.target, self.impairment = target, impairment or Impairment()
        self._random, self._cut = random.Random(1), False
        self._writers: set[asyncio.StreamWriter] = set()
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port: int = self._listener.getsockname()[1]
        self._loop, self._ended = asyncio.new_event_loop(), asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="impaired link", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._listen())

    async def _listen(self) -> None:
        server = await asyncio.start_server(self._serve, sock=self._listener)
        await self._ended.wait()
        server.close()

    def close(self) -> None:
        """End the link and every connection."""
        self.mend()
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(5)

    def cut(self) -> None:
        """Simulate an outage until :meth:`mend`: bytes are dropped silently, and new connections are closed."""
        self._cut = True

    def mend(self) -> None:
        """End the outage; earlier connections are closed, as after a long outage."""

        def drop() -> None:
            for writer in self._writers:
                writer.transport.abort()
            self._cut = False

        self._loop.call_soon_threadsafe(drop)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        ends = [writer]
        with contextlib.suppress(OSError, asyncio.CancelledError):
            if not self._cut:
                far_reader, far_writer = await asyncio.open_connection(*self.target)
                ends.append(far_writer)
                self._writers.update(ends)
                await asyncio.gather(self._forward(reader, far_writer), self._forward(far_reader, writer))
        while self._cut and len(ends) > 1:  # during an outage, neither end sees the other one close
            await asyncio.sleep(0.02)
        self._writers.difference_update(ends)
        for end in ends:
            end.close()

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Forward one direction of a connection until its sender ends it."""
        waiting: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(QUEUE_SEGMENTS)
        sender = asyncio.create_task(self._send(waiting, writer))
        bad, free_s, last_s, data = self.impairment, 0.0, 0.0, b"-"
        try:
            while data:
                data = await reader.read(SEGMENT_BYTES)
                free_s = max(self._loop.time(), free_s)
                free_s += len(data) / bad.rate_bytes_s if bad.rate_bytes_s else 0.0
                due = free_s + bad.delay_s + self._random.uniform(-bad.jitter_s, bad.jitter_s)
                last_s = max(last_s, due + STALL_S * (self._random.random() < bad.stall_share))
                await waiting.put((last_s, data))
            await sender
        finally:
            sender.cancel()

    async def _send(self, waiting: asyncio.Queue[tuple[float, bytes]], writer: asyncio.StreamWriter) -> None:
        data = b"-"
        while data:
            due, data = await waiting.get()
            await asyncio.sleep(due - self._loop.time())
            if not self._cut:
                writer.write(data) if data else writer.write_eof()
                await writer.drain()


def main() -> None:
    """Run a link until it is stopped: ``python benchmarks/impaired_link.py 7451 10.0.0.1 7450``."""
    parser = argparse.ArgumentParser(description="TCP proxy that behaves as a bad network.")
    parser.add_argument("port", type=int, help="port of 127.0.0.1 to listen on")
    parser.add_argument("target_host")
    parser.add_argument("target_port", type=int)
    parser.add_argument("--delay-ms", type=float, default=0.0, help="one way")
    parser.add_argument("--jitter-ms", type=float, default=0.0, help="added, uniform in plus and minus")
    parser.add_argument("--rate-mbit", type=float, default=0.0, help="0: unlimited")
    parser.add_argument("--stall-share", type=float, default=0.0, help="share of segments that wait, as after a loss")
    args = parser.parse_args()
    impairment = Impairment(args.delay_ms / 1e3, args.jitter_ms / 1e3, args.rate_mbit * 1e6 / 8, args.stall_share)
    with ImpairedLink((args.target_host, args.target_port), impairment, port=args.port):
        threading.Event().wait()


if __name__ == "__main__":
    main()
