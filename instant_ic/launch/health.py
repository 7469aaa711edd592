"""The nodes' health as the launcher sees it: heartbeats, topic rates, and the steps still missing at start-up."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from instant_ic.bus import RELIABLE, SENSOR, registry
from instant_ic.bus.diagnostics import ERROR, OK, WARN
from instant_ic.bus.heartbeat import EVERY_NODES, TYPE, Heartbeat, from_message
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.launch.topics import PAUSE_S, expected_rate
from instant_ic.msg import MessageError, deserialize, header, message_type, serialize
from instant_ic.util.paths import sign_in_file

if TYPE_CHECKING:
    from pathlib import Path

    from instant_ic.bus.qos import QoS
    from instant_ic.bus.transport import RawSubscription
    from instant_ic.launch.description import NodeSpec

FAULT_HOLDS_S = PAUSE_S
"""Time for which a rate must be wrong before it is reported."""

_VSPACE_READY = 2
_DIAGNOSTICS_S = 1.0

LATE = "/simulation/late"
"""Topic on which the node ``simulator`` reports its delay."""

MILESTONES: tuple[tuple[str, str, str], ...] = (
    ("camera's first image", "theta_camera", "/camera/image/compressed"),
    ("LiDAR's first scan", "vlp16_driver", "/scan"),
    ("base's odometry", "crawler_base", "/wheel/odom"),
    ("map", "grid_slam", "/pose"),  # the map itself is published only when it changes
    ("first depth image", "depth_scaler", "/depth/scaled"),
)
"""Steps of the start-up that an operator waits for: label, node, and the topic whose first message completes it."""


@dataclass(frozen=True)
class TopicFault:
    """A topic that has stopped or is too slow.

    Attributes:
        label: node that publishes it.
        text: the fault, with the numbers.
        stopped: true if no message arrives any more.
    """

    label: str
    topic: str
    text: str
    stopped: bool


class HealthMonitor:
    """A monitor of ``/heartbeat`` (and of ``/vspace/status`` if the stack has a ``nerf``) without a node of its own.

    Args:
        nodes: the stack's nodes.
        run_dir: prepared run directory, which contains the prepared run directories of the groups.
    """

    def __init__(self, nodes: Sequence[NodeSpec], run_dir: Path) -> None:
        self.nodes: dict[str, Heartbeat] = {}
        """Newest heartbeat of each node, by label."""
        self._specs = list(nodes)
        self._folders = {spec.group: spec.run_dir or run_dir for spec in nodes} | {"": run_dir}
        name = f"launch_{os.getpid()}"
        self._transports = {group: LocalTransport(path, name, time.time_ns) for group, path in self._folders.items()}
        for transport in self._transports.values():
            transport.patient = True
        self._beats = [(group, self._subscribe(group, "/heartbeat", TYPE, RELIABLE)) for group in self._folders]
        status = "instant_ic_msgs/msg/VspaceStatus"
        self._vspace = [
            (_labelled(spec, "virtual space"), self._subscribe(spec.group, "/vspace/status", status, RELIABLE))
            for spec in self._running("nerf")
        ]
        array = "diagnostic_msgs/msg/DiagnosticArray"
        self._diagnostics = {
            group: transport.advertise("/diagnostics", array, RELIABLE) for group, transport in self._transports.items()
        }
        self._late = [self._subscribe(spec.group, LATE, "std_msgs/msg/Float32") for spec in self._running("simulator")]
        control = "instant_ic_msgs/msg/ControlState"
        arbiters = self._running("arbiter") if self._late else []
        self._control = [self._subscribe(spec.group, "/ic/state", control) for spec in arbiters]
        self._vspace_text: dict[str, str] = {}
        self._next_diagnostics_s = 0.0
        self._addresses: dict[str, str] = {}
        self._reached: set[str] = set()
        self._flowed: set[tuple[str, str]] = set()
        self._wrong_since: dict[tuple[str, str], float] = {}

    def _running(self, program: str) -> list[NodeSpec]:
        return [spec for spec in self._specs if spec.exec == program]

    def _subscribe(self, group: str, topic: str, type_name: str, qos: QoS = SENSOR) -> RawSubscription:
        return self._transports[group].subscribe(topic, type_name, qos, lambda: None)

    def poll(self) -> None:
        """Process the messages that have arrived; never waits."""
        for transport in self._transports.values():
            transport.wait(0.0)
        for group, subscription in self._beats:
            for publisher, message in _arrived(subscription):
                beat = from_message(message)
                if beat.node == publisher:  # else a bridge forwards the heartbeat of a node on another machine
                    self.nodes[f"{group}/{beat.node}" if group else beat.node] = beat
        for label, subscription in self._vspace:
            for _, status in _arrived(subscription):
                self._vspace_text[label] = status.message
                if status.state == _VSPACE_READY:
                    self._reached.add(label)
        for milestone, spec, topic in self._milestones():
            health = self.nodes.get(spec.label)
            flow = health.outputs.get(topic) if health is not None else None
            if flow is not None and flow.age_s < math.inf:
                self._reached.add(milestone)

    def _milestones(self) -> list[tuple[str, NodeSpec, str]]:
        """Return label, node and topic of each milestone of this stack."""
        return [
            (_labelled(spec, text), spec, topic)
            for text, program, topic in MILESTONES
            for spec in self._running(program)
        ]

    @property
    def cpu_cores(self) -> float:
        """Number of cores that the nodes use, by their newest heartbeats."""
        return sum(health.cpu_percent for health in self.nodes.values()) / 100.0

    def take_late(self) -> tuple[float | None, bool]:
        """Return the largest delay of the simulated devices since the last call, and whether a source is stale.

        The delay is a share of the acceptable delay; None without a report. Stale sources are reported by the arbiter.
        Both are known only with a simulator in the stack.
        """
        late = max((float(message.data) for sub in self._late for _, message in _arrived(sub)), default=None)
        reasons = [message.reason_code for sub in self._control for _, message in _arrived(sub)]
        return late, any(reason >= message_type("ControlState").REASON_SCAN_STALE for reason in reasons)

    def beat_s(self, spec: NodeSpec, pid: int) -> float | None:
        """Return the monotonic time of the newest heartbeat of a running process; None before the first."""
        health = self.nodes.get(spec.label)
        return health.seen_s if health is not None and health.pid == pid and health.up else None

    def nodes_missing(self) -> list[str]:
        """Return the nodes that have not yet reported that they run."""
        return [s.label for s in self._specs if s.label not in self.nodes or not self.nodes[s.label].up]

    def waiting_for(self) -> list[str]:
        """Return the ``MILESTONES`` (and the v-space) of this stack's nodes that have not been reached yet."""
        left = [label for label, _, _ in self._milestones() if label not in self._reached]
        for label, _ in self._vspace:
            if label not in self._reached:
                text = self._vspace_text.get(label)
                left.append(f"{label} ({text})" if text else label)
        return left

    def topic_faults(self) -> list[TopicFault]:
        """Return the topics that have stopped or become too slow for ``FAULT_HOLDS_S``, by config/topics.yaml.

        Topics that never had a message are left to :meth:`waiting_for` and to the node's own diagnoses.
        """
        now_s = time.monotonic()
        faults: list[TopicFault] = []
        for spec in self._specs:
            health = self.nodes.get(spec.label)
            if health is None or health.silent or not health.up:
                continue
            for topic, flow in health.outputs.items():
                expected = expected_rate(topic)
                if expected is None or topic.endswith(EVERY_NODES):
                    continue
                key = spec.label, topic
                text = expected.fault(flow.rate_hz, flow.age_s)
                if not text:
                    self._flowed.add(key)
                    self._wrong_since.pop(key, None)
                elif key in self._flowed and now_s - self._wrong_since.setdefault(key, now_s) > FAULT_HOLDS_S:
                    faults.append(TopicFault(spec.label, topic, text, not expected.alive(flow.age_s)))
        return faults

    def publish(self, down: Mapping[str, str], faults: Sequence[TopicFault]) -> None:
        """Publish ``/diagnostics`` once a second.

        Args:
            down: label → text, for nodes that should run but do not.
            faults: see :meth:`topic_faults`.
        """
        now_s = time.monotonic()
        if now_s < self._next_diagnostics_s:
            return
        self._next_diagnostics_s = now_s + _DIAGNOSTICS_S
        status = message_type("DiagnosticStatus")
        for group, publisher in self._diagnostics.items():
            names = {spec.label: spec.name for spec in self._specs if spec.group == group}
            entries = [(ERROR, names[label], text) for label, text in down.items() if label in names]
            entries += [
                (WARN if f.stopped else OK, f"{names[f.label]} {f.topic}", f.text) for f in faults if f.label in names
            ]
            statuses = [
                status(level=level, name=f"launch: {name}", message=text, hardware_id="", values=[])
                for level, name, text in entries
            ]
            array = message_type("DiagnosticArray")(header=header("", time.time_ns()), status=statuses)
            publisher.send(serialize(array))

    def addresses(self, *, with_token: bool) -> dict[str, str]:
        """Return the addresses of the operator's page and, if it needs a token, of the Foxglove bridge, once they run.

        Args:
            with_token: include the token, which changes with each start; only for a terminal. False: name its file.
        """
        for spec in self._specs:
            health = self.nodes.get(spec.label)
            if spec.exec not in ("console", "foxglove_bridge") or health is None or not health.up:
                continue
            folder = self._folders[spec.group]
            file = sign_in_file(folder, spec.name)
            if with_token and file.is_file():
                with suppress(OSError):  # the node has just ended and removed its file
                    self._addresses[spec.label] = file.read_text(encoding="utf-8").strip()
            elif spec.label not in self._addresses:
                address = next((console_address(n) for n in registry.list_nodes(folder) if n.name == spec.name), "")
                if file.is_file():
                    address = f"{address or spec.exec}, sign in with the link in {file}"
                if address:
                    self._addresses[spec.label] = address
        return self._addresses

    def close(self) -> None:
        """End the subscriptions."""
        for transport in self._transports.values():
            transport.close()


def _arrived(subscription: RawSubscription) -> Iterator[tuple[str, Any]]:
    """Yield publisher and content of the messages that have arrived, except those that cannot be read."""
    for received in subscription.take():
        with suppress(MessageError):  # must not end the stack; the node then counts as silent
            yield received.publisher, deserialize(received.payload, received.type_name)


def _labelled(spec: NodeSpec, text: str) -> str:
    return f"{spec.group}/{text}" if spec.group else text


def console_address(node: registry.NodeInfo) -> str:
    """Return the address of a console by its parameters ``server.host`` and ``server.port``; empty if unknown."""
    server = node.params.get("server", {})
    if not server.get("port"):  # 0 is any free port; the console logs the one it got
        return ""
    host = str(server.get("host") or "127.0.0.1")
    scheme = "https" if server.get("access", {}).get("tls_certificate") else "http"
    return f"{scheme}://{'127.0.0.1' if host == '0.0.0.0' else host}:{server['port']}"
