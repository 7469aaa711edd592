"""Simulated bad network in user space: a TCP proxy with delay, jitter, limited rate, stalls and outages.

It acts on the byte stream. TCP users see a lost packet as a stall: everything behind it waits.
"""

from __future__ import annotations

import random
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Self


@dataclass(frozen=True)
class Impairment:
    """Impairment of each direction.

    Attributes:
        delay_s: one way.
        jitter_s: added to the delay, uniform in ±; the order of bytes is kept.
        rate_bytes_s: 0 is unlimited.
        stall_share: share of segments delayed by ``STALL_S``, like a segment whose packet was lost.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    rate_bytes_s: float = 0.0
    stall_share: float = 0.0


STALL_S = 0.2
"""Duration of a retransmission."""
_QUEUE_BYTES = 256 * 1024
"""Router queue; when it is full the sender is blocked."""
_SEGMENT = 4096


class _Way:
    """One direction of one connection."""

    def __init__(self, source: socket.socket, sink: socket.socket) -> None:
        self.source, self.sink = source, sink
        self.queue: deque[tuple[float, bytes]] = deque()
        self.queued = 0
        self.free_s = self.last_s = 0.0
        self.ended = False


class ImpairedLink:
    """Context manager that listens on a port of 127.0.0.1 (0: a free one) and forwards to ``target`` (host, port)."""

    def __init__(self, target: tuple[str, int], impairment: Impairment | None = None, port: int = 0) -> None:
        self.target = target
        self.impairment = impairment or Impairment()
        self._random = random.Random(1)
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port: int = self._listener.getsockname()[1]
        self._ways: list[_Way] = []
        self._lock = threading.Lock()
        self._cut = False
        self._stalled_until = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="impaired link", daemon=True)

    def __enter__(self) -> Self:
        """Start the link."""
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the link and close every connection."""
        self._stop.set()
        self._thread.join(5)
        self._listener.close()
        self._drop_all()

    def stall(self, seconds: float) -> None:
        """Stop forwarding for a while; no byte is lost."""
        self._stalled_until = time.monotonic() + seconds

    def cut(self) -> None:
        """Simulate an outage until :meth:`mend`: bytes are dropped silently, and new connections get no answer."""
        self._cut = True

    def mend(self) -> None:
        """End the outage; earlier connections stay dead, as after a long outage."""
        self._drop_all()
        self._cut = False

    def _drop_all(self) -> None:
        with self._lock:
            for way in self._ways:
                way.source.close()
            self._ways.clear()

    def _accept(self) -> None:
        near, _ = self._listener.accept()
        if self._cut:
            near.close()
            return
        try:
            far = socket.create_connection(self.target, timeout=0.5)  # blocks all other connections meanwhile
        except OSError:
            near.close()
            return
        for each in (near, far):
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            each.setblocking(False)
        with self._lock:
            self._ways += [_Way(near, far), _Way(far, near)]

    def _run(self) -> None:
        selector = selectors.DefaultSelector()
        selector.register(self._listener, selectors.EVENT_READ)
        while not self._stop.is_set():
            with self._lock:
                ways = list(self._ways)
            wanted = {way.source: way for way in ways if way.queued < _QUEUE_BYTES and not way.ended}
            for key in list(selector.get_map().values()):
                if key.fileobj is not self._listener and key.fileobj not in wanted:
                    selector.unregister(key.fileobj)
            for source in wanted:
                if source.fileno() >= 0 and source not in selector.get_map():
                    selector.register(source, selectors.EVENT_READ)
            now = time.monotonic()
            dues = [way.queue[0][0] for way in ways if way.queue]
            events = selector.select(max(0.0, min(0.02, min(dues, default=now + 1) - now)))
            for key, _ in events:
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._read(wanted[key.fileobj])  # type: ignore[index]
            for way in ways:
                self._write(way)
        selector.close()

    def _read(self, way: _Way) -> None:
        try:
            data = way.source.recv(_SEGMENT)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if self._cut:
            return
        if not data:
            way.ended = True
            return
        bad, now = self.impairment, time.monotonic()
        begin = max(now, way.free_s)
        way.free_s = begin + (len(data) / bad.rate_bytes_s if bad.rate_bytes_s else 0.0)
        due = way.free_s + bad.delay_s + self._random.uniform(-bad.jitter_s, bad.jitter_s)
        if self._random.random() < bad.stall_share:
            due += STALL_S
        way.last_s = max(way.last_s, due)
        way.queue.append((way.last_s, data))
        way.queued += len(data)

    def _write(self, way: _Way) -> None:
        now = time.monotonic()
        if self._cut:
            way.queue.clear()
            way.queued = 0
            return
        try:
            while way.queue and way.queue[0][0] <= now and now >= self._stalled_until:
                due, data = way.queue[0]
                sent = way.sink.send(data)
                way.queued -= sent
                if sent < len(data):
                    way.queue[0] = (due, data[sent:])
                    return
                way.queue.popleft()
            if way.ended and not way.queue:
                way.sink.close()
        except BlockingIOError:
            return
        except OSError:
            way.ended = True
            way.queue.clear()
        if way.ended and not way.queue:
            with self._lock:
                self._ways = [w for w in self._ways if w.source not in (way.source, way.sink)]
            way.source.close()
            way.sink.close()


def main(argv: Sequence[str] | None = None) -> int:
    """Run a link until it is stopped: ``python benchmarks/impaired_link.py 7451 10.0.0.1 7450``."""
    import argparse

    parser = argparse.ArgumentParser(description="TCP proxy that behaves as a bad network.")
    parser.add_argument("port", type=int, help="port of 127.0.0.1 to listen on")
    parser.add_argument("target_host")
    parser.add_argument("target_port", type=int)
    parser.add_argument("--delay-ms", type=float, default=0.0, help="one way")
    parser.add_argument("--jitter-ms", type=float, default=0.0, help="added, uniform in plus and minus")
    parser.add_argument("--rate-mbit", type=float, default=0.0, help="0: unlimited")
    parser.add_argument("--stall-share", type=float, default=0.0, help="share of segments that wait, as after a loss")
    args = parser.parse_args(argv)
    impairment = Impairment(args.delay_ms / 1e3, args.jitter_ms / 1e3, args.rate_mbit * 1e6 / 8, args.stall_share)
    with ImpairedLink((args.target_host, args.target_port), impairment, port=args.port):
        threading.Event().wait()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
