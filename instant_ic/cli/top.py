"""``ic top``: the table of the nodes, from their heartbeats."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from instant_ic.bus import registry
from instant_ic.bus.control import ControlError, NodeControl
from instant_ic.bus.heartbeat import Heartbeat
from instant_ic.cli.errors import UserError
from instant_ic.cli.names import nobody_runs
from instant_ic.cli.observer import Heartbeats
from instant_ic.launch.node_table import NodeRow, heartbeat_row, node_table
from instant_ic.util import paths
from instant_ic.util.safe_text import direct

_PIPE_WIDTH = 300

SORT_KEYS: dict[str, Callable[[NodeRow], Any]] = {
    "cpu": lambda row: 0.0 if math.isnan(row.cpu_percent) else -row.cpu_percent,
    "memory": lambda row: 0.0 if math.isnan(row.rss_mb) else -row.rss_mb,
    "name": lambda row: row.node,
    "lost": lambda row: (-row.lost, row.node),
}


def make_rows(infos: Sequence[registry.NodeInfo], beats: Mapping[str, Heartbeat]) -> list[NodeRow]:
    """Return the rows of the running nodes.

    Args:
        infos: nodes listed in the registry.
        beats: newest heartbeat of each node.
    """
    rows = []
    for info in infos:
        beat = beats.get(info.name)
        if beat is None or beat.pid != info.pid:
            rows.append(NodeRow(info.name, "silent", "no heartbeat yet"))
            continue
        row = heartbeat_row(info.name, beat)
        if beat.silent:
            row.message = f"no heartbeat for {time.monotonic() - beat.seen_s:.0f} s"
            row.cpu_percent = row.rss_mb = math.nan
        row.message = row.message or "; ".join(f"{t.topic} {t.fault}" for t in row.outputs if t.fault)
        rows.append(row)
    return rows


def table(rows: Sequence[NodeRow], sort: str) -> Group:
    """Return the table of the nodes, with a summary above.

    Args:
        rows: the nodes.
        sort: a key of ``SORT_KEYS``.
    """
    cpu = sum(row.cpu_percent for row in rows if not math.isnan(row.cpu_percent))
    memory = sum(row.rss_mb for row in rows if not math.isnan(row.rss_mb))
    head = Text(
        f"{len(rows)} nodes, {cpu:.0f} % of {100 * (os.cpu_count() or 1)} % CPU, {memory / 1e3:.2f} GB, "
        f"load {os.getloadavg()[0]:.1f}, sorted by {sort}",
        style="bold",
    )
    return Group(head, node_table(sorted(rows, key=SORT_KEYS[sort])))


def show(args: argparse.Namespace) -> int:
    """Show the table, live or once."""
    run_dir = paths.run_dir()
    if not registry.list_nodes(run_dir):
        raise UserError(nobody_runs())
    with Heartbeats(run_dir) as heartbeats:

        def content(seconds: float, until_all: bool = False) -> Group:
            """Return the table after listening for ``seconds``, or until all nodes were heard."""
            infos = registry.list_nodes(run_dir)
            rows = make_rows(infos, heartbeats.listen(seconds, [info.name for info in infos] if until_all else ()))
            for row in rows:
                if row.state == "silent":
                    _ask(row, run_dir)
            return table(rows, args.sort)

        if sys.stdin.isatty() and sys.stdout.isatty() and not args.once:
            console = Console(file=direct(sys.stdout))
            with Live(content(0.7), console=console, screen=True, auto_refresh=False) as live:
                while True:
                    live.update(content(args.delay), refresh=True)
        newest = content(1.5, until_all=True)
    width = None if sys.stdout.isatty() else _PIPE_WIDTH
    Console(file=direct(sys.stdout), width=width).print(newest)
    return 0


def _ask(row: NodeRow, run_dir: Path) -> None:
    """Ask a node without a heartbeat for its activity, through its control channel."""
    try:
        status = NodeControl(run_dir, row.node, 0.3).status()
    except ControlError:
        return
    if status["busy"]:
        row.state = "starting" if status["busy"] == "setup" else "busy"
        row.message = f"in {status['busy']} for {status['busy_s']:.0f} s"
