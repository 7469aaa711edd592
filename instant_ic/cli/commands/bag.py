"""``ic bag``: record, play, inspect, compare, convert and recover bags."""

from __future__ import annotations

import argparse
from typing import Any

from instant_ic.cli import completion
from instant_ic.cli.errors import UserError

COMMANDS = ("pause", "resume", "toggle", "step", "rate", "seek", "split", "record", "stop", "status")
_VALUES = {"step": "count", "rate": "rate", "seek": "offset_s"}


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = subparsers.add_parser(
        "bag",
        help="record, play, inspect, compare, convert and recover bags",
        description="Work with bags: rosbag2 folders (MCAP) that ROS 2, Foxglove and rosbags can open.",
        epilog="example: ic bag record -o drive",
    )
    verbs = parser.add_subparsers(metavar="VERB", required=True)

    def verb(name: str, words: str, function: str, example: str) -> argparse.ArgumentParser:
        added: argparse.ArgumentParser = verbs.add_parser(
            name, help=words, description=f"{words[0].upper()}{words[1:]}.", epilog=f"example: {example}"
        )

        def run(args: argparse.Namespace) -> int:
            import importlib

            module, _, name = function.partition(".")
            status: int = getattr(importlib.import_module(f"instant_ic.cli.{module}"), name)(args)
            return status

        added.set_defaults(func=run)
        return added

    recording = verb(
        "record",
        "record topics until Ctrl-C; space pauses",
        "bag_run.record",
        "ic bag record -o drive /scan '/camera/*' -x /camera/raw --max-bag-size 2GB",
    )
    _topics(recording)
    recording.add_argument("-o", "--output", default="", metavar="DIR", help="default: runs/bag_DATE_TIME")
    recording.add_argument("--duration", type=_seconds, default=0.0, metavar="S", help="stop after this time")
    _files(recording)
    recording.add_argument(
        "--max-queue",
        type=size,
        default=256_000_000,
        metavar="SIZE",
        help="size of the queue for the disk (default: 256MB); messages beyond it are dropped and counted",
    )
    recording.add_argument(
        "--min-free",
        type=size,
        default=100_000_000,
        metavar="SIZE",
        help="pause writing below this free disk space (default: 100MB)",
    )
    recording.add_argument(
        "--snapshot",
        action="store_true",
        help="keep the last seconds in memory and write them on ic bag snapshot or an emergency stop",
    )
    recording.add_argument(
        "--snapshot-seconds", type=_seconds, default=30.0, metavar="S", help="seconds kept in memory (default: 30)"
    )
    recording.add_argument(
        "--snapshot-after",
        type=_seconds,
        default=2.0,
        metavar="S",
        help="seconds to include after the snapshot (default: 2)",
    )
    recording.add_argument(
        "--max-cache-size",
        type=size,
        default=256_000_000,
        metavar="SIZE",
        help="memory limit for a snapshot (default: 256MB)",
    )
    recording.add_argument("--start-paused", action="store_true", help="wait for resume before recording")
    recording.add_argument(
        "--use-sim-time", action="store_true", help="stamp messages with /clock, for example from a playing bag"
    )

    playing = verb(
        "play",
        "play a bag with /clock; space pauses, → steps, ↑ ↓ change the rate",
        "bag_run.play",
        "ic bag play drive --rate 2 --start 10",
    )
    completion.offer(
        playing.add_argument("bag", metavar="BAG", help="folder, .mcap, .db3 or ROS 1 .bag file"), completion.bags
    )
    _topics(playing)
    playing.add_argument("-r", "--rate", type=float, default=1.0, help="speed factor (default: %(default)s)")
    playing.add_argument("--start", type=_seconds, default=0.0, metavar="S", help="start at this offset")
    playing.add_argument("--duration", type=_seconds, default=0.0, metavar="S", help="play this many seconds")
    playing.add_argument("--loop", action="store_true", help="restart at the end")
    playing.add_argument("--start-paused", action="store_true", help="wait for space, → or ic bag control resume")
    playing.add_argument("--remap", action="append", default=[], metavar="FROM:=TO", help="rename a topic; repeatable")
    playing.add_argument(
        "--force",
        action="store_true",
        help="publish commands and states even though a base is running: the robot may move",
    )
    playing.add_argument("--no-clock", action="store_true", help="do not publish /clock")
    playing.add_argument(
        "--delay", type=_seconds, default=0.5, metavar="S", help="wait for subscribers to connect (default: 0.5)"
    )
    playing.add_argument(
        "--wait-for", action="append", default=[], metavar="NODE", help="start once this node subscribes; repeatable"
    )

    looking = verb("info", "topics, types, counts, files and losses of a bag", "bag_look.info", "ic bag info drive")
    completion.offer(looking.add_argument("bag", metavar="BAG"), completion.bags)
    looking.add_argument("--json", action="store_true", help="print JSON")

    comparing = verb(
        "diff",
        "compare two bags; exit status 1 if they differ",
        "bag_look.diff",
        "ic bag diff first second --stamp-tolerance 0.01 --tolerance 'ranges=0.01' --ignore-field header.stamp",
    )
    completion.offer(comparing.add_argument("a", metavar="A"), completion.bags)
    comparing.add_argument("b", metavar="B")
    comparing.add_argument("--common", action="store_true", help="compare only topics that both bags have")
    tolerances(comparing)
    comparing.add_argument("--json", action="store_true", help="print JSON")

    converting = verb(
        "convert",
        "convert ROS 1 bags, SQLite bags and bare files to a bag; filter, merge, split, compress",
        "bag_look.convert",
        "ic bag convert old.bag -o drive",
    )
    converting.add_argument("bags", nargs="+", metavar="BAG", help="several bags are merged by stamp")
    converting.add_argument("-o", "--output", required=True, metavar="DIR")
    converting.add_argument(
        "-t",
        "--topic",
        dest="topics",
        action="append",
        default=[],
        metavar="TOPIC",
        help="name or pattern; repeatable; default: everything",
    )
    converting.add_argument("-x", "--exclude", action="append", default=[], metavar="TOPIC", help="topics to leave out")
    converting.add_argument("--start", type=_seconds, default=0.0, metavar="S", help="start at this offset")
    converting.add_argument("--end", type=_seconds, default=0.0, metavar="S", help="end at this offset")
    converting.add_argument(
        "--remap", action="append", default=[], metavar="FROM:=TO", help="rename a topic; repeatable"
    )
    converting.add_argument("--skip-unknown", action="store_true", help="leave out topics of unknown types")
    _files(converting)

    rescuing = verb(
        "recover",
        "recover a readable bag from one that was cut short or damaged",
        "bag_look.recover",
        "ic bag recover broken -o saved",
    )
    completion.offer(rescuing.add_argument("bag", metavar="BAG"), completion.bags)
    rescuing.add_argument("-o", "--output", default="", metavar="DIR", help="default: BAG_recovered")

    indexing = verb(
        "reindex", "rebuild a bag's metadata.yaml from its complete files", "bag_look.reindex", "ic bag reindex drive"
    )
    completion.offer(indexing.add_argument("bag", metavar="BAG"), completion.bags)

    snapping = verb(
        "snapshot",
        "make a recorder write the last seconds (ic bag record --snapshot)",
        "bag_run.snapshot",
        "ic bag snapshot 'door stuck'",
    )
    snapping.add_argument("reason", nargs="?", default="", help="added to the folder's name")
    snapping.add_argument("--node", default="", help="recorder to use if several are running")
    snapping.add_argument(
        "--timeout", type=_seconds, default=60.0, metavar="S", help="wait at most this long (default: 60)"
    )

    steering = verb(
        "control",
        "control a running recorder or player",
        "bag_run.control",
        "ic bag control rate 0.5",
    )
    steering.add_argument("command", choices=COMMANDS)
    steering.add_argument("value", nargs="?", type=float, help="for step (messages), rate, seek (seconds)")
    steering.add_argument("--node", default="", help="recorder or player to use if several are running")


def tolerances(parser: argparse.ArgumentParser) -> None:
    """Add the tolerance options of a comparison."""
    parser.add_argument(
        "--ignore", action="append", default=[], metavar="TOPIC", help="topics to ignore: name or pattern"
    )
    parser.add_argument("--atol", type=_seconds, default=0.0, metavar="X", help="absolute tolerance of numbers")
    parser.add_argument("--rtol", type=_seconds, default=0.0, metavar="X", help="relative tolerance of numbers")
    parser.add_argument(
        "--tolerance",
        action="append",
        default=[],
        metavar="FIELD=X",
        help="absolute tolerance of a field: ranges=0.01, /pose:pose.covariance=1e-6; repeatable",
    )
    parser.add_argument(
        "--ignore-field", action="append", default=[], metavar="FIELD", help="for example header.stamp; repeatable"
    )
    parser.add_argument(
        "--stamp-tolerance",
        type=_seconds,
        default=None,
        metavar="S",
        help="match messages by stamps that differ by at most this (default: match by order)",
    )


def _topics(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("topics", nargs="*", metavar="TOPIC", help="names or patterns; default: everything")
    parser.add_argument("-x", "--exclude", action="append", default=[], metavar="TOPIC", help="topics to leave out")


def _files(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "-b", "--max-bag-size", type=size, default=0, metavar="SIZE", help="split files at 500MB, 2GB, ..."
    )
    parser.add_argument(
        "-d", "--max-bag-duration", type=_seconds, default=0.0, metavar="S", help="split files at this time"
    )
    parser.add_argument("--compression", action="store_true", help="compress with zstd")


def size(text: str) -> int:
    """Parse a size into bytes: ``1000000``, ``500MB``, ``2GB``, ``1.5GiB``."""
    units = {"": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}
    number = text.strip().upper()
    unit = number.lstrip("0123456789.").strip()
    try:
        value = float(number[: len(number) - len(unit)] if unit else number) * units[unit]
    except (KeyError, ValueError):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size such as 1000000, 500MB, 2GB") from None
    return int(value)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be >= 0 (got {text})")
    return value


def topic_names(names: list[str]) -> list[str]:
    """Topic names with their leading slash, which is optional on the command line."""
    return [name if name.startswith(("/", "*")) else f"/{name}" for name in names]


def pairs(words: list[str], separator: str, option: str) -> dict[str, str]:
    """Arguments of the form ``a:=b`` as a dictionary.

    Raises:
        UserError: an argument has another form.
    """
    found = {}
    for word in words:
        left, middle, right = word.partition(separator)
        if not left or not middle or not right:
            raise UserError(f"{option} {word}: expected FROM{separator}TO", 2)
        found[left] = right
    return found


def argument_of(command: str, value: float | None) -> dict[str, Any]:
    """Arguments of a control command for a node.

    Raises:
        UserError: a value is missing, or the command takes none.
    """
    if command in _VALUES:
        if value is None and command != "step":
            raise UserError(f"ic bag control {command} needs a value", 2)
        number = 1.0 if value is None else value
        return {_VALUES[command]: int(number) if command == "step" else number}
    if value is not None:
        raise UserError(f"ic bag control {command} takes no value", 2)
    return {}
