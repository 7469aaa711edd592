"""The heartbeat of a node (NodeStatus), for the launcher and the commands."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Any

TYPE = "instant_ic_msgs/msg/NodeStatus"
STATES = ("starting", "running", "degraded", "failed", "stopping")
SILENT_AFTER_S = 3.0
"""Age of a heartbeat above which its node is silent, in seconds."""
EVERY_NODES = ("/heartbeat", "/diagnostics", "/rosout")
"""Last parts of the topics that every node publishes. Without them, a node is silent, not slow."""


@dataclass(frozen=True)
class Flow:
    """One input or output topic of a node; ``age_s`` is the age of the newest message, inf before the first."""

    rate_hz: float
    age_s: float = math.inf


@dataclass
class Heartbeat:
    """Newest status of a node.

    Attributes:
        state: one of ``STATES``.
        message: text of its worst diagnosis; empty when all is well.
        cpu_percent: load in percent of one core.
        inputs, outputs: rate and age of each topic.
        lost: number of messages that this node has lost, by (topic, publisher).
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
        """True if the next heartbeat is overdue."""
        return time.monotonic() - self.seen_s > SILENT_AFTER_S

    @property
    def up(self) -> bool:
        """True if the node reports that it is running."""
        return self.state in ("running", "degraded")


def from_message(message: Any) -> Heartbeat:
    """Return the heartbeat of a NodeStatus message. Lists of unequal length are cut to the shortest."""
    flows = zip(message.inputs, message.input_rates_hz, message.input_ages_s, strict=False)
    sent = zip(message.outputs, message.output_rates_hz, message.output_ages_s, strict=False)
    lost = zip(message.lost_topics, message.lost_publishers, message.lost_counts, strict=False)
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
