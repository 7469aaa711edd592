"""``ic node``: which nodes run."""

from __future__ import annotations

import argparse
from typing import Any

from instant_ic.cli.errors import UserError


def add_parser(subparsers: Any) -> None:
    """Adds the verb."""
    parser = subparsers.add_parser(
        "node", help="list running nodes", description="Tells which nodes run.", epilog="example: ic node list"
    )
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    listing = verbs.add_parser(
        "list",
        help="names of the running nodes",
        description="Lists the running nodes with process id, time since their start and module.",
        epilog="example: ic node list",
    )
    listing.set_defaults(func=list_nodes)
    info = verbs.add_parser(
        "info",
        help="topics and process of a node",
        description="Tells what a node publishes and subscribes.",
        epilog="example: ic node info grid_slam",
    )
    info.add_argument("node", metavar="NODE")
    info.set_defaults(func=show)


def list_nodes(args: argparse.Namespace) -> int:
    """Prints a line a node."""
    import time

    from instant_ic import paths
    from instant_ic.bus import registry

    nodes = registry.list_nodes(paths.run_dir())
    width = max([len(node.name) for node in nodes], default=0)
    for node in nodes:
        up_s = max(0.0, time.time() - node.started_ns / 1e9)
        print(f"{node.name:<{width}}  pid {node.pid:<7}  up {up_s:6.0f} s  {node.module}")
    if not nodes:
        print(f"no node runs in {paths.run_dir()}")
    return 0


def find(name: str) -> Any:
    """A running node by name."""
    from instant_ic import paths
    from instant_ic.bus import registry

    nodes = {node.name: node for node in registry.list_nodes(paths.run_dir())}
    if name.strip("/") not in nodes:
        running = ", ".join(nodes) or "none"
        raise UserError(f"node {name!r} does not run in {paths.run_dir()} (running: {running})")
    return nodes[name.strip("/")]


def show(args: argparse.Namespace) -> int:
    """Prints one node."""
    node = find(args.node)
    print(f"{node.name}: {node.module}, pid {node.pid}")
    for title, topics in (("publishes", node.publishes), ("subscribes", node.subscribes)):
        print(f"{title}:")
        for topic, type_name in sorted(topics.items()):
            print(f"  {topic}: {type_name}")
    return 0
