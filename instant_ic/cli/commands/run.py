"""``ic run``: one node in the foreground."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from instant_ic.cli import completion
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
    completion.offer(
        parser.add_argument(
            "node", metavar="NODE", help="name of a node (a wrong one lists them all), or a Python file with a node"
        ),
        completion.programs,
    )
    parser.add_argument("arguments", nargs=argparse.REMAINDER, metavar="ARGUMENTS", help="for the node")
    parser.set_defaults(func=run, leaves=True)


def run(args: argparse.Namespace) -> int:
    """Runs the node in this process."""
    from instant_ic.bus.process import run as run_node

    return run_node(
        _own_node(Path(args.node)) if args.node.endswith(".py") else _shipped_node(args.node), args.arguments
    )


def _shipped_node(name: str) -> Any:
    from instant_ic.bag.replay import find_node_class
    from instant_ic.cli.names import near

    known = completion.programs()
    if name not in known:
        raise UserError(
            f"there is no node {name!r}; there are {', '.join(known)} ({near(name, known, 'or FILE.py')})", 2
        )
    return find_node_class(name)


def _own_node(file: Path) -> Any:
    """The node class that a user's file defines."""
    import importlib.util
    import sys

    from instant_ic.bus import Node

    if not file.is_file():
        raise UserError(f"{file} does not exist", 2)
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[file.stem] = module  # dataclasses look their module up
    sys.path.insert(0, str(file.resolve().parent))
    spec.loader.exec_module(module)
    found = [
        value
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, Node) and value.__module__ == module.__name__
    ]
    if len(found) != 1:
        there = ", ".join(cls.__name__ for cls in found) or "none"
        raise UserError(f"{file} must define one node class (it has: {there})", 2)
    return found[0]
