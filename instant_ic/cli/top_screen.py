"""The live table of ``ic top``: rendered by rich, controlled by single keys."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable, Sequence

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from instant_ic.cli.terminal import single_keys
from instant_ic.cli.top import HEADINGS, SORT_KEYS, NodeRow, TopicRow, cells, rate_words
from instant_ic.util.safe_text import direct, visible

_STATE_COLOURS = {"running": "green", "starting": "yellow", "degraded": "dark_orange", "stopping": "dim"}
_KEYS = {"c": "cpu", "m": "memory", "n": "name", "l": "lost"}


def table(rows: Sequence[NodeRow], sort: str, inputs: bool = False) -> Group:
    """Table of the nodes, with a summary above and the keys below.

    Args:
        sort: a key of ``SORT_KEYS``.
    """
    shown = Table(box=None, pad_edge=False, header_style="bold reverse", expand=True)
    for heading in HEADINGS:
        if heading == "IN Hz" and not inputs:
            continue
        right = heading in ("PID", "CPU%", "MEM MB", "THR", "LOST")
        wide = heading in ("OUT Hz", "IN Hz", "MESSAGE")
        shown.add_column(heading, justify="right" if right else "left", no_wrap=not wide, ratio=2 if wide else None)
    for row in sorted(rows, key=SORT_KEYS[sort]):
        words: list[str | Text] = list(cells(row))
        words[2] = Text(row.state, style=_STATE_COLOURS.get(row.state, "bold red"))
        words[3] = Text(str(words[3]), style="bold" if row.cpu_percent > 80 else "")
        words[6] = Text(str(words[6]), style="" if row.lost else "dim")  # a total: the start-up's losses count too
        words[7] = _flows(row.outputs)
        words[8] = _flows(row.inputs)
        words[9] = Text(visible(row.message), style="yellow" if row.message else "")
        shown.add_row(*(word for heading, word in zip(HEADINGS, words, strict=True) if heading != "IN Hz" or inputs))
    cpu = sum(row.cpu_percent for row in rows if row.cpu_percent == row.cpu_percent)
    memory = sum(row.rss_mb for row in rows if row.rss_mb == row.rss_mb)
    head = Text(
        f"{len(rows)} nodes, {cpu:.0f} % of {100 * (os.cpu_count() or 1)} % CPU, {memory / 1e3:.2f} GB, "
        f"load {os.getloadavg()[0]:.1f}, sorted by {sort}",
        style="bold",
    )
    keys = Text("q quit   c CPU   m memory   n name   l losses   i inputs", style="dim")
    return Group(head, shown, keys)


def _flows(rows: Sequence[TopicRow]) -> Text:
    text = Text()
    for row in rows:
        if row.rate_hz > 0 or row.fault:
            rate = f"\u00a0{rate_words(row)}"  # a no-break space keeps the rate beside its topic
            text.append(visible(row.topic), style="dim").append(rate, style="red" if row.fault else "").append("  ")
    return text


def run(rows: Callable[[float], list[NodeRow]], period_s: float, sort: str) -> int:
    """Show the table until ``q`` or Ctrl-C.

    Args:
        rows: returns the newest rows; its argument is the listening time in seconds.
        sort: a key of ``SORT_KEYS``.
    """
    inputs = False
    newest = rows(0.7)
    with (
        single_keys(),
        Live(table(newest, sort), console=Console(file=direct(sys.stdout)), screen=True, auto_refresh=False) as live,
    ):
        next_s = 0.0
        while True:
            if time.monotonic() >= next_s:
                newest, next_s = rows(0.05), time.monotonic() + period_s
            live.update(table(newest, sort, inputs), refresh=True)
            ready, _, _ = select.select([sys.stdin], [], [], max(0.0, min(0.2, next_s - time.monotonic())))
            key = os.read(sys.stdin.fileno(), 1).decode(errors="replace") if ready else ""
            if key in ("q", "Q", "\x1b", "\x03", "\x04"):
                return 0
            inputs ^= key == "i"
            sort = _KEYS.get(key, sort)
