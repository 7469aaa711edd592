"""What the nodes tell of themselves, as the launcher shows it: heartbeats, and what the stack still waits for."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from instant_ic.bus import RELIABLE, registry
from instant_ic.bus.zmq_transport import ZmqTransport
from instant_ic.launch.description import NodeSpec
from instant_ic.msg import deserialize

SILENT_AFTER_S = 3.0
"""A node without a heartbeat for longer than this is shown as silent."""

_STATES = ("starting", "running", "degraded", "failed", "stopping")
_VSPACE_READY = 2

MILESTONES: tuple[tuple[str, str, str], ...] = (
    ("camera", "theta_camera", "/camera/image/compressed"),
    ("lidar", "vlp16_driver", "/scan"),
    ("base", "crawler_base", "/wheel/odom"),
    ("map", "grid_slam", "/pose"),  # the map itself is sent only when it changes
    ("depth", "depth_scaler", "/depth/scaled"),
)
"""What an operator waits for at the start: word, module of the node, topic whose flow says that it is there."""


@dataclass
class NodeHealth:
    """The newest heartbeat of a node.

    Attributes:
        state: as in NodeStatus.msg, in lower case.
        message: the worst diagnosis in words.
        cpu_percent: of one core.
        rss_mb: resident memory.
        rates_hz: topic → messages a second that it sends.
        seen_s: monotonic time when it came.
    """

    state: str
    message: str
    cpu_percent: float
    rss_mb: float
    rates_hz: dict[str, float] = field(default_factory=dict)
    seen_s: float = 0.0

    @property
    def silent(self) -> bool:
        """Whether the last heartbeat is too old."""
        return time.monotonic() - self.seen_s > SILENT_AFTER_S


class HealthMonitor:
    """Listens to ``/heartbeat`` (and ``/vspace/status`` where a ``nerf`` runs) without a node of its own.

    Args:
        nodes: the nodes of the stack.
        run_dir: prepared run directory.
    """

    def __init__(self, nodes: Sequence[NodeSpec], run_dir: Path) -> None:
        self.nodes: dict[str, NodeHealth] = {}
        self._specs = list(nodes)
        self._run_dir = run_dir
        self._transport = ZmqTransport(run_dir, f"launch_{os.getpid()}", time.time_ns)
        status = "instant_ic_msgs/msg/NodeStatus"
        prefixes = sorted({f"/{spec.namespace.strip('/')}" if spec.namespace else "" for spec in nodes})
        self._beats = [
            self._transport.subscribe(f"{prefix}/heartbeat", status, RELIABLE, lambda: None) for prefix in prefixes
        ]
        self._vspace = [
            self._transport.subscribe("/vspace/status", "instant_ic_msgs/msg/VspaceStatus", RELIABLE, lambda: None)
            for spec in nodes
            if spec.exec == "nerf" and not spec.namespace
        ]
        self._reached: set[str] = set()

    def poll(self) -> None:
        """Takes in what has come; never waits."""
        for subscription in self._beats:
            for received in subscription.take():
                self._take(deserialize(received.payload, received.type_name))
        for subscription in self._vspace:
            for received in subscription.take():
                if deserialize(received.payload, received.type_name).state == _VSPACE_READY:
                    self._reached.add("v-space")
        for label, program, topic in MILESTONES:
            for spec in self._specs:
                health = self.nodes.get(spec.name)
                if spec.exec == program and health is not None and health.rates_hz.get(topic, 0.0) > 0:
                    self._reached.add(label)

    def _take(self, message: Any) -> None:
        outputs = zip(message.outputs, message.output_rates_hz, strict=False)
        state = _STATES[message.state] if message.state < len(_STATES) else "unknown"
        self.nodes[message.node] = NodeHealth(
            state,
            message.message,
            float(message.cpu_percent),
            float(message.rss_mb),
            {topic: float(rate) for topic, rate in outputs},
            time.monotonic(),
        )

    def nodes_missing(self) -> list[str]:
        """Nodes that have not said yet that they run."""
        up = ("running", "degraded")
        return [s.name for s in self._specs if s.name not in self.nodes or self.nodes[s.name].state not in up]

    def waiting_for(self) -> list[str]:
        """What of ``MILESTONES`` (and the v-space) has not been reached, of the nodes in this stack."""
        programs = {spec.exec for spec in self._specs}
        wanted = [label for label, program, _ in MILESTONES if program in programs]
        return [label for label in [*wanted, *["v-space"] * len(self._vspace)] if label not in self._reached]

    def console_address(self) -> str | None:
        """Address of the operator's page once a node of the console says that it runs."""
        names = {spec.name for spec in self._specs if spec.exec == "console"}
        if not any(name in self.nodes and self.nodes[name].state == "running" for name in names):
            return None
        return find_console(registry.list_nodes(self._run_dir), names)

    def close(self) -> None:
        """Lets go of the bus."""
        self._transport.close()


def find_console(infos: Iterable[registry.NodeInfo], names: Iterable[str]) -> str | None:
    """Address of a console out of the registry, by its parameters ``server.host`` and ``server.port``."""
    wanted = set(names)
    for info in infos:
        server = info.params.get("server", {})
        if info.name in wanted and server.get("port"):
            host = str(server.get("host") or "127.0.0.1")
            return f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{server['port']}"
    return None
