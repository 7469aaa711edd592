"""Publisher of one topic: a Unix socket that readers connect to, and shared memory for large messages.

A message goes from the publishing thread straight into each reader's socket, without another thread or process in
between. A slow reader gets what its QoS asks for: the newest message, or a queue.
"""

from __future__ import annotations

import functools
import logging
import os
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from instant_ic.bus import registry
from instant_ic.bus.frame import (
    BUFFER_ID,
    DATA,
    GREETING,
    HEADER,
    MAGIC,
    MOST_BYTES,
    RETIRED,
    SHARED,
    SHARED_BODY,
    VERSION,
    Hello,
    type_digest,
)
from instant_ic.bus.qos import QoS
from instant_ic.bus.shm import BufferPool, SharedBuffer
from instant_ic.bus.transport import Payload, PublisherStats, TransportError

if TYPE_CHECKING:
    from instant_ic.bus.local_transport import LocalTransport

SHARED_FROM_BYTES = 96 << 10
"""Messages of this size and more go through shared memory. Below it, copying through a socket costs less than the
bookkeeping (``benchmarks/bus.py --only inline shared``)."""

BUFFERS_A_READER = 8
"""How many buffers one reader can hold at a time; see also :data:`~.local_subscription.VIEWS_HELD`."""

_SPARE_BUFFERS = 3
_SOCKET_BYTES = 1 << 20
_QUEUE_BYTES = 128 << 20
_LINGER_S = 0.2  # lets a last zero command leave when a node shuts down
_MEMORY_RETRY_S = 5.0
_DOOR_S = 0.05
_SCATTER_FROM_BYTES = 8192
_READ_ONLY = select.EPOLLIN | select.EPOLLRDHUP

log = logging.getLogger(__name__)


class _Outgoing(NamedTuple):
    """A message on its way to readers: bytes, or a shared buffer."""

    sequence: int
    publish_ns: int
    size: int
    body: bytes | memoryview = b""
    buffer: SharedBuffer | None = None

    def kept(self) -> _Outgoing:
        """The same message, independent of the caller's memory."""
        if self.buffer is not None or isinstance(self.body, bytes):
            return self
        return _Outgoing(self.sequence, self.publish_ns, self.size, bytes(self.body))

    def inline(self) -> _Outgoing:
        """The same message as bytes, without a shared buffer."""
        if self.buffer is None:
            return self
        return _Outgoing(self.sequence, self.publish_ns, self.size, bytes(self.buffer.view(self.size)))


class _Reader:
    """One connected reader. Every call requires the publisher's lock."""

    def __init__(self, connection: socket.socket, rewatch: Callable[[_Reader], None]) -> None:
        self.socket = connection
        self._rewatch = rewatch
        self.depth = 0  # 0: it has not sent its greeting yet
        self.shared = True
        self.gone = False
        self.deaf = False  # no longer reads, but may still hold buffers
        self.prompt = False  # has received everything offered: small messages may go straight into its socket
        self.events = _READ_ONLY
        self._send = connection.send
        self._flying: dict[int, SharedBuffer] = {}
        self._known: set[int] = set()
        self._queue: deque[_Outgoing] = deque()
        self._queue_bytes = self._queued_buffers = 0
        self._part: memoryview | None = None  # rest of a frame that was sent only in part
        self._part_fd: int | None = None
        self._skipped = 0
        self._incoming = b""

    def greet(self) -> bool:
        """Read the reader's greeting; True once it is complete.

        Raises:
            ValueError: the greeting is not of this version.
        """
        self._receive()
        if len(self._incoming) < GREETING.size:
            return False
        magic, version, self.shared, depth = GREETING.unpack_from(self._incoming)
        if magic != MAGIC or version != VERSION or not depth:
            raise ValueError(f"a reader of another bus version (expected {VERSION}, it sent {magic!r} {version})")
        self._incoming = self._incoming[GREETING.size :]
        self.depth = depth
        self.prompt = True
        return True

    def send_now(self, frame: bytes) -> bool:
        """Send a whole frame to a :attr:`prompt` reader; False when the message must be offered instead."""
        try:
            sent = self._send(frame)
        except BlockingIOError:
            return False
        except OSError:  # EPIPE, ECONNRESET: the reader is gone
            self._end()
            return True
        if sent < len(frame):
            self._part, self.prompt = memoryview(frame)[sent:], False
            self._rewatch(self)
        return True

    def offer(self, message: _Outgoing) -> None:
        """Send a message, or queue it when the reader does not keep up."""
        if self.deaf or self.gone:
            return
        if not self.shared:
            message = message.inline()
        if self._part is None and not self._queue and self._may_fly(message):
            self._start(message)
        else:
            self._enqueue(message)
            if self._part is None:  # buffers may have come back since, and nothing else would notice
                self.flush()

    def flush(self) -> None:
        """Send queued messages as far as the socket and the reader's buffers allow."""
        if self._part is not None:
            self._send_part()
        while self._part is None and self._queue and self._may_fly(self._queue[0]) and not (self.deaf or self.gone):
            self._start(self._pop())
        self.prompt = not (self._part is not None or self._queue or self._skipped or self.deaf or self.gone)

    def release(self) -> None:
        """Take back the buffers that the reader has finished with."""
        if not self._flying:
            return
        self._receive()
        whole = len(self._incoming) // BUFFER_ID.size * BUFFER_ID.size
        for (number,) in BUFFER_ID.iter_unpack(self._incoming[:whole]):
            if (buffer := self._flying.pop(number, None)) is not None:
                buffer.holders.discard(self)
        self._incoming = self._incoming[whole:]

    def retire(self, buffer: SharedBuffer) -> None:
        """Announce to the reader that a buffer will not be used again, so that it can unmap it."""
        if buffer.number in self._known:
            self._known.discard(buffer.number)
            frame = HEADER.pack(RETIRED, 0, BUFFER_ID.size, 0, 0) + BUFFER_ID.pack(buffer.number)
            if self._part is not None:
                self._part = memoryview(bytes(self._part) + frame)
            else:
                self.write(frame)

    def wanted_events(self) -> int:
        """Events that epoll should wait for."""
        if self._part is not None:
            return select.EPOLLRDHUP | select.EPOLLOUT
        return _READ_ONLY if self._queue or not self.depth else select.EPOLLRDHUP

    @property
    def waiting(self) -> bool:
        """Whether anything is still to be sent."""
        return not (self.gone or self.deaf) and (self._part is not None or bool(self._queue))

    @property
    def untaken(self) -> int:
        """Number of queued messages still to be sent; 0 for a newest-only reader, which loses none."""
        return len(self._queue) + (self._part is not None) if self.waiting and self.depth > 1 else 0

    def close(self) -> None:
        """Close the connection and take back all buffers lent to the reader."""
        self.gone, self.prompt = True, False
        for buffer in self._flying.values():
            buffer.holders.discard(self)
        self._flying.clear()
        self._drop_queue()
        self.socket.close()

    def _end(self) -> None:
        """Mark the reader as gone; the buffers it holds come back when its connection closes."""
        self.deaf, self.prompt = True, False
        self._drop_queue()

    def _drop_queue(self) -> None:
        for message in self._queue:
            if message.buffer is not None:
                message.buffer.holders.discard(self)
        self._queue.clear()
        self._queue_bytes = self._queued_buffers = 0
        self._part = None

    def _may_fly(self, message: _Outgoing) -> bool:
        if message.buffer is None or len(self._flying) < BUFFERS_A_READER:
            return True
        self.release()
        return len(self._flying) < BUFFERS_A_READER

    def _enqueue(self, message: _Outgoing) -> None:
        self.prompt = False
        message = message.kept()
        if self.depth > 1 and len(self._flying) + self._queued_buffers >= BUFFERS_A_READER:
            message = message.inline()
        if message.buffer is not None:
            message.buffer.holders.add(self)
            self._queued_buffers += 1
        while self._queue and (len(self._queue) >= self.depth or self._queue_bytes + message.size > _QUEUE_BYTES):
            old = self._pop()
            if old.buffer is not None:
                old.buffer.holders.discard(self)
            if self.depth == 1:  # a newest-only reader: a message it skips is not lost
                self._skipped += 1
        self._queue.append(message)
        self._queue_bytes += message.size

    def _pop(self) -> _Outgoing:
        message = self._queue.popleft()
        self._queue_bytes -= message.size
        self._queued_buffers -= message.buffer is not None
        return message

    def _start(self, message: _Outgoing) -> None:
        skipped, self._skipped = self._skipped, 0
        buffer = message.buffer
        if buffer is None:
            head = HEADER.pack(DATA, skipped, message.size, message.sequence, message.publish_ns)
            if message.size < _SCATTER_FROM_BYTES:
                self.write(head + message.body)
            else:
                self.write(head, message.body)
            return
        new = buffer.number not in self._known
        frame = HEADER.pack(SHARED, skipped, SHARED_BODY.size, message.sequence, message.publish_ns) + SHARED_BODY.pack(
            buffer.number, new, message.size
        )
        buffer.holders.add(self)
        self._flying[buffer.number] = buffer
        self._known.add(buffer.number)
        self.write(frame, fd=buffer.fd if new else None)

    def write(self, head: bytes, body: bytes | memoryview | None = None, fd: int | None = None) -> None:
        """Send a frame; whatever the socket does not accept is kept for :meth:`flush`."""
        try:
            if fd is not None:
                sent = socket.send_fds(self.socket, [head], [fd])
            elif body is None:
                sent = self.socket.send(head)
            else:
                sent = self.socket.sendmsg((head, body))
        except BlockingIOError:
            sent = 0
        except OSError:  # EPIPE, ECONNRESET: the reader is gone
            self._end()
            return
        total = len(head) + (0 if body is None else len(body))
        if sent < total:
            rest = head[sent:] + bytes(body[max(0, sent - len(head)) :] if body is not None else b"")
            self._part, self.prompt = memoryview(rest), False
            self._part_fd = None if sent else fd  # sent with the first byte

    def _send_part(self) -> None:
        assert self._part is not None
        try:
            while self._part:
                if self._part_fd is not None:
                    sent = socket.send_fds(self.socket, [self._part], [self._part_fd])
                    self._part_fd = None
                else:
                    sent = self.socket.send(self._part)
                self._part = self._part[sent:]
            self._part = None
        except BlockingIOError:
            return
        except OSError:
            self._end()

    def _receive(self) -> None:
        try:
            while data := self.socket.recv(4096):
                self._incoming += data
                if len(data) < 4096:
                    return
        except BlockingIOError:
            return
        except OSError:  # epoll reports it too, and the reader is closed then
            self._end()


class LocalPublisher:
    """Publisher of one topic of one node.

    Raises:
        RegistryError: the node already publishes the topic, or the path is too long.
    """

    def __init__(self, transport: LocalTransport, topic: str, type_name: str, qos: QoS) -> None:
        self.topic = topic
        self.type_name = type_name
        self.qos = qos
        self.stats = PublisherStats()
        self._transport = transport
        self._lock = threading.RLock()  # publish may be called from any thread; the bus thread serves the readers
        self._sequence = 0
        self._readers: dict[int, _Reader] = {}
        self._pool = BufferPool()
        self._memory_retry_s = 0.0
        self._last: _Outgoing | None = None
        self._closed = False
        self._told_full = False
        digest = type_digest(type_name)
        self._claim, self._path = registry.claim_socket(transport.run_dir, topic, transport.node)
        identity = os.urandom(8).hex()
        self._hello = Hello(transport.node, topic, type_name, digest, identity).pack()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        try:
            self._listener.bind(str(self._path))
            self._listener.listen(128)
            self._claim.write(
                {
                    "topic": topic,
                    "type": type_name,
                    "qos": qos.name,
                    "node": transport.node,
                    "pid": os.getpid(),
                    "socket": str(self._path),
                    "id": identity,
                    "started_ns": time.time_ns(),
                }
            )
        except registry.RegistryError:
            self._give_up()
            raise
        except OSError as error:
            self._give_up()
            raise registry.RegistryError(f"publisher of {topic} by node {transport.node}: {error}") from error
        transport.watch(self._listener.fileno(), select.EPOLLIN, self._on_listener)

    def _give_up(self) -> None:
        self._listener.close()
        self._path.unlink(missing_ok=True)
        self._claim.release()

    @property
    def subscriber_count(self) -> int:
        """Number of connected readers."""
        return sum(1 for reader in list(self._readers.values()) if reader.depth and not reader.deaf)

    def send(self, payload: Payload, publish_ns: int | None = None) -> None:
        """Send one message without waiting. The payload may be changed as soon as this returns.

        Raises:
            TransportError: the message is larger than 4 GiB.
        """
        if not isinstance(payload, (bytes, bytearray, memoryview)):
            payload = payload[0] if len(payload) == 1 else b"".join(payload)
        body = payload if isinstance(payload, bytes) else memoryview(payload).cast("B")
        size = len(body)
        if size >= SHARED_FROM_BYTES:

            def copy(target: memoryview) -> None:
                target[:] = body

            self.send_filled(size, copy, publish_ns)
            return
        with self._lock:
            if self._closed:
                return
            self._sequence = sequence = self._sequence + 1
            stamp = self._transport.now_ns() if publish_ns is None else publish_ns
            # Every microsecond from here to the readers is latency, so everything else comes after.
            head = HEADER.pack(DATA, 0, size, sequence, stamp)
            frame = head + body if size < _SCATTER_FROM_BYTES else None  # one copy costs less than a scattered write
            late = None
            for reader in self._readers.values():
                if reader.prompt:
                    if frame is None:
                        reader.write(head, body)
                        if not reader.prompt:
                            self._rewatch(reader)
                        continue
                    if reader.send_now(frame):
                        continue
                elif not reader.depth or reader.deaf:
                    continue
                late = late or _Outgoing(sequence, stamp, size, bytes(body))
                reader.offer(late)
                self._rewatch(reader)
            if self.qos.latched:
                self._keep(_Outgoing(sequence, stamp, size, bytes(body)))
        self.stats.add(self._transport.steady_ns(), size)

    def send_filled(self, size: int, fill: Callable[[memoryview], None], publish_ns: int | None = None) -> None:
        """Send ``size`` bytes that ``fill`` writes in place, without a further copy and without waiting.

        Raises:
            TransportError: the message is larger than 4 GiB.
        """
        if size > MOST_BYTES:
            raise TransportError(f"{self.topic}: a message of {size} bytes; the bus carries at most {MOST_BYTES}")
        if size < SHARED_FROM_BYTES:
            data = bytearray(size)
            fill(memoryview(data))
            self.send(data, publish_ns)
            return
        with self._lock:
            if self._closed:
                return
            buffer = self._buffer(size)
            if buffer is None:
                body = memoryview(bytearray(size))
                fill(body)
                self._distribute(*self._next(publish_ns), size, body, None)
                return
            target = buffer.begin(size)
            try:
                fill(target)
            finally:
                target.release()
            sequence, stamp = self._next(publish_ns)
            buffer.finish(sequence)
            self._distribute(sequence, stamp, size, b"", buffer)

    def close(self) -> None:
        """End the topic and remove it from the registry."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._claim.release()
            self._transport.unwatch(self._listener.fileno())
            self._listener.close()
        deadline = time.monotonic() + _LINGER_S
        while any(reader.waiting for reader in list(self._readers.values())) and time.monotonic() < deadline:
            with self._lock:
                for reader in self._readers.values():
                    reader.flush()
            time.sleep(0.002)
        with self._lock:
            untaken = sum(reader.untaken for reader in self._readers.values())
            if untaken:  # no later message will reveal this gap to the readers
                log.warning("%s closed: %d messages lost, its readers were too slow to take them", self.topic, untaken)
            for reader in list(self._readers.values()):
                self._drop(reader)
            self._pool.close()
        self._path.unlink(missing_ok=True)
        self._transport.forget(self)

    # -- under the lock --------------------------------------------------------------------------

    def _next(self, publish_ns: int | None) -> tuple[int, int]:
        self._sequence += 1
        return self._sequence, self._transport.now_ns() if publish_ns is None else publish_ns

    def _distribute(
        self, sequence: int, publish_ns: int, size: int, body: bytes | memoryview, buffer: SharedBuffer | None
    ) -> None:
        message = _Outgoing(sequence, publish_ns, size, body, buffer)
        for reader in self._readers.values():
            if reader.depth:
                reader.offer(message)
                if not reader.prompt:
                    self._rewatch(reader)
        if self.qos.latched:
            self._keep(message)
        self.stats.add(self._transport.steady_ns(), size)

    def _keep(self, message: _Outgoing) -> None:
        """Keep the last value for late joiners."""
        if self._last is not None and self._last.buffer is not None:
            self._last.buffer.holders.discard(self)
        self._last = message.kept()
        if message.buffer is not None:
            message.buffer.holders.add(self)

    def _buffer(self, size: int) -> SharedBuffer | None:
        """A free buffer, or None when this message must go through the sockets."""
        readers = self._readers.values()
        if not readers and not self.qos.latched:
            return None
        for reader in readers:
            reader.release()
            if not reader.prompt and reader.waiting:
                reader.flush()
                self._rewatch(reader)
        if self._memory_retry_s and time.monotonic() < self._memory_retry_s:
            self.stats.not_shared += 1
            return None
        try:
            buffer, retired = self._pool.acquire(size, _SPARE_BUFFERS + (BUFFERS_A_READER + 1) * len(readers))
        except OSError as error:
            self._memory_retry_s = time.monotonic() + _MEMORY_RETRY_S
            self.stats.not_shared += 1
            self.stats.not_shared_why = f"no shared memory for {size} bytes: {error.strerror or error}"
            log.warning("%s: %s; large messages go through the socket, slower", self.topic, self.stats.not_shared_why)
            return None
        for old in retired:
            for reader in readers:
                reader.retire(old)
        if buffer is None:
            self.stats.not_shared += 1
            self.stats.not_shared_why = "readers hold all buffers"
        return buffer

    def _rewatch(self, reader: _Reader) -> None:
        if reader.gone:
            return
        events = reader.wanted_events()
        if events != reader.events:
            reader.events = events
            self._transport.rewatch(reader.socket.fileno(), events)

    def _drop(self, reader: _Reader) -> None:
        fd = reader.socket.fileno()
        self._transport.unwatch(fd)
        self._readers.pop(fd, None)
        reader.close()

    # -- on the bus thread -----------------------------------------------------------------------

    def _on_listener(self, _: int) -> None:
        with self._lock:
            if self._closed:
                return
            while True:
                try:
                    connection, _address = self._listener.accept()
                except BlockingIOError:
                    return
                except OSError as error:  # too many open files: the reader waits for a connection until there are fewer
                    if not self._told_full:
                        log.error("%s: cannot accept a reader: %s", self.topic, error)
                    self._told_full = True
                    time.sleep(_DOOR_S)
                    return
                self._told_full = False
                connection.setblocking(False)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SOCKET_BYTES)
                reader = _Reader(connection, self._rewatch)
                self._readers[connection.fileno()] = reader
                self._transport.watch(connection.fileno(), reader.events, functools.partial(self._on_reader, reader))
                self._on_reader(reader, select.EPOLLIN)  # its greeting is usually there already

    def _on_reader(self, reader: _Reader, events: int) -> None:
        with self._lock:
            if reader.gone:
                return
            if events & (select.EPOLLRDHUP | select.EPOLLHUP | select.EPOLLERR):
                self._drop(reader)
                return
            if not reader.depth:
                try:
                    if not reader.greet():
                        return
                except ValueError as error:
                    log.error("%s: refused %s", self.topic, error)
                    self._drop(reader)
                    return
                reader.write(self._hello)
                if self._last is not None:
                    reader.offer(self._last)
            else:
                reader.release()
                reader.flush()
            self._rewatch(reader)
