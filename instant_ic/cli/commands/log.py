"""``ic log``: log lines and log levels of the nodes."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import not_negative, verb
from instant_ic.cli.errors import UserError
from instant_ic.util.safe_text import direct

if TYPE_CHECKING:
    from instant_ic.cli.logs import LogLine

_POLL_S = 0.2


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add = verb(
        subparsers, "log", "show log lines of the nodes, or set a log level", show,
        "ic log arbiter navigator --level warning -f", "Show log lines of the nodes, sorted by time.\n"
        "ic log level NODE [LEVEL] prints or sets the log level of a running node: debug, info, warning, error.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    ).add_argument  # fmt: skip
    add("nodes", metavar="NODE", nargs="*", help="default: all", completer=completion.nodes)
    text, levels = "lowest level to show (default: %(default)s)", ("debug", "info", "warning", "error")
    add("-l", "--level", type=_level_name, choices=levels, default="debug", metavar="LEVEL", help=text)
    add("-f", "--follow", action="store_true", help="follow: print new lines as they arrive")
    add("-n", "--lines", type=not_negative, default=30, metavar="N", help="the last N (default: %(default)s)")


def _level_name(text: str) -> str:
    return {"warn": "warning"}.get(text.lower(), text.lower())


def show(args: argparse.Namespace) -> int:
    """Print log lines, or a node's level."""
    from instant_ic.cli.logs import LogFolder
    from instant_ic.cli.names import near
    from instant_ic.util import paths

    if args.nodes[:1] == ["level"]:
        return _show_level(args.nodes[1:])
    run_dir = paths.run_dir()
    known = {path.stem for path in (run_dir / "log").glob("*.log")}
    for name in args.nodes:
        if name not in known:
            hint = near(name, known, "ic launch writes logs; ic run and others show them in their terminal")
            raise UserError(f"{name}: no log of it in {run_dir} ({hint})")
    folder = LogFolder(run_dir / "log", args.nodes)
    lines = [line for line in folder.new_lines() if line.at_least(args.level.upper())]
    _print(lines[max(0, len(lines) - args.lines) :], args.level)
    while args.follow:
        time.sleep(_POLL_S)
        _print(folder.new_lines(), args.level)
    return 0


def _print(lines: Iterable[LogLine], level: str) -> None:
    for line in lines:
        if line.at_least(level.upper()):
            print(line.show(sys.stdout.isatty()), file=direct(sys.stdout), flush=True)


def _show_level(words: list[str]) -> int:
    """Print or set the log level of a running node."""
    from instant_ic.bus.control import NodeControl
    from instant_ic.cli.names import find_node
    from instant_ic.util import paths

    if len(words) not in (1, 2):
        raise UserError("usage: ic log level NODE [debug|info|warning|error]", 2)
    control = NodeControl(paths.run_dir(), find_node(words[0]).name)
    print(control.log_level(_level_name(words[1]) if len(words) == 2 else None))
    return 0
