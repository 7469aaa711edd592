"""``ic topic info``: publishers and subscribers of a topic, rates, and losses between them."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping

from instant_ic.bus import registry
from instant_ic.bus.heartbeat import Flow, Heartbeat
from instant_ic.cli.errors import UserError
from instant_ic.cli.names import absolute, near, topic_types
from instant_ic.cli.tables import print_table
from instant_ic.util import paths


def info(args: argparse.Namespace) -> int:
    """Print publishers and subscribers; with ``-v`` also QoS, rates and losses."""
    run_dir = paths.run_dir()
    topic = absolute(args.topic)
    found = next((entry for entry in registry.list_topics(run_dir) if entry.topic == topic), None)
    publishers = found.publishers if found else []
    nodes = {node.name: node for node in registry.list_nodes(run_dir)}
    readers = [node for node in nodes.values() if topic in node.subscribes]
    if not publishers and not readers:
        raise UserError(
            f"{topic}: no node publishes or subscribes to it ({near(topic, topic_types(), 'see ic topic list')})"
        )
    beats: Mapping[str, Heartbeat] = {}
    if args.verbose:
        from instant_ic.cli.heartbeats import hear
        from instant_ic.launch.topics import expected_rate

        # Commands such as ic topic pub publish too, but have no heartbeat.
        beats = hear(run_dir, {p.node for p in publishers if p.node in nodes} | {node.name for node in readers})
        if nominal := expected_rate(topic):
            print(f"Nominal rate: {nominal.rate_hz:g} Hz{f', {nominal.when}' if nominal.when else ''}")
    print(f"Type: {found.type_name if found else readers[0].subscribes[topic]}")
    print(f"Publisher count: {len(publishers)}")
    for publisher in publishers:
        print(f"  {publisher.node} (pid {publisher.pid}, QoS {publisher.qos}, {publisher.type_name})")
    print(f"Subscription count: {len(readers)}")
    for node in readers:
        print(f"  {node.name} (pid {node.pid}, {node.subscribes[topic]})")
    if args.verbose:
        rows = []
        for publisher in publishers:
            beat = beats.get(publisher.node)
            rows.append((publisher.node, "publishes", _rate(beat.outputs.get(topic) if beat else None), ""))
        for node in readers:
            beat = beats.get(node.name)
            lost = beat.lost if beat else {}
            of = [f"{count} of {name}" for (lost_topic, name), count in sorted(lost.items()) if lost_topic == topic]
            rows.append((node.name, "subscribes", _rate(beat.inputs.get(topic) if beat else None), ", ".join(of)))
        print_table(rows, ("NODE", "", "RATE", "LOST"))
    return 0


def _rate(flow: Flow | None) -> str:
    if flow is None:
        return "unknown: no heartbeat"
    return "no message yet" if math.isinf(flow.age_s) else f"{flow.rate_hz:.2f} Hz, newest {flow.age_s:.2f} s ago"
