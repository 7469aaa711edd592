"""The launcher's output: plain lines for logs and CI, and a live table of the nodes in a terminal."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import timedelta

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.rule import Rule
from rich.text import Text

from instant_ic.launch.node_table import STATE_STYLES, NodeRow, node_table
from instant_ic.util.safe_text import direct, masked, visible

_COLOURS = ("cyan", "green", "magenta", "yellow", "blue", "bright_cyan", "bright_green", "bright_magenta")
_LINE_STYLES = {" WARNING ": "yellow", " ERROR ": "red", " CRITICAL ": "bold red"}
_LOGGED = re.compile(r"\d{4}-\d\d-\d\d (\d\d:\d\d:\d\d\.\d{3} ([A-Z]+) +(.*))")
"""A line of a node's log: date, time, level, text."""
_TABLE_S = 0.5
_HOLDS_BACK_S = 30.0
"""Warnings are held back for this long or until the stack is ready, since most warnings of a start resolve by then."""


@dataclass(frozen=True)
class StackView:
    """State of a stack at one time.

    Attributes:
        rows: its processes, in the order of the launch file.
        missing: nodes that have not yet reported that they run.
        waiting: steps of the start-up that are still missing, such as the camera's first image.
        addresses: address of each page, by its node's label, once it is available.
        faults: topics that have stopped or are too slow, as text.
        looked: true once the launcher receives heartbeats.
        ending: true while the stack shuts down; then the screen waits for no node.
        pace: pace of the simulation, as text; empty in real time.
    """

    rows: tuple[NodeRow, ...] = ()
    missing: tuple[str, ...] = ()
    waiting: tuple[str, ...] = ()
    addresses: Mapping[str, str] = field(default_factory=dict)
    faults: tuple[str, ...] = field(default=())
    looked: bool = True
    ending: bool = False
    pace: str = ""


class StackScreen:
    """The screen of a stack: lines and events, the missing steps of the start-up, and the console's address.

    Args:
        nodes: names of the nodes, in the order of the launch file.
        live: keep a table of the nodes below the lines.
        progress_period_s: period of the reports of missing steps, if there is no table.
        console: destination of the output; for tests.
        verbose: print every line of the nodes. Otherwise print each warning and error once, and lines that are not
            log lines; warnings of the start-up only if it takes longer than ``_HOLDS_BACK_S``.
    """

    def __init__(
        self,
        nodes: Sequence[str],
        live: bool,
        progress_period_s: float = 5.0,
        console: Console | None = None,
        verbose: bool = False,
    ) -> None:
        self._console = console or Console(file=direct(sys.stdout), highlight=False, soft_wrap=True)
        self._colours = {node: _COLOURS[index % len(_COLOURS)] for index, node in enumerate(nodes)}
        self._width = max([len(node) for node in nodes] + [6])
        self._live = Live(console=self._console, auto_refresh=False, transient=True) if live else None
        self._progress_period_s = progress_period_s
        self._started_s = time.monotonic()
        self._next_progress_s = self._started_s + progress_period_s
        self._next_table_s = self._started_s
        self._all_up = self._ready = False
        self._addresses: dict[str, str] = {}
        self._reported_faults: tuple[str, ...] = ()
        self._verbose = verbose
        self._shows = dict.fromkeys(nodes, True)
        """Node -> whether its last log line was shown; the lines of a traceback that follow are treated alike."""
        self._shown: set[tuple[str, str]] = set()
        self._held_back: list[tuple[str, str]] = []

    def start(self) -> None:
        """Show the table."""
        if self._live is not None:
            self._live.start()

    def stop(self) -> None:
        """Remove the table.

        Raises:
            OSError: the terminal or the reader of standard output is gone.
        """
        if self._live is not None:
            self._live.stop()
        self._console.file.flush()

    def node_line(self, node: str, text: str) -> None:
        """Print a line of a node's output if it is worth showing."""
        if self._verbose or self._is_worth_showing(node, text):
            self._print_line(node, text)

    def _is_worth_showing(self, node: str, text: str) -> bool:
        logged = _LOGGED.match(text)
        if logged is None:
            return self._shows.get(node, True)
        key = node, re.sub(r"\d+", "0", logged[3])
        new = logged[2] in ("WARNING", "ERROR", "CRITICAL") and key not in self._shown
        if new:
            self._shown.add(key)
            if self._starting:
                self._held_back.append((node, text))
        self._shows[node] = new and not self._starting
        return self._shows[node]

    @property
    def _starting(self) -> bool:
        return not self._ready and time.monotonic() - self._started_s < _HOLDS_BACK_S

    def _print_line(self, node: str, text: str) -> None:
        prefix = (f"{node:>{self._width}} │ ", self._colours.get(node, "white"))
        style = next((style for word, style in _LINE_STYLES.items() if word in text), "")
        logged = _LOGGED.match(text)
        shown = visible(masked(logged[1] if logged else text), colours=True)
        self._console.print(Text.assemble(prefix, Text.from_ansi(shown, style=style)))

    def event(self, text: str, bad: bool = False) -> None:
        """Print an event of the launcher."""
        self._console.print(Text(f"{'launch':>{self._width}} │ {visible(text)}", style="bold red" if bad else "bold"))

    def refresh(self, view: StackView) -> None:
        """Print the changes since the last view, and render the table again."""
        now = time.monotonic()
        if view.looked and not view.ending:
            self._report_progress(view, now)
        if self._live is not None and (now >= self._next_table_s or view.ending):
            self._next_table_s = now + _TABLE_S
            self._live.update(self.table(view), refresh=True)

    def _report_progress(self, view: StackView, now: float) -> None:
        if not view.missing and not self._all_up:
            self._all_up = True
            count = sum(row.state not in ("failed", "ended") for row in view.rows) or len(self._colours)
            up = "the node is up" if count == 1 else f"all {count} nodes are up"
            self.event(f"{up} after {now - self._started_s:.1f} s")
        for node, address in view.addresses.items():
            if self._addresses.setdefault(node, "") != address:
                self._addresses[node] = address
                self.event(f"{node}: {address}")
        if self._all_up and not view.waiting and not self._ready:
            self._ready = True
            at = f": {self._page}" if self._page else ""
            self.event(f"ready after {now - self._started_s:.1f} s{at}")
            self._held_back.clear()  # warnings of the start-up; lasting faults are in the nodes' diagnoses
            for row in view.rows:
                if row.message and not self._verbose:
                    self.event(f"{row.node}: {row.message}", bad=row.state not in STATE_STYLES)
        if not self._starting:
            for node, text in self._held_back:
                self._print_line(node, text)
            self._held_back.clear()
        if self._live is not None:
            return  # the table shows the rest
        if now >= self._next_progress_s:
            self._next_progress_s = now + self._progress_period_s
            if not self._ready:
                running = len(self._colours) - len(view.missing)
                progress = f"{running} of {len(self._colours)} nodes are up, " if view.missing else ""
                self.event(f"{progress}waiting for {', '.join(view.missing or view.waiting)}")
            self._report_faults(view.faults)

    @property
    def _page(self) -> str | None:
        """Address of the operator's page."""
        return next((url for node, url in self._addresses.items() if node.rpartition("/")[2] == "console"), None)

    def _report_faults(self, faults: tuple[str, ...]) -> None:
        """Report a topic when it becomes faulty and when it recovers, but not when only its numbers change."""
        before = {fault.partition(":")[0] for fault in self._reported_faults}
        now = {fault.partition(":")[0] for fault in faults}
        if new := [fault for fault in faults if fault.partition(":")[0] not in before]:
            self.event(f"too slow: {', '.join(new)}", bad=True)
        if over := sorted(before - now):
            self.event(f"back to the right rate: {', '.join(over)}")
        self._reported_faults = faults

    def table(self, view: StackView) -> RenderableType:
        """Return the table of nodes with a status line below."""
        return Group(Rule(style="dim"), node_table(view.rows, self._colours), self._footer(view))

    def _footer(self, view: StackView) -> Text:
        text = Text(overflow="ellipsis", no_wrap=True)
        if view.ending:
            return text.append("stopping", style="bold yellow")
        waiting = view.missing or view.waiting
        if not view.looked:
            text.append("starting", style="yellow")
        elif waiting:
            text.append(f"waiting for {', '.join(waiting)}", style="yellow")
        else:
            text.append("ready", style="bold green")
        if self._page:
            text.append(" · ").append(self._page, style="bold underline")
        if view.pace:
            text.append(f" · {view.pace}", style="yellow")
        runs = timedelta(seconds=int(time.monotonic() - self._started_s))
        text.append(f" · {runs} · Ctrl-C stops the stack", style="dim")
        return text
