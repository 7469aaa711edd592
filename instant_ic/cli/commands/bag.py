"""``ic bag``: record, play, look at, compare and rescue bags."""

from __future__ import annotations

import argparse
import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from instant_ic.cli.errors import UserError


def add_parser(subparsers: Any) -> None:
    """Adds the verb."""
    parser = subparsers.add_parser(
        "bag",
        help="record, play, inspect, compare and recover bags",
        description="Works with bags: rosbag2 folders (MCAP) that ROS 2, Foxglove and rosbags open as they are.",
        epilog="example: ic bag record -o drive",
    )
    verbs = parser.add_subparsers(metavar="VERB", required=True)

    def verb(name: str, words: str, function: Any, example: str) -> argparse.ArgumentParser:
        added: argparse.ArgumentParser = verbs.add_parser(
            name, help=words, description=f"{words[0].upper()}{words[1:]}.", epilog=f"example: {example}"
        )
        added.set_defaults(func=function)
        return added

    recording = verb(
        "record", "records topics until Ctrl-C", record, "ic bag record -o drive /scan '/camera/*' -x /camera/raw"
    )
    recording.add_argument("topics", nargs="*", metavar="TOPIC", help="names or patterns; default: everything")
    recording.add_argument("-o", "--output", default="", metavar="DIR", help="default: runs/bag_DATE_TIME")
    recording.add_argument("-x", "--exclude", action="append", default=[], metavar="TOPIC", help="leave out")
    recording.add_argument("--duration", type=float, default=0.0, metavar="S", help="end after this time")
    recording.add_argument("--use-sim-time", action="store_true", help="file messages by /clock, as while a bag plays")

    playing = verb("play", "plays a bag with /clock", play, "ic bag play drive --rate 2 --start 10")
    playing.add_argument("bag", metavar="BAG")
    playing.add_argument("topics", nargs="*", metavar="TOPIC", help="names or patterns; default: everything")
    playing.add_argument("-x", "--exclude", action="append", default=[], metavar="TOPIC", help="leave out")
    playing.add_argument("-r", "--rate", type=float, default=1.0, help="2 plays twice as fast (default: %(default)s)")
    playing.add_argument("--start", type=float, default=0.0, metavar="S", help="skip the beginning")
    playing.add_argument("--duration", type=float, default=0.0, metavar="S", help="play only so much of the bag")
    playing.add_argument("--loop", action="store_true", help="begin again at the end")
    playing.add_argument("--remap", action="append", default=[], metavar="FROM:=TO", help="other name; repeatable")
    playing.add_argument("--no-clock", action="store_true", help="send no /clock")
    playing.add_argument("--wait-for", action="append", default=[], metavar="NODE", help="begin once it reads")

    looking = verb("info", "topics, types, counts and losses of a bag", info, "ic bag info drive")
    looking.add_argument("bag", metavar="BAG")

    comparing = verb(
        "diff", "compares two bags; exit status 1 when they differ", diff, "ic bag diff first second --ignore /rosout"
    )
    comparing.add_argument("a", metavar="A")
    comparing.add_argument("b", metavar="B")
    comparing.add_argument("--ignore", action="append", default=[], metavar="TOPIC", help="leave out")

    comparing.add_argument("--common", action="store_true", help="only topics that both bags have")

    rescuing = verb(
        "recover", "makes a readable bag of one that was cut short", recover, "ic bag recover broken -o saved"
    )
    rescuing.add_argument("bag", metavar="BAG")
    rescuing.add_argument("-o", "--output", default="", metavar="DIR", help="default: BAG_recovered")


def record(args: argparse.Namespace) -> int:
    """Runs the recorder node in this process."""
    from instant_ic.bag.replay import find_node_class
    from instant_ic.bus.process import run

    if args.output and Path(args.output).exists():
        raise UserError(f"{args.output} exists already, not overwriting")
    words = ["--name", f"bag_recorder_{os.getpid()}", *_parameters(path=args.output, duration_s=args.duration)]
    words += _parameters(topics=_topics(args.topics), exclude=_topics(args.exclude))
    words += _parameters(use_sim_time=True) if args.use_sim_time else []
    return run(find_node_class("bag_recorder"), words)


def play(args: argparse.Namespace) -> int:
    """Runs the player node in this process."""
    from instant_ic.bag.replay import find_node_class
    from instant_ic.bus.process import run

    if not Path(args.bag).exists():
        raise UserError(f"bag {args.bag} does not exist")
    words = ["--name", f"bag_player_{os.getpid()}", *_parameters(use_sim_time=True, bag=args.bag, rate=args.rate)]
    words += _parameters(start_offset_s=args.start, duration_s=args.duration, loop=args.loop)
    words += _parameters(topics=_topics(args.topics), exclude=_topics(args.exclude))
    words += _parameters(publish_clock=not args.no_clock, wait_for=args.wait_for)
    for remap in args.remap:
        words += ["-r", remap]
    return run(find_node_class("bag_player"), words)


def _topics(names: list[str]) -> list[str]:
    return [name if name.startswith(("/", "*")) else f"/{name}" for name in names]


def _parameters(**values: Any) -> list[str]:
    """Command-line words of a node (JSON is YAML)."""
    return [word for key, value in values.items() for word in ("-p", f"{key}:={json.dumps(value)}")]


def info(args: argparse.Namespace) -> int:
    """Prints what a bag holds."""
    from instant_ic.bag import BagReader

    path = Path(args.bag)
    with BagReader(path) as reader:
        size = sum(f.stat().st_size for f in ([path] if path.is_file() else path.iterdir()))
        span_s = (reader.end_ns - reader.start_ns) / 1e9
        print(f"bag:      {path}")
        print(f"size:     {size / 1e6:.1f} MB")
        print(f"start:    {datetime.fromtimestamp(reader.start_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S.%f} UTC")
        print(f"duration: {span_s:.3f} s")
        print(f"messages: {reader.count}")
        lost = json.loads(reader.custom.get("instant_ic.lost", "{}"))
        topics = reader.topics
        width, type_width = (max([len(getattr(t, a)) for t in topics], default=0) for a in ("topic", "type_name"))
        for topic in topics:
            hz = f"{(topic.count - 1) / span_s:8.2f} Hz" if topic.count > 1 and span_s > 0 else " " * 11
            missing = f"  {lost[topic.topic]} lost" if topic.topic in lost else ""
            print(
                f"  {topic.topic:<{width}}  {topic.type_name:<{type_width}}  {topic.count:>7} {hz}"
                f"  {topic.qos.name}{missing}"
            )
        if "recovered_from" in reader.custom:
            print(f"recovered from {reader.custom['recovered_from']}")
    return 0


def diff(args: argparse.Namespace) -> int:
    """Compares topic by topic."""
    from instant_ic.bag.compare import compare

    topics = compare(Path(args.a), Path(args.b), tuple(_topics(args.ignore)), args.common)
    if not topics:
        raise UserError("there is no topic to compare")
    width = max([len(topic.topic) for topic in topics], default=0)
    for topic in topics:
        print(f"{topic.topic:<{width}}  {topic.count_a:>6} {topic.count_b:>6}  {topic.first or 'same'}")
    different = sum(not topic.same for topic in topics)
    print(f"{len(topics) - different} of {len(topics)} topics are the same")
    return 1 if different else 0


def recover(args: argparse.Namespace) -> int:
    """Copies what can be read."""
    from instant_ic.bag.recover import recover as recover_bag

    source = Path(args.bag)
    target = Path(args.output) if args.output else source.with_name(f"{source.stem}_recovered")
    result = recover_bag(source, target)
    print(f"{target}: {result.count} messages")
    if result.stopped_by:
        print(f"reading stopped at the cut: {result.stopped_by}")
    return 0
