"""Publishes topics to Zenoh as ROS 2 topics (rmw_zenoh's format), byte for byte, and subscribes to topics there."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from instant_ic.bridge.commands import COMMANDS, CommandLimits
from instant_ic.bridge.zenoh_incoming import Incoming, check_subscribe
from instant_ic.bridge.zenoh_outgoing import Outgoing, parse_publish
from instant_ic.bridge.zenoh_security import command_security
from instant_ic.bridge.zenoh_session import (
    CLIENT_DEFAULTS,
    DEFAULT_ROUTER,
    SESSION_DEFAULTS,
    RosNode,
    RosSession,
    ZenohError,
    load_config,
)
from instant_ic.bus import ERROR, OK, WARN, Node, NodeError, main, registry
from instant_ic.bus.registry import TopicWatch
from instant_ic.config.ranges import Range, check_ranges

RETRY_S = 2.0
"""Seconds between attempts of a client to reach its router."""

_LOOK_S = 0.2  # between searches for new and removed topics


@dataclass(frozen=True)
class ZenohGatewayConfig:
    """Parameters.

    Attributes:
        namespace: name of the robot in the fleet, so that ``/scan`` here is ``/robot1/scan`` there; empty keeps names.
        domain: ROS domain (``ROS_DOMAIN_ID``).
        mode: peer joins through a router on this host, as rmw_zenoh does; client connects to a router elsewhere.
        connect: routers to connect to; empty: tcp/localhost:7447, or the routers of the session file.
        session_file: Zenoh configuration (JSON5), as a path or a file of config/, which replaces mode; empty: none.
        publish: topics to send: NAME or PATTERN, optionally followed by rate_hz=N for at most N messages per second.
        subscribe: topics to receive, names or patterns.
        commands: operators' commands to accept: /operator/cmd_vel, /operator/estop. Only over TLS with certificates on
            both sides (session_file). Without TLS, only pressing the emergency stop is accepted.
        insecure_loopback_commands: accept commands without TLS if every link stays within this machine, as in a
            simulation. Anybody who can run a program on it can then drive. Refused beside a real base.
        unprotected: allow ``insecure_loopback_commands`` beside a real base, with a permanent warning.
        limits: limits on the commands.
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

    def __post_init__(self) -> None:
        check_ranges(self)
        parse_publish(self.publish)
        check_subscribe(self.subscribe)
        try:
            registry.check_topic(self.prefix or "/none")
        except registry.RegistryError:
            raise ValueError(f"namespace {self.namespace!r} must look like robot1 or fleet/robot1") from None
        if unknown := set(self.commands) - set(COMMANDS):
            raise ValueError(f"commands may only hold {', '.join(COMMANDS)} (got {', '.join(sorted(unknown))})")

    @property
    def prefix(self) -> str:
        """Text before the names of topics in the ROS graph: ``/robot1``; empty without a namespace."""
        return f"/{self.namespace}" if self.namespace else ""


class ZenohGatewayNode(Node[ZenohGatewayConfig]):
    """Node that finds topics on both sides, passes their messages, and reports counts and losses."""

    name = "zenoh_gateway"
    session: RosSession | None = None
    _no_commands = ""

    def setup(self) -> None:
        if self.run_dir is None:
            raise NodeError("the gateway needs the real bus and a real Zenoh session: it cannot run in lockstep")
        if self.namespace:
            raise NodeError(
                f"--namespace {self.namespace}: to set the names in Zenoh, use the parameter namespace instead"
            )
        config = self.config
        self.gate = config.limits.gate()
        self._watch = TopicWatch(self.run_dir)
        self._lost = 0
        try:
            defaults = CLIENT_DEFAULTS if config.mode == "client" else SESSION_DEFAULTS
            self._zenoh: Any = load_config(config.session_file, config.connect, defaults=defaults)
            if config.commands:
                level, text = command_security(self._zenoh, config.insecure_loopback_commands)
                self.diagnose("commands", level, text)
                self._no_commands = text if level == ERROR else ""
            if json.loads(self._zenoh.get_json("mode")) != "client":
                self.connect(RosSession(self._zenoh, config.domain))
        except ZenohError as error:
            raise NodeError(str(error)) from None
        if self.session is None:  # the router may start later
            self._opener = self.background(self.open, self.opened)
            self._opener.submit(None)
            self.timer(RETRY_S, self.try_again)
        self.timer(_LOOK_S, self.look)
        self.timer(1.0, self.report)

    def open(self, _: None) -> RosSession | ZenohError:
        """Try to reach the router, on a background thread."""
        try:
            return RosSession(self._zenoh, self.config.domain)
        except ZenohError as error:
            return error

    def opened(self, session: RosSession | ZenohError) -> None:
        if isinstance(session, ZenohError):
            self.diagnose("link", WARN, f"{session}; trying again (is the router running? ic run zenoh_router)")
            return
        if self.stopping:
            session.close()
            return
        try:
            self.connect(session)
        except registry.RegistryError as error:
            self.diagnose("link", WARN, f"{error}; trying again")

    def connect(self, session: RosSession) -> None:
        """Set up the topics in a session; close the session if that fails."""
        config = self.config
        try:
            own = RosNode(session, config.prefix or "/", self.node_name)
            incoming = Incoming(
                self, own, config.prefix, config.subscribe, config.commands, self.gate, self._no_commands
            )
            outgoing = Outgoing(self, own, config.prefix, config.publish, incoming.wants)
            session.watch(incoming.on_token)
        except Exception:
            session.close()
            raise
        self.session, self.incoming, self.outgoing = session, incoming, outgoing
        self.look()

    def try_again(self) -> None:
        if self.session is None and not self._opener.busy:
            self._opener.submit(None)

    def look(self) -> None:
        if self.session is not None:
            self.outgoing.reconcile(self._watch.topics())
            self.incoming.reconcile()

    def report(self) -> None:
        if self.session is None:
            return
        routers, peers = self.session.links()
        if routers or peers:
            self.diagnose("link", OK, f"{routers} routers, {peers} peers")
        else:
            where = ", ".join(self.config.connect) or self.config.session_file or DEFAULT_ROUTER
            self.diagnose("link", WARN, f"no router answers at {where}: is it running? (ic run zenoh_router)")
        outgoing, incoming, lost = self.outgoing, self.incoming, self.incoming.lost()
        text = f"{outgoing.count} messages out on {len(outgoing.topics)} topics, "
        text += f"{incoming.count} in on {len(incoming.topics)}"
        if lost:
            text += f"; lost: {', '.join(f'{topic} {count}' for topic, count in lost.items())}"
        level = WARN if sum(lost.values()) > self._lost else OK
        self._lost = sum(lost.values())
        refused = {f"refused: {verdict.name.lower()}": count for verdict, count in self.gate.refused.items()}
        counts = {"thinned": outgoing.thinned, "malformed": incoming.malformed(), **refused}
        self.diagnose("topics", level, text, **counts)

    def teardown(self) -> None:
        if self.session is not None:
            self.session.close()


if __name__ == "__main__":
    main(ZenohGatewayNode)
