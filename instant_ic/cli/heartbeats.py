"""The newest heartbeat of each node, for the commands that show the state of nodes."""

from __future__ import annotations

import math
import time
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from instant_ic.bus import registry
from instant_ic.cli.observer import Observer
from instant_ic.msg import deserialize

TYPE = "instant_ic_msgs/msg/NodeStatus"
STATES = ("starting", "running", "degraded", "failed", "stopping")
SILENT_AFTER_S = 3.0
"""A node without a heartbeat for longer than this is stale (state ``silent``)."""


@dataclass(frozen=True)
class Flow:
    """One topic in or out of a node.

    Attributes:
        rate_hz: messages per second.
        age_s: time since the newest message; inf before the first.
    """

    rate_hz: float
    age_s: float = math.inf


@dataclass
class Heartbeat:
    """Newest status of a node.

    Attributes:
        node: its name.
        pid: process id.
        state: one of ``STATES``.
        message: text of its worst diagnosis; empty when all is well.
        cpu_percent: of one core.
        rss_mb: resident memory.
        inputs: topic → flow of a subscription.
        outputs: topic → flow of a publisher.
        lost: (topic, publisher) → messages that this node has lost.
        seen_s: monotonic time at which the heartbeat arrived.
    """

    node: str
    pid: int
    state: str
    message: str
    cpu_percent: float
    rss_mb: float
    inputs: dict[str, Flow] = field(default_factory=dict)
    outputs: dict[str, Flow] = field(default_factory=dict)
    lost: dict[tuple[str, str], int] = field(default_factory=dict)
    seen_s: float = 0.0

    @property
    def silent(self) -> bool:
        """Whether the next heartbeat is overdue."""
        return time.monotonic() - self.seen_s > SILENT_AFTER_S


def from_message(message: Any) -> Heartbeat:
    """Heartbeat from a NodeStatus message."""
    flows = zip(message.inputs, message.input_rates_hz, message.input_ages_s, strict=True)
    sent = zip(message.outputs, message.output_rates_hz, message.output_ages_s, strict=True)
    lost = zip(message.lost_topics, message.lost_publishers, message.lost_counts, strict=True)
    return Heartbeat(
        message.node,
        int(message.pid),
        STATES[message.state] if message.state < len(STATES) else "unknown",
        message.message,
        float(message.cpu_percent),
        float(message.rss_mb),
        {topic: Flow(float(rate), float(age)) for topic, rate, age in flows},
        {topic: Flow(float(rate), float(age)) for topic, rate, age in sent},
        {(topic, publisher): int(count) for topic, publisher, count in lost},
        time.monotonic(),
    )


class Heartbeats:
    """Context manager that listens to the heartbeats of every node in a run directory, in every namespace."""

    def __init__(self, run_dir: Path) -> None:
        self.run_dir = run_dir
        self.newest: dict[str, Heartbeat] = {}
        self._observer: Observer | None = None

    def __enter__(self) -> Heartbeats:
        """Start listening."""
        topics = {info.topic for info in registry.list_topics(self.run_dir) if info.type_name == TYPE}
        self._observer = Observer(sorted(topics | {"/heartbeat"}), run_dir=self.run_dir)
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect from the bus."""
        if self._observer is not None:
            self._observer.__exit__(None, None, None)

    def listen(self, seconds: float, until: Collection[str] = ()) -> dict[str, Heartbeat]:
        """Listen for some time, or until all the named nodes were heard; return the newest heartbeat of each node."""
        assert self._observer is not None
        for batch in self._observer.batches(seconds, 0.1):
            for received in batch:
                if received.type_name == TYPE:
                    beat = from_message(deserialize(received.payload, received.type_name))
                    self.newest[beat.node] = beat
            if until and all(node in self.newest for node in until):
                break
        return self.newest


def hear(run_dir: Path, nodes: Collection[str], seconds: float = 2.5) -> dict[str, Heartbeat]:
    """Heartbeats of the given nodes, without those that send none within ``seconds``."""
    if not nodes:
        return {}
    with Heartbeats(run_dir) as heartbeats:
        return heartbeats.listen(seconds, nodes)
