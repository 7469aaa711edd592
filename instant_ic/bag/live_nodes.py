"""The nodes that run beside a player: would its messages reach a robot, and are its readers ready?"""

from __future__ import annotations

import fnmatch
from collections.abc import Collection, Mapping
from pathlib import Path

from instant_ic.bag.errors import BagError
from instant_ic.bus.heartbeat import EVERY_NODES
from instant_ic.bus.registry import NodeInfo

_BASE = "crawler_base"
_BRIDGES = ("host_bridge", "zenoh_gateway")
"""Pass what they subscribe to on to a robot on another machine."""
_COMMAND = "/cmd_vel"
_ACTED_ON = ("/cmd_vel", "/nav/cmd_vel", "/operator/*", "/robot/estop", "/ic/*", "/vbot/odom")
"""Topics that a robot's nodes act on, in the namespace of its base."""
_HARMLESS = {"/clock", *EVERY_NODES}
"""On any other topic a second publisher would mix the bag with the live robot."""


def reached_base(nodes: Collection[NodeInfo], played: Mapping[str, str]) -> tuple[str, list[str]] | None:
    """Find a base, real or simulated, that could obey the played messages, or a bridge that passes them to one.

    Args:
        nodes: running nodes, without the player.
        played: topic on the bus → topic in the bag.

    Returns:
        Name of the base or bridge and the topics of the bag that would reach the robot; None where there is none.
    """
    live = {topic for node in nodes for topic in node.publishes} - _HARMLESS
    for base in nodes:
        if base.executable == _BASE:
            spaces = {"", *(topic.removesuffix(_COMMAND) for topic in base.subscribes if topic.endswith(_COMMAND))}
            acted_on = {*live, *base.subscribes, *(f"{space}{topic}" for space in spaces for topic in _ACTED_ON)}
        elif base.executable in _BRIDGES:
            acted_on = {t for t in base.subscribes if any(fnmatch.fnmatchcase(t, f"*{each}") for each in _ACTED_ON)}
        else:
            continue
        found = [
            played[topic]
            for topic in sorted(played)
            if any(fnmatch.fnmatchcase(topic, pattern) for pattern in acted_on)
        ]
        if found:
            return base.name, found
    return None


def refuse_base(bag: str, run_dir: Path, nodes: Collection[NodeInfo], played: Mapping[str, str]) -> None:
    """Refuse to play what a base in the run directory, real or simulated, could obey.

    Args:
        bag, run_dir: for the text of the error.
        nodes, played: see :func:`reached_base`.

    Raises:
        BagError: there is one, or a bridge to one.
    """
    if reached := reached_base(nodes, played):
        base, topics = reached
        left_out = " ".join(f"-x {topic}" for topic in topics)
        raise BagError(
            f"{bag}: {', '.join(topics)} would reach the robot of {base}, which runs in {run_dir}. Leave them out "
            f"({left_out}), rename them (--remap {topics[0]}:=/bag{topics[0]}), end the stack, or play them all the "
            "same with --force"
        )


def missing_readers(
    wait_for: Collection[str], nodes: Collection[NodeInfo], publishers: Mapping[str, tuple[str, int]]
) -> list[str]:
    """Describe what is missing before nodes receive everything that is played.

    Args:
        wait_for: names of the nodes, which must subscribe to at least one played topic.
        nodes: running nodes.
        publishers: topic in the bag → (topic on the bus, number of connected subscribers).

    Returns:
        The missing nodes and connections as text; empty when all are there.
    """
    running = {node.name: node for node in nodes if node.name in wait_for}
    played = {topic for topic, _ in publishers.values()}
    # A recorder subscribes only after it has found the topics: it is ready once it subscribes to one of them.
    absent = [name for name in wait_for if name not in running or played.isdisjoint(running[name].subscribes)]
    readers = [topic for node in running.values() for topic in node.subscribes]
    unread = [name for name, (topic, connected) in publishers.items() if connected < readers.count(topic)]
    return [f"node {name} to read what is played" for name in absent] + [f"a reader of {name}" for name in unread]
