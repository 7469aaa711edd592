"""The newest heartbeat of each node, for the verbs that show what the nodes tell of themselves."""

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
"""A node without a heartbeat for longer than this is called silent."""


@dataclass(frozen=True)
class Flow:
    """One topic in or out of a node.

    Attributes:
        rate_hz: messages a second.
        age_s: since the newest message; inf before the first.
    """

    rate_hz: float
    age_s: float = math.inf


@dataclass
class Heartbeat:
    """What a node last told of itself.

    Attributes:
        node: its name.
        pid: of its process.
        state: a word of ``STATES``.
        message: its worst diagnosis in words; empty when all is well.
        cpu_percent: of one core.
        rss_mb: resident memory.
        inputs: topic → what comes in.
        outputs: topic → what goes out.
        lost: (topic, publisher) → messages lost on the way in.
        seen_s: monotonic time when the heartbeat came.
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
    """A NodeStatus message."""
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
    """Listens to the heartbeats of every node in a run directory, whatever its namespace; a context manager."""

    def __init__(self, run_dir: Path) -> None:
        self.run_dir = run_dir
        self.newest: dict[str, Heartbeat] = {}
        self._observer: Observer | None = None

    def __enter__(self) -> Heartbeats:
        """Starts to listen."""
        topics = {info.topic for info in registry.list_topics(self.run_dir) if info.type_name == TYPE}
        self._observer = Observer(sorted(topics | {"/heartbeat"}), run_dir=self.run_dir)
        return self

    def __exit__(self, *_: object) -> None:
        """Lets go of the bus."""
        if self._observer is not None:
            self._observer.__exit__(None, None, None)

    def listen(self, seconds: float, until: Collection[str] = ()) -> dict[str, Heartbeat]:
        """Takes in what comes for some time, or until every node named has been heard; the newest of each node."""
        assert self._observer is not None
        for batch in self._observer.batches(seconds, 0.1):
            for received in batch:
                if received.type_name == TYPE:
                    beat = from_message(deserialize(received.payload, received.type_name))
                    self.newest[beat.node] = beat
            if until and all(node in self.newest for node in until):
                break
        return self.newest


def hear(run_dir: Path, nodes: Collection[str], seconds: float = 1.5) -> dict[str, Heartbeat]:
    """The heartbeats of some nodes; those that stay silent for ``seconds`` are missing."""
    if not nodes:
        return {}
    with Heartbeats(run_dir) as heartbeats:
        return heartbeats.listen(seconds, nodes)
