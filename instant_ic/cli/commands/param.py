"""``ic param``: the parameters that running nodes were started with."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from instant_ic.cli.errors import UserError


def add_parser(subparsers: Any) -> None:
    """Adds the verb."""
    parser = subparsers.add_parser(
        "param",
        help="parameters of running nodes",
        description="Tells the parameters that running nodes were started with.",
        epilog="example: ic param list grid_slam",
    )
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    listing = verbs.add_parser(
        "list",
        help="all parameters of one node, or of all",
        description="Lists parameters with their values.",
        epilog="example: ic param list grid_slam",
    )
    listing.add_argument("node", nargs="?", metavar="NODE", help="default: every node")
    listing.set_defaults(func=list_parameters)
    get = verbs.add_parser(
        "get",
        help="one parameter",
        description="Prints the value of one parameter.",
        epilog="example: ic param get grid_slam field.resolution_m",
    )
    get.add_argument("node", metavar="NODE")
    get.add_argument("key", metavar="KEY", help="nested keys with dots")
    get.set_defaults(func=get_parameter)


def list_parameters(args: argparse.Namespace) -> int:
    """Prints parameters by node."""
    from instant_ic import paths
    from instant_ic.bus import registry
    from instant_ic.cli.commands.node import find

    nodes = [find(args.node)] if args.node else registry.list_nodes(paths.run_dir())
    if not nodes:
        print(f"no node runs in {paths.run_dir()}")
    for node in nodes:
        print(f"{node.name}:")
        for key, value in sorted(flatten(node.params).items()):
            print(f"  {key}: {_show(value)}")
    return 0


def get_parameter(args: argparse.Namespace) -> int:
    """Prints one value."""
    from instant_ic.cli.commands.node import find

    values = flatten(find(args.node).params)
    if args.key not in values:
        import difflib

        close = difflib.get_close_matches(args.key, values, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else f"; ic param list {args.node} shows them"
        raise UserError(f"node {args.node} has no parameter {args.key!r}{hint}")
    print(_show(values[args.key]))
    return 0


def flatten(params: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested parameters with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in params.items():
        if isinstance(value, Mapping) and value:
            flat.update(flatten(value, f"{prefix}{key}."))
        else:
            flat[prefix + key] = value
    return flat


def _show(value: Any) -> str:
    import yaml

    return str(yaml.safe_dump(value, default_flow_style=True, width=1 << 20)).removesuffix("...\n").strip()
