"""``ic bag``: record, play, inspect, compare and recover bags."""

from __future__ import annotations

import argparse
from typing import Any

from instant_ic.cli.arguments import group, verb
from instant_ic.cli.errors import UserError

COMMANDS = ("pause", "resume", "step", "rate", "record", "stop", "status")
_VALUES = {"step": "count", "rate": "rate"}


def add_parser(subparsers: Any) -> None:
    verbs = group(
        subparsers, "bag", "record, play, inspect, compare and recover bags",
        "Work with bags: rosbag2 folders (MCAP), which ROS 2, Foxglove and rosbags can open.", "ic bag record -o drive",
    )  # fmt: skip
    _add_record(verbs)
    _add_play(verbs)
    _add_inspection(verbs)
    _add_recovery(verbs)
    _add_control(verbs)


def _add_record(verbs: Any) -> None:
    """Add ``ic bag record``; its options are parameters of the node."""
    text, example = "record topics until Ctrl-C", "ic bag record -o drive /scan '/camera/*' -x /camera/raw"
    recording = verb(verbs, "record", text, "bag_run.record", f"{example} --max-bag-size 2GB", **_ONLY_GIVEN)
    _topics(recording)
    add = recording.add_argument
    add("-o", "--output", dest="path", metavar="DIR", help="default: runs/bag_DATE_TIME")
    add("--duration", **_SPAN, dest="duration_s", help="stop after this time")
    add("-b", "--max-bag-size", type=size, metavar="SIZE", help="split files at 500MB, 2GB, ...")
    add("-d", "--max-bag-duration", **_SPAN, help="split files at this time")
    add("--compression", dest="compressed", action="store_true", help="compress with zstd")
    text = "size of the queue for the disk (default: 256MB); messages beyond it are dropped and counted"
    add("--max-queue", **_MEGABYTES, dest="queue_mb", help=text)
    text = "pause writing below this free disk space (default: 100MB)"
    add("--min-free", **_MEGABYTES, dest="min_free_mb", help=text)
    text = "keep the last seconds in memory and write them on ic bag snapshot or an emergency stop"
    add("--snapshot", action="store_true", help=text)
    add("--snapshot-seconds", **_SPAN, help="seconds kept in memory (default: 30)")
    text = "seconds to include after the snapshot (default: 2)"
    add("--snapshot-after", **_SPAN, dest="snapshot_after_s", help=text)
    text = "memory limit for a snapshot (default: 256MB)"
    add("--max-cache-size", **_MEGABYTES, dest="max_cache_mb", help=text)
    add("--use-sim-time", action="store_true", help="stamp messages with /clock, for example from a playing bag")


def _add_play(verbs: Any) -> None:
    """Add ``ic bag play``; its options are parameters of the node."""
    text, example = "play a bag with /clock", "ic bag play drive --rate 2 --start 10"
    playing = verb(verbs, "play", text, "bag_run.play", example, **_ONLY_GIVEN)
    add = playing.add_argument
    add("bag", metavar="BAG", help="folder, .mcap or .db3 file")
    _topics(playing)
    add("-r", "--rate", type=float, help="speed factor (default: 1)")
    add("--start", **_SPAN, dest="start_offset_s", help="start at this offset")
    add("--duration", **_SPAN, dest="duration_s", help="play this many seconds")
    add("--loop", action="store_true", help="restart at the end")
    add("--start-paused", action="store_true", help="wait for ic bag control resume")
    add("--remap", **_MANY, metavar="FROM:=TO", help="rename a topic; repeatable")
    text = "publish commands and states even though a base is running: the robot may move"
    add("--force", action="store_true", help=text)
    add("--no-clock", dest="publish_clock", action="store_false", help="do not publish /clock")
    add("--delay", **_SPAN, dest="delay_s", help="wait for subscribers to connect (default: 0.5)")
    add("--wait-for", action="append", metavar="NODE", help="start once this node subscribes; repeatable")


def _add_inspection(verbs: Any) -> None:
    """Add ``ic bag info`` and ``diff``."""
    looking = verb(
        verbs, "info", "topics, types, counts, files and losses of a bag", "bag_look.info", "ic bag info drive"
    )
    looking.add_argument("bag", metavar="BAG")
    looking.add_argument("--json", action="store_true", help="print JSON")

    example = "ic bag diff first second --stamp-tolerance 0.01 --tolerance 'ranges=0.01' --ignore-field header.stamp"
    comparing = verb(verbs, "diff", "compare two bags; exit status 1 if they differ", "bag_look.diff", example)
    comparing.add_argument("a", metavar="A")
    comparing.add_argument("b", metavar="B")
    comparing.add_argument("--common", action="store_true", help="compare only topics that both bags have")
    tolerances(comparing)
    comparing.add_argument("--json", action="store_true", help="print JSON")


def _add_recovery(verbs: Any) -> None:
    """Add ``ic bag recover``."""
    text, example = "recover a readable bag from one that was cut short or damaged", "ic bag recover broken -o saved"
    rescuing = verb(verbs, "recover", text, "bag_look.recover", example)
    rescuing.add_argument("bag", metavar="BAG")
    rescuing.add_argument("-o", "--output", default="", metavar="DIR", help="default: BAG_recovered")


def _add_control(verbs: Any) -> None:
    """Add ``ic bag snapshot`` and ``control``."""
    text = "make a recorder write the last seconds (ic bag record --snapshot)"
    snapping = verb(verbs, "snapshot", text, "bag_run.snapshot", "ic bag snapshot 'door stuck'")
    snapping.add_argument("reason", nargs="?", default="", help="added to the folder's name")
    snapping.add_argument("--node", default="", help="recorder to use if several are running")
    snapping.add_argument("--timeout", **_SPAN, default=60.0, help="wait at most this long (default: 60)")

    steering = verb(
        verbs, "control", "control a running recorder or player", "bag_run.control", "ic bag control rate 0.5"
    )
    steering.add_argument("command", choices=COMMANDS)
    steering.add_argument("value", nargs="?", type=float, help="for step (messages) and rate")
    steering.add_argument("--node", default="", help="recorder or player to use if several are running")


def tolerances(parser: argparse.ArgumentParser) -> None:
    """Add the tolerance options of a comparison."""
    add: Any = parser.add_argument
    many: dict[str, Any] = {"action": "append", "default": []}
    add("--ignore", **many, type=topic_name, metavar="TOPIC", help="topics to ignore: name or pattern")
    add("--atol", type=_seconds, default=0.0, metavar="X", help="absolute tolerance of numbers")
    text = "absolute tolerance of a field: ranges=0.01, /pose:pose.covariance=1e-6; repeatable"
    add("--tolerance", **many, metavar="FIELD=X", help=text)
    add("--ignore-field", **many, metavar="FIELD", help="for example header.stamp; repeatable")
    text = "match messages by stamps that differ by at most this (default: match by order)"
    add("--stamp-tolerance", type=_seconds, metavar="S", help=text)


def _topics(parser: argparse.ArgumentParser) -> None:
    add: Any = parser.add_argument
    add("topics", nargs="*", type=topic_name, metavar="TOPIC", help="names or patterns; default: everything")
    add("-x", "--exclude", action="append", type=topic_name, metavar="TOPIC", help="topics to leave out")


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


def _megabytes(text: str) -> int:
    return size(text) // 1_000_000


def topic_name(name: str) -> str:
    """Return a topic's name with its leading slash, which is optional on the command line."""
    return name if name.startswith(("/", "*")) else f"/{name}"


def pairs(words: list[str], separator: str, option: str) -> dict[str, str]:
    """Return arguments of the form FROM + separator + TO as a dictionary.

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
    """Return the arguments of a control command for a node.

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


_SPAN: dict[str, Any] = {"type": _seconds, "metavar": "S"}
_MEGABYTES: dict[str, Any] = {"type": _megabytes, "metavar": "SIZE"}
_ONLY_GIVEN: dict[str, Any] = {"argument_default": argparse.SUPPRESS}
"""Option of a parser that leaves the defaults to the node."""
_MANY: dict[str, Any] = {"action": "append", "default": []}
