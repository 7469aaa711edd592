"""Reports of every node: log, heartbeat and diagnostics."""

from __future__ import annotations

import logging
import mmap
import os
import time
from pathlib import Path
from typing import ClassVar

import numpy as np

from instant_ic.bus.diagnostics import ERROR, WARN
from instant_ic.bus.flow_report import FlowReport
from instant_ic.bus.node_interface import NodeInterface
from instant_ic.bus.qos import RELIABLE
from instant_ic.bus.topics import Publisher
from instant_ic.msg import header, message_type, to_time
from instant_ic.util.diagnosis import Diagnosis
from instant_ic.util.safe_text import masked


class NodeReport:
    """Publishes a node's log, heartbeat and diagnostics.

    Attributes:
        rosout, heartbeat, diagnostics: the publishers of the three.
    """

    def __init__(self, node: NodeInterface) -> None:
        self._node = node
        self._flows = FlowReport(time.monotonic_ns())
        self._load = time.process_time(), time.monotonic()  # CPU seconds of the process, and the time of this reading
        self.rosout: Publisher = node.publisher("/rosout", message_type("Log"), RELIABLE)
        self._handler = _RosoutHandler(node.node_name, self.rosout)
        for logger in _loggers(node.node_name):
            logger.addHandler(self._handler)
        self.heartbeat = node.publisher("/heartbeat", message_type("NodeStatus"), RELIABLE)
        self.diagnostics = node.publisher("/diagnostics", message_type("DiagnosticArray"), RELIABLE)
        self.beat()

    def close(self) -> None:
        """Stop publishing the log."""
        for logger in _loggers(self._node.node_name):
            logger.removeHandler(self._handler)

    def beat(self) -> None:
        """Publish the heartbeat: state, load, topics and lost messages."""
        node = self._node
        now = node.clock.steady_ns()
        status = message_type("NodeStatus")
        level, text, _ = node.diagnostics.worst
        state = "DEGRADED" if node.run_state == "RUNNING" and level >= ERROR else node.run_state
        inputs = [s.raw for s in node.subscriptions]
        outputs = [p.raw for p in node.publishers]
        losses = [(s.topic, other, count) for s in inputs for other, count in sorted(s.stats.lost_by.items())]
        self.heartbeat.publish(
            status(
                header=header("", time.time_ns()),
                node=node.node_name,
                pid=os.getpid(),
                state=getattr(status, state),
                message=text if level >= WARN else "",
                cpu_percent=self._cpu_percent(),
                rss_mb=int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE / 1e6,
                inputs=[s.topic for s in inputs],
                input_rates_hz=np.array([s.stats.rate_hz(now) for s in inputs], np.float32),
                input_ages_s=np.array([s.stats.age_s(now) for s in inputs], np.float32),
                input_lost=np.array([s.stats.lost for s in inputs], np.uint64),
                lost_topics=[topic for topic, _, _ in losses],
                lost_publishers=[other for _, other, _ in losses],
                lost_counts=np.array([count for _, _, count in losses], np.uint64),
                outputs=[p.topic for p in outputs],
                output_rates_hz=np.array([p.stats.rate_hz(now) for p in outputs], np.float32),
                output_ages_s=np.array([p.stats.age_s(now) for p in outputs], np.float32),
            )
        )

    def _cpu_percent(self) -> float:
        """Return the load since the last call, in percent of one core."""
        (before_cpu_s, before_s), self._load = self._load, (time.process_time(), time.monotonic())
        return 100.0 * (self._load[0] - before_cpu_s) / max(self._load[1] - before_s, 1e-3)

    def publish_diagnostics(self) -> None:
        """Publish the node's diagnoses and those of its topics."""
        node = self._node
        flows: list[Diagnosis] = []
        now, report_ns = node.clock.steady_ns(), time.monotonic_ns()
        for subscription in node.subscriptions:
            stats, topic = subscription.raw.stats, subscription.raw.topic
            values = {"rate_hz": round(stats.rate_hz(now), 2), "age_s": round(stats.age_s(now), 3)}
            flows += self._flows.input(topic, stats, values, report_ns)
        for publisher in node.publishers:
            flows += self._flows.output(publisher.topic, publisher.raw.stats, report_ns)
        found = dict(node.diagnostics.present)
        found |= {flow.name: (int(flow.level), flow.text, dict(flow.values)) for flow in flows}
        status, key_value = message_type("DiagnosticStatus"), message_type("diagnostic_msgs/KeyValue")
        entries = [
            status(
                level=level,
                name=f"{node.node_name}: {name}",
                message=text,
                hardware_id="",
                values=[key_value(key=str(key), value=str(value)) for key, value in values.items()],
            )
            for name, (level, text, values) in found.items()
        ]
        self.diagnostics.publish(message_type("DiagnosticArray")(header=header("", time.time_ns()), status=entries))


def set_log_level(node_name: str, level: str) -> None:
    """Set the log level of a node and the library: ``debug``, ``info``, ``warning`` or ``error``."""
    for logger in _loggers(node_name):
        logger.setLevel(level.upper())


def _loggers(node_name: str) -> tuple[logging.Logger, logging.Logger]:
    """Return the node's own logger and the library's, which carries no node name."""
    return logging.getLogger(node_name), logging.getLogger("instant_ic")


class _RosoutHandler(logging.Handler):
    """Publishes a node's log records on ``/rosout``."""

    _LEVELS: ClassVar = {logging.DEBUG: 10, logging.INFO: 20, logging.WARNING: 30, logging.ERROR: 40}

    def __init__(self, node_name: str, rosout: Publisher) -> None:
        super().__init__()
        self._node_name = node_name
        self._rosout = rosout
        self._log_type = message_type("Log")

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._rosout.publish(
                self._log_type(
                    stamp=to_time(int(record.created * 1e9)),
                    level=self._LEVELS.get(record.levelno, 50),
                    name=self._node_name,
                    msg=masked(record.getMessage()).encode(errors="replace").decode(),
                    file=record.pathname,
                    function=record.funcName or "",
                    line=record.lineno,
                )
            )
        except Exception:  # noqa: BLE001 - a bad log line must not end the callback that wrote it
            self.handleError(record)
