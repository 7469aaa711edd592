"""Subscription of one topic: a ZeroMQ SUB socket, connected to all its publishers (docs/wire.md)."""

from __future__ import annotations

import errno
import itertools
import logging
import select
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np
import zmq

from instant_ic.bus import registry
from instant_ic.bus.frame import (
    INLINE,
    KEY_COPY,
    REFERENCE,
    SHARED,
    FrameError,
    Header,
    type_digest,
    unpack_header,
)
from instant_ic.bus.host import Host
from instant_ic.bus.qos import QoS
from instant_ic.bus.shm import Slot, progress_page, store_progress
from instant_ic.bus.transport import Received, Stats

VIEWS_HELD = 4
"""Number of views into a publisher's shared memory that one reader keeps. Further messages are copied, so that a queue
or a node that collects messages cannot use up the publisher's slots."""

_QUEUE = 256  # messages that ZeroMQ queues in this process; the publisher queues more
_LARGE_FROM_BYTES = 64 << 10
_RECONNECT_MS = 20
_GRACE_S = 2.0  # time in which the last messages of a publisher that has left the registry may still arrive
_SEARCH_S = 1.0
_MOST_COMPLAINTS = 64
_NOBLOCK, _EVENTS, _POLLIN = int(zmq.NOBLOCK), int(zmq.EVENTS), int(zmq.POLLIN)
_leases: dict[Slot, weakref.ref[Any]] = {}  # slots of messages in use, kept even if their subscription is closed
_new = tuple.__new__  # faster than Received(...), which calls it through a Python function

log = logging.getLogger(__name__)


class _Source:
    """One publisher of the topic; ``place`` is its index on the progress page."""

    def __init__(self, info: registry.PublisherInfo, place: int) -> None:
        self.info = info
        self.node, self.type_name = info.node, info.type_name
        self.address = f"ipc://{info.socket}"  # a restarted publisher of the same node has the same address
        self.place = place
        self.left_s = 0.0  # time at which it was found missing in the registry; 0 while it is present
        self.expected = 0  # sequence of the next message; 0 before the first
        self.slots: dict[int, Slot] = {}
        self.mapped = False  # true once a slot could be opened; shared memory then works with this publisher
        self.views = 0


class LocalSubscription:
    """Subscription to all publishers of one topic.

    Raises:
        RegistryError: the topic's name is invalid, or its folder cannot be used.
    """

    def __init__(self, host: Host, topic: str, type_name: str | None, qos: QoS, on_ready: Callable[[], None]) -> None:
        self.topic = registry.check_topic(topic)
        self.type_name = type_name
        self.qos = qos
        self.stats = Stats()
        self._host, self._on_ready = host, on_ready
        self._name = self.topic.encode()
        self._digest = type_digest(type_name) if type_name else None
        self._lock = threading.Lock()
        self.queue: deque[Received] = deque()
        self._depth = qos.depth
        self._now_ns, self._steady_ns, self._next_order = host.now_ns, host.steady_ns, host.next_order
        folder = registry.topic_dir(host.run_dir, topic)
        registry.own_folder(folder)
        self.folder = registry.TopicFolder(folder)
        self.sources: dict[bytes, _Source] = {}  # by identity; a connection to each
        self._next_search_s = 0.0
        self._told: set[object] = set()
        self._page, self._announcement = progress_page(newest_only=qos.depth == 1)
        self.socket = host.context.socket(zmq.SUB)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.setsockopt(zmq.RCVHWM, _QUEUE)
        self.socket.setsockopt(zmq.RECONNECT_IVL, _RECONNECT_MS)
        self.socket.setsockopt(zmq.SUBSCRIBE, self._announcement)
        self.socket.setsockopt(zmq.SUBSCRIBE, self._name)
        self.fd = int(self.socket.getsockopt(zmq.FD))
        host.readers[self.fd] = self
        host.inputs.register(self.fd, select.EPOLLIN)

    # -- on the reading thread, under the read lock ------------------------------------

    def discover(self) -> None:
        """Connect to new publishers and disconnect from those that have left. Call :meth:`read` afterwards.

        Raises:
            OSError: the run directory is gone.
        """
        if self.folder.look():
            self._connect()
        now = time.monotonic()
        for identity, source in list(self.sources.items()):
            if source.left_s and now - source.left_s > _GRACE_S:
                del self.sources[identity]
                if not self._connected(source.address):
                    self.socket.disconnect(source.address)

    def _connected(self, address: str) -> bool:
        return any(source.address == address for source in self.sources.values())

    def _connect(self) -> None:
        """Connect to publishers that are new in the registry, and record which have left it."""
        present = {bytes.fromhex(info.id): info for info in self.folder.publishers}
        for identity in present.keys() - self.sources.keys():
            taken = {source.place for source in self.sources.values()}
            source = _Source(present[identity], next(place for place in itertools.count() if place not in taken))
            if not self._connected(source.address):
                try:
                    self.socket.connect(source.address)
                except zmq.ZMQError as error:
                    self._complain(source.address, f"{source.address} cannot be connected: {error}")
                    continue
            # Messages of this publisher are accepted from now on, even after it has left the registry.
            self.sources[identity] = source
        for identity, source in self.sources.items():
            source.left_s = 0.0 if identity in present else source.left_s or time.monotonic()

    def read(self, one: bool = False) -> None:
        """Read all messages that have arrived, or only ``one``, to handle it sooner; a full read must then follow."""
        socket = self.socket
        receive = socket.recv
        while one or int(socket.getsockopt(_EVENTS)) & _POLLIN:
            try:
                first = receive(_NOBLOCK)
            except zmq.Again:
                return
            try:
                # If a part is missing, the next message's first part or none is read. Neither has the body's size.
                header = unpack_header(first)
                if header[0] == SHARED or header[6] < _LARGE_FROM_BYTES:
                    self._message(header, receive(_NOBLOCK))
                else:
                    self._message(header, receive(_NOBLOCK, copy=False).buffer.toreadonly())
            except (FrameError, zmq.Again) as error:
                text = str(error) or "message in parts"
                while socket.getsockopt(zmq.RCVMORE):
                    receive(_NOBLOCK)
                self._reject(text)
                self._complain(text[:40], f"{text}; the message is dropped")
            if one:
                return

    def _message(self, header: Header, body: bytes | memoryview) -> None:
        kind, _, sequence, publish_ns, publisher, digest, size = header
        source = self.sources.get(publisher) or self._met(publisher)
        gap = sequence - source.expected if source.expected else 0
        if gap < 0:  # a latched value that was sent again
            return
        if self._digest is not None and digest != self._digest:
            self._refuse(source)
            return
        payload: bytes | memoryview | None = body
        if kind == SHARED:
            payload = self._shared(source, header, body)
            gap += payload is None
        elif len(body) != size:
            raise FrameError(f"message of {len(body)} bytes, {size} announced")
        source.expected = sequence + 1
        if gap and self._depth > 1:  # a newest-only reader needs only the newest
            self.stats.lose(source.node, gap)
        if size >= _LARGE_FROM_BYTES:
            store_progress(self._page, source.place, publisher, sequence)
        if payload is None:
            return
        node, steady, order = source.node, self._steady_ns(), self._next_order()
        # The type has been checked, unless the subscription accepts any type; then the registry's is used.
        message = _new(
            Received,
            (self.topic, source.type_name, payload, publish_ns, self._now_ns(), order, node, steady, publisher),
        )
        with self._lock:
            queue = self.queue
            waiting = len(queue)
            if waiting and self._depth == 1:
                queue = self.queue = deque(other for other in queue if other.publisher != node)
            elif waiting >= self._depth:
                self.stats.lose(queue.popleft().publisher, 1)
            queue.append(message)
        if not waiting:
            self._on_ready()
        self.stats.add(steady)

    def _met(self, publisher: bytes) -> _Source:
        """Look up the publisher of a first message in the registry.

        Raises:
            FrameError: the registry does not list the publisher.
        """
        now = time.monotonic()
        if now >= self._next_search_s:
            self.folder.read()
            self._connect()
            if publisher in self.sources:
                return self.sources[publisher]
            self._next_search_s = now + _SEARCH_S
        raise FrameError(f"message from a publisher that is not in the registry (identity {publisher.hex()})")

    def _shared(self, source: _Source, header: Header, body: bytes | memoryview) -> memoryview | None:
        """Return the message in shared memory, or None if its slot already holds another message."""
        if len(body) != REFERENCE.size:
            raise FrameError(f"reference of {len(body)} bytes; it has {REFERENCE.size}")
        pid, fd, number, oldest = REFERENCE.unpack(body)
        _, _, sequence, _, publisher, _, size = header
        for retired in [n for n in source.slots if n < oldest]:
            del source.slots[retired]
        slot = source.slots.get(number)
        if slot is None:
            try:
                slot = source.slots[number] = Slot.open(pid, fd, publisher)
                source.mapped = True
            except OSError as error:
                if source.mapped and error.errno == errno.ENOENT:
                    return None
                self._without_shared_memory(source, sequence, error)
        if not slot.lease(sequence, size):
            return None
        if source.views >= VIEWS_HELD:
            copy = memoryview(bytes(slot.view(size)))
            slot.unlock()
            return copy
        array = np.frombuffer(slot.view(size), np.uint8)
        # Everything derived from the message refers to this array. Once it is freed, nothing reads the slot any more.
        _leases[slot] = weakref.ref(array, lambda _: self._done(source, slot, sequence))
        source.views += 1
        return array.data

    def _done(self, source: _Source, slot: Slot, sequence: int) -> None:
        """Unlock a slot once its last view is freed. This may run on any thread."""
        if slot.sequence != sequence:
            self.stats.overwritten += 1
            log.error("%s: %s overwrote a message that was still in use", self.topic, source.node)
        source.views -= 1
        del _leases[slot]
        slot.unlock()

    def _without_shared_memory(self, source: _Source, sequence: int, error: OSError) -> NoReturn:
        """Subscribe to inline messages instead of shared ones."""
        if KEY_COPY not in self._told:
            self._told.add(KEY_COPY)
            source.expected = source.expected or sequence  # the latched value is sent again
            for wanted in (self._name + bytes([INLINE]), KEY_COPY + self._name):
                self.socket.setsockopt(zmq.SUBSCRIBE, wanted)
            for unwanted in (self._name, self._announcement):
                self.socket.setsockopt(zmq.UNSUBSCRIBE, unwanted)
        raise FrameError(
            f"shared memory of {source.node} cannot be used ({error.strerror or error}); large messages are requested "
            "through the socket, which is slower"
        )

    def _reject(self, why: str) -> None:
        self.stats.rejected += 1
        self.stats.rejected_why = why

    def _refuse(self, source: _Source) -> None:
        same = source.type_name == self.type_name
        why = f"{source.type_name} with other fields" if same else f"{source.type_name}, {self.type_name} expected"
        self._reject(f"node {source.node} sends {why}")
        self._complain(source.info.id, f"{self.stats.rejected_why}; its messages are refused and counted")

    def _complain(self, what: object, text: str) -> None:
        """Log an error once."""
        if what not in self._told and len(self._told) < _MOST_COMPLAINTS:
            self._told.add(what)
            log.error("%s: %s", self.topic, text)

    # -- on the node's thread --------------------------------------------------------------------

    def take(self) -> list[Received]:
        if not self.queue:
            return []
        with self._lock:
            messages = list(self.queue)
            self.queue.clear()
        return messages

    def close(self) -> None:
        """Close the socket. Views of messages stay valid."""
        with self._host.read_lock:
            if self._host.readers.get(self.fd) is self:  # else it is closed already
                del self._host.readers[self.fd]
                self._host.inputs.unregister(self.fd)
                self.socket.close()
                self._page.close()
