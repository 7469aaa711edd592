"""Rows of ``ic top``, from the heartbeats of the nodes; the live table."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from instant_ic.bus.heartbeat import Heartbeat
from instant_ic.launch.node_table import NodeRow, node_table, topic_rows
from instant_ic.util.safe_text import direct

if TYPE_CHECKING:
    from rich.console import Group

    from instant_ic.bus.registry import NodeInfo

SORT_KEYS: dict[str, Callable[[NodeRow], Any]] = {
    "cpu": lambda row: -row.cpu_percent if row.cpu_percent == row.cpu_percent else 0.0,
    "memory": lambda row: -row.rss_mb if row.rss_mb == row.rss_mb else 0.0,
    "name": lambda row: row.node,
    "lost": lambda row: (-row.lost, row.node),
}


def make_rows(infos: Sequence[NodeInfo], beats: Mapping[str, Heartbeat]) -> list[NodeRow]:
    """Return the rows of the running nodes.

    Args:
        infos: nodes listed in the registry.
        beats: newest heartbeat of each node.
    """
    rows = []
    for info in infos:
        row = NodeRow(info.name, "silent")
        beat = beats.get(info.name)
        if beat is None or beat.pid != info.pid:
            row.message = "no heartbeat yet"
        else:
            row.outputs = topic_rows(beat.outputs)
            row.lost = sum(beat.lost.values())
            if beat.silent:
                row.message = f"no heartbeat for {time.monotonic() - beat.seen_s:.0f} s"
            else:
                row.state, row.message = beat.state, beat.message
                row.cpu_percent, row.rss_mb = beat.cpu_percent, beat.rss_mb
            row.message = row.message or "; ".join(f"{t.topic} {t.fault}" for t in row.outputs if t.fault)
        rows.append(row)
    return rows


def table(rows: Sequence[NodeRow], sort: str) -> Group:
    """Return the table of the nodes, with a summary above.

    Args:
        rows: the nodes.
        sort: a key of ``SORT_KEYS``.
    """
    from rich.console import Group
    from rich.text import Text

    cpu = sum(row.cpu_percent for row in rows if row.cpu_percent == row.cpu_percent)
    memory = sum(row.rss_mb for row in rows if row.rss_mb == row.rss_mb)
    head = Text(
        f"{len(rows)} nodes, {cpu:.0f} % of {100 * (os.cpu_count() or 1)} % CPU, {memory / 1e3:.2f} GB, "
        f"load {os.getloadavg()[0]:.1f}, sorted by {sort}",
        style="bold",
    )
    return Group(head, node_table(sorted(rows, key=SORT_KEYS[sort])))


def show_live(rows: Callable[[float], list[NodeRow]], period_s: float, sort: str) -> None:
    """Show the table until Ctrl-C.

    Args:
        rows: returns the newest rows; its argument is the listening time in seconds.
        period_s: time between two updates.
        sort: a key of ``SORT_KEYS``.
    """
    from rich.console import Console
    from rich.live import Live

    console = Console(file=direct(sys.stdout))
    with Live(table(rows(0.7), sort), console=console, screen=True, auto_refresh=False) as live:
        while True:
            live.update(table(rows(period_s), sort), refresh=True)
