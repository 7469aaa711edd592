"""``ic param``: read and change parameters of running nodes."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import group, verb
from instant_ic.cli.errors import UserError

if TYPE_CHECKING:
    from instant_ic.bus.control import NodeControl


def add_parser(subparsers: Any) -> None:
    """Add the command with its verbs."""
    text = "read and change parameters of running nodes"
    verbs = group(subparsers, "param", text, f"{text.capitalize()}.", "ic param set arbiter switch.yaw_deg 12")
    of = {"metavar": "NODE", "completer": completion.nodes}

    def with_node(name: str, words: str, function: Any, example: str) -> Any:
        parser = verb(verbs, name, words, function, f"ic param {example}")
        parser.add_argument("node", **of)
        return parser.add_argument

    text = "names of the parameters of one node, or of all"
    add = verb(verbs, "list", text, list_parameters, "ic param list grid_slam").add_argument
    add("node", nargs="?", help="default: every node", **of)
    add("-v", "--values", action="store_true", help="also print their values")
    add("--changed", action="store_true", help="only values that differ from the default, with both")
    add = with_node("get", "value of one parameter", get_parameter, "get grid_slam field.resolution_m")
    add("key", metavar="KEY", help="a nested key is separated by dots", completer=completion.parameters)
    add = with_node("set", "change parameters while the node runs", set_parameters, "set depth_estimator max_rate_hz 1")
    text = "several pairs are changed together, or none; values are YAML"
    add("pairs", metavar="KEY VALUE", nargs="+", completer=completion.parameters, help=text)
    add = with_node("describe", "type, range, default and meaning", describe, "describe arbiter switch.yaw_deg")
    add("keys", metavar="KEY", nargs="*", help="default: all", completer=completion.parameters)
    add = with_node("dump", "all parameters of a node as a parameter file", dump, "dump arbiter > arbiter.yaml")
    add = with_node("load", "set parameters from a file", load, "load arbiter arbiter.yaml")
    add("file", metavar="FILE", type=Path, help="file in the format of ic param dump")


def _control(node: str) -> NodeControl:
    from instant_ic.bus.control import NodeControl
    from instant_ic.cli.names import find_node
    from instant_ic.util import paths

    return NodeControl(paths.run_dir(), find_node(node).name)


def list_parameters(args: argparse.Namespace) -> int:
    """Print parameters from the registry, which also works for a hung node."""
    from instant_ic.bus import registry
    from instant_ic.cli.names import find_node, nobody_runs
    from instant_ic.config import params
    from instant_ic.util import paths

    nodes = [find_node(args.node)] if args.node else registry.list_nodes(paths.run_dir())
    if not nodes:
        raise UserError(nobody_runs())
    for node in nodes:
        print(f"{node.name}:")
        if args.changed:  # only the running node knows its defaults
            for info in _control(node.name).describe():
                if info.value != info.default:
                    print(f"  {info.name}: {_show(info.value)} (default {_show(info.default)})")
            continue
        for key, value in sorted(params.flatten(node.params).items()):
            print(f"  {key}: {_show(value)}" if args.values else f"  {key}")
    return 0


def get_parameter(args: argparse.Namespace) -> int:
    """Print the value of a parameter, or the values of a group."""
    from instant_ic.cli.names import find_node
    from instant_ic.config import params

    values = params.flatten(find_node(args.node).params)
    if args.key in values:
        print(_show(values[args.key]))
        return 0
    for key in _matching(args.node, args.key, values):
        print(f"{key}: {_show(values[key])}")
    return 0


def _matching(node: str, key: str, known: Iterable[str]) -> list[str]:
    """Return the parameters that a key names: one, or all of a group."""
    from instant_ic.cli.names import near

    found = [name for name in known if name == key or name.startswith(f"{key}.")]
    if not found:
        raise UserError(f"node {node} has no parameter {key!r} ({near(key, known, f'see ic param list {node}')})")
    return found


def set_parameters(args: argparse.Namespace) -> int:
    """Change several parameters together, or none of them."""
    from instant_ic.config import params

    words = args.pairs
    if len(words) % 2:
        raise UserError(f"{words[-1]}: a value is missing (ic param set {args.node} KEY VALUE ...)", 2)
    pairs = zip(words[::2], words[1::2], strict=True)
    return _change(args.node, {key: params.yaml_value(text, f"{key} {text}") for key, text in pairs})


def _change(node: str, values: dict[str, Any]) -> int:
    changed = _control(node).set(values)
    for key, value in changed.items():
        print(f"{key}: {_show(value)}")
    if not changed:
        print("nothing to change: the parameters already have these values")
    return 0


def describe(args: argparse.Namespace) -> int:
    """Print type, range, value and meaning of parameters."""
    infos = {info.name: info for info in _control(args.node).describe()}
    names = [name for key in args.keys for name in _matching(args.node, key, infos)] if args.keys else list(infos)
    for info in map(infos.__getitem__, names):
        print(f"Parameter name: {info.name}")
        print(f"  Type: {info.type}{f', {info.range}' if info.range else ''}")
        default = "" if info.value == info.default else f" (default {_show(info.default)})"
        print(f"  Value: {_show(info.value)}{default}")
        print(f"  Live: {'yes' if info.live else 'no, takes effect at start'}")
        if info.description:
            print(f"  Description: {info.description}")
    return 0


def dump(args: argparse.Namespace) -> int:
    """Print all parameters as a parameter file."""
    from instant_ic.cli.names import find_node
    from instant_ic.config.yaml_text import dump_yaml

    node = find_node(args.node)
    nested: dict[str, Any] = {}
    for key, value in _control(node.name).get().items():
        *groups, last = key.split(".")
        place = nested
        for key_group in groups:
            place = place.setdefault(key_group, {})
        place[last] = value
    print(dump_yaml({node.name: {"ros__parameters": nested}}, default_flow_style=None, width=100), end="")
    return 0


def load(args: argparse.Namespace) -> int:
    """Set the parameters of a file. Parameters that already have the file's value need not be live."""
    from instant_ic.cli.names import find_node
    from instant_ic.config import params

    name = find_node(args.node).name
    values = params.load_file(args.file, name)
    if not values:
        raise UserError(f"{args.file} has no parameters for {name} (it must have a section {name!r} or '/**')", 2)
    return _change(name, {key: value.given for key, value in values.items()})


def _show(value: Any) -> str:
    from instant_ic.config.yaml_text import one_line

    return one_line(value)
