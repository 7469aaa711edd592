"""Faults and CPU of the nodes for the operator: diagnoses and missing heartbeats."""

from __future__ import annotations

import math
from typing import Any

from instant_ic.bus.clock import Clock
from instant_ic.msg import DiagnosticArray, NodeStatus

TIMEOUT_S = 3.0
MAX_FAULTS = 4
MOST_NAMES = 500  # largest number of nodes, and of diagnoses; those of other machines count too
OK, WARN, ERROR = 0, 1, 2  # diagnostic_msgs/DiagnosticStatus


class FaultList:
    """Newest diagnoses and heartbeats."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._diagnoses: dict[str, tuple[int, str, float]] = {}
        self._heartbeats: dict[str, tuple[float, NodeStatus]] = {}  # of nodes that have not announced their shutdown

    @property
    def _now_s(self) -> float:
        return self._clock.steady_ns() / 1e9

    def nodes(self) -> list[dict[str, Any]]:
        """Return the running nodes: ``name``, and ``cpu_percent`` of one core."""
        return [
            {"name": name, "cpu_percent": round(float(self._heartbeats[name][1].cpu_percent), 1)}
            for name in sorted(self._heartbeats)
            if self._now_s - self._heartbeats[name][0] <= TIMEOUT_S
            and math.isfinite(self._heartbeats[name][1].cpu_percent)  # JSON has no other numbers
        ]

    def take_diagnoses(self, message: DiagnosticArray) -> None:
        """Store the newest diagnosis of each name."""
        now_s = self._now_s
        for status in message.status:
            if status.name not in self._diagnoses and len(self._diagnoses) >= MOST_NAMES:
                self._diagnoses = {n: found for n, found in self._diagnoses.items() if now_s - found[2] < TIMEOUT_S}
                if len(self._diagnoses) >= MOST_NAMES:
                    return
            self._diagnoses[status.name] = (int(status.level), status.message, now_s)

    def take_heartbeat(self, message: NodeStatus) -> None:
        """Note a node's heartbeat. A node that announced its shutdown does not count as missing."""
        if int(message.state) == NodeStatus.STOPPING:
            self._heartbeats.pop(message.node, None)
        elif message.node in self._heartbeats or len(self._heartbeats) < MOST_NAMES:
            self._heartbeats[message.node] = self._now_s, message

    def worst(self) -> list[dict[str, str]]:
        """Return the worst present fault of each node, worst first: ``level`` (warn, error), ``name``, ``text``."""
        now_s = self._now_s
        found = [
            (level, name.partition(":")[0], text)
            for name, (level, text, seen_s) in self._diagnoses.items()
            if level >= WARN and now_s - seen_s < TIMEOUT_S
        ]
        found += [
            (ERROR, name, "does not answer")
            for name, (seen_s, _) in self._heartbeats.items()
            if now_s - seen_s > TIMEOUT_S
        ]
        worst: dict[str, tuple[int, str]] = {}
        for level, name, text in sorted(found, key=lambda fault: -fault[0]):
            worst.setdefault(name, (level, text))
        return [
            {"level": "error" if level >= ERROR else "warn", "name": name, "text": text}
            for name, (level, text) in list(worst.items())[:MAX_FAULTS]
        ]
