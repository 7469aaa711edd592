"""Topics over ZeroMQ: one ipc socket a publisher, found through the registry; no broker, no master.

Each node has one thread that always drains every subscription, so a slow callback never turns the newest message into
an old one (measured: a mailbox keeps the age of a frame at one period where a queue grows without bound).
"""

from __future__ import annotations

import itertools
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import zmq

from . import registry
from .frame import FrameError, FrameHeader, type_digest
from .qos import QoS
from .transport import Payload, Received, Stats, joined

_LINGER_MS = 200  # a last zero command still goes out when a node ends
_HOUSEKEEPING_S = 0.05
_DISCOVERY_S = 0.1
_DRAIN_MOST = 500

log = logging.getLogger(__name__)


class ZmqPublisher:
    """One topic of one node."""

    def __init__(
        self, transport: ZmqTransport, topic: str, type_name: str, qos: QoS, now_ns: Callable[[], int]
    ) -> None:
        self.topic = topic
        self.type_name = type_name
        self.qos = qos
        self.stats = Stats()
        self._now_ns = now_ns
        self._transport = transport
        self._id = os.urandom(8)
        self._digest = type_digest(type_name)
        self._topic_bytes = topic.encode()
        self._lock = threading.Lock()  # a ZeroMQ socket is not thread-safe; publish may come from any thread
        self._sequence = 0
        self._last: list[bytes | memoryview] | None = None
        self._subscribers = 0
        self._closed = False
        self._claim, path = registry.claim_socket(transport.run_dir, topic, transport.node)
        self._socket = transport.context.socket(zmq.XPUB)
        self._socket.setsockopt(zmq.LINGER, _LINGER_MS)
        self._socket.setsockopt(zmq.SNDHWM, qos.high_water_mark)
        self._socket.setsockopt(zmq.XPUB_VERBOSER, 1)
        self._socket.bind(f"ipc://{path}")
        self._path = path
        self._claim.write(
            {
                "topic": topic,
                "type": type_name,
                "qos": qos.name,
                "node": transport.node,
                "pid": os.getpid(),
                "socket": str(path),
                "id": self._id.hex(),
                "started_ns": time.time_ns(),
            }
        )

    @property
    def subscriber_count(self) -> int:
        """How many readers are connected now."""
        self.attend()
        return self._subscribers

    def send(self, payload: Payload, publish_ns: int | None = None) -> None:
        """Sends one message; never waits."""
        now = self._now_ns()
        payload = joined(payload)
        with self._lock:
            if self._closed:
                return
            self._sequence += 1
            head = FrameHeader(self._sequence, now if publish_ns is None else publish_ns, self._id, self._digest).pack()
            frames: list[bytes | memoryview] = [self._topic_bytes, head, payload]
            if self.qos.latched:
                self._last = frames
            self._socket.send_multipart(frames, copy=False)
            self.stats.add(now, len(payload))

    def attend(self) -> None:
        """Counts readers that came and went, and gives a latched value to those that came."""
        with self._lock:
            if self._closed:
                return
            came = False
            while int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
                event = self._socket.recv(zmq.NOBLOCK)
                if event[:1] == b"\x01":
                    self._subscribers += 1
                    came = True
                else:
                    self._subscribers = max(0, self._subscribers - 1)
            if came and self._last is not None:
                self._socket.send_multipart(self._last, copy=False)

    def close(self) -> None:
        """Ends the topic and takes it out of the registry."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._claim.release()
            self._socket.close()
        self._path.unlink(missing_ok=True)
        self._transport.forget(self)


class ZmqSubscription:
    """All publishers of one topic, read by the transport's thread."""

    def __init__(
        self,
        transport: ZmqTransport,
        topic: str,
        type_name: str | None,
        qos: QoS,
        on_ready: Callable[[], None],
    ) -> None:
        self.topic = registry.check_topic(topic)
        self.type_name = type_name
        self.qos = qos
        self.stats = Stats()
        self._transport = transport
        self._on_ready = on_ready
        self._digest = type_digest(type_name) if type_name else None
        self._names: dict[bytes, str] = {}
        self._nodes: dict[bytes, str] = {}
        self._sequences: dict[bytes, int] = {}
        self._told: set[bytes] = set()
        self._lock = threading.Lock()
        self._newest: dict[bytes, Received] = {}
        self._queue: deque[Received] = deque()
        self._folder = registry.topic_dir(transport.run_dir, topic)
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._seen_mtime = -1
        self._next_full_look = 0.0
        self._connected: dict[str, str] = {}
        self.socket = transport.context.socket(zmq.SUB)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.setsockopt(zmq.RCVHWM, qos.high_water_mark)
        self.socket.setsockopt(zmq.RECONNECT_IVL, 50)
        self.socket.setsockopt(zmq.SUBSCRIBE, topic.encode())
        self.publishers: list[registry.PublisherInfo] = []

    # -- on the transport's thread ---------------------------------------------------------------

    def discover(self) -> None:
        """Connects to publishers that appeared, lets go of those that left."""
        mtime = self._folder.stat().st_mtime_ns
        now = time.monotonic()
        if mtime == self._seen_mtime and now < self._next_full_look:
            return
        self._seen_mtime, self._next_full_look = mtime, now + 1.0
        self.publishers = registry.topic_publishers(self._transport.run_dir, self.topic)
        wanted = {str(info.socket): info for info in self.publishers}
        for path in [p for p in self._connected if p not in wanted]:
            self.socket.disconnect(f"ipc://{path}")
            del self._connected[path]
        for path, info in wanted.items():
            self._names[bytes.fromhex(info.id)] = info.type_name
            self._nodes[bytes.fromhex(info.id)] = info.node
            if path not in self._connected:
                self.socket.connect(f"ipc://{path}")
            self._connected[path] = info.id

    def drain(self) -> None:
        """Reads everything that waits on the socket."""
        ready = False
        for _ in range(_DRAIN_MOST):  # then the other topics have their turn
            try:
                frames = self.socket.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                break
            ready |= self._accept(frames)
        if ready:
            self._on_ready()

    def _accept(self, frames: list[zmq.Frame]) -> bool:
        try:
            if len(frames) != 3:
                raise FrameError(f"{len(frames)} parts, 3 expected")
            head = FrameHeader.unpack(frames[1].buffer)
        except FrameError as error:
            self._reject(b"", f"{self.topic}: {error}")
            return False
        # ZeroMQ subscribes by prefix: /map also brings /map_updates of a publisher that shares the socket.
        if frames[0].bytes != self.topic.encode():
            return False
        if self._digest is not None and head.type_digest != self._digest:
            other = self._names.get(head.publisher, "another type")
            self._reject(head.publisher, f"{self.topic}: a publisher sends {other}, {self.type_name} expected")
            return False
        last = self._sequences.get(head.publisher)
        if last is not None:
            if head.sequence <= last:  # a latched value sent again for someone else
                return False
            self.stats.lose(self._node_of(head.publisher), head.sequence - last - 1)
        self._sequences[head.publisher] = head.sequence
        now = self._transport.now_ns()
        payload = frames[2].buffer
        type_name = self.type_name or self._names.get(head.publisher)
        if type_name is None:  # a raw reader that heard the publisher before it read its JSON
            self.discover()
            type_name = self._names.get(head.publisher, "")
        order, node = self._transport.next_order(), self._node_of(head.publisher)
        message = Received(self.topic, type_name, payload, head.publish_ns, now, order, node)
        self.stats.add(now, len(payload))
        with self._lock:
            if self.qos.depth == 1:
                self._newest[head.publisher] = message
            elif len(self._queue) >= self.qos.depth:
                self.stats.lose(self._node_of(head.publisher), 1)
                self._queue.popleft()
                self._queue.append(message)
            else:
                self._queue.append(message)
        return True

    def _node_of(self, publisher: bytes) -> str:
        return self._nodes.get(publisher, publisher.hex())

    def _reject(self, publisher: bytes, why: str) -> None:
        self.stats.rejected += 1
        if publisher not in self._told:
            self._told.add(publisher)
            log.error("%s; its messages are refused and counted", why)

    # -- on the node's thread --------------------------------------------------------------------

    def take(self) -> list[Received]:
        """See :class:`~.transport.RawSubscription`."""
        with self._lock:
            messages = [*self._newest.values(), *self._queue]
            self._newest.clear()
            self._queue.clear()
        messages.sort(key=lambda message: message.order)
        return messages

    def close(self) -> None:
        """Ends the subscription."""
        self._transport.forget(self)


class ZmqTransport:
    """Topics of one node over ipc.

    Args:
        run_dir: the run directory, made if missing.
        node: the node's name; names the publishers' sockets.
        now_ns: the node's clock.

    Raises:
        RegistryError: the run directory cannot be used.
    """

    def __init__(self, run_dir: Path, node: str, now_ns: Callable[[], int]) -> None:
        self.run_dir = registry.prepare(run_dir)
        self.node = registry.check_node_name(node)
        self.now_ns = now_ns
        self.context = zmq.Context()
        self._orders = itertools.count()
        self._lock = threading.Lock()
        self._publishers: list[ZmqPublisher] = []
        self._subscriptions: list[ZmqSubscription] = []
        self._closing: list[ZmqSubscription] = []
        self._stop = threading.Event()
        self._wake_out = self.context.socket(zmq.PAIR)
        self._wake_in = self.context.socket(zmq.PAIR)
        self._wake_in.bind("inproc://wake")
        self._wake_out.connect("inproc://wake")
        self._thread = threading.Thread(target=self._run, name="bus", daemon=True)
        self._thread.start()

    def next_order(self) -> int:
        """Place of a message in the order of arrival."""
        return next(self._orders)

    def advertise(self, topic: str, type_name: str, qos: QoS) -> ZmqPublisher:
        """A publisher that readers find from now on.

        Raises:
            RegistryError: the node publishes the topic already, or the path is too long.
        """
        publisher = ZmqPublisher(self, registry.check_topic(topic), type_name, qos, self.now_ns)
        with self._lock:
            self._publishers.append(publisher)
        return publisher

    def subscribe(self, topic: str, type_name: str | None, qos: QoS, on_ready: Callable[[], None]) -> ZmqSubscription:
        """A subscription to all present and coming publishers; ``type_name`` None takes any type."""
        subscription = ZmqSubscription(self, topic, type_name, qos, on_ready)
        with self._lock:
            self._subscriptions.append(subscription)
            self._wake()
        return subscription

    def forget(self, item: ZmqPublisher | ZmqSubscription) -> None:
        """Lets go of a closed publisher or subscription."""
        with self._lock:
            if isinstance(item, ZmqPublisher):
                if item in self._publishers:
                    self._publishers.remove(item)
            elif item in self._subscriptions:
                self._subscriptions.remove(item)
                self._closing.append(item)
                self._wake()

    def close(self) -> None:
        """Closes everything; last messages get up to 0.2 s to leave."""
        if self._stop.is_set():
            return
        for publisher in list(self._publishers):
            publisher.close()
        with self._lock:
            self._stop.set()
            self._wake()
        self._thread.join(timeout=5.0)
        self._wake_out.close(linger=0)
        self.context.term()

    def _wake(self) -> None:
        self._wake_out.send(b"", zmq.NOBLOCK)

    def _run(self) -> None:
        poller = zmq.Poller()
        poller.register(self._wake_in, zmq.POLLIN)
        polled: dict[ZmqSubscription, None] = {}
        next_discovery = next_housekeeping = 0.0
        while not self._stop.is_set():
            with self._lock:
                wanted, closing = list(self._subscriptions), self._closing
                publishers = list(self._publishers)
                self._closing = []
            for subscription in closing:
                if subscription in polled:
                    poller.unregister(subscription.socket)
                    del polled[subscription]
                subscription.socket.close()
            for subscription in wanted:
                if subscription not in polled:
                    polled[subscription] = None
                    poller.register(subscription.socket, zmq.POLLIN)
                    next_discovery = 0.0
            now = time.monotonic()
            if now >= next_discovery:
                next_discovery = now + _DISCOVERY_S
                for subscription in polled:
                    try:
                        subscription.discover()
                    except OSError as error:  # the run directory was taken away under us
                        log.error("%s: %s", subscription.topic, error)
                        next_discovery = now + 1.0
            if now >= next_housekeeping:
                next_housekeeping = now + _HOUSEKEEPING_S
                for publisher in publishers:
                    publisher.attend()
            events = dict(poller.poll(int(_HOUSEKEEPING_S * 1000)))
            if self._wake_in in events:
                while int(self._wake_in.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
                    self._wake_in.recv(zmq.NOBLOCK)
            for subscription in polled:
                if subscription.socket in events:
                    subscription.drain()
        for subscription in {*polled, *self._subscriptions, *self._closing}:
            subscription.socket.close()
        self._wake_in.close(linger=0)
