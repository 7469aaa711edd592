"""Real nodes on the real bus inside the test's process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from instant_ic.bus import RELIABLE, Node
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.msg import serialize, type_name


def wait_for(condition: Callable[[], Any], what: str, timeout_s: float = 30.0) -> Any:
    deadline = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < deadline, f"no {what} within {timeout_s:g} s"
        time.sleep(0.01)
    return value


class LiveNode:
    """A node that spins on a thread of its own."""

    def __init__(self, run_dir: Path, node_class: type[Node[Any]], config: Any, name: str):
        clock = SystemClock()
        transport = LocalTransport(run_dir, name, clock.now_ns)
        self.node = node_class(config, transport, clock, name)
        try:
            self.node.start()
        except BaseException:
            self.node.close()
            raise
        self._thread = threading.Thread(target=self.node.spin, daemon=True)
        self._thread.start()

    def told(self, name: str) -> str:
        """The words of a diagnosis; empty while there is none."""
        return self.node.diagnoses().get(name, (0, "", {}))[1]

    def close(self) -> None:
        self.node.stop()
        self._thread.join(10)
        self.node.close()


@dataclass(frozen=True)
class _Nothing:
    """No parameters."""


class _Plain(Node[_Nothing]):
    name = "plain"


class Neighbour:
    """Another node of the run directory, for publishing and listening."""

    def __init__(self, run_dir: Path, name: str):
        self.node = _Plain(_Nothing(), LocalTransport(run_dir, name, time.time_ns), SystemClock(), name)
        self.received: dict[str, list[Any]] = {}

    def publisher(self, topic: str, message_class: Any, qos=RELIABLE):
        return self.node.publisher(topic, message_class, qos)

    def listen(self, topic: str, qos=RELIABLE) -> list[Any]:
        """A list that fills with what comes while :meth:`spin` or :meth:`wait` runs."""
        messages = self.received.setdefault(topic, [])
        self.node.subscribe_received(topic, messages.append, qos)
        return messages

    def wait(self, condition: Callable[[], Any], what: str, timeout_s: float = 30.0) -> Any:
        def look() -> Any:
            self.node.spin_once()
            return condition()

        return wait_for(look, what, timeout_s)

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.node.spin_once()
            time.sleep(0.01)

    def close(self) -> None:
        self.node.close()


def cdr(message: Any) -> bytes:
    assert type_name(message)
    return bytes(serialize(message))
