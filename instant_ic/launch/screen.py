"""The launcher's words: plain lines for logs and CI, a live table of the nodes in a terminal."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from instant_ic.launch.process import ManagedProcess, State

if TYPE_CHECKING:
    from instant_ic.launch.health import HealthMonitor, NodeHealth

_COLOURS = ("cyan", "green", "magenta", "yellow", "blue", "bright_cyan", "bright_green", "bright_magenta")
_STATE_COLOURS = {"running": "green", "starting": "yellow", "degraded": "yellow"}


class Screen:
    """Prints lines and events, tells what the stack waits for, and the console's address.

    Args:
        nodes: names, in the order of the launch file.
        live: keep a table of the nodes below the lines.
        progress_period_s: without the table, how often to tell what is still waited for.
        console: where to; for tests.
    """

    def __init__(
        self,
        nodes: Sequence[str],
        live: bool,
        progress_period_s: float = 5.0,
        console: Console | None = None,
    ) -> None:
        self._console = console or Console(highlight=False, soft_wrap=True)
        self._colours = {node: _COLOURS[index % len(_COLOURS)] for index, node in enumerate(nodes)}
        self._width = max([len(node) for node in nodes] + [6])
        self._live = Live(console=self._console, auto_refresh=False, transient=True) if live else None
        self._progress_period_s = progress_period_s
        self._started_s = time.monotonic()
        self._next_progress_s = self._started_s + progress_period_s
        self._next_table_s = 0.0
        self._told_nodes = self._told_ready = False
        self._address: str | None = None
        self.health: HealthMonitor | None = None
        self.ending = False
        """Set once the stack is being stopped: then nothing is waited for any more."""

    def __enter__(self) -> Screen:
        """Shows the table."""
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Takes the table away."""
        if self._live is not None:
            self._live.stop()

    def node_line(self, node: str, text: str) -> None:
        """A line that a node has written."""
        line = Text(f"{node:>{self._width}} | ", style=self._colours.get(node, "white"))
        self._console.print(line + Text.from_ansi(text))

    def event(self, text: str, bad: bool = False) -> None:
        """Something that the supervisor has done or seen."""
        self._console.print(Text(f"{'launch':>{self._width}} | {text}", style="bold red" if bad else "bold"))

    def refresh(self, processes: Sequence[ManagedProcess]) -> None:
        """Looks at the heartbeats; updates the table twice a second."""
        now = time.monotonic()
        if self.health is not None and not self.ending:
            self.health.poll()
            self._tell_progress(self.health, now)
        if self._live is not None and now >= self._next_table_s:
            self._next_table_s = now + 0.5
            self._live.update(Group(self._table(processes), Text(self._footer())), refresh=True)

    def _tell_progress(self, health: HealthMonitor, now: float) -> None:
        missing = health.nodes_missing()
        if not missing and not self._told_nodes:
            self._told_nodes = True
            self.event(f"all {len(self._colours)} nodes are up after {now - self._started_s:.1f} s")
        if self._address is None and (address := health.console_address()):
            self._address = address
            self.event(f"console: {address}")
        waiting = health.waiting_for()
        if self._told_nodes and not waiting and not self._told_ready:
            self._told_ready = True
            at = f": {self._address}" if self._address else ""
            self.event(f"ready after {now - self._started_s:.1f} s{at}")
        if self._live is None and not self._told_ready and now >= self._next_progress_s:
            self._next_progress_s = now + self._progress_period_s
            self.event(f"waiting for {', '.join(missing or waiting)}")

    def _footer(self) -> str:
        if self.health is None:
            return "starting"
        if self.ending:
            return "stopping"
        waiting = self.health.nodes_missing() or self.health.waiting_for()
        words = [f"waiting for {', '.join(waiting)}" if waiting else "ready"]
        if self._address:
            words.insert(0, self._address)
        return " · ".join([*words, f"{time.monotonic() - self._started_s:.0f} s", "Ctrl-C ends everything"])

    def _table(self, processes: Sequence[ManagedProcess]) -> Table:
        table = Table(box=None, pad_edge=False, expand=False)
        # Least widths, or a long message in the last column would squeeze the others away.
        for name, justify, width in (
            ("node", "left", self._width),
            ("state", "left", 8),
            ("CPU %", "right", 5),
            ("MB", "right", 5),
        ):
            table.add_column(name, justify=justify, no_wrap=True, min_width=width)  # type: ignore[arg-type]
        table.add_column("sends, Hz", no_wrap=True, overflow="ellipsis")
        for process in processes:
            health = self.health.nodes.get(process.spec.name) if self.health is not None else None
            table.add_row(*_row(process, health))
        return table


def _row(process: ManagedProcess, health: NodeHealth | None) -> tuple[Text | str, ...]:
    name = process.spec.name
    if process.state is not State.RUNNING:
        colour = "dim" if process.state is State.ENDED else "red"
        return (name, Text(process.state.value, style=colour), "", "", "")
    if health is None:
        return (name, Text("starting", style="yellow"), "", "", "")
    state = "silent" if health.silent else health.state
    sends = " ".join(
        f"{topic.lstrip('/')} {rate:.1f}"
        for topic, rate in health.rates_hz.items()
        if rate > 0 and topic not in ("/heartbeat", "/diagnostics", "/rosout")
    )
    return (
        name,
        Text(state, style=_STATE_COLOURS.get(state, "red")),
        f"{health.cpu_percent:.0f}",
        f"{health.rss_mb:.0f}",
        health.message or sends,
    )
