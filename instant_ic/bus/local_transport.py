"""Topics of one node on one machine: ZeroMQ sockets found through the registry, without a broker or master.

While the node's thread waits in :meth:`LocalTransport.wait`, it reads the sockets itself, so a message wakes only that
thread. During a long callback of the node, the bus thread reads instead. The bus thread also serves new subscriptions
and looks for publishers. It sleeps in between, because a thread that has just woken up has cold caches and needs ten
times as long per message as one that keeps running.

Both threads wait on the sockets' file descriptors. ZeroMQ's sockets are not thread-safe, so both use them only under a
lock. A thread that uses a socket must read all its messages, because the descriptor does not report an event twice.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from instant_ic.bus import registry
from instant_ic.bus.host import Host
from instant_ic.bus.local_publisher import LINGER_S, LocalPublisher
from instant_ic.bus.local_subscription import LocalSubscription
from instant_ic.bus.qos import QoS

_LOOK_S = 0.2
_IDLE_S = 1.0
_AWAY_S = 0.015  # time since the node's last wait after which the bus thread reads, the next time that it is awake
_CLOSE_S = 5.0

log = logging.getLogger(__name__)


class LocalTransport(Host):
    """Topics of one node, and the event that its thread waits for. Waiting also reads the node's sockets.

    Args:
        run_dir: the run directory; created if missing.
        node: the node's name, which is also the file name of its publishers' sockets.
        now_ns: the node's clock, for stamps.
        steady_ns: the node's steady clock, for rates and ages.

    Attributes:
        patient: true if messages do not end a wait; they are read at its end.

    Raises:
        RegistryError: the run directory cannot be used.
    """

    def __init__(
        self, run_dir: Path, node: str, now_ns: Callable[[], int], steady_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        super().__init__(run_dir, node, now_ns, steady_ns)
        self.patient = False
        self._driver: int | None = None  # id of the thread that waits
        self._set = self._waiting = False
        self._left_s = 0.0  # monotonic time at which the last wait ended
        self._next_look_s = 0.0
        self._unread: list[int] = []  # sockets of which only one message was read
        self._writers: list[LocalPublisher] = []
        self._wake, self._poke = (os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC) for _ in range(2))
        self.inputs.register(self._wake, select.EPOLLIN)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bus", daemon=True)
        self._thread.start()

    def set(self) -> None:
        """End the present or the next wait. Any thread may call this."""
        if not self._set:
            self._set = True
            if threading.get_ident() != self._driver:
                os.eventfd_write(self._wake, 1)

    def clear(self) -> None:
        """Reset the event, so that later waits do not end at once."""
        self._set = False

    def advertise(self, topic: str, type_name: str, qos: QoS) -> LocalPublisher:
        """Create a publisher. Readers can find it at once.

        Raises:
            RegistryError: the node already publishes the topic, or the path is too long.
        """
        publisher = LocalPublisher(self, registry.check_topic(topic), type_name, qos)
        with self.read_lock:
            self._writers = [*(writer for writer in self._writers if not writer.closed), publisher]
        os.eventfd_write(self._poke, 1)
        return publisher

    def subscribe(self, topic: str, type_name: str | None, qos: QoS, on_ready: Callable[[], None]) -> LocalSubscription:
        """Subscribe to all present and future publishers.

        Args:
            topic: name of the topic.
            type_name: type of the topic; None accepts any type.
            qos: preset that sets the queue's length.
            on_ready: function called on the reading thread when :meth:`LocalSubscription.take` has messages again; it
                must not block.
        """
        with self.read_lock:
            subscription = LocalSubscription(self, topic, type_name, qos, on_ready)
        self._next_look_s = 0.0
        os.eventfd_write(self._poke, 1)
        return subscription

    def close(self) -> None:
        """Close all topics. The last messages get up to 0.2 s to leave."""
        if self._stop.is_set():
            return
        self._stop.set()
        os.eventfd_write(self._poke, 1)
        self._thread.join(timeout=_CLOSE_S)
        for subscription in list(self.readers.values()):
            subscription.close()
        for publisher in self._writers:
            publisher.close()
        with self.read_lock:
            self._set = True  # makes later calls of `set` do nothing
            self.inputs.close()
            os.close(self._wake)
            os.close(self._poke)
        started_s = time.monotonic()
        self.context.term()
        if time.monotonic() - started_s > LINGER_S / 2:  # no later message will show the gap to the readers
            log.warning("%s closed, but a reader was too slow: its last messages are lost", self.node)

    # -- reading ---------------------------------------------------------------------------------

    def wait(self, timeout: float) -> None:
        """Read the node's sockets until a message arrives, the event is set or the time-out has passed."""
        self._driver = threading.get_ident()
        self._read(self._unread)  # a message found here sets the event, because no descriptor reports it
        timeout = 0.0 if self._set else timeout
        self._waiting = timeout > 0.0  # a wait of zero does not take the reading over from the bus thread
        patient = self.patient
        if patient:
            ready = [*_readable([self._wake], timeout), *self.readers]
        else:
            ready = [fd for fd, _ in self.inputs.poll(timeout, 64)]
        self._read(ready, one=not patient)
        self._unread = [] if patient else ready
        if self._wake in ready:  # else the eventfd would end every later wait
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._wake)
        self._waiting, self._left_s = False, time.monotonic()

    def _read(self, fds: Iterable[int], one: bool = False) -> None:
        with self.read_lock:
            for fd in fds:
                if (subscription := self.readers.get(fd)) is not None:
                    subscription.read(one)

    def _run(self) -> None:
        while not self._stop.is_set():
            now = time.monotonic()
            try:
                if now >= self._next_look_s:
                    self._next_look_s = now + _IDLE_S
                    self._look()
                    self._next_look_s = min(self._next_look_s, now + (_LOOK_S if self.readers else _IDLE_S))
                writers = {writer.fd: writer for writer in self._writers if not writer.closed}
                inputs: list[int] = []
                timeout_s = self._next_look_s - now
                if not (self._waiting or self.patient):
                    if (away_in_s := self._left_s + _AWAY_S - now) > 0:
                        timeout_s = min(timeout_s, away_in_s)
                    else:
                        inputs = list(self.readers)
                        self._read(self._unread)  # their descriptors do not report messages that have arrived already
                ready = _readable([self._poke, *writers, *inputs], max(0.0, timeout_s))
                if self._poke in ready:
                    os.eventfd_read(self._poke)
                for fd in ready:
                    if (publisher := writers.get(fd)) is not None:
                        publisher.serve()
                if not self._waiting:
                    self._read(ready)
            except Exception as error:  # one bad event must not stop the bus
                expected = isinstance(error, OSError)  # such as a missing run directory
                log.error("%s: fault on the bus thread: %s", self.node, error, exc_info=not expected)
                self._stop.wait(_AWAY_S)

    def _look(self) -> None:
        """Look for publishers and subscribers.

        Raises:
            OSError: the run directory is gone.
        """
        fault: Exception | None = None
        for publisher in self._writers:
            publisher.serve()
        for fd, subscription in list(self.readers.items()):
            with self.read_lock:
                if self.readers.get(fd) is subscription:  # else it has just been closed
                    try:
                        subscription.discover()
                    except Exception as error:  # noqa: BLE001 - raised below, after the other topics
                        fault = error
                    if not self.patient:  # a patient node reads all sockets when it wakes
                        subscription.read()
        if fault is not None:
            raise fault


def _readable(fds: Iterable[int], timeout_s: float) -> list[int]:
    """Wait for the first of some descriptors and return those that are readable."""
    poll = select.poll()
    for fd in fds:
        poll.register(fd, select.POLLIN)
    return [fd for fd, _ in poll.poll(1000.0 * timeout_s)]
