"""The newest heartbeat of each node, for the commands that show the state of nodes."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from instant_ic.bus import registry
from instant_ic.bus.heartbeat import TYPE, Heartbeat, from_message
from instant_ic.cli.observer import TopicObserver
from instant_ic.msg import deserialize


class Heartbeats(TopicObserver):
    """Listens to the heartbeats of every node in a run directory, in every namespace."""

    def __init__(self, run_dir: Path) -> None:
        topics = {info.topic for info in registry.list_topics(run_dir) if info.type_name == TYPE}
        super().__init__(sorted(topics | {"/heartbeat"}), run_dir=run_dir)
        self.newest: dict[str, Heartbeat] = {}

    def listen(self, seconds: float, until: Collection[str] = ()) -> dict[str, Heartbeat]:
        """Listen for some time, or until all the named nodes were heard; return the newest heartbeat of each node."""
        for batch in self.batches(seconds, 0.1):
            for received in batch:
                if received.type_name == TYPE:
                    with suppress(ValueError):  # it cannot be read: the node counts as silent
                        beat = from_message(deserialize(received.payload, received.type_name))
                        self.newest[beat.node] = beat
            if until and all(node in self.newest for node in until):
                break
        return self.newest


def hear(run_dir: Path, nodes: Collection[str], seconds: float = 2.5) -> dict[str, Heartbeat]:
    """Return the heartbeats of the given nodes, without those that send none within ``seconds``."""
    if not nodes:
        return {}
    with Heartbeats(run_dir) as heartbeats:
        return heartbeats.listen(seconds, nodes)
