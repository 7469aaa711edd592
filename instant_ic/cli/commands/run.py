"""``ic run``: one node in the foreground."""

from __future__ import annotations

import argparse
from typing import Any

from instant_ic.cli.errors import UserError


def add_parser(subparsers: Any) -> None:
    """Adds the verb."""
    parser = subparsers.add_parser(
        "run",
        help="run one node in the foreground",
        description="Runs one node until Ctrl-C. What follows its name goes to the node; ic run NODE --help lists it.",
        epilog="example: ic run grid_slam --params-file config/slam.yaml -p use_sim_time:=true -r /scan:=/front/scan",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("node", metavar="NODE", help="name of a node; a wrong one lists them all")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, metavar="ARGUMENTS", help="for the node")
    parser.set_defaults(func=run)


def run(args: argparse.Namespace) -> int:
    """Runs the node in this process."""
    from instant_ic.launch.description import known_nodes

    if args.node not in known_nodes():
        raise UserError(f"there is no node {args.node!r}; there are {', '.join(known_nodes())}", 2)
    from instant_ic.bag.replay import find_node_class
    from instant_ic.bus.process import run as run_node

    return run_node(find_node_class(args.node), args.arguments)
