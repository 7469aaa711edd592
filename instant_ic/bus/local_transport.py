"""Topics of one node on one machine: ZeroMQ sockets found through the registry; no broker, no master.

Which thread reads: while the node's thread waits in :meth:`LocalTransport.wait`, it reads its own sockets, so a message
wakes only that thread. During a long callback the bus thread reads instead, so that the newest message does not grow
old in a queue. The bus thread also serves new subscriptions and looks for publishers.

A thread that wakes runs with cold caches: a message then costs ten times what it costs in a row of messages. So no
thread wakes to look whether there is something to do, except for publishers.

Both wait on the sockets' file descriptors and touch a socket only under a lock, since ZeroMQ's are not thread-safe.
A thread that touches one must read all it has: its descriptor does not report an event twice.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import threading
import time
from collections.abc import Callable
from pathlib import Path

from instant_ic.bus import registry
from instant_ic.bus.host import Host
from instant_ic.bus.local_publisher import LINGER_S, LocalPublisher
from instant_ic.bus.local_subscription import LocalSubscription
from instant_ic.bus.qos import QoS

_DISCOVERY_S = 0.2
_IDLE_S = 1.0
_BUSY_S = 0.015  # a longer callback is slow
_SLOW_FOR_S = 10.0  # how long after a slow callback a message wakes the bus thread during each callback
_CLOSE_S = 5.0

log = logging.getLogger(__name__)


class LocalTransport:
    """Topics of one node, and the event that its thread waits on: waiting reads the node's sockets.

    Args:
        run_dir: the run directory; created if missing.
        node: the node's name; also names its publishers' sockets.
        now_ns: the node's clock, for stamps.
        steady_ns: the node's steady clock, for rates and ages.

    Attributes:
        patient: messages do not end a wait; they are read when it ends.

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
        self.patient = False
        self._host = Host(run_dir, node, now_ns, steady_ns)
        self.run_dir = self._host.run_dir
        self.node = node
        self._driver: int | None = None  # the thread that waits
        self._set = self._written = False
        self._quiet = False  # what the bus thread reads now wakes nobody
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._wake_poll = select.poll()
        self._wake_poll.register(self._wake, select.POLLIN)
        self._read_lock = threading.RLock()
        self._writers: dict[int, LocalPublisher] = {}  # by the descriptor of its socket
        self._readers: dict[int, LocalSubscription] = {}
        self._unread: list[LocalSubscription] = []  # may have more, which their descriptors do not show
        self._stop = threading.Event()
        self._inputs = select.epoll()
        self._events = select.epoll()
        self._poke = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._waiting = False
        self._left_s = time.monotonic()
        self._slow_until_s = 0.0
        self._bus_reads = True
        self._inputs.register(self._wake, select.EPOLLIN)
        self._events.register(self._poke, select.EPOLLIN)
        self._events.register(self._inputs.fileno(), select.EPOLLIN)
        self._next_look_s = 0.0
        self._thread = threading.Thread(target=self._run, name="bus", daemon=True)
        self._thread.start()

    def waker(self) -> LocalTransport:
        """The event that the node's thread waits on."""
        return self

    def set(self) -> None:
        """End the present or the next wait; may be called from any thread."""
        if not self._set:
            if self._quiet and threading.get_ident() == self._thread.ident:
                return
            self._set = True
            if threading.get_ident() != self._driver:
                self._written = True
                os.eventfd_write(self._wake, 1)

    def clear(self) -> None:
        """Let later waits wait."""
        self._set = False
        if self._written:
            self._written = False
            self._drain()

    def is_set(self) -> bool:
        """Whether the next wait ends at once."""
        return self._set

    def _drain(self) -> None:
        """Take the event from its descriptor, which would end every later wait at once."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake)

    def advertise(self, topic: str, type_name: str, qos: QoS) -> LocalPublisher:
        """Create a publisher, which readers can find at once.

        Raises:
            RegistryError: the node already publishes the topic, or the path is too long.
        """
        publisher = LocalPublisher(self._host, registry.check_topic(topic), type_name, qos, self._forget_publisher)
        self._writers[publisher.fd] = publisher
        self._events.register(publisher.fd, select.EPOLLIN)
        return publisher

    def subscribe(self, topic: str, type_name: str | None, qos: QoS, on_ready: Callable[[], None]) -> LocalSubscription:
        """Subscribe to all present and future publishers.

        Args:
            topic, qos: what to read.
            type_name: its type; None accepts any.
            on_ready: called when :meth:`LocalSubscription.take` has messages again, on the thread that reads; it must
                not wait.
        """
        with self._read_lock:
            subscription = LocalSubscription(self._host, topic, type_name, qos, on_ready, self._forget_subscription)
            self._readers[subscription.fd] = subscription
            self._inputs.register(subscription.fd, select.EPOLLIN)
        self._next_look_s = 0.0
        os.eventfd_write(self._poke, 1)
        return subscription

    def _forget_publisher(self, publisher: LocalPublisher) -> None:
        """Stop serving a publisher; its socket closes next."""
        if self._writers.pop(publisher.fd, None) is not None:
            self._events.unregister(publisher.fd)

    def _forget_subscription(self, subscription: LocalSubscription) -> None:
        """Stop reading a subscription and close its socket."""
        with self._read_lock:
            if self._readers.get(subscription.fd) is subscription:  # not closed before
                del self._readers[subscription.fd]
                self._inputs.unregister(subscription.fd)
                subscription.shut()

    def close(self) -> None:
        """Close everything; the last messages get up to 0.2 s to leave."""
        if self._stop.is_set():
            return
        self._stop.set()
        os.eventfd_write(self._poke, 1)
        self._thread.join(timeout=_CLOSE_S)
        for subscription in list(self._readers.values()):
            subscription.close()
        for publisher in list(self._writers.values()):
            publisher.close()
        with self._read_lock:
            self._set = True  # later calls of `set` do nothing
            self._inputs.close()
            self._events.close()
            os.close(self._wake)
            os.close(self._poke)
        started_s = time.monotonic()
        self._host.context.term()
        if time.monotonic() - started_s > LINGER_S / 2:  # no later message will reveal the gap to the readers
            log.warning("%s closed: its last messages are lost, a reader was too slow to take them", self.node)

    # -- reading ---------------------------------------------------------------------------------

    def wait(self, timeout: float) -> None:
        """Read the node's sockets until a message arrives, the event is set, or the time is over."""
        if self._set:
            return
        self._waiting = True
        self._driver = threading.get_ident()
        if self._bus_reads:
            with self._read_lock:  # the bus thread may just be taking the event from its descriptor
                self._hand_reading(False)
        now = time.monotonic()
        if now - self._left_s > _BUSY_S:
            self._slow_until_s = now + _SLOW_FOR_S
        self._read_rest()
        if self.patient and not self._set:
            self._wake_poll.poll(1000.0 * timeout)
        if self.patient or self._set:
            timeout = 0.0
        self._read(self._inputs.poll(timeout, 64), one=True)
        self._left_s = time.monotonic()
        if self.patient:
            self._read_rest()
        elif self._left_s < self._slow_until_s:
            self._hand_reading(True)
        self._waiting = False

    def _hand_reading(self, to_bus: bool) -> None:
        """Let the bus thread read, or no longer."""
        self._bus_reads = to_bus
        self._events.modify(self._inputs.fileno(), select.EPOLLIN if to_bus else 0)

    def _read(self, events: list[tuple[int, int]], one: bool) -> None:
        """Read what waits, or ``one`` message of each socket: looking for more would delay it."""
        with self._read_lock:
            for fd, _ in events:
                subscription = self._readers.get(fd)
                if subscription is not None:
                    subscription.read(one)
                    if one:
                        self._unread.append(subscription)
                elif one or not self._waiting:  # the event; left as it is, it would end every poll at once
                    self._drain()

    def _read_rest(self) -> None:
        """Read what was left of sockets of which one message was read."""
        if self._unread:
            with self._read_lock:
                unread, self._unread = self._unread, []
                for subscription in unread:
                    if self._readers.get(subscription.fd) is subscription:
                        subscription.read_rest()

    def _run(self) -> None:
        inputs = self._inputs.fileno()
        early = False
        while not self._stop.is_set():
            now = time.monotonic()
            if now >= self._next_look_s:
                self._next_look_s = now + _IDLE_S
                if self._look() and self._readers:
                    self._next_look_s = min(self._next_look_s, now + _DISCOVERY_S)
            if not (self._waiting or self._bus_reads or self.patient) and now - self._left_s > _BUSY_S:
                self._hand_reading(True)
                self._read_rest()
            timeout = _BUSY_S if early else max(0.0, self._next_look_s - now)
            early = False
            try:
                for fd, _ in self._events.poll(timeout, 64):
                    if fd == inputs:
                        # Most callbacks end soon: two threads that read in turn would wait for each other all the time.
                        early = not self._waiting and time.monotonic() - self._left_s < _BUSY_S
                        if early:
                            self._hand_reading(False)
                        else:
                            self._read(self._inputs.poll(0, 64), one=False)
                    elif fd == self._poke:
                        os.eventfd_read(fd)
                    elif (publisher := self._writers.get(fd)) is not None:
                        publisher.serve()
            except Exception:  # one bad event must not stop the bus
                log.exception("%s: fault on the bus thread", self.node)
                self._stop.wait(_BUSY_S)

    def _look(self) -> bool:
        """Look for publishers; False when the run directory is gone."""
        for publisher in list(self._writers.values()):
            publisher.serve()
        fine = True
        for subscription in list(self._readers.values()):
            with self._read_lock:
                try:
                    if self._readers.get(subscription.fd) is subscription:  # not just closed
                        self._quiet = self.patient
                        subscription.discover()
                except OSError as error:
                    log.error("%s: %s", subscription.topic, error)
                    fine = False
                finally:
                    self._quiet = False
        return fine
