"""Records topics as they come: new publishers are found while it runs, nothing is decoded, losses are counted."""

from __future__ import annotations

import fnmatch
import json
import time
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from instant_ic.bag.writer import BagWriter
from instant_ic.bus.qos import PRESETS, SENSOR, QoS
from instant_ic.bus.registry import NodeInfo, TopicInfo

FOREIGN_CLOCK_NS = 10_000_000_000
"""A stamp farther than this from the simulated clock was made by another clock."""


@dataclass(frozen=True)
class TopicChoice:
    """Which topics to take.

    Attributes:
        topics: names or patterns (``/camera/*``); empty takes all.
        exclude: names or patterns to leave out.
    """

    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    def takes(self, topic: str) -> bool:
        """Whether a topic is wanted."""
        if any(fnmatch.fnmatchcase(topic, pattern) for pattern in self.exclude):
            return False
        return not self.topics or any(fnmatch.fnmatchcase(topic, pattern) for pattern in self.topics)


EVERYTHING = TopicChoice()


class LossCounter(Protocol):
    """What a subscription knows of itself."""

    @property
    def lost(self) -> int:
        """Messages missing by the gaps in the sequence."""


RawCallback = Callable[[str, str, bytes | memoryview, int], None]
Subscribe = Callable[[str, RawCallback], LossCounter]


class Recorder:
    """The recording itself, without a bus: it is told of publishers and given bytes.

    Args:
        path: the bag's folder.
        choice: which topics.
        subscribe: ``(topic, callback)`` subscribes to raw bytes and gives the counter of lost messages.
        sim_now_ns: the simulated clock, where there is one. Who does not follow it (the recorder itself, the console)
            stamps with the machine's time; such messages get the simulated time of their arrival instead.

    Raises:
        BagError: the bag cannot be made.
    """

    def __init__(
        self, path: Path, choice: TopicChoice, subscribe: Subscribe, sim_now_ns: Callable[[], int] | None = None
    ) -> None:
        self.path = path
        self.writer = BagWriter(path)
        self.counts: Counter[str] = Counter()
        self.early = 0
        self._choice = choice
        self._subscribe = subscribe
        self._sim_now_ns = sim_now_ns
        self._begun_ns = 0
        self._held: list[tuple[str, str, bytes, int]] = []
        self._losses: dict[str, LossCounter] = {}
        self._qos: dict[str, QoS] = {}
        self._parameters: dict[str, object] = {}
        self._flushed_s = time.monotonic()

    @property
    def topics(self) -> Collection[str]:
        """Topics that it listens to."""
        return self._losses.keys()

    def discover(self, topics: Collection[TopicInfo], nodes: Collection[NodeInfo] = ()) -> None:
        """Subscribes to what is new and wanted; notes the parameters of nodes."""
        for info in topics:
            if info.topic not in self._losses and self._choice.takes(info.topic):
                offered = [PRESETS.get(publisher.qos, SENSOR) for publisher in info.publishers]
                # Several publishers of one topic: a reader must know that it is latched if any of them is.
                self._qos[info.topic] = max(offered, key=lambda qos: (qos.latched, qos.reliable))
                self._losses[info.topic] = self._subscribe(info.topic, self.take)
        for node in nodes:
            self._parameters[node.name] = {"module": node.module, "params": node.params}

    def take(self, topic: str, type_name: str, payload: bytes | memoryview, publish_ns: int) -> None:
        """Writes one message.

        Raises:
            BagError: the disk is full, or the type is unknown.
        """
        stamp_ns = self._stamp_ns(publish_ns)
        if stamp_ns <= 0:  # a node on simulated time, before the first /clock: it has no time to be filed under
            self.early += 1
        elif self._begun_ns:
            self._write(topic, type_name, payload, stamp_ns)
        elif self._qos.get(topic, SENSOR).latched:
            # Its value may be minutes old: it waits for the first message that says when this bag begins.
            self._held.append((topic, type_name, bytes(payload), stamp_ns))
        else:
            self._begin(stamp_ns)
            self._write(topic, type_name, payload, stamp_ns)

    def _begin(self, stamp_ns: int) -> None:
        self._begun_ns = stamp_ns
        held, self._held = self._held, []
        for topic, type_name, payload, own_ns in held:
            self._write(topic, type_name, payload, own_ns)

    def _write(self, topic: str, type_name: str, payload: bytes | memoryview, stamp_ns: int) -> None:
        qos = self._qos.get(topic, SENSOR)
        if qos.latched:
            stamp_ns = max(stamp_ns, self._begun_ns)
        self.writer.write(topic, type_name, payload, stamp_ns, qos)
        self.counts[topic] += 1

    def _stamp_ns(self, publish_ns: int) -> int:
        if self._sim_now_ns is None:
            return publish_ns
        now_ns = self._sim_now_ns()
        return publish_ns if abs(publish_ns - now_ns) < FOREIGN_CLOCK_NS else now_ns

    def lost(self) -> dict[str, int]:
        """Messages lost on the way, by topic, where there are any."""
        return {topic: counter.lost for topic, counter in self._losses.items() if counter.lost}

    def tick(self, now_s: float | None = None) -> None:
        """Called now and then: hands what came to the system once a second."""
        now = time.monotonic() if now_s is None else now_s
        if now - self._flushed_s >= 1.0:
            self._flushed_s = now
            self.writer.flush()

    def close(self) -> None:
        """Completes the bag; its metadata tell losses and the nodes' parameters."""
        if self._held:
            self._begin(max(stamp_ns for _, _, _, stamp_ns in self._held))
        self.writer.set_custom("instant_ic.lost", json.dumps(self.lost(), sort_keys=True))
        self.writer.set_custom("instant_ic.before_clock", str(self.early))
        self.writer.set_custom("instant_ic.parameters", json.dumps(self._parameters, sort_keys=True))
        self.writer.close()
