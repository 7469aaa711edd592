"""``ic topic``: inspect and publish topics."""

from __future__ import annotations

import argparse
from typing import Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import group, not_negative, positive, positive_int, verb
from instant_ic.cli.errors import UserError


def add_parser(subparsers: Any) -> None:
    """Add the command with its verbs."""
    verbs = group(
        subparsers, "topic", "list, watch, measure and publish topics", "Inspect topics and publish to them.",
        "ic topic hz /scan",
    )  # fmt: skip
    add = verb(verbs, "list", "list published and subscribed topics", list_topics, "ic topic list -t").add_argument
    add("-t", "--show-types", action="store_true", help="also print the type of each")
    add("-v", "--verbose", action="store_true", help="also print type, QoS, publishers and subscribers")
    text = "type of a topic, or the definition of a message type with units and frames"
    named = verb(verbs, "type", text, show_type, "ic topic type /scan; ic topic type LaserScan")
    named.add_argument("name", metavar="TOPIC_OR_TYPE", completer=completion.topics)
    add = verb(verbs, "find", "topics of a type", find, "ic topic find sensor_msgs/msg/Image").add_argument
    add("type", metavar="TYPE", help="full or short name", completer=completion.types)
    text = "type, publishers and subscribers of a topic"
    add = _with_topic(verb(verbs, "info", text, "topic_info.info", "ic topic info -v /scan"))
    add("-v", "--verbose", action="store_true", help="also rates, and losses from each publisher to each subscriber")
    _add_watching(verbs)
    _add_publishing(verbs)


def _with_topic(parser: Any, nargs: str | None = None) -> Any:
    parser.add_argument("topic", metavar="TOPIC", nargs=nargs, completer=completion.topics)
    return parser.add_argument


def _add_watching(verbs: Any) -> None:
    example = "ic topic echo /pose --once --field pose.pose"
    add = _with_topic(verb(verbs, "echo", "print messages as they arrive", "topic_watch.echo", example))
    add("--once", action="store_true", help="stop after the first message")
    add("-n", type=positive_int, default=0, metavar="COUNT", help="stop after this many messages")
    add("--field", default="", metavar="PATH", help="only this field, for example pose.pose")
    add("-f", "--full-length", "--full", action="store_true", help="print long arrays and strings in full")
    add("--json", action="store_true", help="one line of JSON for each message, in full")
    text = "stop after this time; fail if messages are missing"
    add("--timeout", type=positive, default=float("inf"), metavar="S", help=text)
    for name, words, function in (
        ("hz", "print rate, jitter and losses of topics once a second", "rate"),
        ("bw", "print the bandwidth of topics once a second", "bandwidth"),
        ("delay", "print the age of messages on arrival, by their stamp, once a second", "delay"),
    ):
        add = _with_topic(verb(verbs, name, words, f"topic_watch.{function}", f"ic topic {name} /scan"), "+")
        text, window = "number of messages in the window (default: %(default)s)", 10_000 if name == "hz" else 100
        add("-w", "--window", type=positive_int, default=window, metavar="N", help=text)
        text = "stop after this time (default: never)"
        add("--duration", type=positive, default=float("inf"), metavar="S", help=text)


def _add_publishing(verbs: Any) -> None:
    example = "ic topic pub --once /flag std_msgs/msg/Bool '{data: true}'"
    add = _with_topic(verb(verbs, "pub", "publish messages", "topic_pub.publish", example))
    text = "full or short name, for example TwistStamped"
    add("type", metavar="TYPE", help=text, completer=completion.types)
    text = "values of fields; all others are zero; 'header: auto' and 'stamp: now' take the current time"
    add("values", metavar="YAML", nargs="?", default="{}", help=text)
    add("-r", "--rate", type=positive, default=1.0, metavar="HZ", help="rate (default: %(default)s)")
    add("-1", "--once", action="store_true", help="publish one message")
    add("-n", "--times", type=positive_int, default=0, metavar="N", help="publish this many messages")
    text = "wait for this many subscribers first (default: 1 with --once or -n, else 0)"
    add("-w", "--wait-matching-subscriptions", type=not_negative, metavar="N", dest="readers", help=text)
    text = "longest wait for subscribers (default: %(default)s)"
    add("--max-wait-time-secs", type=positive, default=10.0, metavar="S", help=text)
    add("--qos", choices=("sensor", "reliable", "latched"), default="reliable", help="default: reliable")
    add("--force", action="store_true", help="publish even if a node commands the robot on this topic")


def list_topics(args: argparse.Namespace) -> int:
    """Print the topics of the running nodes."""
    from instant_ic.bus import registry
    from instant_ic.cli.names import topic_types
    from instant_ic.cli.tables import print_table
    from instant_ic.util import paths

    types = topic_types()
    if not args.verbose:
        for topic, name in types.items():
            print(f"{topic} [{name}]" if args.show_types else topic)
        return 0
    published = {entry.topic: entry.publishers for entry in registry.list_topics(paths.run_dir())}
    nodes = registry.list_nodes(paths.run_dir())
    rows = []
    for topic, name in types.items():
        publishers = ", ".join(f"{p.node} ({p.qos})" for p in published.get(topic, ())) or "-"
        readers = ", ".join(node.name for node in nodes if topic in node.subscribes) or "-"
        rows.append((topic, name, publishers, readers))
    print_table(rows, ("TOPIC", "TYPE", "PUBLISHERS", "SUBSCRIBERS"))
    return 0


def show_type(args: argparse.Namespace) -> int:
    """Print the type of a topic, or the definition of a type."""
    from instant_ic.cli.names import absolute, find_type, near, topic_types
    from instant_ic.msg.definition import expanded_definition

    types = topic_types()
    if absolute(args.name) in types:
        print(types[absolute(args.name)])
    elif args.name.startswith("/"):
        raise UserError(f"no node publishes or subscribes to {args.name} ({near(args.name, types, 'ic topic list')})")
    else:
        print(expanded_definition(find_type(args.name)))
    return 0


def find(args: argparse.Namespace) -> int:
    """Print the topics of a type."""
    from instant_ic.cli.names import topic_types

    package, _, short = args.type.rpartition("/")
    for topic, name in topic_types().items():
        parts = name.split("/")
        if parts[-1] == short and package.split("/")[0] in ("", parts[0]):
            print(topic)
    return 0
