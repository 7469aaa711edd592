"""Rules between the parameters of the nodes of one robot. Each node's own rules are in its configuration."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

RELATED = (
    "arbiter",
    "crawler_base",
    "navigator",
    "virtual_robot",
    "console",
    "foxglove_bridge",
    "zenoh_gateway",
    "vlp16_driver",
)
"""Nodes whose parameters must agree."""
_MISSED = 2
"""Number of messages that a time-out must span."""


@dataclass(frozen=True)
class Driving:
    """A node that takes part in driving.

    Attributes:
        at: place of the node, such as ``launch/full.yaml:12``.
        config: configuration of the node.
        meant: keys that may differ from other nodes, because the node's own entry of the launch file sets them, or
            because they have been compared with a ``/**`` section already.
    """

    at: str
    config: Any
    meant: Collection[str] = ()

    def value(self, key: str) -> Any:
        """Return the value of a dotted key; None if the node has no such parameter."""
        found = self.config
        for name in key.split("."):
            found = getattr(found, name, None)
        return found


_SAME = tuple(
    f"limits.max_{kind}" for kind in ("linear_m_s", "angular_rad_s", "linear_accel_m_s2", "angular_accel_rad_s2")
) + ("footprint.length_m", "footprint.width_m")
_SPANS = (
    ("crawler_base", "command_timeout_s", "arbiter", "rate_hz", 10.0),  # at rest the arbiter sends at most 10 a second
    ("arbiter", "timeouts.nav", "navigator", "controller_frequency", 1e9),
    ("arbiter", "timeouts.vbot", "virtual_robot", "rate_hz", 1e9),
    ("arbiter", "timeouts.odometry", "crawler_base", "rate_hz", 1e9),
    ("arbiter", "timeouts.command", "console", "server.drive.keep_alive_hz", 1e9),
    ("arbiter", "timeouts.command", "console", "server.drive.rate_hz", 1e9),
    ("navigator", "state_timeout_s", "arbiter", "rate_hz", 1e9),
    ("virtual_robot", "state_timeout_s", "arbiter", "rate_hz", 1e9),
)
"""Node and time-out, and the node and rate of the messages that the time-out must span; the number limits the rate."""

_SIMULATED = (
    ("console", "server.access.simulated"),
    ("foxglove_bridge", "simulated"),
    ("zenoh_gateway", "insecure_loopback_commands"),
)
"""Nodes that admit operators, and the parameter that opens them to all users of the machine."""


def disagreements(robot: Mapping[str, Sequence[Driving]]) -> Iterator[str]:
    """Yield a text for each contradiction between the nodes of one robot.

    Args:
        robot: name → the nodes of that name with their configurations; nodes outside the launch file are missing.
    """
    found = (_between(dict(zip(robot, nodes, strict=True))) for nodes in itertools.product(*robot.values()))
    yield from dict.fromkeys(itertools.chain.from_iterable(found))


def _between(robot: Mapping[str, Driving]) -> Iterator[str]:
    for key in _SAME:
        yield from _differing(robot, key)
    for name, timeout, source, rate, most_hz in _SPANS:
        if name in robot and source in robot:
            node, hz = robot[name], min(robot[source].value(rate), most_hz)
            if node.value(timeout) * hz < _MISSED:
                yield (
                    f"{node.at}: node {name}: {timeout} must span {_MISSED} messages of {source}: "
                    f"{_MISSED / hz:.2g} s at {rate} {hz:g} (got {node.value(timeout)})"
                )
    if (arbiter := robot.get("arbiter")) and (console := robot.get("console")):
        key, longest_s = "server.drive.stop_after_s", arbiter.value("timeouts.stop_after_s")
        if console.value(key) > longest_s:
            rule = f"{key} must be at most the arbiter's timeouts.stop_after_s = {longest_s} s"
            yield f"{console.at}: node console: {rule} (got {console.value(key)})"
    yield from _open_doors(robot)
    if (arbiter := robot.get("arbiter")) and (lidar := robot.get("vlp16_driver")):
        blind_m = arbiter.value("collision_monitor.blind_radius_m")
        for key in ("decoder.min_range", "scan.range_min"):
            if blind_m and lidar.value(key) > blind_m:
                rule = f"{key} must be at most the arbiter's collision_monitor.blind_radius_m = {blind_m} m"
                yield f"{lidar.at}: node vlp16_driver: {rule}: nearer things are forgotten (got {lidar.value(key)})"
    if (arbiter := robot.get("arbiter")) and (base := robot.get("crawler_base")):
        tracks, width = base.value("geometry.track_width"), arbiter.value("footprint.width_m")
        if tracks > width:
            rule = f"geometry.track_width must be within footprint.width_m {width}"
            yield f"{base.at}: node crawler_base: {rule} (got {tracks})"


def _open_doors(robot: Mapping[str, Driving]) -> Iterator[str]:
    """Yield a text for each node that admits operators without a token although the base drives a real robot."""
    port = robot["crawler_base"].value("roboclaw.port") if "crawler_base" in robot else ""
    if not port.startswith("/dev/") or port.startswith("/dev/shm/"):  # the simulator's is in its run directory
        return
    for name, key in _SIMULATED:
        if name in robot and robot[name].value(key) and not (meant := robot[name].value("unprotected")):
            yield (
                f"{robot[name].at}: node {name}: {key} is true, but crawler_base drives {port}: any user of this "
                f"machine could drive the robot. Set it to false{'' if meant is None else ', or unprotected to true'}"
            )


def _differing(robot: Mapping[str, Driving], key: str) -> Iterator[str]:
    having = {name: node for name, node in robot.items() if node.value(key) is not None and key not in node.meant}
    first = next(iter(having), "")
    for name, node in having.items():
        wanted = having[first].value(key)
        if node.value(key) != wanted:
            yield (
                f"{node.at}: node {name}: {key} is {node.value(key)}, but {wanted} in node {first}: set it for all "
                "nodes in the /** section of one file"
            )
