"""``ic log``: log lines and log levels of the nodes."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import not_negative, seconds, verb
from instant_ic.cli.errors import UserError
from instant_ic.util.safe_text import direct

if TYPE_CHECKING:
    from instant_ic.cli.logs import LogFolder, LogLine

_POLL_S = 0.2
_LINES = 30


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
    text = f"the last N (default: {_LINES}, or all since --since)"
    add("-n", "--lines", type=not_negative, metavar="N", help=text)
    add("--since", type=seconds, metavar="TIME", help="lines of the last 30s, 10m, 2h, 1d")


def _level_name(text: str) -> str:
    return {"warn": "warning"}.get(text.lower(), text.lower())


def show(args: argparse.Namespace) -> int:
    """Print log lines, or a node's level."""
    from instant_ic.bus import registry
    from instant_ic.cli.logs import LogFolder
    from instant_ic.cli.names import near
    from instant_ic.util import paths

    if args.nodes[:1] == ["level"]:
        return _show_level(args.nodes[1:])
    run_dir = paths.run_dir()
    running = {node.name: node.started_ns / 1e9 for node in registry.list_nodes(run_dir)}
    known = {*running, *(path.stem for path in (run_dir / "log").glob("*.log"))}
    for name in args.nodes:
        if name not in known:
            raise UserError(f"{name}: no such node and no log of it in {run_dir} ({near(name, known, 'ic node list')})")
    folder = LogFolder(run_dir / "log", args.nodes)
    since_s = time.time() - args.since if args.since else 0.0
    lines = [line for line in folder.new_lines() if line.at_least(args.level.upper()) and line.stamp_s >= since_s]
    count = args.lines if args.lines is not None else len(lines) if args.since else _LINES
    _print(lines[max(0, len(lines) - count) :], args.level)
    if args.follow:
        _follow(run_dir, folder, set(args.nodes), args.level)
    silent = [n for n, started_s in running.items() if not folder.has(n, started_s) and n in (args.nodes or running)]
    if silent:
        print(f"ic: {', '.join(silent)}: not started by ic launch, so without a log file. Use -f.", file=sys.stderr)
    return 0


def _print(lines: Iterable[LogLine], level: str) -> None:
    for line in lines:
        if line.at_least(level.upper()):
            print(line.show(sys.stdout.isatty()), file=direct(sys.stdout), flush=True)


def _follow(run_dir: Path, folder: LogFolder, nodes: set[str], level: str) -> None:
    """Print new lines until Ctrl-C; nodes without a file are heard on ``/rosout``."""
    from instant_ic.bus import registry
    from instant_ic.cli.logs import from_rosout
    from instant_ic.cli.observer import TopicObserver
    from instant_ic.msg import deserialize

    topics = {info.topic for info in registry.list_topics(run_dir) if info.type_name == "rcl_interfaces/msg/Log"}
    with TopicObserver(sorted(topics | {"/rosout"})) as observer:
        for batch in observer.batches(float("inf"), _POLL_S):
            heard = [from_rosout(deserialize(received.payload, received.type_name)) for received in batch]
            started = {node.name: node.started_ns / 1e9 for node in registry.list_nodes(run_dir)} if heard else {}
            live = [
                line
                for line in heard
                if (not nodes or line.node in nodes) and not folder.has(line.node, started.get(line.node, float("inf")))
            ]
            _print(sorted([*folder.new_lines(), *live], key=lambda one: one.stamp_s), level)


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
