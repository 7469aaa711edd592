"""The table of nodes that the launcher and ``ic top`` show: state, CPU, memory, and rates of the topics."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from rich.table import Table
from rich.text import Text

from instant_ic.bus.heartbeat import EVERY_NODES, Flow, Heartbeat
from instant_ic.launch.topics import expected_rate
from instant_ic.util.safe_text import visible

STATE_STYLES = {
    "running": ("●", "green"),
    "starting": ("◌", "yellow"),
    "waiting to start": ("◌", "yellow"),
    "degraded": ("●", "yellow"),
    "slow": ("●", "yellow"),
    "stopping": ("◌", "dim"),
    "ended": ("○", "dim"),
}
"""Sign and style of the states that are not a fault."""
_FAULT_STYLE = ("●", "bold red")


@dataclass(frozen=True)
class TopicRow:
    """A topic of a node.

    Attributes:
        age_s: time since the newest message; inf before the first.
        nominal_hz: expected rate; None if unknown.
        fault: text of the fault; empty if there is none.
    """

    topic: str
    rate_hz: float
    age_s: float
    nominal_hz: float | None = None
    fault: str = ""

    @property
    def rate(self) -> str:
        """Measured and nominal rate as text: ``9.8/10``, ``9.8``, or ``-`` if the rate is zero."""
        measured = f"{self.rate_hz:.0f}" if self.rate_hz >= 19.5 else f"{self.rate_hz:.1f}" if self.rate_hz > 0 else "-"
        return measured if self.nominal_hz is None else f"{measured}/{self.nominal_hz:g}"


@dataclass
class NodeRow:
    """One node.

    Attributes:
        state: state in one or two words.
        message: worst diagnosis of the node, else the faults of its topics; empty if there is neither.
        cpu_percent: CPU time, in percent of one core; nan if unknown.
        rss_mb: resident memory; nan if unknown.
        restarts: number of restarts by the launcher.
        lost: number of messages that the node has lost.
        outputs: active topics of the node, faulty ones first.
    """

    node: str
    state: str
    message: str = ""
    cpu_percent: float = math.nan
    rss_mb: float = math.nan
    restarts: int = 0
    lost: int = 0
    outputs: list[TopicRow] = field(default_factory=list)


def heartbeat_row(label: str, beat: Heartbeat, restarts: int = 0) -> NodeRow:
    """Return a node's row, from its newest heartbeat."""
    state, lost = "silent" if beat.silent else beat.state, sum(beat.lost.values())
    row = NodeRow(label, state, beat.message, beat.cpu_percent, beat.rss_mb, restarts, lost)
    row.outputs = topic_rows(beat.outputs)
    return row


def topic_rows(flows: Mapping[str, Flow]) -> list[TopicRow]:
    """Return the topics of a heartbeat that flow or should flow.

    Faulty topics come first, then those with a nominal rate, because the last ones may not fit into a line.
    """
    rows = []
    for topic, flow in flows.items():
        expected = expected_rate(topic)
        started = flow.age_s < math.inf  # some topics are published only while somebody subscribes
        fault = expected.fault(flow.rate_hz, flow.age_s) if expected and started else ""
        if (flow.rate_hz > 0 or fault) and not topic.endswith(EVERY_NODES):
            rows.append(TopicRow(topic, flow.rate_hz, flow.age_s, expected.rate_hz if expected else None, fault))
    return sorted(rows, key=lambda row: (not row.fault, row.nominal_hz is None))


def node_table(rows: Iterable[NodeRow], colours: Mapping[str, str] | None = None) -> Table:
    """Return the table of nodes.

    Args:
        rows: the nodes.
        colours: colours of the nodes' names; default: none.
    """
    table = Table(box=None, pad_edge=False, header_style="dim")
    # Minimum widths keep a long message in the last column from squeezing the others.
    for name, width in (("node", 6), ("state", 10), ("CPU %", 5), ("MB", 5), ("lost", 4)):
        table.add_column(name, justify="left" if width > 5 else "right", no_wrap=True, min_width=width)
    table.add_column("sends, Hz", no_wrap=True, overflow="ellipsis")
    for row in rows:
        sign, style = STATE_STYLES.get(row.state, _FAULT_STYLE)
        state = Text(f"{sign} {row.state}", style=style)
        if row.restarts:
            state.append(f" ↻{row.restarts}", style="yellow")
        last = Text(visible(row.message), style="yellow" if row.state in STATE_STYLES else "red")
        for output in row.outputs:
            last.append("  " if last else "")
            last.append(f"{visible(output.topic).lstrip('/')} ", style="dim")
            last.append(output.rate, style="yellow" if output.fault else "")
        table.add_row(
            Text(row.node, style=(colours or {}).get(row.node, "")),
            state,
            _number(row.cpu_percent),
            _number(row.rss_mb),
            str(row.lost or ""),
            last,
        )
    return table


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.0f}"
