"""State of a transport that its publishers and subscriptions share."""

from __future__ import annotations

import itertools
import select
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import zmq

from instant_ic.bus import registry

_MOST_SOCKETS = 4096


class Reader(Protocol):
    """A subscription to read when its file descriptor is readable."""

    def discover(self) -> None: ...
    def read(self, one: bool = False) -> None: ...
    def close(self) -> None: ...


class Host:
    """Run directory, node name, clocks, ZeroMQ context and open subscriptions of one transport.

    Raises:
        RegistryError: the run directory cannot be used.
    """

    def __init__(self, run_dir: Path, node: str, now_ns: Callable[[], int], steady_ns: Callable[[], int]) -> None:
        self.run_dir = registry.prepare(run_dir)
        self.node = registry.check_node_name(node)
        self.now_ns = now_ns
        self.steady_ns = steady_ns
        self.next_order: Callable[[], int] = itertools.count().__next__  # position of a message in order of arrival
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.context.set(zmq.MAX_SOCKETS, _MOST_SOCKETS)
        self.read_lock = threading.RLock()  # guards the sockets of subscriptions
        self.readers: dict[int, Reader] = {}  # open subscriptions by the descriptor of their socket
        self.inputs = select.epoll()  # descriptors on which the node's thread waits
