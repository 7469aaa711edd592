"""``ic launch``: start a stack from a launch file."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import launch_values, verb
from instant_ic.cli.tables import print_table


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = verb(
        subparsers, "launch", "start a stack from a launch file", run,
        "ic launch sim console_port:=9000 record:=drive",
        "Start the nodes of a launch file, show their state, and stop them all on Ctrl-C.",
    )  # fmt: skip
    add = parser.add_argument
    text = "path, or a shipped file: sim, robot, station, full, fleet, replay"
    add("file", metavar="FILE", help=text, completer=completion.launch_files)
    text = "arguments of the launch file"
    add("arguments", nargs="*", metavar="KEY:=VALUE", help=text, completer=completion.launch_arguments)
    add("-s", "--show-args", "--show-arguments", action="store_true", help="list the file's arguments and exit")
    add("--check", action="store_true", help="check file, arguments and every node's parameters without starting")
    text = "skip the check of node parameters before the start (each node checks its own)"
    add("--no-check", action="store_true", help=text)
    add("-v", "--verbose", action="store_true", help="show every line that the nodes log")
    add("--plain", action="store_true", help="plain log lines even in a terminal")
    text = "speed of simulated time relative to real time, such as 0.5; default: auto, as fast as the machine can "
    add("--pace", type=_pace, metavar="X", help=text + "run simulated devices (with real devices: 1)")
    add("--run-dir", type=Path, metavar="DIR", help="default: $INSTANT_IC_RUN_DIR")
    parse = parser.parse_known_args

    def pairs_beside_the_file(words: Any = None, namespace: Any = None) -> Any:
        """Allow ``sim --check a:=b``: argparse accepts positional arguments only next to each other."""
        first, rest = list(words or [])[:1], list(words or [])[1:]
        if first and not first[0].startswith("-"):
            pairs = [word for word in rest if ":=" in word and not word.startswith("-")]
            words = [*first, *pairs, *(word for word in rest if word not in pairs)]
        return parse(words, namespace)

    parser.parse_known_args = pairs_beside_the_file


def run(args: argparse.Namespace) -> int:
    """Check and start a launch file, or show its arguments."""
    from instant_ic.launch import find_launch_file, read_arguments, read_launch_file
    from instant_ic.util import paths

    file = find_launch_file(args.file)
    if args.show_args:
        arguments = read_arguments(file)
        rows = [(a.name, a.type, "required" if a.default is None else a.default, a.description) for a in arguments]
        print_table(rows, ("ARGUMENT", "TYPE", "DEFAULT", "MEANING"))
        return 0
    run_dir = (args.run_dir or paths.run_dir()).absolute()
    description = read_launch_file(file, launch_values(args.arguments), run_dir)
    if args.check or not args.no_check:
        from instant_ic.launch.parameters import check_parameters_apart, existing_bags

        problems = check_parameters_apart(description.nodes) + existing_bags(description.nodes)
        for problem in problems:
            print(f"ic: {problem}", file=sys.stderr)
        if problems:
            return 2
    if args.check:
        print(f"{description.file.name}: {len(description.nodes)} nodes, no errors")
        return 0
    from instant_ic.cli.commands import compile as kernels
    from instant_ic.launch.app import run_stack

    if any(node.exec in kernels.NODES for node in description.nodes):
        kernels.run()  # failures are reported by the nodes that need the kernels
    return run_stack(description, run_dir, False if args.plain else None, args.pace, verbose=args.verbose)


def _pace(text: str) -> float | None:
    """Read the value of ``--pace``; None stands for auto."""
    from instant_ic.util.pace import PaceError, check_factor

    try:
        return None if text == "auto" else check_factor(float(text))
    except PaceError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a number or auto (got {text!r})") from None
