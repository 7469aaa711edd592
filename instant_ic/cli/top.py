"""The table of ``ic top``: a row per node, from its heartbeat, its process and the nominal rates of its topics."""

from __future__ import annotations

import dataclasses
import math
import os
import select
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from instant_ic.bus.heartbeat import EVERY_NODES, Flow, Heartbeat
from instant_ic.launch.topics import TopicRate, nominal_rate
from instant_ic.util.safe_text import direct, visible

if TYPE_CHECKING:
    from rich.console import Group
    from rich.text import Text

    from instant_ic.bus.registry import NodeInfo

_STATE_STYLES = {"running": "green", "starting": "yellow", "degraded": "dark_orange", "stopping": "dim"}
_RIGHT = ("PID", "CPU%", "MEM MB", "THR", "LOST")
_KEYS = {"c": "cpu", "m": "memory", "n": "name", "l": "lost"}


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

    @property
    def rate(self) -> str:
        """Measured and nominal rate as text: ``9.8/10``, ``9.8``, or ``-`` where the rate is zero."""
        measured = f"{self.rate_hz:.0f}" if self.rate_hz >= 19.5 else f"{self.rate_hz:.1f}" if self.rate_hz > 0 else "-"
        return measured if self.nominal_hz is None else f"{measured}/{self.nominal_hz:g}"


@dataclass
class NodeRow:
    """One node.

    Attributes:
        state: from its heartbeat; ``silent`` or ``busy`` where there is none.
        message: its worst diagnosis, else the faults of its rates.
        cpu_percent: percent of one core since the last measurement; nan if unknown.
        rss_mb: resident memory; nan if unknown.
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

    def look(self, pid: int) -> tuple[float, float, int]:
        """Return CPU in percent of one core since the last call, memory in MB, and number of threads.

        The CPU is nan at the first call; the result is (nan, nan, 0) when there is no such process.
        """
        import psutil

        try:
            first = pid not in self._known
            process = self._known.setdefault(pid, psutil.Process(pid))
            with process.oneshot():
                cpu = process.cpu_percent()
                return math.nan if first else cpu, process.memory_info().rss / 1e6, process.num_threads()
        except psutil.Error:
            self._known.pop(pid, None)
            return math.nan, math.nan, 0


def expected_rate(topic: str) -> TopicRate | None:
    """Return the nominal rate of a topic, with or without a namespace; None where unknown."""
    return nominal_rate(topic) or nominal_rate(topic, topic.split("/")[1])


def make_rows(
    infos: Sequence[NodeInfo], beats: Mapping[str, Heartbeat], look: Callable[[int], tuple[float, float, int]]
) -> list[NodeRow]:
    """Return the rows of the running nodes.

    Args:
        infos: nodes listed in the registry.
        beats: newest heartbeat of each node.
        look: returns CPU, memory and threads of a process.
    """
    rows = []
    for info in infos:
        cpu, rss, threads = look(info.pid)
        row = NodeRow(info.name, info.pid, "silent", "", cpu, rss, threads)
        beat = beats.get(info.name)
        if beat is None or beat.pid != info.pid:
            row.message = "no heartbeat yet"
        else:
            row.outputs, row.inputs = _topic_rows(beat.outputs), _topic_rows(beat.inputs)
            row.lost = sum(beat.lost.values())
            if beat.silent:
                row.message = f"no heartbeat for {time.monotonic() - beat.seen_s:.0f} s"
            else:
                row.state, row.message = beat.state, beat.message
                row.cpu_percent = beat.cpu_percent if math.isnan(cpu) else cpu
            row.message = row.message or "; ".join(f"{t.topic} {t.fault}" for t in row.outputs if t.fault)
        rows.append(row)
    return rows


def _topic_rows(flows: Mapping[str, Flow]) -> list[TopicRow]:
    rows = []
    for topic, flow in sorted(flows.items()):
        if not topic.endswith(EVERY_NODES):
            expected = expected_rate(topic)
            fault = expected.fault(flow.rate_hz, flow.age_s) if expected else ""
            rows.append(TopicRow(topic, flow.rate_hz, flow.age_s, expected.rate_hz if expected else None, fault))
    return rows


def table(rows: Sequence[NodeRow], sort: str, inputs: bool = False) -> Group:
    """Return the table of the nodes, with a summary above.

    Args:
        rows: the nodes.
        sort: a key of ``SORT_KEYS``.
        inputs: also show the rates of the inputs.
    """
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    shown = Table(box=None, pad_edge=False, header_style="bold reverse", expand=True)
    headings = ["NODE", "PID", "STATE", "CPU%", "MEM MB", "THR", "LOST", "OUT Hz", *["IN Hz"] * inputs, "MESSAGE"]
    for heading in headings:
        wide = heading in ("OUT Hz", "IN Hz", "MESSAGE")
        shown.add_column(
            heading, justify="right" if heading in _RIGHT else "left", no_wrap=not wide, ratio=2 if wide else None
        )
    for row in sorted(rows, key=SORT_KEYS[sort]):
        shown.add_row(
            row.node,
            str(row.pid),
            Text(row.state, style=_STATE_STYLES.get(row.state, "bold red")),
            Text(_number(row.cpu_percent), style="bold" if row.cpu_percent > 80 else ""),
            _number(row.rss_mb),
            str(row.threads or "-"),
            Text(str(row.lost), style="" if row.lost else "dim"),  # a total: the start-up's losses count too
            _rates(row.outputs),
            *([_rates(row.inputs)] if inputs else []),
            Text(visible(row.message), style="yellow" if row.message else ""),
        )
    cpu = sum(row.cpu_percent for row in rows if row.cpu_percent == row.cpu_percent)
    memory = sum(row.rss_mb for row in rows if row.rss_mb == row.rss_mb)
    head = Text(
        f"{len(rows)} nodes, {cpu:.0f} % of {100 * (os.cpu_count() or 1)} % CPU, {memory / 1e3:.2f} GB, "
        f"load {os.getloadavg()[0]:.1f}, sorted by {sort}",
        style="bold",
    )
    return Group(head, shown)


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.0f}"


def _rates(rows: Sequence[TopicRow]) -> Text:
    from rich.text import Text

    text = Text()
    for row in rows:
        if row.rate_hz > 0 or row.fault:
            rate = f"\u00a0{row.rate}"  # a no-break space keeps the rate beside its topic
            text.append(visible(row.topic), style="dim").append(rate, style="red" if row.fault else "").append("  ")
    return text


def as_json(rows: Sequence[NodeRow]) -> list[dict[str, Any]]:
    """Return rows as plain values; unknown values are null."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: clean(inner) for key, inner in value.items()}
        if isinstance(value, list):
            return [clean(inner) for inner in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return [clean(dataclasses.asdict(row)) for row in rows]


def show_live(rows: Callable[[float], list[NodeRow]], period_s: float, sort: str) -> None:
    """Show the table until ``q`` or Ctrl-C.

    Args:
        rows: returns the newest rows; its argument is the listening time in seconds.
        period_s: time between two updates.
        sort: a key of ``SORT_KEYS``.
    """
    from rich.console import Console, Group
    from rich.live import Live
    from rich.text import Text

    from instant_ic.cli.terminal import single_keys

    inputs, next_s, newest = False, 0.0, rows(0.7)
    keys = Text("q quit   c CPU   m memory   n name   l losses   i inputs", style="dim")
    with single_keys(), Live(console=Console(file=direct(sys.stdout)), screen=True, auto_refresh=False) as live:
        while True:
            if time.monotonic() >= next_s:
                newest, next_s = rows(0.05), time.monotonic() + period_s
            live.update(Group(table(newest, sort, inputs), keys), refresh=True)
            ready, _, _ = select.select([sys.stdin], [], [], max(0.0, min(0.2, next_s - time.monotonic())))
            key = os.read(sys.stdin.fileno(), 1).decode(errors="replace") if ready else ""
            if key in ("q", "Q", "\x1b", "\x03", "\x04"):
                return
            inputs ^= key == "i"
            sort = _KEYS.get(key, sort)
