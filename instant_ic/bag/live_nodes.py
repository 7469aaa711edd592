"""Checks of the nodes that run beside a player: no played message may reach a robot, and readers must be ready."""

from __future__ import annotations

import fnmatch
import time
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

from instant_ic.bag.message import BagError
from instant_ic.bus.heartbeat import EVERY_NODES
from instant_ic.bus.registry import NodeInfo, list_nodes
from instant_ic.bus.topics import Publisher

_WAIT_S = 60.0
_BASE = "crawler_base"
_BRIDGES = ("host_bridge", "zenoh_gateway")
"""Nodes that forward their subscriptions to a robot on another machine."""
_COMMAND = "/cmd_vel"
_ACTED_ON = (
    *("/cmd_vel", "/nav/cmd_vel", "/operator/*", "/robot/estop", "/ic/*", "/vbot/odom"),
    *("/view/shown", "/vspace/status"),  # age of the images that the operator sees
    *("/initialpose", "/slam/*"),  # the robot's pose, and whether it is trusted
)
"""Topics on which a robot's nodes act, in the namespace of its base."""
_HARMLESS = {"/clock", *EVERY_NODES}
"""Topics that may be played beside a robot. On others, a second publisher would mix the bag with the live robot."""


def _reached_base(nodes: Collection[NodeInfo], played: Mapping[str, str]) -> tuple[str, list[str]] | None:
    """Return a base or bridge, and the topics of the bag that would reach its robot; None if no topic would."""
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
    """Refuse to play topics that a base could obey, whether real or simulated, in the run directory or behind a bridge.

    Args:
        bag: name of the bag, for the error.
        run_dir: run directory, for the error.
        nodes: running nodes, without the player.
        played: topic on the bus → topic in the bag.

    Raises:
        BagError: a played topic would reach a base, directly or through a bridge.
    """
    if reached := _reached_base(nodes, played):
        base, topics = reached
        left_out = " ".join(f"-x {topic}" for topic in topics)
        raise BagError(
            f"{bag}: {', '.join(topics)} would reach the robot of {base}, which runs in {run_dir}. Leave them out "
            f"({left_out}), rename them (--remap {topics[0]}:=/bag{topics[0]}), end the stack, or play them all the "
            "same with --force"
        )


def wait_for_readers(
    wait_for: Collection[str], run_dir: Path, publishers: Mapping[str, Publisher], wait: Callable[[float], bool]
) -> None:
    """Wait until nodes are connected to all played topics to which they subscribe.

    Args:
        wait_for: names of the nodes. Each must subscribe to at least one played topic.
        run_dir: run directory of the nodes.
        publishers: topic in the bag → its publisher.
        wait: function that waits for the given seconds and returns True to give up.

    Raises:
        BagError: a node is still not connected after a minute.
    """
    deadline_s = time.monotonic() + _WAIT_S
    missing: list[str] = []
    while time.monotonic() < deadline_s:
        missing = _missing(wait_for, list_nodes(run_dir), publishers)
        if not missing or wait(0.1):
            return
    raise BagError(f"waited {_WAIT_S:.0f} s for {', '.join(missing)}")


def _missing(wait_for: Collection[str], nodes: Collection[NodeInfo], publishers: Mapping[str, Publisher]) -> list[str]:
    running = {node.name: node for node in nodes if node.name in wait_for}
    played = {out.topic for out in publishers.values()}
    # A recorder subscribes only after it has found the topics. Its first subscription to a played topic makes it ready.
    absent = [name for name in wait_for if name not in running or played.isdisjoint(running[name].subscribes)]
    readers = [topic for node in running.values() for topic in node.subscribes]
    unread = [name for name, out in publishers.items() if out.subscriber_count < readers.count(out.topic)]
    return [f"node {name} to read a played topic" for name in absent] + [f"a reader of {name}" for name in unread]
