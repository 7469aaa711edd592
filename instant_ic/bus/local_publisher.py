"""Publisher of one topic: a ZeroMQ XPUB socket, and shared memory for large messages (docs/wire.md)."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable

import zmq

from instant_ic.bus import registry
from instant_ic.bus.frame import (
    HEADER,
    INLINE,
    KEY_COPY,
    KEY_INLINE,
    KEY_SHARED,
    MOST_BYTES,
    REFERENCE,
    SHARED,
    type_digest,
    unpack_header,
)
from instant_ic.bus.host import Host
from instant_ic.bus.qos import QoS
from instant_ic.bus.shm import LEAST_SLOTS, PeerProgress, Slot, SlotPool
from instant_ic.bus.transport import Buffer, Payload, PublisherStats, TransportError

SHARED_FROM_BYTES = 96 << 10
"""Messages of this size and more go through shared memory. Below it, copying through a socket costs less than the
bookkeeping (docs/benchmarks.md)."""

SLOTS_A_READER = 5
"""How many slots each reader adds to a publisher's limit; see also :data:`~.local_subscription.VIEWS_HELD`."""

_QUEUE_BYTES = 128 << 20
"""What may wait for a blocked reader: of messages through the socket, and of large ones that no slot had room for."""
LINGER_S = 0.2  # lets a last zero command leave when a node shuts down
_MEMORY_RETRY_S = 5.0
_MORE = int(zmq.SNDMORE)
_NOBLOCK = int(zmq.NOBLOCK)

log = logging.getLogger(__name__)


class LocalPublisher:
    """Publisher of one topic of one node.

    Args:
        host: the node's transport.
        topic, type_name, qos: what it publishes.
        on_close: called once when the publisher is closed.

    Raises:
        RegistryError: the node already publishes the topic, or the path is too long.
    """

    def __init__(
        self, host: Host, topic: str, type_name: str, qos: QoS, on_close: Callable[[LocalPublisher], None]
    ) -> None:
        self.topic = topic
        self.type_name = type_name
        self.qos = qos
        self.stats = PublisherStats()
        self._now_ns, self._steady_ns = host.now_ns, host.steady_ns
        self._on_close = on_close
        self._lock = threading.RLock()  # publish may be called from any thread; the bus thread serves subscriptions
        self._name = topic.encode()
        self._type_hash = type_digest(type_name)
        self._id = os.urandom(8)
        self._sequence = 0
        self._subscribers = 0
        self._copies = 0  # subscribers that want large messages inline
        self._progress: dict[bytes, PeerProgress] = {}
        self._pool = SlotPool(self._id)
        self._memory_retry_s = 0.0
        self._inlined: deque[tuple[int, int]] = deque()  # sequence and size of large messages through the socket
        self._last: tuple[bytes, Buffer, Slot | None] | None = None  # header, third part, slot of the latched value
        self._closed = False
        self._claim, self._path = registry.claim_socket(host.run_dir, topic, host.node)
        self._socket = host.context.socket(zmq.XPUB)
        try:
            self._socket.setsockopt(zmq.LINGER, int(LINGER_S * 1000))
            self._socket.setsockopt(zmq.XPUB_VERBOSER, 1)  # each subscription is seen here, not only a key's first
            # For good: libzmq can stall a connection for ever when the limit is lowered on a socket in use.
            self._socket.setsockopt(zmq.SNDHWM, _QUEUE_BYTES // SHARED_FROM_BYTES)
            self._socket.bind(f"ipc://{self._path}")
            self._path.chmod(0o600)
            self._claim.write(
                {
                    "topic": topic,
                    "type": type_name,
                    "qos": qos.name,
                    "node": host.node,
                    "pid": os.getpid(),
                    "socket": str(self._path),
                    "id": self._id.hex(),
                    "started_ns": time.time_ns(),
                }
            )
        except registry.RegistryError:
            self._leave()
            raise
        except (OSError, zmq.ZMQError) as error:
            self._leave()
            raise registry.RegistryError(f"publisher of {topic} by node {host.node}: {error}") from error
        self.fd = int(self._socket.getsockopt(zmq.FD))

    @property
    def subscriber_count(self) -> int:
        """Number of connected readers."""
        return self._subscribers

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
            header = self._header(INLINE, size, publish_ns)
            if self._subscribers:
                self._emit(self._name + KEY_INLINE, header, body)
            if self.qos.latched:
                self._last = header, bytes(body), None
        self.stats.add(self._steady_ns(), size)

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
            if not self._subscribers and not self.qos.latched:
                self._sequence += 1
            elif (slot := self._slot(size)) is not None:
                self._send_shared(slot, size, fill, publish_ns)
            elif not self.qos.latched and not self._has_room(size):
                self._sequence += 1  # readers count the gap
            else:
                body = bytearray(size)
                fill(memoryview(body))
                header = self._header(INLINE, size, publish_ns)
                self._emit(self._name + KEY_INLINE, header, body)
                if self.qos.latched:
                    self._last = header, body, None
        self.stats.add(self._steady_ns(), size)

    def serve(self) -> None:
        """Handle new and ended subscriptions; on the bus thread, when :attr:`fd` is readable.

        Sending may take the event from the descriptor, so it is called every second in any case.
        """
        with self._lock:
            while not self._closed and int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
                request = self._socket.recv(_NOBLOCK)
                while self._socket.getsockopt(zmq.RCVMORE):  # no subscription has a second part
                    self._socket.recv(_NOBLOCK)
                    request = b""
                if request[:2] in (b"\1!", b"\0!"):
                    self._on_announcement(request[1:], request[0] == 1)
                elif request[:1] in (b"\1", b"\0"):
                    self._on_subscription(request[1:], request[0] == 1)

    def close(self) -> None:
        """End the topic and remove it from the registry; the last messages get up to 0.2 s to leave."""
        with self._lock:
            if self._closed:
                return
            deadline = time.monotonic() + LINGER_S
            newest = max((slot.sequence for slot in self._pool.slots), default=0)
            # A slot can be opened only as long as this process keeps it.
            while self._subscribers and self._read_by_all()[1] < newest and time.monotonic() < deadline:
                time.sleep(0.002)
                self.serve()
            self._closed = True
        self._on_close(self)
        with self._lock:
            self._leave()
            self._pool.close()

    # -- under the lock --------------------------------------------------------------------------

    def _leave(self) -> None:
        """Close the socket and free the name; libzmq leaves its file in place."""
        self._socket.close()
        self._path.unlink(missing_ok=True)
        self._claim.release()

    def _header(self, kind: int, size: int, publish_ns: int | None) -> bytes:
        self._sequence += 1
        stamp = self._now_ns() if publish_ns is None else publish_ns
        return HEADER.pack(kind, self._sequence, stamp, self._id, self._type_hash, size)

    def _emit(self, key: bytes, header: bytes, body: Buffer) -> None:
        send = self._socket.send
        send(key, _MORE)
        send(header, _MORE)
        send(body)

    def _has_room(self, size: int) -> bool:
        """Whether a large message may go through the socket: its own limit counts messages, not bytes."""
        seen = min((progress.sequence() for progress in self._progress.values()), default=self._sequence)
        while self._inlined and self._inlined[0][0] <= seen:
            self._inlined.popleft()
        if self._inlined and sum(waiting for _, waiting in self._inlined) + size > _QUEUE_BYTES:
            return False
        self._inlined.append((self._sequence + 1, size))
        return True

    def _send_shared(self, slot: Slot, size: int, fill: Callable[[memoryview], None], publish_ns: int | None) -> None:
        try:
            with slot.begin(size) as target:
                fill(target)
            header = self._header(SHARED, size, publish_ns)
            slot.finish(self._sequence)
        finally:
            slot.unlock()
        reference = REFERENCE.pack(os.getpid(), slot.fd, slot.number, self._pool.oldest)
        if self.qos.latched:
            self._last = header, reference, slot
        if self._subscribers:
            self._emit(self._name + KEY_SHARED, header, reference)
        if self._copies:
            self._emit(KEY_COPY + self._name, _inline(header), slot.view(size))

    def _slot(self, size: int) -> Slot | None:
        """A locked slot, or None when this message must go through the socket."""
        if self._memory_retry_s and time.monotonic() < self._memory_retry_s:
            self.stats.not_shared += 1
            return None
        must, should = self._read_by_all()
        keep = self._last[2] if self._last else None
        try:
            slot = self._pool.acquire(size, LEAST_SLOTS + SLOTS_A_READER * self._subscribers, must, should, keep)
        except OSError as error:
            self._memory_retry_s = time.monotonic() + _MEMORY_RETRY_S
            self.stats.not_shared += 1
            self.stats.not_shared_why = f"no shared memory for {size} bytes: {error.strerror or error}"
            log.warning("%s: %s; large messages go through the socket, slower", self.topic, self.stats.not_shared_why)
            return None
        if slot is None:
            self.stats.not_shared += 1
            self.stats.not_shared_why = "readers hold all slots"
        return slot

    def _read_by_all(self) -> tuple[int, int]:
        """Sequences up to which all readers that want every message, and all readers, have looked at the messages."""
        must = self._sequence
        should = must if self._subscribers <= len(self._progress) else 0  # others announce no progress
        for progress in self._progress.values():
            sequence = progress.sequence()
            should = min(should, sequence)
            if not progress.newest_only:
                must = min(must, sequence)
        return must, should

    # -- subscriptions ---------------------------------------------------------------------------

    def _on_subscription(self, prefix: bytes, begins: bool) -> None:
        """Count a reader, and give it the last value; the others get it again and know its sequence."""
        every = self._name.startswith(prefix)
        inline, copies = every or prefix == self._name + KEY_INLINE, prefix == KEY_COPY + self._name
        self._subscribers += inline if begins else -inline
        self._copies += copies if begins else -copies
        if not begins or self._last is None:
            return
        header, body, slot = self._last
        if slot is None and inline:
            self._emit(self._name + KEY_INLINE, header, body)
        elif slot is not None and every:
            self._emit(self._name + KEY_SHARED, header, body)
        elif slot is not None and copies:
            self._emit(KEY_COPY + self._name, _inline(header), slot.view(unpack_header(header)[5]))

    def _on_announcement(self, announcement: bytes, begins: bool) -> None:
        if not begins:
            self._progress.pop(announcement, None)
            return
        joined = self._sequence - (self._last is not None)
        try:
            self._progress[announcement] = PeerProgress(announcement, self._id, joined)
        except (OSError, ValueError, OverflowError) as error:
            log.debug("%s: progress of a reader cannot be read: %s", self.topic, error)


def _inline(header: bytes) -> bytes:
    """The header of the inline copy of a message in shared memory."""
    return HEADER.pack(INLINE, *unpack_header(header)[1:])
