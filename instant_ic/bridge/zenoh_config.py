"""Parameters of the node ``zenoh_gateway``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from instant_ic.bridge.commands import COMMANDS, CommandLimits
from instant_ic.bridge.zenoh_topics import Namespace, parse_publish
from instant_ic.bus import registry
from instant_ic.config.ranges import Range, check_ranges


@dataclass(frozen=True)
class ZenohGatewayConfig:
    """Parameters.

    Attributes:
        namespace: the robot's name in the fleet; ``/scan`` here is ``/robot1/scan`` there. Empty: names stay.
        domain: ROS domain (``ROS_DOMAIN_ID``).
        mode: peer: of a router on this host, as rmw_zenoh; client: of a router elsewhere.
        connect: routers to connect to; empty: tcp/localhost:7447, or those of the session file.
        session_file: Zenoh configuration (JSON5), path or file of config/, which replaces mode; empty: none.
        publish: topics to send: NAME or PATTERN, optionally followed by rate_hz=N for at most N messages per second.
        subscribe: topics to receive, names or patterns.
        commands: operators' commands to accept: /operator/cmd_vel, /operator/estop. Only over TLS with certificates on
            both sides (session_file); without it only pressing the emergency stop.
        insecure_loopback_commands: accept commands without TLS where every link stays within this machine, as in a
            simulation; anybody who can run a program on it can then drive. Refused beside a real base.
        unprotected: allows it beside a real base, with a permanent warning.
        limits: limits on the commands.
        discovery_period_s: seconds between searches for new and removed topics.
    """

    namespace: str = ""
    domain: Annotated[int, Range(0, 232)] = 0
    mode: Literal["peer", "client"] = "peer"
    connect: tuple[str, ...] = ()
    session_file: str = ""
    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()
    insecure_loopback_commands: bool = False
    unprotected: bool = False
    limits: CommandLimits = field(default_factory=CommandLimits)
    discovery_period_s: Annotated[float, Range(0.05, 10)] = 0.2

    def __post_init__(self) -> None:
        check_ranges(self)
        parse_publish(self.publish)
        try:
            Namespace(self.namespace)
        except registry.RegistryError:
            raise ValueError(f"namespace {self.namespace!r} must look like robot1 or fleet/robot1") from None
        if unknown := set(self.commands) - set(COMMANDS):
            raise ValueError(f"commands may only hold {', '.join(COMMANDS)} (got {', '.join(sorted(unknown))})")
