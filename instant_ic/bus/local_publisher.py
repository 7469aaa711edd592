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
from instant_ic.bus.frame import HEADER, INLINE, KEY_COPY, MARK, MOST_BYTES, REFERENCE, SHARED, type_digest
from instant_ic.bus.host import Host
from instant_ic.bus.qos import QoS
from instant_ic.bus.shm import LEAST_SLOTS, PeerProgress, Slot, SlotPool
from instant_ic.bus.transport import Buffer, PublisherStats, TransportError

SHARED_FROM_BYTES = 96 << 10
"""Smallest message that goes through shared memory. For smaller messages, copying through a socket costs less than the
bookkeeping (docs/benchmarks.md)."""

SLOTS_A_READER = 5
"""Number of slots by which each reader raises a publisher's limit; see :data:`~.local_subscription.VIEWS_HELD`."""

_QUEUE_BYTES = 128 << 20
"""Limit of the queue for a slow subscriber, in bytes of large messages for which no slot was free."""
LINGER_S = 0.2  # time for the last messages, such as a zero command, to leave when a node shuts down
_NO_MEMORY_S = 5.0  # wait after a failed allocation of shared memory
_MORE = int(zmq.SNDMORE)
_NOBLOCK = int(zmq.NOBLOCK)

log = logging.getLogger(__name__)

_Message = tuple[int, int, int, Buffer, Slot | None]  # sequence, publication time in ns, size, body, its slot


class LocalPublisher:
    """Publisher of one topic of one node.

    Attributes:
        closed: true once the publisher takes no more messages.

    Raises:
        RegistryError: the node already publishes the topic, or the path is too long.
    """

    def __init__(self, host: Host, topic: str, type_name: str, qos: QoS) -> None:
        self.topic = topic
        self.type_name = type_name
        self.qos = qos
        self.stats = PublisherStats()
        self.subscriber_count = 0
        self._now_ns, self._steady_ns = host.now_ns, host.steady_ns
        self._lock = threading.RLock()  # any thread may publish, and the bus thread serves subscriptions
        self._name = topic.encode()
        self._type_hash = type_digest(type_name)
        self.identity = os.urandom(8)
        self.sequence = 0
        self._copies = 0  # subscribers that want large messages inline
        self._progress: dict[bytes, PeerProgress] = {}
        self.pool = SlotPool(self.identity)
        self.inlined: deque[tuple[int, int]] = deque()  # sequence and size of large messages sent through the socket
        self._no_memory_until_s = 0.0
        self._last: _Message | None = None  # the latched value
        self.closed = False
        self._claim, self.path = registry.claim_socket(host.run_dir, topic, host.node)
        self._socket = host.context.socket(zmq.XPUB)
        try:
            self._socket.setsockopt(zmq.LINGER, int(LINGER_S * 1000))
            self._socket.setsockopt(zmq.XPUB_VERBOSER, 1)  # report every subscription, not only the first of a key
            # Set once: libzmq can stall a connection for ever when the limit of a socket in use is lowered.
            self._socket.setsockopt(zmq.SNDHWM, _QUEUE_BYTES // SHARED_FROM_BYTES)
            self._socket.bind(f"ipc://{self.path}")
            self.path.chmod(0o600)
            registry.announce(self._claim, topic, type_name, qos.name, host.node, self.path, self.identity)
        except registry.RegistryError:
            self._leave()
            raise
        except (OSError, zmq.ZMQError) as error:
            self._leave()
            raise registry.RegistryError(f"publisher of {topic} by node {host.node}: {error}") from error
        self.fd = int(self._socket.getsockopt(zmq.FD))
        self._send_part = super(zmq.Socket, self._socket).send  # without pyzmq's layer for other kinds of sockets

    def send(self, payload: Buffer, publish_ns: int | None = None) -> None:
        """Send one message without waiting. The caller may change the payload once this returns.

        Raises:
            TransportError: the message is larger than 4 GiB.
        """
        body = payload if isinstance(payload, bytes) else memoryview(payload).cast("B")
        size = len(body)
        if size >= SHARED_FROM_BYTES:

            def copy(target: memoryview) -> None:
                target[:] = body

            self.send_filled(size, copy, publish_ns)
            return
        with self._lock:
            if not self.closed:
                self._send(size, body, publish_ns)
        self.stats.add(self._steady_ns())

    def send_filled(self, size: int, fill: Callable[[memoryview], None], publish_ns: int | None = None) -> None:
        """Send ``size`` bytes that ``fill`` writes straight into the message, without waiting.

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
            if self.closed:
                return
            if not self.subscriber_count and not self.qos.latched:
                self.sequence += 1
            elif (slot := self._slot(size)) is not None:
                try:
                    with slot.begin(size) as target:
                        fill(target)
                    slot.finish(self.sequence + 1)
                finally:
                    slot.unlock()
                reference = REFERENCE.pack(os.getpid(), slot.fd, slot.number, self.pool.oldest)
                self._send(size, reference, publish_ns, slot)
            elif self.qos.latched or self._has_room(size):
                body = bytearray(size)
                fill(memoryview(body))
                self._send(size, body, publish_ns)
            else:
                self.sequence += 1  # readers count the gap as a loss
        self.stats.add(self._steady_ns())

    def serve(self) -> None:
        """Handle new and ended subscriptions.

        The bus thread calls this when :attr:`fd` is readable, and every second, because sending may consume the
        descriptor's event.
        """
        with self._lock:
            while not self.closed and int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
                request = self._socket.recv(_NOBLOCK)
                while self._socket.getsockopt(zmq.RCVMORE):  # no subscription has a second part
                    self._socket.recv(_NOBLOCK)
                    request = b""
                if request[:2] in (b"\1!", b"\0!"):
                    self._on_announcement(request[1:], request[0] == 1)
                elif request[:1] in (b"\1", b"\0"):
                    self._on_subscription(request[1:], request[0] == 1)

    def close(self) -> None:
        """Remove the publisher from the registry. The last messages get up to 0.2 s to leave."""
        with self._lock:
            if self.closed:
                return
            deadline = time.monotonic() + LINGER_S
            newest = max((slot.written for slot in self.pool.slots), default=0)
            # Readers can open a slot only while this process keeps it.
            while self.subscriber_count and self._read_by_all()[1] < newest and time.monotonic() < deadline:
                time.sleep(0.002)
                self.serve()
            self.closed = True
            self._leave()
            self.pool.close()

    # -- under the lock --------------------------------------------------------------------------

    def _leave(self) -> None:
        """Close the socket, remove its file, which libzmq leaves behind, and free the name."""
        self._socket.close()
        self.path.unlink(missing_ok=True)
        self._claim.release()

    def _send(self, size: int, body: Buffer, publish_ns: int | None, slot: Slot | None = None) -> None:
        self.sequence += 1
        message = self.sequence, self._now_ns() if publish_ns is None else publish_ns, size, body, slot
        if self.subscriber_count:
            self._emit(message)
        if slot is not None and self._copies:
            self._emit(message, copy=True)
        if self.qos.latched:
            self._last = (*message[:3], bytes(body), slot)

    def _emit(self, message: _Message, copy: bool = False) -> None:
        """Send a message. ``copy`` sends a shared one inline to the subscribers that need it inline."""
        sequence, publish_ns, size, body, slot = message
        name, kind = self._name, INLINE if slot is None else SHARED
        if slot is not None and copy:
            name, kind, body = KEY_COPY + name, INLINE, slot.view(size)
        self._send_part(
            name + HEADER.pack(kind, MARK, sequence, publish_ns, self.identity, self._type_hash, size), _MORE
        )
        self._send_part(body)

    def _has_room(self, size: int) -> bool:
        """Return whether the queue has room for a large message. ZeroMQ's own limit counts messages, not bytes."""
        seen = min((progress.sequence() for progress in self._progress.values()), default=self.sequence)
        while self.inlined and self.inlined[0][0] <= seen:
            self.inlined.popleft()
        if self.inlined and sum(waiting for _, waiting in self.inlined) + size > _QUEUE_BYTES:
            return False
        self.inlined.append((self.sequence + 1, size))
        return True

    def _slot(self, size: int) -> Slot | None:
        """Return a locked slot, or None if the message must go through the socket."""
        why = "readers hold all slots"
        most = LEAST_SLOTS + SLOTS_A_READER * self.subscriber_count
        if time.monotonic() < self._no_memory_until_s:  # a failing allocation is slow and uses up the free memory
            why, most = self.stats.not_shared_why, 0
        try:
            keep = self._last[4] if self._last else None
            if (slot := self.pool.acquire(size, most, *self._read_by_all(), keep)) is not None:
                return slot
        except OSError as error:
            why = f"no shared memory for {size} bytes: {error.strerror or error}"
            self._no_memory_until_s = time.monotonic() + _NO_MEMORY_S
            log.warning("%s: %s. Large messages go through the socket, which is slower", self.topic, why)
        self.stats.not_shared += 1
        self.stats.not_shared_why = why
        return None

    def _read_by_all(self) -> tuple[int, int]:
        """Return the newest sequence that every lossless reader has looked at, and the newest that every reader has."""
        must = self.sequence
        # The progress of a reader without an announcement is unknown.
        should = must if self.subscriber_count <= len(self._progress) else 0
        for progress in self._progress.values():
            sequence = progress.sequence()
            should = min(should, sequence)
            if not progress.newest_only:
                must = min(must, sequence)
        return must, should

    # -- subscriptions ---------------------------------------------------------------------------

    def _on_subscription(self, prefix: bytes, begins: bool) -> None:
        """Count a reader and send the last value. Other readers get it again and ignore it by its sequence."""
        every = self._name.startswith(prefix)
        inline, copies = every or prefix == self._name + bytes([INLINE]), prefix == KEY_COPY + self._name
        self.subscriber_count += inline if begins else -inline
        self._copies += copies if begins else -copies
        if begins and self._last is not None and (every or (copies if self._last[4] else inline)):
            self._emit(self._last, copies)

    def _on_announcement(self, announcement: bytes, begins: bool) -> None:
        if not begins:
            self._progress.pop(announcement, None)
            return
        joined = self.sequence - (self._last is not None)
        try:
            self._progress[announcement] = PeerProgress(announcement, self.identity, joined)
        except (OSError, ValueError, OverflowError) as error:
            log.debug("%s: progress of a reader cannot be read: %s", self.topic, error)
