"""The launcher's view of the nodes' health: heartbeats, topic rates, and what is still missing at start-up."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from instant_ic.bus import RELIABLE, SENSOR, registry
from instant_ic.bus.heartbeat import EVERY_NODES, TYPE, Heartbeat, from_message
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.node import ERROR, OK, WARN
from instant_ic.bus.qos import QoS
from instant_ic.launch.description import NodeSpec
from instant_ic.launch.topics import nominal_rate
from instant_ic.msg import MessageError, deserialize, header, message_type, serialize
from instant_ic.util.paths import sign_in_file

FAULT_HOLDS_S = 3.0
"""A wrong rate is reported once it has lasted this long."""

_VSPACE_READY = 2
_DIAGNOSTICS_S = 1.0

LATE = "/simulation/late"
"""Topic of the node ``simulator``."""

MILESTONES: tuple[tuple[str, str, str], ...] = (
    ("camera's first image", "theta_camera", "/camera/image/compressed"),
    ("LiDAR's first scan", "vlp16_driver", "/scan"),
    ("base's odometry", "crawler_base", "/wheel/odom"),
    ("map", "grid_slam", "/pose"),  # the map itself is published only when it changes
    ("first depth image", "depth_scaler", "/depth/scaled"),
)
"""What an operator waits for at start-up: label, node, and the topic whose messages show that it works."""


@dataclass(frozen=True)
class TopicFault:
    """A topic that has stopped or is too slow."""

    label: str
    """Node that publishes it."""
    topic: str
    words: str
    stopped: bool


class HealthMonitor:
    """Subscribes to ``/heartbeat`` (and ``/vspace/status`` if the stack has a ``nerf``) without a node of its own.

    Args:
        run_dir: prepared run directory; those of groups lie in it, also prepared.
    """

    def __init__(self, nodes: Sequence[NodeSpec], run_dir: Path) -> None:
        self.nodes: dict[str, Heartbeat] = {}
        """By label."""
        self._specs = [spec for spec in nodes if spec.heartbeat]
        self._run_dir = run_dir
        groups = {spec.group: spec.run_dir or run_dir for spec in nodes} | {"": run_dir}
        name = f"launch_{os.getpid()}"
        self._transports = {group: LocalTransport(folder, name, time.time_ns) for group, folder in groups.items()}
        for transport in self._transports.values():
            transport.patient = True
        self._folders = groups
        spaces = {(spec.group, spec.namespace.strip("/")): spec for spec in self._specs}
        self._beats = [(spec.group, self._subscribe(spec, "/heartbeat", TYPE, RELIABLE)) for spec in spaces.values()]
        status = "instant_ic_msgs/msg/VspaceStatus"
        self._vspace = [
            (_labelled(spec, "virtual space"), self._subscribe(spec, "/vspace/status", status, RELIABLE))
            for spec in self._of("nerf")
            if not spec.namespace
        ]
        array = "diagnostic_msgs/msg/DiagnosticArray"
        self._diagnostics = {
            group: transport.advertise("/diagnostics", array, RELIABLE) for group, transport in self._transports.items()
        }
        self._late = [self._subscribe(spec, LATE, "std_msgs/msg/Float32") for spec in self._of("simulator")]
        control = "instant_ic_msgs/msg/ControlState"
        self._control = [self._subscribe(spec, "/ic/state", control) for spec in self._of("arbiter") if self._late]
        self._vspace_text: dict[str, str] = {}
        self._next_diagnostics_s = 0.0
        self._addresses: dict[str, str] = {}
        self._reached: set[str] = set()
        self._flowed: set[tuple[str, str]] = set()
        self._wrong_since: dict[tuple[str, str], float] = {}

    def _of(self, program: str) -> list[NodeSpec]:
        return [spec for spec in self._specs if spec.exec == program]

    def _subscribe(self, spec: NodeSpec, topic: str, type_name: str, qos: QoS = SENSOR) -> Any:
        namespace = spec.namespace.strip("/")
        name = f"/{namespace}{topic}" if namespace else topic
        return self._transports[spec.group].subscribe(name, type_name, qos, lambda: None)

    def poll(self) -> None:
        """Process the messages that have arrived; never waits."""
        for transport in self._transports.values():
            transport.wait(0.0)
        for group, subscription in self._beats:
            for publisher, message in _published([subscription]):
                beat = from_message(message)
                if beat.node == publisher:  # a bridge's may come from a node of this name on another machine
                    self.nodes[f"{group}/{beat.node}" if group else beat.node] = beat
        for label, subscription in self._vspace:
            for status in _taken([subscription]):
                self._vspace_text[label] = status.message
                if status.state == _VSPACE_READY:
                    self._reached.add(label)
        for word, program, topic in MILESTONES:
            for spec in self._specs:
                health = self.nodes.get(spec.label)
                flow = health.outputs.get(topic) if health is not None and spec.exec == program else None
                if flow is not None and flow.age_s < math.inf:
                    self._reached.add(_labelled(spec, word))

    @property
    def cpu_cores(self) -> float:
        """Cores that the nodes use, by their newest heartbeats."""
        return sum(health.cpu_percent for health in self.nodes.values()) / 100.0

    def take_late(self) -> tuple[float | None, bool]:
        """Largest delay of the simulated devices since the last call, and whether the arbiter reported a stale source.

        The delay is a share of the acceptable one; None without a report. Both only with a simulator in the stack.
        """
        late = max((float(message.data) for message in _taken(self._late)), default=None)
        reasons = [message.reason_code for message in _taken(self._control)]
        return late, any(reason >= message_type("ControlState").REASON_SCAN_STALE for reason in reasons)

    def beat_s(self, spec: NodeSpec, pid: int) -> float | None:
        """Monotonic time of the newest heartbeat in which this process reported that it runs; None before the first."""
        health = self.nodes.get(spec.label)
        return health.seen_s if health is not None and health.pid == pid and health.up else None

    @property
    def reached(self) -> int:
        """Steps of the start so far: nodes that run, and what :meth:`waiting_for` no longer lists."""
        return len(self._reached) + sum(health.up for health in self.nodes.values())

    def nodes_missing(self) -> list[str]:
        """Nodes that have not reported yet that they run."""
        return [s.label for s in self._specs if s.label not in self.nodes or not self.nodes[s.label].up]

    def waiting_for(self) -> list[str]:
        """``MILESTONES`` (and the v-space) of this stack's nodes that have not been reached yet."""
        wanted = [
            _labelled(spec, word) for word, program, _ in MILESTONES for spec in self._specs if spec.exec == program
        ]
        left = [label for label in wanted if label not in self._reached]
        for label, _ in self._vspace:
            if label not in self._reached:
                text = self._vspace_text.get(label)
                left.append(f"{label} ({text})" if text else label)
        return left

    def topic_faults(self) -> list[TopicFault]:
        """Topics that have stopped or become too slow (config/topics.yaml), once the fault has lasted a while.

        Topics that never had a message are left to :meth:`waiting_for` and to the node's own diagnoses.
        """
        now_s = time.monotonic()
        faults: list[TopicFault] = []
        for spec in self._specs:
            health = self.nodes.get(spec.label)
            if health is None or health.silent or not health.up:
                continue
            for topic, flow in health.outputs.items():
                expected = nominal_rate(topic, spec.namespace)
                if expected is None or topic.endswith(EVERY_NODES):
                    continue
                key, age_s = (spec.label, topic), flow.age_s
                words = expected.fault(flow.rate_hz, age_s)
                if not words:
                    self._flowed.add(key)
                    self._wrong_since.pop(key, None)
                elif key in self._flowed and now_s - self._wrong_since.setdefault(key, now_s) > FAULT_HOLDS_S:
                    faults.append(TopicFault(spec.label, topic, words, not expected.alive(age_s)))
        return faults

    def publish(self, down: dict[str, str], faults: Sequence[TopicFault]) -> None:
        """Publish ``/diagnostics`` once a second.

        Args:
            down: label → text, for nodes that should run and do not.
            faults: see :meth:`topic_faults`.
        """
        now_s = time.monotonic()
        if now_s < self._next_diagnostics_s:
            return
        self._next_diagnostics_s = now_s + _DIAGNOSTICS_S
        for group, publisher in self._diagnostics.items():
            labels = {spec.label: spec.name for spec in self._specs if spec.group == group}
            entries = [(ERROR, labels[label], words) for label, words in down.items() if label in labels]
            entries += [
                (WARN if f.stopped else OK, f"{labels[f.label]} {f.topic}", f.words)
                for f in faults
                if f.label in labels
            ]
            publisher.send(serialize(_diagnostic_array(entries)))

    def addresses(self, *, with_token: bool) -> dict[str, str]:
        """Addresses of the operator's page and, if it needs a token, of the Foxglove bridge, once their nodes run.

        Args:
            with_token: for a terminal: include the token, which is a new one after a restart; else name its file.
        """
        for spec in self._specs:
            health = self.nodes.get(spec.label)
            if spec.exec not in ("console", "foxglove_bridge") or health is None or not health.up:
                continue
            folder = self._folders[spec.group]
            file = sign_in_file(folder, spec.name)
            if with_token and (address := _line_of(file)):
                self._addresses[spec.label] = address
            elif spec.label not in self._addresses:
                address = find_console(registry.list_nodes(folder), [spec.name]) or ""
                if file.is_file():
                    address = f"{address or spec.exec}, sign in as {file} says"
                if address:
                    self._addresses[spec.label] = address
        return self._addresses

    def close(self) -> None:
        for transport in self._transports.values():
            transport.close()


def _line_of(file: Path) -> str:
    """A file's text; empty if there is none, because its node has just ended."""
    with suppress(OSError):
        return file.read_text(encoding="utf-8").strip()
    return ""


def _published(subscriptions: Iterable[Any]) -> Iterable[tuple[str, Any]]:
    """Publishers and messages that have arrived. A message that cannot be read must not end the stack."""
    for subscription in subscriptions:
        for received in subscription.take():
            with suppress(MessageError):  # its node counts as silent
                yield received.publisher, deserialize(received.payload, received.type_name)


def _taken(subscriptions: Iterable[Any]) -> Iterable[Any]:
    """The messages that have arrived."""
    return (message for _, message in _published(subscriptions))


def _labelled(spec: NodeSpec, word: str) -> str:
    return f"{spec.group}/{word}" if spec.group else word


def _diagnostic_array(entries: Sequence[tuple[int, str, str]]) -> Any:
    status = message_type("DiagnosticStatus")
    return message_type("DiagnosticArray")(
        header=header("", time.time_ns()),
        status=[
            status(level=level, name=f"launch: {name}", message=words, hardware_id="", values=[])
            for level, name, words in entries
        ],
    )


def find_console(infos: Iterable[registry.NodeInfo], names: Iterable[str]) -> str | None:
    """Address of a console according to the registry, from its parameters ``server.host`` and ``server.port``."""
    wanted = set(names)
    for info in infos:
        server = info.params.get("server", {})
        if info.name in wanted and server.get("port"):
            host = str(server.get("host") or "127.0.0.1")
            scheme = "https" if server.get("access", {}).get("tls_certificate") else "http"
            return f"{scheme}://{'127.0.0.1' if host == '0.0.0.0' else host}:{server['port']}"
    return None
