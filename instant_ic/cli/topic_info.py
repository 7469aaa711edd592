"""``ic topic info`` and ``ic node info``: publishers and subscribers, rates, and losses between them."""

from __future__ import annotations

import argparse
import math

from instant_ic.bus import registry
from instant_ic.bus.control import ControlError, NodeControl
from instant_ic.bus.heartbeat import Heartbeat
from instant_ic.cli.errors import UserError
from instant_ic.cli.names import absolute, find_node, near, topic_types
from instant_ic.cli.observer import hear
from instant_ic.cli.tables import print_table
from instant_ic.launch.topics import expected_rate
from instant_ic.util import paths

PUBLISHES, SUBSCRIBES = "publishes", "subscribes"


def info(args: argparse.Namespace) -> int:
    """Print publishers and subscribers of a topic; with ``-v`` also rates and losses."""
    run_dir = paths.run_dir()
    topic = absolute(args.topic)
    found = next((entry for entry in registry.list_topics(run_dir) if entry.topic == topic), None)
    nodes = registry.list_nodes(run_dir)
    rows = [(p.node, PUBLISHES, p.type_name, p.qos, str(p.pid)) for p in (found.publishers if found else ())]
    rows += [(n.name, SUBSCRIBES, n.subscribes[topic], "", str(n.pid)) for n in nodes if topic in n.subscribes]
    if not rows:
        hint = near(topic, topic_types(), "see ic topic list")
        raise UserError(f"{topic}: no node publishes or subscribes to it ({hint})")
    headings: tuple[str, ...] = ("NODE", "", "TYPE", "QOS", "PID")
    if args.verbose:
        if nominal := expected_rate(topic):
            print(f"nominal rate: {nominal.rate_hz:g} Hz{f', {nominal.when}' if nominal.when else ''}")
        # Only nodes have heartbeats, not commands that publish, such as ic topic pub.
        beats = hear(run_dir, {row[0] for row in rows} & {node.name for node in nodes})
        print_table([(*row, *_flow(beats.get(row[0]), row[1], topic)) for row in rows], (*headings, "RATE", "LOST"))
    else:
        print_table(rows, headings)
    return 0


def show_node(args: argparse.Namespace) -> int:
    """Print a node's state, process and topics."""
    node = find_node(args.node)
    print(f"{node.name}: {node.executable}, pid {node.pid}")
    beat = hear(paths.run_dir(), [node.name]).get(node.name)
    if beat is None:
        print("state: silent, no heartbeat within 2.5 s")
    else:
        print(f"state: {beat.state}{f', {beat.message}' if beat.message else ''}")
        print(f"process: {beat.cpu_percent:.0f} % of a core, {beat.rss_mb:.0f} MB")
    try:
        status = NodeControl(paths.run_dir(), node.name, 2.0).status()
        doing = f", in {status['busy']} for {status['busy_s']:.1f} s" if status["busy_s"] > 0.5 else ""
        print(f"threads: {status['threads']}{doing}")
    except ControlError as error:
        print(f"control: {error}")
    topics = [(topic, PUBLISHES, kind) for topic, kind in sorted(node.publishes.items())]
    topics += [(topic, SUBSCRIBES, kind) for topic, kind in sorted(node.subscribes.items())]
    rows = [(*row, *_flow(beat, row[1], row[0])) for row in topics]
    print_table(rows, ("TOPIC", "", "TYPE", "RATE", "LOST"))
    return 0


def _flow(beat: Heartbeat | None, role: str, topic: str) -> tuple[str, str]:
    """Return the rate and the losses of a topic as text, from a node's heartbeat."""
    flow = beat and (beat.outputs if role == PUBLISHES else beat.inputs).get(topic)
    if not beat or not flow:
        return "unknown", ""
    rate = "no message yet" if math.isinf(flow.age_s) else f"{flow.rate_hz:.2f} Hz, newest {flow.age_s:.2f} s ago"
    lost = beat.lost if role == SUBSCRIBES else {}
    return rate, ", ".join(f"{count} of {name}" for (of, name), count in sorted(lost.items()) if of == topic)
