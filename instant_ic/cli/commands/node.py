"""``ic node``: list and describe running nodes."""

from __future__ import annotations

import argparse
from typing import Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import group, verb


def add_parser(subparsers: Any) -> None:
    verbs = group(subparsers, "node", "list running nodes", "List and describe running nodes.", "ic node list")
    add = verb(verbs, "list", "names of the running nodes", list_nodes, "ic node list -v").add_argument
    add("-c", "--count-nodes", action="store_true", help="print only their number")
    add("-v", "--verbose", action="store_true", help="also process id, uptime, executable")
    info = verb(
        verbs, "info", "state, process and topics of a node", show, "ic node info grid_slam",
        "Show a node's state and process, its publishers and subscriptions, and their rates.",
    )  # fmt: skip
    info.add_argument("node", metavar="NODE", completer=completion.nodes)


def list_nodes(args: argparse.Namespace) -> int:
    import sys
    import time

    from instant_ic.bus import registry
    from instant_ic.cli.names import nobody_runs
    from instant_ic.util import paths

    nodes = registry.list_nodes(paths.run_dir())
    if args.count_nodes:
        print(len(nodes))
        return 0
    width = max([len(node.name) for node in nodes], default=0)
    for node in nodes:
        up_s = max(0.0, time.time() - node.started_ns / 1e9)
        print(
            f"{node.name:<{width}}  pid {node.pid:<7}  up {up_s:6.0f} s  {node.executable}"
            if args.verbose
            else node.name
        )
    if not nodes:
        print(f"ic: {nobody_runs()}", file=sys.stderr)
    return 0


def show(args: argparse.Namespace) -> int:
    import math

    from instant_ic.bus.control import ControlError, NodeControl
    from instant_ic.bus.heartbeat import Flow
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

    def line(topic: str, kind: str, flow: Flow | None) -> str:
        if flow is None:
            return f"  {topic}: {kind}"
        return f"  {topic}: {kind}" + (", no message yet" if math.isinf(flow.age_s) else f", {flow.rate_hz:.2f} Hz")

    print("Publishers:")
    for topic, kind in sorted(node.publishes.items()):
        print(line(topic, kind, beat.outputs.get(topic) if beat else None))
    print("Subscribers:")
    for topic, kind in sorted(node.subscribes.items()):
        lost = {p: count for (name, p), count in beat.lost.items() if name == topic} if beat else {}
        words = f", lost {', '.join(f'{count} of {p}' for p, count in lost.items())}" if lost else ""
        print(line(topic, kind, beat.inputs.get(topic) if beat else None) + words)
    return 0
