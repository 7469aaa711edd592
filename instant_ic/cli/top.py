"""Rows of ``ic top``: one per node, from its heartbeat, its process and the table of nominal rates."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from instant_ic.bus.heartbeat import EVERY_NODES, Flow, Heartbeat

if TYPE_CHECKING:
    from instant_ic.launch.topics import TopicRate


@dataclass(frozen=True)
class TopicRow:
    """An input or output topic of a node.

    Attributes:
        age_s: time since the newest message; inf before the first.
        nominal_hz: expected rate; None where unknown.
        fault: text of the fault; empty where there is none.
    """

    topic: str
    rate_hz: float
    age_s: float
    nominal_hz: float | None = None
    fault: str = ""


@dataclass
class NodeRow:
    """One node.

    Attributes:
        state: from its heartbeat; ``silent`` or ``busy`` where there is none.
        message: its worst diagnosis, else the faults of its rates.
        cpu_percent: percent of one core since the last measurement.
    """

    node: str
    pid: int
    state: str
    message: str = ""
    cpu_percent: float = math.nan
    rss_mb: float = math.nan
    threads: int = 0
    outputs: list[TopicRow] = field(default_factory=list)
    inputs: list[TopicRow] = field(default_factory=list)
    lost: int = 0
    up_s: float = 0.0


SORT_KEYS: dict[str, Callable[[NodeRow], Any]] = {
    "cpu": lambda row: -row.cpu_percent if row.cpu_percent == row.cpu_percent else 0.0,
    "memory": lambda row: -row.rss_mb if row.rss_mb == row.rss_mb else 0.0,
    "name": lambda row: row.node,
    "lost": lambda row: (-row.lost, row.node),
}


class Processes:
    """CPU, memory and threads of processes, read from the operating system: also available for a hanging node."""

    def __init__(self) -> None:
        self._known: dict[int, Any] = {}

    def begin(self, pid: int) -> None:
        """Start measuring the CPU of a process that is not known yet."""
        if pid not in self._known:
            self.look(pid)

    def look(self, pid: int) -> tuple[float, float, int]:
        """CPU in percent of one core since the last call, memory in MB, number of threads.

        The CPU is nan at the first call; the result is (nan, nan, 0) when there is no such process.
        """
        import psutil

        try:
            process = self._known.get(pid)
            first = process is None
            if process is None:
                process = self._known[pid] = psutil.Process(pid)
            with process.oneshot():
                cpu = process.cpu_percent()
                return math.nan if first else cpu, process.memory_info().rss / 1e6, process.num_threads()
        except psutil.Error:
            self._known.pop(pid, None)
            return math.nan, math.nan, 0


def make_rows(
    infos: Sequence[Any],
    beats: Mapping[str, Heartbeat],
    look: Callable[[int], tuple[float, float, int]],
    nominal: Callable[[str], TopicRate | None],
    now_ns: int,
) -> list[NodeRow]:
    """Rows of the running nodes.

    Args:
        infos: nodes listed in the registry.
        look: returns CPU, memory and threads of a process.
        nominal: returns the expected rate of a topic.
        now_ns: system time.
    """
    rows = []
    for info in infos:
        cpu, rss, threads = look(info.pid)
        row = NodeRow(info.name, info.pid, "silent", "", cpu, rss, threads)
        row.up_s = max(0.0, (now_ns - info.started_ns) / 1e9)
        beat = beats.get(info.name)
        if beat is None or beat.pid != info.pid:
            row.message = "no heartbeat yet"
        elif beat.silent:
            row.message = f"no heartbeat for {time.monotonic() - beat.seen_s:.0f} s"
        else:
            row.state, row.message = beat.state, beat.message
            row.cpu_percent = beat.cpu_percent if math.isnan(cpu) else cpu
        if beat is not None and beat.pid == info.pid:
            row.outputs = _topics(beat.outputs, nominal)
            row.inputs = _topics(beat.inputs, nominal)
            row.lost = sum(beat.lost.values())
            faults = [f"{topic.topic} {topic.fault}" for topic in row.outputs if topic.fault]
            if faults and not row.message:
                row.message = "; ".join(faults)
        rows.append(row)
    return rows


def _topics(flows: Mapping[str, Flow], nominal: Callable[[str], TopicRate | None]) -> list[TopicRow]:
    rows = []
    for topic, flow in sorted(flows.items()):
        if topic.endswith(EVERY_NODES):
            continue
        expected = nominal(topic)
        fault = expected.fault(flow.rate_hz, flow.age_s) if expected is not None else ""
        rows.append(TopicRow(topic, flow.rate_hz, flow.age_s, expected.rate_hz if expected else None, fault))
    return rows


def rate_words(row: TopicRow) -> str:
    """``9.8/10`` (measured and nominal), ``9.8``, or ``-`` where the rate is zero."""
    if row.rate_hz <= 0:
        return "-" if row.nominal_hz is None else f"-/{row.nominal_hz:g}"
    measured = f"{row.rate_hz:.0f}" if row.rate_hz >= 19.5 else f"{row.rate_hz:.1f}"
    return measured if row.nominal_hz is None else f"{measured}/{row.nominal_hz:g}"


def expected_rate(topic: str) -> TopicRate | None:
    """Nominal rate of a topic, with or without a namespace; None where unknown."""
    from instant_ic.launch.topics import nominal_rate

    return nominal_rate(topic) or nominal_rate(topic, topic.split("/")[1])


HEADINGS = ("NODE", "PID", "STATE", "CPU%", "MEM MB", "THR", "LOST", "OUT Hz", "IN Hz", "MESSAGE")


def cells(row: NodeRow) -> list[str]:
    """A row as text, in the order of ``HEADINGS``."""

    def number(value: float) -> str:
        return "-" if math.isnan(value) else f"{value:.0f}"

    def flows(rows: Sequence[TopicRow]) -> str:
        return " ".join(f"{one.topic} {rate_words(one)}" for one in rows if one.rate_hz > 0 or one.fault)

    return [
        row.node,
        str(row.pid),
        row.state,
        number(row.cpu_percent),
        number(row.rss_mb),
        str(row.threads or "-"),
        str(row.lost),
        flows(row.outputs),
        flows(row.inputs),
        row.message,
    ]


def plain_table(rows: Sequence[NodeRow]) -> str:
    """Table for a pipe or a log: columns aligned with spaces, rates in lines below each node."""
    table = [[*HEADINGS[:7], "MESSAGE"], *([*cells(row)[:7], row.message] for row in rows)]
    widths = [max(len(line[column]) for line in table) for column in range(7)]
    lines = []
    for index, line in enumerate(table):
        first = [
            f"{cell:<{w}}" if i in (0, 2) else f"{cell:>{w}}"
            for i, (cell, w) in enumerate(zip(line, widths, strict=False))
        ]
        lines.append("  ".join([*first, line[7]]).rstrip())
        if index:
            lines += [
                f"    → {topic.topic} {rate_words(topic)} Hz{f'  ({topic.fault})' if topic.fault else ''}"
                for topic in rows[index - 1].outputs
                if topic.rate_hz > 0 or topic.fault
            ]
    return "\n".join(lines)


def as_json(rows: Sequence[NodeRow]) -> list[dict[str, Any]]:
    """Rows as plain values; unknown values are null."""
    from dataclasses import asdict

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: clean(inner) for key, inner in value.items()}
        if isinstance(value, list):
            return [clean(inner) for inner in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return [clean(asdict(row)) for row in rows]
