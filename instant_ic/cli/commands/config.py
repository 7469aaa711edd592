"""``ic config``: show a node's parameters and the origin of each value."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import group, launch_values, verb
from instant_ic.cli.errors import UserError
from instant_ic.cli.tables import print_table

if TYPE_CHECKING:
    from instant_ic.launch.description import NodeSpec


def add_parser(subparsers: Any) -> None:
    verbs = group(
        subparsers, "config", "show the values of a node",
        "Show the values that a node would start with (ic launch FILE --check checks them).",
        "ic config show arbiter --changed",
    )  # fmt: skip
    add = verb(
        verbs, "show", "effective value of each parameter of a node, and where it comes from", show_node,
        "ic config show vlp16_driver --launch robot lidar_port:=3000",
        "Print the effective value of each parameter of a node, and where it comes from: the default, a "
        "parameter file, the launch file, or an argument of the launch file.",
    ).add_argument  # fmt: skip
    add("node", metavar="NODE", help="name of the node in the launch file")
    text = "launch file and its arguments (default: the first of full, sim and replay with this node)"
    form = ("FILE", "KEY:=VALUE")
    add("--launch", nargs="+", default=[], metavar=form, help=text, completer=completion.launch_files)
    add("--changed", action="store_true", help="only values that differ from the default")


def show_node(args: argparse.Namespace) -> int:
    from instant_ic.config.parameter_info import parameter_infos
    from instant_ic.config.params import configure
    from instant_ic.config.yaml_text import one_line
    from instant_ic.launch.parameters import given_values

    spec = _node(args.node, args.launch[:1], launch_values(args.launch[1:]))
    config_class, values = given_values(spec)
    infos = [
        info
        for config in configure(config_class, values)
        for info in parameter_infos(type(config), config)
        if not args.changed or info.value != info.default
    ]
    rows = [(i.name, one_line(i.value), values[i.name].where if i.name in values else "default") for i in infos]
    print(f"{spec.label} ({spec.file.name}):")
    print_table(rows)
    return 0


def _node(name: str, launch_files: list[str], arguments: dict[str, str]) -> NodeSpec:
    from instant_ic.cli.names import near
    from instant_ic.launch import find_launch_file, read_launch_file
    from instant_ic.util import paths

    known: list[str] = []
    for file in launch_files or ["full", "sim", "replay"]:
        needed = {} if launch_files else {"replay": {"bag": "BAG"}}.get(file, {})
        for spec in read_launch_file(find_launch_file(file), {**needed, **arguments}, paths.run_dir()).nodes:
            if name in (spec.label, spec.name):
                if str(paths.node_file(spec.exec)) not in spec.command:
                    raise UserError(f"{name} is not a node of instant_ic: its parameters are not known")
                return spec
            known.append(spec.label)
    where = " ".join(launch_files) or "full, sim or replay"
    raise UserError(f"no node {name!r} in {where} ({near(name, known, 'see ic launch FILE --show-args')})")
