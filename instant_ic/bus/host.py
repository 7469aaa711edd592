"""What the publishers and subscriptions of one transport share."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import zmq

from instant_ic.bus import registry

_MOST_SOCKETS = 4096


class Host:
    """Run directory, node name, clocks and ZeroMQ context of one transport.

    Raises:
        RegistryError: the run directory cannot be used.
    """

    def __init__(self, run_dir: Path, node: str, now_ns: Callable[[], int], steady_ns: Callable[[], int]) -> None:
        self.run_dir = registry.prepare(run_dir)
        self.node = registry.check_node_name(node)
        self.now_ns = now_ns
        self.steady_ns = steady_ns
        self.next_order: Callable[[], int] = itertools.count().__next__  # a message's position in order of arrival
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.context.set(zmq.MAX_SOCKETS, _MOST_SOCKETS)
