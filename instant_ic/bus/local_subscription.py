"""Subscription of one topic: connections to all its publishers."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import socket
import struct
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from instant_ic.bus import registry
from instant_ic.bus.frame import (
    BUFFER_ID,
    DATA,
    GREETING,
    HEADER,
    HELLO,
    MAGIC,
    SHARED,
    SHARED_BODY,
    VERSION,
    FrameError,
    Hello,
    check_kind,
    type_digest,
)
from instant_ic.bus.qos import QoS
from instant_ic.bus.shm import SharedMapping
from instant_ic.bus.transport import Received, Stats

if TYPE_CHECKING:
    from instant_ic.bus.local_transport import LocalTransport

VIEWS_HELD = 4
"""How many views into shared memory one reader keeps. Further messages are copied, so that a queue, or a node that
collects messages, cannot use up the publisher's buffers."""

RECEIVE_BYTES = 100_000  # fits any message that does not go through shared memory
_LEAST_ROOM = 4096
_VIEW_FROM_BYTES = 16_384
_FDS_SPACE = socket.CMSG_SPACE(4 * 8)
_FULL_LOOK_S = 1.0
_new = tuple.__new__  # what Received(...) calls in the end, without a Python call in between

log = logging.getLogger(__name__)


class Inlet:
    """Connection to one publisher: reads frames, maps its buffers, returns them."""

    def __init__(self, subscription: LocalSubscription, path: str) -> None:
        self.subscription = subscription
        self.hello: Hello | None = None
        self.refused = False
        self.node = self.type_name = ""
        self.expected = 0  # sequence of the next message; 0 before the first
        self._deliver = subscription.deliver
        self._rest = b""  # the start of an incomplete frame
        self._header = (0, 0, 0, 0, 0)
        self._body: memoryview | None = None  # a large body that arrives in pieces
        self._got = 0
        self._room = _LEAST_ROOM
        self._fds: deque[int] = deque()
        self._mappings: dict[int, SharedMapping] = {}
        self._views: dict[int, weakref.ref[Any]] = {}
        self._closing = False
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        self._receive = self.socket.recvmsg
        try:
            self.socket.connect(path)
            self.socket.send(GREETING.pack(MAGIC, VERSION, subscription.shared, subscription.qos.depth))
        except OSError:
            self.socket.close()
            raise

    def read(self) -> bool:
        """Read what waits on the socket; False when the publisher is gone.

        Raises:
            FrameError: the data is not of this version of the bus.
        """
        while True:
            if self._body is not None:
                try:
                    count = self.socket.recv_into(self._body[self._got :])
                except BlockingIOError:
                    return True
                except OSError:
                    return False
                self._got += count
                if self._got == len(self._body):
                    body, self._body = self._body.toreadonly(), None
                    self._frame(*self._header, body)
                elif not count:
                    return False
                continue
            try:
                data, ancillary, flags, _ = self._receive(self._room, _FDS_SPACE, socket.MSG_CMSG_CLOEXEC)
            except BlockingIOError:
                return True
            except OSError:  # ECONNRESET: the publisher died before it read our data
                return False
            if ancillary:
                for _level, _kind, fds in ancillary:
                    self._fds.extend(fd for (fd,) in struct.iter_unpack("@i", fds[: len(fds) // 4 * 4]))
                if flags & socket.MSG_CTRUNC:
                    self._without_shared_memory("too many open files")
            count = len(data)
            if not count:
                return False
            full = count == self._room
            # Room for as much as came last: a much larger buffer would cost more than the rest of this loop.
            self._room = min(2 * count, RECEIVE_BYTES) if full else max(count + 256, _LEAST_ROOM)
            if self._rest:
                data, self._rest = self._rest + data, b""
            elif count >= HEADER.size and not full:
                kind, skipped, size, sequence, publish_ns = HEADER.unpack_from(data)
                if kind == DATA and size + HEADER.size == count:  # one complete message, the usual case
                    payload = data[HEADER.size :] if size < _VIEW_FROM_BYTES else memoryview(data)[HEADER.size :]
                    self._deliver(self, sequence, skipped, publish_ns, payload)
                    return True
            self._parse(data)
            if not full and self._body is None and not ancillary:
                return True  # everything has been read

    def _parse(self, data: bytes) -> None:
        at, end = 0, len(data)
        while end - at >= HEADER.size:
            kind, skipped, size, sequence, publish_ns = HEADER.unpack_from(data, at)
            body_at = at + HEADER.size
            at = body_at + size
            if at > end:
                check_kind(kind)
                at = body_at - HEADER.size
                if size > RECEIVE_BYTES:  # arrives in pieces, received straight into its final place
                    self._header = (kind, skipped, size, sequence, publish_ns)
                    self._body, self._got = memoryview(np.empty(size, np.uint8).data), end - body_at
                    self._body[: self._got] = memoryview(data)[body_at:]
                    return
                break
            # A view keeps everything alive that came with it; use one only where the copy would cost more.
            body = data[body_at:at] if size < _VIEW_FROM_BYTES else memoryview(data)[body_at:at]
            if kind == DATA:
                self._deliver(self, sequence, skipped, publish_ns, body)
            elif kind == SHARED:
                self._deliver(self, sequence, skipped, publish_ns, self._shared(bytes(body), sequence))
            else:
                self._frame(kind, skipped, size, sequence, publish_ns, body)
        if at < end:
            self._rest = data[at:]

    def _frame(self, kind: int, skipped: int, _: int, sequence: int, publish_ns: int, body: bytes | memoryview) -> None:
        check_kind(kind)
        if kind == DATA:
            self.subscription.deliver(self, sequence, skipped, publish_ns, body)
        elif kind == SHARED:
            self.subscription.deliver(self, sequence, skipped, publish_ns, self._shared(bytes(body), sequence))
        elif kind == HELLO:
            self.hello = Hello.unpack(bytes(body))
            self.subscription.met(self)
        elif len(body) == BUFFER_ID.size:  # RETIRED
            self._mappings.pop(BUFFER_ID.unpack(body)[0], None)

    def _shared(self, body: bytes, sequence: int) -> memoryview | None:
        """The message in shared memory; None when the buffer does not hold the announced message."""
        if len(body) != SHARED_BODY.size:
            raise FrameError(f"shared-memory frame with a body of {len(body)} bytes")
        number, new, size = SHARED_BODY.unpack(body)
        if new:
            if not self._fds:
                raise FrameError("new buffer without its file descriptor")
            try:
                self._mappings[number] = SharedMapping(self._fds.popleft())
            except OSError as error:
                self._without_shared_memory(error.strerror or str(error))
        mapping = self._mappings.get(number)
        if mapping is None or not mapping.fits(size):
            raise FrameError(f"a message of {size} bytes in buffer {number}, which is unknown or too small")
        if mapping.sequence != sequence:
            self._give_back(number)
            return None  # the publisher has overwritten a buffer that it lent
        if len(self._views) >= VIEWS_HELD or self.refused:
            copy = memoryview(b"" if self.refused else bytes(mapping.view(size)))
            torn = mapping.sequence != sequence
            self._give_back(number)
            return None if torn else copy
        array = np.frombuffer(mapping.view(size), np.uint8)
        # Everything derived from the message refers to this array: when it is freed, nothing reads the buffer any more.
        self._views[number] = weakref.ref(array, functools.partial(self._done, number, sequence, mapping))
        return array.data

    def _without_shared_memory(self, why: str) -> NoReturn:
        self.subscription.shared = False
        raise FrameError(f"shared memory cannot be used ({why}); reconnecting without it, which is slower")

    def _done(self, number: int, sequence: int, mapping: SharedMapping, _: object) -> None:
        """Return a buffer when its last view is gone; may run in any thread."""
        if mapping.sequence != sequence:
            self.subscription.tell_torn(self)
        self._views.pop(number, None)
        self._give_back(number)
        if self._closing and not self._views:
            self.socket.close()

    def _give_back(self, number: int) -> None:
        with contextlib.suppress(OSError):  # the publisher is gone, and its buffers with it
            self.socket.send(BUFFER_ID.pack(number), socket.MSG_NOSIGNAL)

    def close(self) -> None:
        """Stop receiving. While the node still holds a view, the publisher must not overwrite that buffer, so the
        connection stays open until the last view is gone.
        """
        while self._fds:
            os.close(self._fds.popleft())
        self._closing = True
        if self._views:
            with contextlib.suppress(OSError):  # the publisher closed first
                self.socket.shutdown(socket.SHUT_RD)
            if self._views:
                return
        self.socket.close()


class LocalSubscription:
    """Subscription of one topic, for all its publishers.

    Raises:
        RegistryError: the topic's name is invalid.
    """

    def __init__(
        self, transport: LocalTransport, topic: str, type_name: str | None, qos: QoS, on_ready: Callable[[], None]
    ) -> None:
        self.topic = registry.check_topic(topic)
        self.type_name = type_name
        self.qos = qos
        self.stats = Stats()
        self.on_ready = on_ready
        self.waker: object = None  # its `set` is `on_ready`, which the thread waiting on it need not call
        self.fresh = False
        self.shared = True  # until this process proves unable to map memory
        self.publishers: list[registry.PublisherInfo] = []
        self._transport = transport
        self._digest = type_digest(type_name) if type_name else None
        self._expected: dict[str, int] = {}  # next sequence, by publisher whose connection was lost
        self._told: set[str] = set()
        self._lock = threading.Lock()
        self._queue: deque[Received] = deque()
        self._depth = qos.depth
        self._now_ns, self._steady_ns, self._next_order = transport.now_ns, transport.steady_ns, transport.next_order
        self._folder = registry.topic_dir(transport.run_dir, topic)
        registry.own_folder(self._folder)
        self._seen_mtime = -1
        self._next_full_look = 0.0
        self._inlets: dict[str, tuple[str, Inlet]] = {}  # by the publisher's identity: path of its socket, connection

    # -- on the reading thread, under the transport's read lock ------------------------------------

    def discover(self) -> None:
        """Connect to new publishers and disconnect from those that left.

        Raises:
            OSError: the run directory is gone.
        """
        mtime = self._folder.stat().st_mtime_ns
        now = time.monotonic()
        if mtime == self._seen_mtime and now < self._next_full_look:
            return
        self._seen_mtime, self._next_full_look = mtime, now + _FULL_LOOK_S
        self.publishers = registry.topic_publishers(self._transport.run_dir, self.topic)
        wanted = {info.id: str(info.socket) for info in self.publishers}
        for identity in [i for i in self._inlets if i not in wanted]:
            # Its registration is removed before its socket: its last messages may still be on the way.
            inlet = self._inlets[identity][1]
            self._transport.read_inlet(inlet)
            if identity in self._inlets:  # not yet removed by the read above
                self.lose_inlet(inlet)
        for identity, path in wanted.items():
            if identity not in self._inlets:
                try:
                    inlet = Inlet(self, path)
                except OSError:  # it is starting up or shutting down: try again at the next look
                    self._next_full_look = now
                    continue
                self._inlets[identity] = (path, inlet)
                self._transport.add_inlet(inlet)

    def lose_inlet(self, inlet: Inlet) -> None:
        """Close a connection; a publisher that is still alive is found again."""
        for identity, (_, other) in list(self._inlets.items()):
            if other is inlet:
                del self._inlets[identity]
                self._expected[identity] = inlet.expected
        self._next_full_look = 0.0
        self._transport.remove_inlet(inlet)
        inlet.close()

    def met(self, inlet: Inlet) -> None:
        """Handle a publisher's greeting."""
        hello = inlet.hello
        assert hello is not None
        if hello.topic != self.topic:
            raise FrameError(f"connected to a publisher of {hello.topic}")
        inlet.refused = self._digest is not None and hello.digest != self._digest
        inlet.node, inlet.type_name = hello.node, self.type_name or hello.type_name
        inlet.expected = self._expected.get(hello.publisher, 0)

    def deliver(
        self, inlet: Inlet, sequence: int, skipped: int, publish_ns: int, payload: bytes | memoryview | None
    ) -> None:
        """Handle one message."""
        node = inlet.node
        if sequence != inlet.expected + skipped:
            if not inlet.expected:
                if inlet.hello is None:
                    raise FrameError("message before the publisher's greeting")
            elif sequence < inlet.expected:  # a latched value, sent again over a new connection
                return
            else:
                self.stats.lose(node, sequence - inlet.expected - skipped)
        inlet.expected = sequence + 1
        if payload is None or inlet.refused:
            self._refuse(inlet)
            return
        steady = self._steady_ns()
        message = _new(
            Received,
            (self.topic, inlet.type_name, payload, publish_ns, self._now_ns(), self._next_order(), node, steady),
        )
        with self._lock:
            queue = self._queue
            if queue:
                if self._depth == 1:
                    for index, other in enumerate(queue):
                        if other.publisher == node:
                            del queue[index]
                            break
                elif len(queue) >= self._depth:
                    self.stats.lose(queue.popleft().publisher, 1)
            queue.append(message)
        self.stats.add(steady, len(payload))
        self.fresh = True

    def tell_torn(self, inlet: Inlet) -> None:
        """Count and log that a publisher overwrote a buffer it had lent, which is a fault of the publisher."""
        self.stats.torn += 1
        node = inlet.hello.node if inlet.hello else "?"
        log.error("%s: %s overwrote a message that was still in use", self.topic, node)

    def _refuse(self, inlet: Inlet) -> None:
        hello = inlet.hello
        assert hello is not None
        if not inlet.refused:
            self.stats.lose(hello.node, 1)
            self.tell_torn(inlet)
            return
        self.stats.rejected += 1
        if hello.publisher not in self._told:
            self._told.add(hello.publisher)
            same = hello.type_name == self.type_name
            why = f"{hello.type_name} with other fields" if same else f"{hello.type_name}, {self.type_name} expected"
            log.error("%s: node %s sends %s; its messages are refused and counted", self.topic, hello.node, why)

    def shut(self) -> None:
        """Close every connection."""
        for _, inlet in list(self._inlets.values()):
            self.lose_inlet(inlet)

    # -- on the node's thread --------------------------------------------------------------------

    def take(self) -> list[Received]:
        """See :class:`~.transport.RawSubscription`."""
        if not self._queue:
            return []
        with self._lock:
            messages = list(self._queue)
            self._queue.clear()
        return messages

    def close(self) -> None:
        """End the subscription."""
        self._transport.forget(self)
