"""``ic topic``: what goes over the bus."""

from __future__ import annotations

import argparse
import time
from typing import Any

from instant_ic.cli.errors import UserError


def add_parser(subparsers: Any) -> None:
    """Adds the verb."""
    parser = subparsers.add_parser(
        "topic",
        help="list, watch and measure topics",
        description="Looks at topics.",
        epilog="example: ic topic hz /scan",
    )
    verbs = parser.add_subparsers(metavar="VERB", required=True)

    def verb(name: str, words: str, function: Any, example: str, topic: bool = True) -> argparse.ArgumentParser:
        added: argparse.ArgumentParser = verbs.add_parser(
            name, help=words, description=f"{words[0].upper()}{words[1:]}.", epilog=f"example: {example}"
        )
        if topic:
            added.add_argument("topic", metavar="TOPIC")
        added.set_defaults(func=function)
        return added

    listing = verb("list", "names of the topics that have a publisher", list_topics, "ic topic list -v", topic=False)
    listing.add_argument("-v", "--verbose", action="store_true", help="with type, QoS and publishers")
    verb("info", "type, publishers and subscribers of a topic", info, "ic topic info /scan")
    echo_parser = verb("echo", "prints messages as they come", echo, "ic topic echo /pose -n 1 --field pose.pose")
    echo_parser.add_argument("-n", type=_positive_int, default=0, metavar="COUNT", help="end after so many messages")
    echo_parser.add_argument("--field", default="", metavar="PATH", help="only this field, for example pose.pose")
    echo_parser.add_argument("--full", action="store_true", help="long arrays and byte strings in full")
    echo_parser.add_argument(
        "--timeout", type=_positive, default=float("inf"), metavar="S", help="end after this time without COUNT"
    )
    for name, words, function in (
        ("hz", "rate, jitter and losses of a topic, once a second", rate),
        ("bw", "bytes a second of a topic, once a second", bandwidth),
    ):
        added = verb(name, words, function, f"ic topic {name} /scan")
        added.add_argument("--duration", type=_positive, default=float("inf"), metavar="S", help="default: no end")


def _positive(text: str) -> float:
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"must be > 0 (got {text})")
    return value


def _positive_int(text: str) -> int:
    value = int(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"must be > 0 (got {text})")
    return value


def list_topics(args: argparse.Namespace) -> int:
    """Prints a line a topic."""
    from instant_ic import paths
    from instant_ic.bus import registry

    topics = registry.list_topics(paths.run_dir())
    width = max([len(info.topic) for info in topics], default=0)
    for info in topics:
        if not args.verbose:
            print(info.topic)
            continue
        publishers = ", ".join(f"{p.node} ({p.qos})" for p in info.publishers)
        print(f"{info.topic:<{width}}  {info.type_name}  {publishers}")
    return 0


def info(args: argparse.Namespace) -> int:
    """Prints one topic."""
    from instant_ic import paths
    from instant_ic.bus import registry

    topic = args.topic if args.topic.startswith("/") else f"/{args.topic}"
    found = [entry for entry in registry.list_topics(paths.run_dir()) if entry.topic == topic]
    readers = [node for node in registry.list_nodes(paths.run_dir()) if topic in node.subscribes]
    if not found and not readers:
        raise UserError(f"{topic}: nobody publishes or subscribes it: ic topic list")
    print(f"topic: {topic}")
    print(f"type: {found[0].type_name if found else readers[0].subscribes[topic]}")
    publishers = found[0].publishers if found else []
    print(f"publishers: {len(publishers)}")
    for publisher in publishers:
        other = f", type {publisher.type_name}" if publisher.type_name != found[0].type_name else ""
        print(f"  {publisher.node} (pid {publisher.pid}, QoS {publisher.qos}{other})")
    print(f"subscribers: {len(readers)}")
    for node in readers:
        print(f"  {node.name} (pid {node.pid})")
    return 0


def echo(args: argparse.Namespace) -> int:
    """Prints messages."""
    from instant_ic.cli.messages import describe, field
    from instant_ic.cli.observer import Observer, nothing_heard
    from instant_ic.msg import deserialize

    count = 0
    with Observer(args.topic) as observer:
        for batch in observer.batches(args.timeout, 0.5):
            for received in batch:
                message: Any = deserialize(received.payload, received.type_name)
                try:
                    value = field(message, args.field)
                except AttributeError as error:
                    raise UserError(f"{received.type_name}: {error}", 2) from None
                print(describe(value, args.full))
                print("---", flush=True)
                count += 1
                if count == args.n:
                    return 0
        if count < args.n or not count:
            raise nothing_heard(observer.topic, args.timeout)
    return 0


def rate(args: argparse.Namespace) -> int:
    """Prints the rate over each second."""
    from instant_ic.cli.observer import Observer, nothing_heard

    stamps: list[float] = []
    next_s = time.monotonic() + 1.0
    with Observer(args.topic) as observer:
        for batch in observer.batches(args.duration, 0.1):
            stamps += [received.received_ns / 1e9 for received in batch]
            if time.monotonic() >= next_s:
                next_s += 1.0
                print(_rate_line(stamps[-1000:], observer.subscription.stats.lost), flush=True)
        if len(stamps) < 2:
            raise nothing_heard(observer.topic, args.duration)
        print(f"all: {_rate_line(stamps, observer.subscription.stats.lost)}")
    return 0


def _rate_line(stamps: list[float], lost: int) -> str:
    from itertools import pairwise
    from statistics import fmean, pstdev

    gaps = [later - earlier for earlier, later in pairwise(stamps)]
    if not gaps:
        return "no new message"
    mean = fmean(gaps)
    hz = 1.0 / mean if mean > 0 else float("inf")
    return (
        f"{hz:.2f} Hz, period min {min(gaps) * 1e3:.1f} ms max {max(gaps) * 1e3:.1f} ms "
        f"std {pstdev(gaps) * 1e3:.1f} ms, {len(stamps)} messages, {lost} lost"
    )


def bandwidth(args: argparse.Namespace) -> int:
    """Prints bytes a second."""
    from instant_ic.cli.observer import Observer, nothing_heard

    began_s = last_s = time.monotonic()
    total = messages = since = since_messages = 0
    with Observer(args.topic) as observer:
        for batch in observer.batches(args.duration, 0.1):
            since += sum(len(received.payload) for received in batch)
            since_messages += len(batch)
            now_s = time.monotonic()
            if now_s - last_s >= 1.0:
                print(_bandwidth_line(since, since_messages, now_s - last_s), flush=True)
                total, messages, since, since_messages, last_s = total + since, messages + since_messages, 0, 0, now_s
        total, messages = total + since, messages + since_messages
        if not messages:
            raise nothing_heard(observer.topic, args.duration)
        print(f"all: {_bandwidth_line(total, messages, time.monotonic() - began_s)}")
    return 0


def _bandwidth_line(size: int, messages: int, seconds: float) -> str:
    mean = f"{size / messages / 1e3:.1f} kB a message" if messages else "no message"
    return f"{size / seconds / 1e6:.3f} MB/s, {messages} messages, {mean}"
