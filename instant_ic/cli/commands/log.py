"""``ic log``: log lines and log levels of the nodes."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import not_negative, seconds, verb
from instant_ic.cli.errors import UserError
from instant_ic.util.safe_text import direct

_POLL_S = 0.2


def add_parser(subparsers: Any) -> None:
    add = verb(
        subparsers, "log", "show log lines of the nodes, or set a log level", show,
        "ic log arbiter navigator --level warning -f", "Show log lines of the nodes, sorted by time.\n"
        "ic log level NODE [LEVEL] prints or sets the log level of a running node: debug, info, warning, error.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    ).add_argument  # fmt: skip
    add("nodes", metavar="NODE", nargs="*", help="default: all", completer=completion.nodes)
    text = "lowest level to show: debug, info, warn, error"
    add("-l", "--level", default="debug", metavar="LEVEL", help=text)
    add("-f", "--follow", action="store_true", help="follow: print new lines as they arrive")
    text = "the last N (default: 30, or all since --since)"
    add("-n", "--lines", type=not_negative, metavar="N", help=text)
    add("--since", type=seconds, metavar="TIME", help="lines of the last 30s, 10m, 2h, 1d")
    add("--color", choices=("auto", "always", "never"), default="auto", help="default: auto")


def show(args: argparse.Namespace) -> int:
    import time

    from instant_ic.bus import registry
    from instant_ic.cli.logs import LogFolder, chosen, level_number
    from instant_ic.cli.logs import show as line_words
    from instant_ic.util import paths

    if args.nodes[:1] == ["level"]:
        return _level(args.nodes[1:])
    try:
        level = level_number(args.level)
    except ValueError as error:
        raise UserError(str(error), 2) from error
    run_dir = paths.run_dir()
    running = {node.name: node.started_ns / 1e9 for node in registry.list_nodes(run_dir)}
    _check_names(args.nodes, run_dir, running)
    colour = args.color == "always" or (args.color == "auto" and sys.stdout.isatty())
    folder = LogFolder(run_dir / "log", args.nodes)
    lines = list(chosen(folder.new_lines(), level, time.time() - args.since if args.since else 0.0))
    count = args.lines if args.lines is not None else len(lines) if args.since else 30
    for line in lines[max(0, len(lines) - count) :]:
        print(line_words(line, colour), file=direct(sys.stdout))
    silent = [name for name, started in running.items() if not folder.has(name, started)]
    silent = [name for name in silent if not args.nodes or name in args.nodes]
    if not args.follow:
        if silent:
            print(
                f"ic: {', '.join(silent)}: no log file because ic launch did not start it; -f shows new lines",
                file=sys.stderr,
            )
        return 0
    sys.stdout.flush()
    return _follow(folder, set(args.nodes), level, colour)


def _check_names(names: list[str], run_dir: Any, running: dict[str, float]) -> None:
    from instant_ic.cli.names import near

    known = {*running, *(path.stem for path in (run_dir / "log").glob("*.log"))}
    for name in names:
        if name not in known:
            raise UserError(f"{name}: no such node and no log of it in {run_dir} ({near(name, known, 'ic node list')})")


def _follow(folder: Any, nodes: set[str], level: int, colour: bool) -> int:
    from instant_ic.bus import registry
    from instant_ic.cli.logs import chosen, from_rosout
    from instant_ic.cli.logs import show as line_words
    from instant_ic.cli.observer import Observer
    from instant_ic.msg import deserialize
    from instant_ic.util import paths

    run_dir = paths.run_dir()
    topics = {info.topic for info in registry.list_topics(run_dir) if info.type_name == "rcl_interfaces/msg/Log"}
    with Observer(sorted(topics | {"/rosout"})) as observer:
        for batch in observer.batches(float("inf"), _POLL_S):
            said = [from_rosout(deserialize(received.payload, received.type_name)) for received in batch]
            started = {node.name: node.started_ns / 1e9 for node in registry.list_nodes(run_dir)} if said else {}
            live = [
                line
                for line in said
                if (not nodes or line.node in nodes) and not folder.has(line.node, started.get(line.node, float("inf")))
            ]
            for line in chosen(sorted([*folder.new_lines(), *live], key=lambda one: one.stamp_s), level):
                print(line_words(line, colour), file=direct(sys.stdout), flush=True)
    return 0


def _level(words: list[str]) -> int:
    from instant_ic.bus.control import NodeControl
    from instant_ic.cli.names import find_node
    from instant_ic.util import paths

    if len(words) not in (1, 2):
        raise UserError("usage: ic log level NODE [debug|info|warning|error]", 2)
    control = NodeControl(paths.run_dir(), find_node(words[0]).name)
    wanted = {"warn": "warning"}.get(words[1].lower(), words[1].lower()) if len(words) == 2 else None
    print(control.log_level(wanted))
    return 0
