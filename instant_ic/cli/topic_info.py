"""``ic topic info``: publishers and subscribers of a topic, rates, and losses between them."""

from __future__ import annotations

import argparse
import math

from instant_ic.bus import registry
from instant_ic.cli.errors import UserError
from instant_ic.cli.names import absolute, near, topic_types
from instant_ic.util import paths


def info(args: argparse.Namespace) -> int:
    run_dir = paths.run_dir()
    topic = absolute(args.topic)
    found = next((entry for entry in registry.list_topics(run_dir) if entry.topic == topic), None)
    publishers = found.publishers if found else []
    readers = [node for node in registry.list_nodes(run_dir) if topic in node.subscribes]
    if not publishers and not readers:
        raise UserError(
            f"{topic}: no node publishes or subscribes to it ({near(topic, topic_types(), 'see ic topic list')})"
        )
    kind = found.type_name if found else readers[0].subscribes[topic]
    print(f"Type: {kind}")
    if args.verbose:
        _show_verbose(topic, kind, publishers, readers)
        return 0
    print(f"Publisher count: {len(publishers)}")
    for publisher in publishers:
        other = f", type {publisher.type_name}" if publisher.type_name != kind else ""
        print(f"  {publisher.node} (pid {publisher.pid}, QoS {publisher.qos}{other})")
    print(f"Subscription count: {len(readers)}")
    for node in readers:
        print(f"  {node.name} (pid {node.pid})")
    return 0


def _show_verbose(
    topic: str, kind: str, publishers: list[registry.PublisherInfo], readers: list[registry.NodeInfo]
) -> None:
    from instant_ic.cli.heartbeats import hear
    from instant_ic.cli.top import expected_rate

    run_dir = paths.run_dir()
    nodes = {node.name: node for node in registry.list_nodes(run_dir)}
    # Commands such as ic topic pub publish too, but have no heartbeat.
    beats = hear(run_dir, {p.node for p in publishers if p.node in nodes} | {node.name for node in readers})
    nominal = expected_rate(topic)
    expected = f" (nominal {nominal.rate_hz:g} Hz{f', {nominal.when}' if nominal.when else ''})" if nominal else ""
    print(f"Publisher count: {len(publishers)}{expected}")
    for publisher in publishers:
        beat = beats.get(publisher.node)
        flow = beat.outputs.get(topic) if beat else None
        print(f"\nNode name: {publisher.node}\n  Endpoint type: PUBLISHER\n  PID: {publisher.pid}")
        print(f"  Type: {publisher.type_name}{'' if publisher.type_name == kind else '  (differs from the others)'}")
        print(f"  QoS: {publisher.qos}")
        print(f"  Rate: {_rate(flow.rate_hz, flow.age_s) if flow else _silence(publisher.node in nodes)}")
    print(f"\nSubscription count: {len(readers)}")
    for node in readers:
        beat = beats.get(node.name)
        flow = beat.inputs.get(topic) if beat else None
        print(f"\nNode name: {node.name}\n  Endpoint type: SUBSCRIPTION\n  PID: {node.pid}")
        print(f"  Type: {node.subscribes[topic]}")
        print(f"  Rate: {_rate(flow.rate_hz, flow.age_s) if flow else _silence(True)}")
        if beat is None:
            continue
        lost = {publisher: count for (name, publisher), count in beat.lost.items() if name == topic}
        print(f"  Lost: {sum(lost.values())}")
        for publisher_name, count in sorted(lost.items()):
            print(f"    {publisher_name} → {node.name}: {count}")


def _rate(rate_hz: float, age_s: float) -> str:
    if math.isinf(age_s):
        return "no message yet"
    return f"{rate_hz:.2f} Hz, newest {age_s:.2f} s ago"


def _silence(is_node: bool) -> str:
    return "unknown: no heartbeat within 2.5 s" if is_node else "unknown: not a node; measure it with ic topic hz"
