"""``ic node``: list and describe running nodes."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import group, verb

if TYPE_CHECKING:
    from instant_ic.bus.heartbeat import Flow


def add_parser(subparsers: Any) -> None:
    """Add the command with its verbs."""
    verbs = group(subparsers, "node", "list running nodes", "List and describe running nodes.", "ic node list")
    add = verb(verbs, "list", "names of the running nodes", list_nodes, "ic node list -v").add_argument
    add("-v", "--verbose", action="store_true", help="also process id, uptime, executable")
    info = verb(
        verbs, "info", "state, process and topics of a node", show, "ic node info grid_slam",
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


def show(args: argparse.Namespace) -> int:
    """Print a node's state, process and topics."""
    from instant_ic.bus.control import ControlError, NodeControl
    from instant_ic.cli.heartbeats import hear
    from instant_ic.cli.names import find_node
    from instant_ic.util import paths

    node = find_node(args.node)
    print(f"{node.name}: {node.executable}, pid {node.pid}")
    beat = hear(paths.run_dir(), [node.name]).get(node.name)
    if beat is None:
        print("state: silent, no heartbeat within 2.5 s")
    else:
        print(f"state: {beat.state}{f', {beat.message}' if beat.message else ''}")
        print(f"process: {beat.cpu_percent:.0f} % of a core, {beat.rss_mb:.0f} MB")
    try:
        status = NodeControl(paths.run_dir(), node.name, 2.0).status()
        doing = f", in {status['busy']} for {status['busy_s']:.1f} s" if status["busy_s"] > 0.5 else ""
        print(f"threads: {status['threads']}{doing}")
    except ControlError as error:
        print(f"control: {error}")
    _show_topics("Publishers", node.publishes, beat.outputs if beat else {}, {})
    _show_topics("Subscribers", node.subscribes, beat.inputs if beat else {}, beat.lost if beat else {})
    return 0


def _show_topics(
    title: str, topics: Mapping[str, str], flows: Mapping[str, Flow], lost: Mapping[tuple[str, str], int]
) -> None:
    import math

    print(f"{title}:")
    for topic, kind in sorted(topics.items()):
        text = f"  {topic}: {kind}"
        if flow := flows.get(topic):
            text += ", no message yet" if math.isinf(flow.age_s) else f", {flow.rate_hz:.2f} Hz"
        losses = [f"{count} of {publisher}" for (name, publisher), count in lost.items() if name == topic]
        print(text + (f", lost {', '.join(losses)}" if losses else ""))
