"""Raw subscriptions for commands, which are not nodes, and the newest heartbeat of each node."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from instant_ic.bus import RELIABLE, registry
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.heartbeat import TYPE, Heartbeat, from_message
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.transport import RawSubscription, Received
from instant_ic.cli.errors import UserError
from instant_ic.cli.names import absolute, unknown_topic
from instant_ic.msg import deserialize
from instant_ic.util import pace, paths
from instant_ic.util.closing import Closing


class TopicObserver(Closing):
    """Subscriptions to topics, until the end of the ``with`` block.

    Args:
        topics: one or several names, with or without the leading slash.

    Raises:
        RegistryError: the run directory cannot be used, or a name is invalid.
    """

    def __init__(self, topics: str | Sequence[str], run_dir: Path | None = None) -> None:
        names = [topics] if isinstance(topics, str) else list(topics)
        self.topics = list(dict.fromkeys(absolute(name) for name in names))
        self._run_dir = run_dir or paths.run_dir()
        registry.prepare(self._run_dir)  # checks the folder's owner before any content is used
        try:
            pace.use(pace.read(self._run_dir))
        except pace.PaceError as error:
            raise registry.RegistryError(str(error)) from error
        self.clock = SystemClock()
        self.received = 0
        """Number of messages yielded by :meth:`batches`."""
        self._ready = threading.Event()
        self.transport = LocalTransport(self._run_dir, f"ic_{os.getpid()}", self.clock.now_ns)
        try:
            self.subscriptions = {topic: self._subscribe(topic) for topic in self.topics}
        except registry.RegistryError:
            self.transport.close()
            raise

    def _subscribe(self, topic: str) -> RawSubscription:
        return self.transport.subscribe(topic, None, RELIABLE, self._ready.set)

    def close(self) -> None:
        self.transport.close()

    def lost_by(self, topic: str) -> dict[str, int]:
        """Return the number of a topic's messages that were lost before they arrived here, by publisher."""
        return self.subscriptions[topic].stats.lost_by

    def batches(self, duration_s: float, period_s: float) -> Iterator[list[Received]]:
        """Yield lists of arrived messages for ``duration_s``, at least every ``period_s``; a list may be empty."""
        end_s = time.monotonic() + duration_s
        while (left_s := end_s - time.monotonic()) > 0:
            self._ready.wait(min(period_s, left_s))
            self._ready.clear()
            batch = [received for topic in self.topics for received in self.subscriptions[topic].take()]
            self.received += len(batch)
            yield batch

    def hint(self) -> None:
        """Print a line to standard error for each topic that has no publisher yet."""
        known = {info.topic for info in registry.list_topics(self._run_dir)}
        for topic in self.topics:
            if topic not in known:
                print(f"ic: {unknown_topic(topic, known)}; waiting for it", file=sys.stderr)

    def too_few(self, seconds: float) -> UserError:
        """Return the error for a command that received no message, or fewer than it needs, with the likely reason."""
        known = {info.topic for info in registry.list_topics(self._run_dir)}
        missing = [topic for topic in self.topics if topic not in known]
        silent = [topic for topic in self.topics if topic in known]
        why = [unknown_topic(topic, known) for topic in missing]
        if self.received:
            plural = "s" * (self.received > 1)
            return UserError("; ".join([f"only {self.received} message{plural} received in {seconds:.0f} s", *why]))
        if silent:
            why.append(f"{', '.join(silent)} has a publisher that sends nothing (ic topic info -v {silent[0]})")
        return UserError(f"nothing received in {seconds:.0f} s: {'; '.join(why)}")


def newest(topic: str, timeout_s: float) -> Received | None:
    """Return the next message of a topic; None if none arrives within ``timeout_s``."""
    with TopicObserver(topic) as observer:
        return next((received for batch in observer.batches(timeout_s, 0.1) for received in batch), None)


class Heartbeats(TopicObserver):
    """Subscription to the heartbeats of all nodes in a run directory."""

    def __init__(self, run_dir: Path) -> None:
        topics = {info.topic for info in registry.list_topics(run_dir) if info.type_name == TYPE}
        super().__init__(sorted(topics | {"/heartbeat"}), run_dir=run_dir)
        self.newest: dict[str, Heartbeat] = {}

    def listen(self, seconds: float, until: Collection[str] = ()) -> dict[str, Heartbeat]:
        """Listen for ``seconds`` or until the nodes in ``until`` were heard; return each node's newest heartbeat."""
        for batch in self.batches(seconds, 0.1):
            for received in batch:
                if received.type_name == TYPE:
                    with suppress(ValueError):  # a node whose heartbeat cannot be read counts as silent
                        beat = from_message(deserialize(received.payload, received.type_name))
                        self.newest[beat.node] = beat
            if until and all(node in self.newest for node in until):
                break
        return self.newest


def hear(run_dir: Path, nodes: Collection[str], seconds: float = 2.5) -> dict[str, Heartbeat]:
    """Return the heartbeats of the given nodes, except those that send none within ``seconds``."""
    if not nodes:
        return {}
    with Heartbeats(run_dir) as heartbeats:
        return heartbeats.listen(seconds, nodes)
