"""``ic bag info``, ``diff`` and ``recover``: the commands that need only files."""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from instant_ic.bag import BagError, BagReader
from instant_ic.bag.compare import Tolerance, TopicDifference, compare
from instant_ic.bag.recover import recover as recover_bag
from instant_ic.cli.commands.bag import pairs
from instant_ic.cli.errors import UserError
from instant_ic.msg import deserialize

BOOKMARKS, _STRING = "/operator/bookmark", "std_msgs/msg/String"
_LEFT_OUT = {
    "overflow": "left out because the disk was too slow",
    "disk_full": "left out while the disk was full",
}


def info(args: argparse.Namespace) -> int:
    with BagReader(Path(args.bag)) as reader:
        summary = _info(reader)
    if args.json:
        print(json.dumps(summary, indent=2))
        return 0
    print(f"bag:      {summary['path']}")
    print(f"size:     {summary['bytes'] / 1e6:.1f} MB{', ' + summary['compression'] if summary['compression'] else ''}")
    print(f"start:    {datetime.fromtimestamp(summary['start_ns'] / 1e9, UTC):%Y-%m-%d %H:%M:%S.%f} UTC")
    print(f"duration: {summary['duration_s']:.3f} s")
    print(f"messages: {summary['messages']}")
    if len(summary["files"]) > 1:
        print("files:    " + ", ".join(f"{file['name']} ({file['bytes'] / 1e6:.1f} MB)" for file in summary["files"]))
    topics = summary["topics"]
    width, type_width = (max([len(topic[key]) for topic in topics], default=0) for key in ("topic", "type"))
    for topic in topics:
        hz = f"{topic['rate_hz']:8.2f} Hz" if topic["rate_hz"] else " " * 11
        lost = f"  {topic['lost']} lost" if topic["lost"] else ""
        by = ", ".join(f"{n} from {node}" for node, n in sorted(topic["lost_by"].items()))
        print(
            f"  {topic['topic']:<{width}}  {topic['type']:<{type_width}}  {topic['messages']:>7} {hz}"
            f"  {topic['qos']}{lost}{f' ({by})' if by else ''}"
        )
    for mark in summary["bookmarks"]:
        print(f"bookmark: {mark['at_s']:.3f} s  {mark['name']}")
    for key, words in _LEFT_OUT.items():
        if summary[key]:
            print(f"{words}: {', '.join(f'{topic} {n}' for topic, n in sorted(summary[key].items()))}")
    if summary["recovered_from"]:
        print(f"recovered from {summary['recovered_from']}")
    return 0


def _bookmarks(reader: BagReader) -> list[dict[str, Any]]:
    """Return the operator's bookmarks, with their offset from the start of the bag."""
    if not any(topic.topic == BOOKMARKS and topic.type_name == _STRING for topic in reader.topics):
        return []
    try:
        found = [m for m in reader.messages({BOOKMARKS}) if m.type_name == _STRING]
        return [
            {"at_s": (m.stamp_ns - reader.start_ns) / 1e9, "name": deserialize(m.payload, _STRING).data} for m in found
        ]
    except BagError as error:  # the rest of the bag can still be described
        print(f"bookmarks cannot be read: {error}", file=sys.stderr)
        return []


def _info(reader: BagReader) -> dict[str, Any]:
    def custom(key: str) -> dict[str, Any]:
        value: dict[str, Any] = json.loads(reader.custom.get(f"instant_ic.{key}", "{}"))
        return value

    span_s = (reader.end_ns - reader.start_ns) / 1e9
    lost_by = custom("lost_by")
    return {
        "path": str(reader.path),
        "bytes": sum(file.stat().st_size for file in reader.files),
        "compression": reader.compression,
        "start_ns": reader.start_ns,
        "end_ns": reader.end_ns,
        "duration_s": span_s,
        "messages": reader.count,
        "files": [{"name": file.name, "bytes": file.stat().st_size} for file in reader.files],
        "topics": [
            {
                "topic": topic.topic,
                "type": topic.type_name,
                "messages": topic.count,
                "rate_hz": (topic.count - 1) / span_s if topic.count > 1 and span_s > 0 else 0.0,
                "qos": topic.qos.name,
                "lost": sum(lost_by.get(topic.topic, {}).values()),
                "lost_by": lost_by.get(topic.topic, {}),
            }
            for topic in reader.topics
        ],
        "bookmarks": _bookmarks(reader),
        **{key: custom(key) for key in _LEFT_OUT},
        "recovered_from": reader.custom.get("recovered_from", ""),
        "unlisted": [file.name for file in reader.unlisted],
    }


def diff(args: argparse.Namespace) -> int:
    found = compare(Path(args.a), Path(args.b), tuple(args.ignore), args.common, tolerance_of(args))
    if not found:
        raise UserError("there are no topics to compare")
    if args.json:
        print(json.dumps([_plain(topic) for topic in found], indent=2))
        return 0 if all(topic.same for topic in found) else 1
    return print_differences(found)


def tolerance_of(args: argparse.Namespace) -> Tolerance:
    """Return the tolerances given on the command line.

    Raises:
        UserError: a tolerance is not a number.
    """
    fields = {}
    for name, text in pairs(args.tolerance, "=", "--tolerance").items():
        try:
            fields[name] = float(text)
        except ValueError:
            raise UserError(f"--tolerance {name}={text}: {text} is not a number", 2) from None
    try:
        return Tolerance(args.atol, fields, tuple(args.ignore_field), args.stamp_tolerance)
    except ValueError as error:
        raise UserError(str(error), 2) from None


def print_differences(found: list[TopicDifference]) -> int:
    """Print a line per topic and per differing field; return the exit status."""
    width = max([len(topic.topic) for topic in found], default=0)
    for topic in found:
        print(f"{topic.topic:<{width}}  {topic.count_a:>6} {topic.count_b:>6}  {topic.first or 'same'}")
        if topic.only_a or topic.only_b:
            print(f"{'':<{width}}  unmatched messages: {topic.only_a} in the first, {topic.only_b} in the second")
        for path, entry in topic.fields.items():
            largest = f"largest difference {entry.largest:.6g}, " if math.isfinite(entry.largest) else ""
            print(f"{'':<{width}}  {path}: {largest}in {entry.messages} messages, first in message {entry.first}")
    different = sum(not topic.same for topic in found)
    print(f"{len(found) - different} of {len(found)} topics are the same")
    return 1 if different else 0


def _plain(topic: TopicDifference) -> dict[str, Any]:
    plain = {**asdict(topic), "same": topic.same}
    for entry in plain["fields"].values():
        entry["largest"] = entry["largest"] if math.isfinite(entry["largest"]) else None  # JSON has no NaN
    return plain


def recover(args: argparse.Namespace) -> int:
    source = Path(args.bag)
    target = Path(args.output) if args.output else source.with_name(f"{source.stem}_recovered")
    result = recover_bag(source, target)
    print(f"{target}: {result.count} messages")
    if result.stopped_by:
        print(f"the bag ends early: {result.stopped_by}")
    for words in result.damaged:
        print(f"left out, damaged: {words}")
    for topic, why in sorted(result.skipped.items()):
        print(f"left out: {topic}, {why}")
    return 0
