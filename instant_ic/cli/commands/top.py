"""``ic top``: CPU, memory, rates and losses of every node."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli.arguments import positive, verb

if TYPE_CHECKING:
    from instant_ic.cli.top import NodeRow

_PIPE_WIDTH = 300


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add = verb(
        subparsers, "top", "CPU, memory, rates and losses of every node, live", show, "ic top --once",
        "Show CPU, memory, rates (measured/nominal) and losses of every node, once a second.",
    ).add_argument  # fmt: skip
    add("--once", action="store_true", help="print one table and exit (default without a terminal)")
    add("--sort", choices=("cpu", "memory", "name", "lost"), default="cpu", help="default: %(default)s")
    add("-d", "--delay", type=positive, default=1.0, metavar="S", help="update period (default: 1)")


def _ask(row: NodeRow, run_dir: Path) -> None:
    """Ask a node without a heartbeat, through its control channel, what it is doing."""
    from instant_ic.bus.control import ControlError, NodeControl

    try:
        status = NodeControl(run_dir, row.node, 0.3).status()
    except ControlError:
        return
    if status["busy"]:
        row.state = "starting" if status["busy"] == "setup" else "busy"
        row.message = f"in {status['busy']} for {status['busy_s']:.0f} s"


def show(args: argparse.Namespace) -> int:
    """Show the table, live or once."""
    import sys

    from rich.console import Console

    from instant_ic.bus import registry
    from instant_ic.cli.errors import UserError
    from instant_ic.cli.heartbeats import Heartbeats
    from instant_ic.cli.names import nobody_runs
    from instant_ic.cli.top import make_rows, show_live, table
    from instant_ic.util import paths
    from instant_ic.util.safe_text import direct

    run_dir = paths.run_dir()
    if not registry.list_nodes(run_dir):
        raise UserError(nobody_runs())
    with Heartbeats(run_dir) as heartbeats:

        def rows(seconds: float, until_all: bool = False) -> list[NodeRow]:
            infos = registry.list_nodes(run_dir)
            beats = heartbeats.listen(seconds, [info.name for info in infos] if until_all else ())
            made = make_rows(infos, beats)
            for row in made:
                if row.state == "silent":
                    _ask(row, run_dir)
            return made

        if sys.stdin.isatty() and sys.stdout.isatty() and not args.once:
            show_live(rows, args.delay, args.sort)
            return 0
        newest = rows(1.5, until_all=True)
    width = None if sys.stdout.isatty() else _PIPE_WIDTH
    Console(file=direct(sys.stdout), width=width).print(table(newest, args.sort))
    return 0
