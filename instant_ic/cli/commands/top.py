"""``ic top``: CPU, memory, rates and losses of every node."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli.arguments import positive, verb

if TYPE_CHECKING:
    from instant_ic.cli.top import NodeRow

_SORT = ("cpu", "memory", "name", "lost")


def add_parser(subparsers: Any) -> None:
    add = verb(
        subparsers, "top", "CPU, memory, rates and losses of every node, live", show, "ic top --once",
        "Show CPU, memory, threads, rates (measured/nominal) and losses of every node, once a second.",
    ).add_argument  # fmt: skip
    add("--once", action="store_true", help="print one table and exit (default without a terminal)")
    add("--json", action="store_true", help="print one table as JSON and exit")
    add("--sort", choices=_SORT, default="cpu", help="default: %(default)s")
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
    import json
    import sys
    import time

    from instant_ic.bus import registry
    from instant_ic.cli.errors import UserError
    from instant_ic.cli.heartbeats import Heartbeats
    from instant_ic.cli.names import nobody_runs
    from instant_ic.cli.top import SORT_KEYS, Processes, as_json, expected_rate, make_rows, plain_table
    from instant_ic.util import paths

    run_dir = paths.run_dir()
    processes = Processes()
    if not registry.list_nodes(run_dir):
        raise UserError(nobody_runs())
    with Heartbeats(run_dir) as heartbeats:

        def rows(seconds: float, until_all: bool = False) -> list[NodeRow]:
            infos = registry.list_nodes(run_dir)
            for info in infos:
                processes.begin(info.pid)
            beats = heartbeats.listen(seconds, [info.name for info in infos] if until_all else ())
            made = make_rows(infos, beats, processes.look, expected_rate, time.time_ns())
            for row in made:
                if row.state == "silent":
                    _ask(row, run_dir)
            return made

        live = sys.stdin.isatty() and sys.stdout.isatty() and not (args.once or args.json)
        if live:
            from instant_ic.cli.top_screen import run

            return run(rows, args.delay, args.sort)
        rows(0.3)
        newest = sorted(rows(1.5, until_all=True), key=SORT_KEYS[args.sort])
        print(json.dumps(as_json(newest)) if args.json else plain_table(newest))
    return 0
