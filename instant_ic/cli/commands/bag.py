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
        description="Works with bags: rosbag2 folders (MCAP) that ROS 2, Foxglove and rosbags open as they are.",
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
        "records topics until Ctrl-C; space pauses",
        "bag_run.record",
        "ic bag record -o drive /scan '/camera/*' -x /camera/raw --max-bag-size 2GB",
    )
    _topics(recording)
    recording.add_argument("-o", "--output", default="", metavar="DIR", help="default: runs/bag_DATE_TIME")
    recording.add_argument("--duration", type=_seconds, default=0.0, metavar="S", help="end after this time")
    _files(recording)
    recording.add_argument(
        "--max-queue",
        type=size,
        default=256_000_000,
        metavar="SIZE",
        help="what may wait for the disk (default: 256MB); more is left out and counted",
    )
    recording.add_argument(
        "--min-free",
        type=size,
        default=100_000_000,
        metavar="SIZE",
        help="stop while the disk has less free space (default: 100MB)",
    )
    recording.add_argument(
        "--snapshot",
        action="store_true",
        help="keep the last seconds in memory, write them at ic bag snapshot or an emergency stop",
    )
    recording.add_argument("--snapshot-seconds", type=_seconds, default=30.0, metavar="S", help="default: 30")
    recording.add_argument(
        "--snapshot-after",
        type=_seconds,
        default=2.0,
        metavar="S",
        help="seconds after the moment that go in too (default: 2)",
    )
    recording.add_argument(
        "--max-cache-size",
        type=size,
        default=256_000_000,
        metavar="SIZE",
        help="memory for the last seconds (default: 256MB)",
    )
    recording.add_argument("--start-paused", action="store_true", help="record once told to resume")
    recording.add_argument("--use-sim-time", action="store_true", help="file messages by /clock, as while a bag plays")

    playing = verb(
        "play",
        "plays a bag with /clock; space pauses, → steps, ↑ ↓ change the rate",
        "bag_run.play",
        "ic bag play drive --rate 2 --start 10",
    )
    completion.offer(
        playing.add_argument("bag", metavar="BAG", help="folder, .mcap, .db3 or ROS 1 .bag file"), completion.bags
    )
    _topics(playing)
    playing.add_argument("-r", "--rate", type=float, default=1.0, help="2 plays twice as fast (default: %(default)s)")
    playing.add_argument("--start", type=_seconds, default=0.0, metavar="S", help="skip the beginning")
    playing.add_argument("--duration", type=_seconds, default=0.0, metavar="S", help="play only so much of the bag")
    playing.add_argument("--loop", action="store_true", help="begin again at the end")
    playing.add_argument("--start-paused", action="store_true", help="wait for space, → or ic bag control resume")
    playing.add_argument("--remap", action="append", default=[], metavar="FROM:=TO", help="other name; repeatable")
    playing.add_argument(
        "--force", action="store_true", help="play commands and states also beside a running base: the robot may move"
    )
    playing.add_argument("--no-clock", action="store_true", help="send no /clock")
    playing.add_argument(
        "--delay", type=_seconds, default=0.5, metavar="S", help="for readers to connect (default: 0.5)"
    )
    playing.add_argument("--wait-for", action="append", default=[], metavar="NODE", help="begin once it reads")

    looking = verb("info", "topics, types, counts, files and losses of a bag", "bag_look.info", "ic bag info drive")
    completion.offer(looking.add_argument("bag", metavar="BAG"), completion.bags)
    looking.add_argument("--json", action="store_true", help="for programs")

    comparing = verb(
        "diff",
        "compares two bags; exit status 1 when they differ",
        "bag_look.diff",
        "ic bag diff first second --stamp-tolerance 0.01 --tolerance 'ranges=0.01' --ignore-field header.stamp",
    )
    completion.offer(comparing.add_argument("a", metavar="A"), completion.bags)
    comparing.add_argument("b", metavar="B")
    comparing.add_argument("--common", action="store_true", help="only topics that both bags have")
    tolerances(comparing)
    comparing.add_argument("--json", action="store_true", help="for programs")

    converting = verb(
        "convert",
        "makes a bag of others: ROS 1 and SQLite bags, bare files; filters, merges, splits, compresses",
        "bag_look.convert",
        "ic bag convert old.bag -o drive",
    )
    converting.add_argument("bags", nargs="+", metavar="BAG", help="several are merged by their stamps")
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
    converting.add_argument("-x", "--exclude", action="append", default=[], metavar="TOPIC", help="leave out")
    converting.add_argument("--start", type=_seconds, default=0.0, metavar="S", help="leave out the beginning")
    converting.add_argument("--end", type=_seconds, default=0.0, metavar="S", help="end so long after the beginning")
    converting.add_argument("--remap", action="append", default=[], metavar="FROM:=TO", help="other name; repeatable")
    converting.add_argument("--skip-unknown", action="store_true", help="leave out types that nobody knows")
    _files(converting)

    rescuing = verb(
        "recover",
        "makes a readable bag of one that was cut short or damaged",
        "bag_look.recover",
        "ic bag recover broken -o saved",
    )
    completion.offer(rescuing.add_argument("bag", metavar="BAG"), completion.bags)
    rescuing.add_argument("-o", "--output", default="", metavar="DIR", help="default: BAG_recovered")

    indexing = verb(
        "reindex", "writes a bag's metadata.yaml anew from its whole files", "bag_look.reindex", "ic bag reindex drive"
    )
    completion.offer(indexing.add_argument("bag", metavar="BAG"), completion.bags)

    snapping = verb(
        "snapshot",
        "has a recorder write the last seconds (ic bag record --snapshot)",
        "bag_run.snapshot",
        "ic bag snapshot 'door stuck'",
    )
    snapping.add_argument("reason", nargs="?", default="", help="becomes part of the folder's name")
    snapping.add_argument("--node", default="", help="of several recorders, this one")
    snapping.add_argument("--timeout", type=_seconds, default=60.0, metavar="S", help="default: 60")

    steering = verb(
        "control",
        "steers a running recorder or player",
        "bag_run.control",
        "ic bag control rate 0.5",
    )
    steering.add_argument("command", choices=COMMANDS)
    steering.add_argument("value", nargs="?", type=float, help="of step (messages), rate, seek (seconds)")
    steering.add_argument("--node", default="", help="of several recorders and players, this one")


def tolerances(parser: argparse.ArgumentParser) -> None:
    """Add the tolerance options of a comparison."""
    parser.add_argument("--ignore", action="append", default=[], metavar="TOPIC", help="leave out; name or pattern")
    parser.add_argument("--atol", type=_seconds, default=0.0, metavar="X", help="numbers may differ by this")
    parser.add_argument("--rtol", type=_seconds, default=0.0, metavar="X", help="and by this share")
    parser.add_argument(
        "--tolerance",
        action="append",
        default=[],
        metavar="FIELD=X",
        help="of one field: ranges=0.01, /pose:pose.covariance=1e-6; repeatable",
    )
    parser.add_argument("--ignore-field", action="append", default=[], metavar="FIELD", help="header.stamp; repeatable")
    parser.add_argument(
        "--stamp-tolerance",
        type=_seconds,
        default=None,
        metavar="S",
        help="pair messages by their stamps, which may differ so much (default: by order)",
    )


def _topics(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("topics", nargs="*", metavar="TOPIC", help="names or patterns; default: everything")
    parser.add_argument("-x", "--exclude", action="append", default=[], metavar="TOPIC", help="leave out")


def _files(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-b", "--max-bag-size", type=size, default=0, metavar="SIZE", help="files of 500MB, 2GB, ...")
    parser.add_argument("-d", "--max-bag-duration", type=_seconds, default=0.0, metavar="S", help="files of this time")
    parser.add_argument("--compression", action="store_true", help="compress with zstd")


def size(text: str) -> int:
    """Parse a size into bytes: ``1000000``, ``500MB``, ``2GB``, ``1.5GiB``."""
    units = {"": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}
    number = text.strip().upper()
    unit = number.lstrip("0123456789.").strip()
    try:
        value = float(number[: len(number) - len(unit)] if unit else number) * units[unit]
    except (KeyError, ValueError):
        raise argparse.ArgumentTypeError(f"{text!r} is no size: 1000000, 500MB, 2GB") from None
    return int(value)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
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
