"""Topics of one node on one machine: Unix sockets found through the registry; no broker, no master.

Which thread reads: while the node's thread waits in :meth:`Waker.wait`, it reads its own sockets, so a message wakes
only that thread. During a long callback the bus thread reads instead, so that the newest message does not grow old in
a queue. The bus thread also accepts readers, sends what a slow reader has not taken yet, and looks for publishers.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import select
import threading
import time
from collections.abc import Callable
from pathlib import Path

from instant_ic.bus import registry
from instant_ic.bus.frame import FrameError
from instant_ic.bus.local_publisher import LocalPublisher
from instant_ic.bus.local_subscription import Inlet, LocalSubscription
from instant_ic.bus.qos import QoS

_DISCOVERY_S = 0.1
_IDLE_S = 5.0
_BUSY_S = 0.015  # during a longer callback the bus thread reads instead
_SLOW_FOR_S = 10.0  # how long after a slow callback the bus thread keeps checking at that interval
_CLOSE_S = 5.0

log = logging.getLogger(__name__)


class Waker:
    """Like a :class:`threading.Event` for the one thread that waits; its ``wait`` also reads the node's sockets."""

    def __init__(self, transport: LocalTransport) -> None:
        self._transport = transport
        self._set = False
        self._written = False
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def set(self) -> None:
        """End the present or the next wait; may be called from any thread."""
        if self._set:
            return
        self._set = True
        if threading.get_ident() != self._transport.driver:
            self._written = True
            os.eventfd_write(self.fd, 1)

    def clear(self) -> None:
        """Reset the event."""
        self._set = False
        if self._written:
            self._written = False
            with contextlib.suppress(BlockingIOError):  # not written yet: one later wait ends early
                os.eventfd_read(self.fd)

    def close(self) -> None:
        """Close the event; later calls of ``set`` do nothing."""
        self._set = True
        os.close(self.fd)

    def wait(self, timeout: float) -> None:
        """Read the node's sockets until a message arrives, the event is set, or the time is over."""
        if not self._set:
            self._transport.wait(timeout)


class LocalTransport:
    """Topics of one node.

    Args:
        run_dir: the run directory; created if missing.
        node: the node's name; also names its publishers' sockets.
        now_ns: the node's clock, for stamps.
        steady_ns: the node's steady clock, for rates and ages.

    Raises:
        RegistryError: the run directory cannot be used.
    """

    def __init__(
        self,
        run_dir: Path,
        node: str,
        now_ns: Callable[[], int],
        steady_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.run_dir = registry.prepare(run_dir)
        self.node = registry.check_node_name(node)
        self.now_ns = now_ns
        self.steady_ns = steady_ns
        self.driver: int | None = None
        self.next_order: Callable[[], int] = itertools.count().__next__  # a message's position in order of arrival
        self._lock = threading.Lock()
        self._read_lock = threading.RLock()
        self._publishers: list[LocalPublisher] = []
        self._subscriptions: list[LocalSubscription] = []
        self._inlets: dict[int, Inlet] = {}
        self._stop = threading.Event()
        self._inputs = select.epoll()
        self._events = select.epoll()
        self._handlers: dict[int, Callable[[int], None]] = {}
        self._poke = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._events.register(self._poke, select.EPOLLIN)
        self._waiting = False
        self._left_s = time.monotonic()
        self._slow_until_s = 0.0
        self._bus_reads = True
        self._events.register(self._inputs.fileno(), select.EPOLLIN)
        self._waker: Waker | None = None
        self._look_now = False
        self._thread = threading.Thread(target=self._run, name="bus", daemon=True)
        self._thread.start()

    def waker(self) -> Waker:
        """The event that the node's thread waits on; one per transport."""
        if self._waker is None:
            self._waker = Waker(self)
            self._inputs.register(self._waker.fd, select.EPOLLIN)
        return self._waker

    def advertise(self, topic: str, type_name: str, qos: QoS) -> LocalPublisher:
        """Create a publisher, which readers can find at once.

        Raises:
            RegistryError: the node already publishes the topic, or the path is too long.
        """
        publisher = LocalPublisher(self, registry.check_topic(topic), type_name, qos)
        with self._lock:
            self._publishers.append(publisher)
        return publisher

    def subscribe(self, topic: str, type_name: str | None, qos: QoS, on_ready: Callable[[], None]) -> LocalSubscription:
        """Subscribe to all present and future publishers; ``type_name`` None accepts any type."""
        subscription = LocalSubscription(self, topic, type_name, qos, on_ready)
        if self._waker is not None and on_ready == self._waker.set:
            subscription.waker = self._waker
        with self._lock:
            self._subscriptions.append(subscription)
            self._look_now = True
        os.eventfd_write(self._poke, 1)
        return subscription

    def forget(self, item: LocalPublisher | LocalSubscription) -> None:
        """Remove a closed publisher or subscription."""
        with self._lock:
            if isinstance(item, LocalPublisher):
                if item in self._publishers:
                    self._publishers.remove(item)
                return
            if item not in self._subscriptions:
                return
            self._subscriptions.remove(item)
        with self._read_lock:
            item.shut()

    def close(self) -> None:
        """Close everything; the last messages get up to 0.2 s to leave."""
        if self._stop.is_set():
            return
        for publisher in list(self._publishers):
            publisher.close()
        self._stop.set()
        os.eventfd_write(self._poke, 1)
        self._thread.join(timeout=_CLOSE_S)
        for subscription in list(self._subscriptions):
            subscription.close()
        with self._read_lock:
            if self._waker is not None:
                self._waker.close()
            self._inputs.close()
            self._events.close()
            os.close(self._poke)

    # -- for publishers: sockets served by the bus thread --------------------------------------------

    def watch(self, fd: int, events: int, handler: Callable[[int], None]) -> None:
        """Call ``handler(events)`` on the bus thread when the file descriptor has one of these events."""
        self._handlers[fd] = handler
        self._events.register(fd, events)

    def rewatch(self, fd: int, events: int) -> None:
        """Change the events to wait for."""
        self._events.modify(fd, events)

    def unwatch(self, fd: int) -> None:
        """Stop watching; call this before the file descriptor is closed."""
        if self._handlers.pop(fd, None) is not None:
            self._events.unregister(fd)

    # -- for subscriptions, under the read lock --------------------------------------------------

    def add_inlet(self, inlet: Inlet) -> None:
        """Start reading a connection."""
        self._inlets[inlet.socket.fileno()] = inlet
        self._inputs.register(inlet.socket.fileno(), select.EPOLLIN)

    def remove_inlet(self, inlet: Inlet) -> None:
        """Stop reading a connection."""
        if self._inlets.pop(inlet.socket.fileno(), None) is not None:
            self._inputs.unregister(inlet.socket.fileno())

    def read_inlet(self, inlet: Inlet) -> None:
        """Read what has arrived over one connection."""
        try:
            alive = inlet.read()
        except (FrameError, OSError) as error:
            log.error("%s: %s; the connection is closed", inlet.subscription.topic, error)
            alive = False
        if not alive:
            inlet.subscription.lose_inlet(inlet)

    # -- reading ---------------------------------------------------------------------------------

    def wait(self, timeout: float) -> None:
        """Read the node's sockets until a message arrives or the time is over; on the node's thread."""
        self._waiting = True
        if self._bus_reads:
            self._bus_reads = False
            self._events.modify(self._inputs.fileno(), 0)
        self.driver = threading.get_ident()
        now = time.monotonic()
        if now - self._left_s > _BUSY_S:
            if now > self._slow_until_s:
                os.eventfd_write(self._poke, 1)
            self._slow_until_s = now + _SLOW_FOR_S
        self._drain(self._inputs.poll(timeout, 16), self._waker)
        self._left_s = time.monotonic()
        self._waiting = False

    def _drain(self, events: list[tuple[int, int]], reader: Waker | None) -> None:
        """Read what waits, and notify every subscription that ``reader`` does not serve."""
        others: list[LocalSubscription] = []
        with self._read_lock:
            for fd, _ in events:
                inlet = self._inlets.get(fd)
                if inlet is not None:
                    self.read_inlet(inlet)
                    subscription = inlet.subscription
                    if subscription.fresh:
                        subscription.fresh = False
                        if reader is None or subscription.waker is not reader:
                            others.append(subscription)
        for subscription in others:
            subscription.on_ready()

    def _run(self) -> None:
        inputs = self._inputs.fileno()
        next_look = 0.0
        while not self._stop.is_set():
            now = time.monotonic()
            if self._look_now or now >= next_look:
                self._look_now = False
                next_look = now + (_DISCOVERY_S if self._look() else 1.0)
            if not self._waiting and not self._bus_reads and now - self._left_s > _BUSY_S:
                self._bus_reads = True
                self._events.modify(inputs, select.EPOLLIN)
            timeout = min(_IDLE_S, next_look - now) if self._subscriptions else _IDLE_S
            if now < self._slow_until_s:
                timeout = min(timeout, _BUSY_S)
            try:
                for fd, events in self._events.poll(max(0.0, timeout), 64):
                    if fd == inputs:
                        self._drain(self._inputs.poll(0, 64), None)
                    elif fd == self._poke:
                        os.eventfd_read(fd)
                    elif (handler := self._handlers.get(fd)) is not None:
                        handler(events)
            except Exception:  # one bad event must not stop the bus
                log.exception("%s: fault on the bus thread", self.node)
                self._stop.wait(_BUSY_S)

    def _look(self) -> bool:
        """Look for publishers; False when the run directory is gone."""
        fine = True
        for subscription in list(self._subscriptions):
            with self._read_lock:
                try:
                    subscription.discover()
                except OSError as error:
                    log.error("%s: %s", subscription.topic, error)
                    fine = False
                fresh, subscription.fresh = subscription.fresh, False
            if fresh:
                subscription.on_ready()
        return fine
