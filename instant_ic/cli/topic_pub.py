"""``ic topic pub``: publish messages from the command line. All values are checked before the first message is sent."""

from __future__ import annotations

import argparse
import itertools
import sys
import time

from instant_ic.bus import LATCHED, RELIABLE, SENSOR, registry
from instant_ic.bus.topics import Publisher
from instant_ic.cli.errors import UserError
from instant_ic.cli.message_input import build, fields, parse
from instant_ic.cli.messages import describe
from instant_ic.cli.names import absolute
from instant_ic.cli.observer import TopicObserver
from instant_ic.msg import message_type, type_name
from instant_ic.util import paths

_QOS = {"sensor": SENSOR, "reliable": RELIABLE, "latched": LATCHED}
_KEEP_S = 0.2  # time for the last message to arrive before the publisher closes


def publish(args: argparse.Namespace) -> int:
    """Publish messages until Ctrl-C, or a given number of them."""
    topic = registry.check_topic(absolute(args.topic))
    fields(args.type)  # raises for an unknown type
    full = type_name(message_type(args.type))
    values = parse(args.values, full)
    build(full, values, time.time_ns())  # raises for values that do not fit
    _check_topic(topic, full, args.force)
    if topic.endswith("/estop") and not values.get("data") and not args.force:
        raise UserError(
            f"{topic}: release the emergency stop where it was set, on the operator's page; --force overrides this", 2
        )
    wanted = 1 if args.once else args.times
    readers = args.readers if args.readers is not None else int(wanted > 0)
    with TopicObserver([]) as observer:
        transport = observer.transport
        publisher = Publisher(transport.advertise(topic, full, _QOS[args.qos]))
        _wait_for_readers(publisher, readers, args.max_wait_time_secs)
        next_s = time.monotonic()
        for count in itertools.count(1):
            message = build(full, values, observer.clock.now_ns())
            publisher.publish(message)
            print(f"publishing #{count}: {full}\n{describe(message)}\n", flush=True)
            if count == wanted:
                break
            next_s = max(next_s + 1.0 / args.rate, time.monotonic())
            time.sleep(max(0.0, next_s - time.monotonic()))
        time.sleep(_KEEP_S)
    return 0


def _check_topic(topic: str, full: str, force: bool) -> None:
    run_dir = paths.run_dir()
    nodes = registry.list_nodes(run_dir)
    found = next((entry for entry in registry.list_topics(run_dir) if entry.topic == topic), None)
    types = {p.node: p.type_name for p in found.publishers} if found else {}
    types |= {node.name: node.subscribes[topic] for node in nodes if node.subscribes.get(topic, "any") != "any"}
    for node, other in types.items():
        if other != full:
            raise UserError(f"{topic} has type {other} in {node}, which would reject a {full}", 2)
    if not topic.endswith("/cmd_vel"):
        return
    writers = ", ".join(p.node for p in found.publishers) if found else ""
    readers = ", ".join(node.name for node in nodes if topic in node.subscribes) or "any subscriber"
    if writers and not force:
        raise UserError(
            f"{topic} is published by {writers}, which keeps the robot safe; a second publisher would bypass that. "
            "Stop that node first, or add --force if the robot cannot hit anything",
            2,
        )
    beside = f" beside {writers}" if writers else ""
    print(f"ic: {topic} moves the robot ({readers}){beside}: keep the emergency stop within reach", file=sys.stderr)


def _wait_for_readers(publisher: Publisher, wanted: int, seconds: float) -> None:
    deadline_s = time.monotonic() + seconds
    warned = False
    while publisher.subscriber_count < wanted:
        if time.monotonic() > deadline_s:
            raise UserError(
                f"{publisher.topic}: {publisher.subscriber_count} of {wanted} subscribers within {seconds:g} s; "
                "use -w 0 to publish without them"
            )
        if not warned and time.monotonic() > deadline_s - seconds + 0.5:
            warned = True
            print(f"Waiting for at least {wanted} matching subscription(s)...", file=sys.stderr, flush=True)
        time.sleep(0.01)
