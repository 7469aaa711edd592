"""Eyes on the bus for commands: raw subscriptions without being a node."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from instant_ic import paths
from instant_ic.bus import RELIABLE, registry
from instant_ic.bus.transport import Received
from instant_ic.bus.zmq_transport import ZmqSubscription, ZmqTransport
from instant_ic.cli.errors import UserError


class Observer:
    """Listens to one topic; a context manager.

    Args:
        topic: its name, with or without the leading slash.
        run_dir: run directory of the stack.

    Raises:
        RegistryError: the run directory cannot be used, or the name is not legal.
    """

    def __init__(self, topic: str, run_dir: Path | None = None) -> None:
        self.topic = topic if topic.startswith("/") else f"/{topic}"
        self._ready = threading.Event()
        self._transport = ZmqTransport(run_dir or paths.run_dir(), f"ic_{os.getpid()}", time.time_ns)
        self.subscription: ZmqSubscription = self._transport.subscribe(self.topic, None, RELIABLE, self._ready.set)

    def __enter__(self) -> Observer:
        """The observer itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Lets go of the bus."""
        self._transport.close()

    def batches(self, duration_s: float, period_s: float) -> Iterator[list[Received]]:
        """What came, at least every ``period_s`` (then maybe empty), for ``duration_s`` in all."""
        end_s = time.monotonic() + duration_s
        while (left_s := end_s - time.monotonic()) > 0:
            self._ready.wait(min(period_s, left_s))
            self._ready.clear()
            yield self.subscription.take()


def nothing_heard(topic: str, seconds: float, run_dir: Path | None = None) -> UserError:
    """The error of a command that heard nothing, with what is likely the reason."""
    known = {info.topic for info in registry.list_topics(run_dir or paths.run_dir())}
    why = "its publisher is silent" if topic in known else "nobody publishes it: ic topic list"
    return UserError(f"{topic}: nothing came in {seconds:.0f} s, {why}")
