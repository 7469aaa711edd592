"""``ic node``: list and describe running nodes."""

from __future__ import annotations

import argparse
from typing import Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import group, verb


def add_parser(subparsers: Any) -> None:
    """Add the command with its verbs."""
    verbs = group(subparsers, "node", "list running nodes", "List and describe running nodes.", "ic node list")
    add = verb(verbs, "list", "names of the running nodes", list_nodes, "ic node list -v").add_argument
    add("-v", "--verbose", action="store_true", help="also process id, uptime, executable")
    info = verb(
        verbs, "info", "state, process and topics of a node", "topic_info.show_node", "ic node info grid_slam",
        "Show a node's state and process, its publishers and subscriptions, and their rates.",
    )  # fmt: skip
    info.add_argument("node", metavar="NODE", completer=completion.nodes)


def list_nodes(args: argparse.Namespace) -> int:
    """Print the running nodes."""
    import sys
    import time

    from instant_ic.bus import registry
    from instant_ic.cli.names import nobody_runs
    from instant_ic.cli.tables import print_table
    from instant_ic.util import paths

    nodes = registry.list_nodes(paths.run_dir())
    if not nodes:
        print(f"ic: {nobody_runs()}", file=sys.stderr)
    elif args.verbose:
        now_s = time.time()
        rows = [(n.name, n.pid, f"{max(0.0, now_s - n.started_ns / 1e9):.0f}", n.executable) for n in nodes]
        print_table(rows, ("NODE", "PID", "UP S", "EXECUTABLE"), right=(1, 2))
    else:
        print("\n".join(node.name for node in nodes))
    return 0
