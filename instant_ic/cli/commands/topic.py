"""``ic topic``: inspect and publish topics."""

from __future__ import annotations

import argparse
from typing import Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import not_negative, positive, positive_int
from instant_ic.cli.errors import UserError


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = subparsers.add_parser(
        "topic",
        help="list, watch, measure and publish topics",
        description="Inspect topics and publish to them.",
        epilog="example: ic topic hz /scan",
    )
    verbs = parser.add_subparsers(metavar="VERB", required=True)

    def verb(name: str, words: str, function: Any, example: str) -> argparse.ArgumentParser:
        added: argparse.ArgumentParser = verbs.add_parser(
            name, help=words, description=f"{words[0].upper()}{words[1:]}.", epilog=f"example: {example}"
        )
        added.set_defaults(func=function)
        return added

    def topic(added: argparse.ArgumentParser, nargs: str | None = None) -> None:
        argument = added.add_argument("topic", metavar="TOPIC", nargs=nargs)
        completion.offer(argument, completion.topics)

    added = verb("list", "list published and subscribed topics", list_topics, "ic topic list -t")
    added.add_argument("-t", "--show-types", action="store_true", help="also print the type of each")
    added.add_argument("-c", "--count-topics", action="store_true", help="print only their number")
    added.add_argument("-v", "--verbose", action="store_true", help="also print type, QoS, publishers and subscribers")

    added = verb("type", "type of a topic", show_type, "ic topic type /scan")
    topic(added)

    added = verb("find", "topics of a type", find, "ic topic find sensor_msgs/msg/Image")
    argument = added.add_argument("type", metavar="TYPE", help="full or short name")
    completion.offer(argument, completion.types)

    added = verb("info", "type, publishers and subscribers of a topic", info, "ic topic info -v /scan")
    topic(added)
    added.add_argument(
        "-v",
        "--verbose",
        action="store_true",
        help="also print QoS, rates, and losses from each publisher to each subscriber",
    )

    added = verb("echo", "print messages as they arrive", echo, "ic topic echo /pose --once --field pose.pose")
    topic(added)
    added.add_argument("--once", action="store_true", help="stop after the first message")
    added.add_argument("-n", type=positive_int, default=0, metavar="COUNT", help="stop after this many messages")
    added.add_argument("--field", default="", metavar="PATH", help="only this field, for example pose.pose")
    added.add_argument(
        "-f", "--full-length", "--full", action="store_true", help="print long arrays and strings in full"
    )
    added.add_argument(
        "-l", "--truncate-length", type=positive_int, default=12, metavar="N",
        help="shorten arrays above N values and strings above 10 N characters (default: %(default)s)",
    )  # fmt: skip
    added.add_argument("--no-arr", action="store_true", help="leave out the values of arrays")
    added.add_argument("--no-str", action="store_true", help="leave out strings")
    added.add_argument("--csv", action="store_true", help="one line of comma-separated values for each message")
    added.add_argument("--json", action="store_true", help="one line of JSON for each message, in full")
    added.add_argument(
        "--timeout",
        type=positive,
        default=float("inf"),
        metavar="S",
        help="stop after this time; fail if messages are missing",
    )

    for name, words, function in (
        ("hz", "print rate, jitter and losses of topics once a second", rate),
        ("bw", "print the bandwidth of topics once a second", bandwidth),
        ("delay", "print the age of messages on arrival, by their stamp, once a second", delay),
    ):
        added = verb(name, words, function, f"ic topic {name} /scan")
        topic(added, "+")
        added.add_argument(
            "-w", "--window", type=positive_int, default=10_000 if name == "hz" else 100, metavar="N",
            help="number of messages in the window (default: %(default)s)",
        )  # fmt: skip
        added.add_argument(
            "--duration", type=positive, default=float("inf"), metavar="S", help="stop after this time (default: never)"
        )
        if name != "bw":
            added.add_argument("--use-sim-time", action="store_true", help="measure in the time of /clock")

    added = verb("pub", "publish messages", publish, "ic topic pub --once /flag std_msgs/msg/Bool '{data: true}'")
    topic(added)
    argument = added.add_argument("type", metavar="TYPE", help="full or short name, for example TwistStamped")
    completion.offer(argument, completion.types)
    added.add_argument(
        "values", metavar="YAML", nargs="?", default="{}",
        help="values of its fields; others are zero; 'header: auto' and 'stamp: now' take the current time",
    )  # fmt: skip
    added.add_argument("-r", "--rate", type=positive, default=1.0, metavar="HZ", help="rate (default: %(default)s)")
    added.add_argument("-1", "--once", action="store_true", help="publish one message")
    added.add_argument("-n", "--times", type=positive_int, default=0, metavar="N", help="publish this many messages")
    added.add_argument(
        "-w", "--wait-matching-subscriptions", type=not_negative, metavar="N", dest="readers",
        help="wait for this many subscribers first (default: 1 with --once or -n, else 0)",
    )  # fmt: skip
    added.add_argument(
        "--max-wait-time-secs",
        type=positive,
        default=10.0,
        metavar="S",
        help="longest wait for subscribers (default: %(default)s)",
    )
    added.add_argument("--qos", choices=("sensor", "reliable", "latched"), default="reliable", help="default: reliable")
    added.add_argument("--use-sim-time", action="store_true", help="stamp messages with the time of /clock")
    added.add_argument("-p", "--print", type=positive_int, default=1, metavar="N", help="print every Nth message")
    added.add_argument(
        "--force", action="store_true", help="publish even where a node commands the robot on this topic"
    )


def list_topics(args: argparse.Namespace) -> int:
    """Print a line per topic."""
    from instant_ic import paths
    from instant_ic.bus import registry
    from instant_ic.cli.names import topic_types

    types = topic_types()
    if args.count_topics:
        print(len(types))
        return 0
    if not args.verbose:
        for topic, name in types.items():
            print(f"{topic} [{name}]" if args.show_types else topic)
        return 0
    published = {entry.topic: entry for entry in registry.list_topics(paths.run_dir())}
    nodes = registry.list_nodes(paths.run_dir())
    width = max([len(topic) for topic in types], default=0)
    for topic, name in types.items():
        publishers = (
            ", ".join(f"{p.node} ({p.qos})" for p in published[topic].publishers) if topic in published else "-"
        )
        readers = ", ".join(node.name for node in nodes if topic in node.subscribes) or "-"
        print(f"{topic:<{width}}  {name}  {publishers} → {readers}")
    return 0


def show_type(args: argparse.Namespace) -> int:
    """Print the type of a topic."""
    from instant_ic.cli.names import absolute, near, topic_types

    types = topic_types()
    if absolute(args.topic) not in types:
        raise UserError(f"no node publishes or subscribes to {args.topic} ({near(args.topic, types, 'ic topic list')})")
    print(types[absolute(args.topic)])
    return 0


def find(args: argparse.Namespace) -> int:
    """Print the topics of one type."""
    from instant_ic.cli.names import topic_types

    package, _, short = args.type.rpartition("/")
    for topic, name in topic_types().items():
        parts = name.split("/")
        if parts[-1] == short and package.split("/")[0] in ("", parts[0]):
            print(topic)
    return 0


def info(args: argparse.Namespace) -> int:
    """Print one topic."""
    from instant_ic.cli.topic_info import show

    return show(args.topic, args.verbose)


def echo(args: argparse.Namespace) -> int:
    """Print messages."""
    from instant_ic.cli.topic_watch import echo

    return echo(args)


def rate(args: argparse.Namespace) -> int:
    """Print rates."""
    from instant_ic.cli.topic_watch import rate

    return rate(args)


def bandwidth(args: argparse.Namespace) -> int:
    """Print bandwidths."""
    from instant_ic.cli.topic_watch import bandwidth

    return bandwidth(args)


def delay(args: argparse.Namespace) -> int:
    """Print the age of messages on arrival."""
    from instant_ic.cli.topic_watch import delay

    return delay(args)


def publish(args: argparse.Namespace) -> int:
    """Publish messages."""
    from instant_ic.cli.topic_pub import publish

    return publish(args)
