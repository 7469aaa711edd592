"""``ic run``: run one node in the foreground."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import verb
from instant_ic.cli.errors import UserError


def add_parser(subparsers: Any) -> None:
    parser = verb(
        subparsers, "run", "run one node in the foreground", run,
        "ic run grid_slam --params-file config/slam.yaml -p use_sim_time:=true -r /scan:=/front/scan",
        "Run one node until Ctrl-C. Arguments after its name go to the node: ic run NODE --help",
    )  # fmt: skip
    text = "name of a node (an unknown name lists all names), or a Python file with a node"
    parser.add_argument("node", metavar="NODE", help=text, completer=completion.programs)
    parser.add_argument("arguments", nargs=argparse.REMAINDER, metavar="ARGUMENTS", help="arguments for the node")
    parser.set_defaults(leaves=True)


def run(args: argparse.Namespace) -> int:
    import sys

    from instant_ic.bus.node_files import NodeFileError, load, node_class
    from instant_ic.bus.process import run as run_node
    from instant_ic.cli.names import near
    from instant_ic.util.paths import node_names

    try:
        if args.node.endswith(".py"):
            file = Path(args.node)
            sys.path.insert(0, str(file.resolve().parent))
            return run_node(load(file), args.arguments)
        return run_node(node_class(args.node), args.arguments)
    except NodeFileError as error:
        hint = "" if args.node.endswith(".py") else f" ({near(args.node, node_names(), 'or FILE.py')})"
        raise UserError(f"{error}{hint}", 2) from None
