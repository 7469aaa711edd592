"""``ic launch``: a whole stack from a launch file."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from instant_ic.cli.errors import UserError


def add_parser(subparsers: Any) -> None:
    """Adds the verb."""
    parser = subparsers.add_parser(
        "launch",
        help="start a stack from a launch file",
        description="Starts the nodes of a launch file, shows how they are, and ends them all on Ctrl-C.",
        epilog="example: ic launch sim console_port:=9000 record:=drive",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", metavar="FILE", help="path, or a shipped one: sim, robot, station, full, replay")
    parser.add_argument("arguments", nargs="*", metavar="KEY:=VALUE", help="arguments of the launch file")
    parser.add_argument("--show-args", action="store_true", help="list the file's arguments and end")
    parser.add_argument(
        "--check", action="store_true", help="check file, arguments and every node's parameters, start nothing"
    )
    parser.add_argument("--plain", action="store_true", help="plain lines also in a terminal")
    parser.add_argument("--run-dir", type=Path, default=None, metavar="DIR", help="default: $INSTANT_IC_RUN_DIR")
    parser.set_defaults(func=run)


def run(args: argparse.Namespace) -> int:
    """Reads, checks and runs the file."""
    from instant_ic import paths
    from instant_ic.launch import find_launch_file, read_arguments, read_launch_file

    try:
        file = find_launch_file(args.file)
    except FileNotFoundError as error:
        raise UserError(str(error), 2) from None
    if args.show_args:
        _show(file.name, read_arguments(file))
        return 0
    values: dict[str, str] = {}
    for word in args.arguments:
        name, separator, value = word.partition(":=")
        if not separator or not name:
            raise UserError(f"{word!r}: expected KEY:=VALUE", 2)
        values[name] = value
    run_dir = args.run_dir or paths.run_dir()
    description = read_launch_file(file, values, run_dir)
    if args.check:
        return _check(description)
    from instant_ic.launch.app import run_stack

    return run_stack(description, run_dir, False if args.plain else None)


def _show(name: str, arguments: Any) -> None:
    print(f"arguments of {name}:")
    if not arguments:
        print("  none")
    for argument in arguments:
        default = "must be given" if argument.default is None else f"default: {argument.default!r}"
        print(f"  {argument.name} ({default})")
        if argument.description:
            print(f"      {argument.description}")


def _check(description: Any) -> int:
    """Builds every node's configuration, as the node itself would."""
    from instant_ic.launch.parameters import check_parameters

    problems = check_parameters(description.nodes)
    for problem in problems:
        print(f"ic: {problem}", file=sys.stderr)
    if not problems:
        print(f"{description.file.name}: {len(description.nodes)} nodes, no mistake found")
    return 2 if problems else 0
