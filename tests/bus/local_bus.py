"""Helpers of the bus's tests: transports in one run directory, numbered messages, waiting for an event."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.bus import RELIABLE, QoS
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.transport import Received

BYTES = "std_msgs/msg/UInt8MultiArray"
LARGE = 200_000
"""Goes through shared memory; what comes of this size over a socket is `bytes`, not a view."""


def wait_for(condition: Callable[[], Any], timeout_s: float = 60.0) -> Any:
    deadline = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.005)
    return value


class Bus:
    """Transports by node name; closed together."""

    def __init__(self, run_dir: Path) -> None:
        self.run_dir = run_dir
        self.transports: dict[str, LocalTransport] = {}

    def node(self, name: str) -> LocalTransport:
        if name not in self.transports:
            self.transports[name] = LocalTransport(self.run_dir, name, time.time_ns)
        return self.transports[name]

    def publisher(self, topic: str = "/x", qos: QoS = RELIABLE, node: str = "sender", type_name: str = BYTES):
        return self.node(node).advertise(topic, type_name, qos)

    def reader(self, topic: str = "/x", qos: QoS = RELIABLE, node: str = "reader", type_name: str | None = BYTES):
        return Reader(self.node(node), topic, qos, type_name)

    def close(self) -> None:
        for transport in self.transports.values():
            transport.close()


class Reader:
    """A subscription and what it has given so far."""

    def __init__(self, transport: LocalTransport, topic: str, qos: QoS, type_name: str | None) -> None:
        self.transport = transport
        self.event = threading.Event()
        self.raw = transport.subscribe(topic, type_name, qos, self.event.set)
        self.stats = self.raw.stats
        self.received: list[Received] = []

    def poll(self) -> list[Received]:
        self.received += self.raw.take()
        return self.received

    def numbers(self) -> list[int]:
        return [number(message) for message in self.poll()]


def numbered(value: int, size: int = 8) -> bytes:
    """A payload that tells its number, and of which every byte can be checked."""
    return struct.pack("<q", value) + bytes([value % 251]) * (size - 8)


def number(message: Received) -> int:
    return int(struct.unpack_from("<q", message.payload)[0])


def whole(message: Received) -> bool:
    """Whether every byte is what :func:`numbered` wrote."""
    data = np.frombuffer(message.payload, np.uint8, offset=8)
    return bool((data == number(message) % 251).all())
