"""Lockstep replay of a bag through real nodes in one process. Every run gives the same result, bit for bit."""

from __future__ import annotations

import functools
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from instant_ic.bag.files import BagReader
from instant_ic.bag.message import BagError, BagMessage
from instant_ic.bag.player import NEVER_PLAYED
from instant_ic.bag.transforms import TRANSFORM_TOPICS, without_children
from instant_ic.bag.writer import BagWriter
from instant_ic.bus.lockstep import LockstepBus, Record
from instant_ic.bus.node import Node
from instant_ic.bus.node_files import node_class
from instant_ic.config.params import SHARED, configure, gather
from instant_ic.config.yaml_text import read_yaml
from instant_ic.msg import deserialize
from instant_ic.util import paths

BROADCASTS: Mapping[str, tuple[str, ...]] = {
    "grid_slam": ("odom",),
    "crawler_base": ("base_link",),
    "theta_camera": ("camera",),
    "vlp16_driver": ("velodyne",),
}
"""Child frames that the shipped nodes broadcast. A replay drops these frames from the bag.

A frame that a node broadcasts only in place of another node (SLAM without wheel odometry) is not listed. For nodes that
are not listed, a frame is dropped as soon as the node has broadcast it.
"""


class ReplayError(RuntimeError):
    """A replay cannot start; the message says why."""


@dataclass(frozen=True)
class ReplayNode:
    """A node to replay."""

    name: str
    node_class: type[Node[Any]]
    config: Any


@dataclass
class ReplayResult:
    """Result of a replay.

    Attributes:
        fed: messages of the bag that were passed to nodes, by topic.
        left_out: messages of the bag that were not passed because a replayed node publishes them.
        made: messages that the nodes published, by topic.
        bag_s: duration of the bag.
        setup_s: start-up time of the nodes.
        wall_s: time for processing the messages.
    """

    fed: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    made: Counter[str] = field(default_factory=Counter)
    bag_s: float = 0.0
    setup_s: float = 0.0
    wall_s: float = 0.0


def shipped_parameter_files(name: str) -> list[Path]:
    """Return the files of ``config/`` with a section for a node, sorted by name, except those of simulated robots."""
    try:
        folder = paths.share_dir("config")
    except FileNotFoundError:
        return []
    found = []
    for file in sorted(folder.glob("*.yaml")):
        if file.name in ("sim.yaml", "fleet_sim.yaml"):  # fleet_sim.yaml lowers rates for many robots on one machine
            continue
        try:
            named = {name, SHARED} & _sections(file, file.stat().st_mtime_ns)
        except (OSError, yaml.YAMLError):
            continue  # this node may not use the broken file; naming the file explicitly reports the error
        if named:
            found.append(file)
    return found


@functools.lru_cache(maxsize=64)
def _sections(file: Path, changed_ns: int) -> frozenset[str]:
    """Return the nodes that a parameter file configures. Cached by modification time, because parsing is slow."""
    content = read_yaml(file.read_text())
    return frozenset(content) if isinstance(content, dict) else frozenset()


def make_node(name: str, params_files: Sequence[Path] | None, overrides: Sequence[str]) -> ReplayNode:
    """Create a node with its parameters.

    Args:
        name: name of the node.
        params_files: parameter files; None takes those of ``config/`` for the node.
        overrides: ``node.key:=value`` arguments; those for other nodes are skipped.

    Raises:
        NodeFileError: no node has this name.
        ParameterError: a parameter is wrong.
    """
    files = shipped_parameter_files(name) if params_files is None else list(params_files)
    own = [word.removeprefix(f"{name}.") for word in overrides if word.startswith(f"{name}.")]
    found = node_class(name)
    config, _ = configure(found.config_class(), gather(name, files, own))
    return ReplayNode(name, found, config)


def replay(
    bag: Path,
    nodes: Sequence[ReplayNode],
    output: Path,
    drop_transforms: Iterable[str] = (),
    on_progress: Callable[[float], None] | None = None,
    compressed: bool = False,
) -> ReplayResult:
    """Feed a bag to nodes message by message and record what they publish.

    The clock follows the bag and stands still while a node works, so the result does not depend on the machine's speed.
    Topics and transforms that a replayed node publishes itself are not fed.

    Args:
        bag: bag to feed.
        nodes: nodes to replay.
        output: folder of the new bag, which must not exist.
        drop_transforms: further child frames to drop.
        on_progress: called with the completed share of the bag, 0 to 1.
        compressed: compress the new bag with zstd.

    Raises:
        BagError: a bag cannot be read or written.
        ReplayError: a node reads a type whose definition differs in the bag.
    """
    result = ReplayResult()
    began_s = time.monotonic()
    with BagReader(bag) as reader:
        if not reader.count:
            raise BagError(f"bag {bag} is empty")
        with BagWriter(output, compressed) as writer:
            made_frames = {child for node in nodes for child in BROADCASTS.get(node.name, ())}
            made_frames.update(drop_transforms)

            def record(entry: Record) -> None:
                result.made[entry.topic] += 1
                if entry.topic in TRANSFORM_TOPICS and entry.node not in BROADCASTS:
                    transforms = deserialize(entry.payload, entry.type_name).transforms
                    made_frames.update(t.child_frame_id for t in transforms)
                writer.write(entry.topic, entry.type_name, entry.payload, entry.stamp_ns, entry.qos)

            with LockstepBus(start_ns=reader.start_ns, keep=False, on_record=record) as bus:
                running = [bus.add(node.node_class, node.config, node.name) for node in nodes]
                _check_types(reader, bus)
                span_ns = max(1, reader.end_ns - reader.start_ns)
                result.bag_s, result.setup_s = span_ns / 1e9, time.monotonic() - began_s
                for message in reader.messages(current=True):
                    _feed(message, bus, running, made_frames, result)
                    if on_progress is not None:
                        on_progress((message.stamp_ns - reader.start_ns) / span_ns)
                result.wall_s = time.monotonic() - began_s - result.setup_s
                for node in running:
                    for publisher in node.publishers:
                        writer.add_topic(publisher.topic, publisher.raw.type_name, publisher.raw.qos)
    return result


def _check_types(reader: BagReader, bus: LockstepBus) -> None:
    for topic in reader.topics:
        if topic.problem and bus.subscriptions.get(topic.topic):
            raise ReplayError(f"bag {reader.path}, topic {topic.topic} ({topic.type_name}): {topic.problem}")


def _feed(
    message: BagMessage, bus: LockstepBus, running: Sequence[Node[Any]], made_frames: set[str], result: ReplayResult
) -> None:
    """Publish a message of the bag, or only advance the clock if a replayed node publishes that topic itself."""
    payload: bytes | None = message.payload
    if message.topic in TRANSFORM_TOPICS:
        payload = without_children(message, made_frames)
    elif message.topic in NEVER_PLAYED or any(
        out.topic == message.topic for node in running for out in node.publishers
    ):
        payload = None
    if payload is None:
        result.left_out[message.topic] += 1
        bus.advance_to(message.stamp_ns)
    else:
        result.fed[message.topic] += 1
        bus.publish_bytes(message.topic, message.type_name, payload, message.stamp_ns, message.qos.latched)
