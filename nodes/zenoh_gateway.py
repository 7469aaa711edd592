"""Publishes topics to Zenoh as ROS 2 topics (rmw_zenoh's format), byte for byte, and subscribes to topics there."""

from __future__ import annotations

from typing import Any

from instant_ic.bridge.zenoh_config import ZenohGatewayConfig
from instant_ic.bridge.zenoh_incoming import Incoming, topic_counts
from instant_ic.bridge.zenoh_outgoing import Outgoing
from instant_ic.bridge.zenoh_security import command_security
from instant_ic.bridge.zenoh_session import (
    CLIENT_DEFAULTS,
    SESSION_DEFAULTS,
    RosNode,
    RosSession,
    ZenohError,
    config_path,
    is_client,
    load_config,
)
from instant_ic.bridge.zenoh_topics import Namespace, parse_subscribe
from instant_ic.bus import ERROR, OK, WARN, Node, NodeError, main, registry
from instant_ic.bus.registry import TopicWatch
from instant_ic.msg import MessageError

_AGAIN_S = 2.0


class ZenohGatewayNode(Node[ZenohGatewayConfig]):
    """Discovers topics on both sides, reports counts and losses."""

    name = "zenoh_gateway"
    session: RosSession | None = None
    _zenoh: Any
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
            parse_subscribe(config.subscribe)
            defaults = CLIENT_DEFAULTS if config.mode == "client" else SESSION_DEFAULTS
            self._zenoh = load_config(config_path(config.session_file), config.connect, defaults=defaults)
            client = is_client(self._zenoh)
            if config.commands:
                level, text = command_security(self._zenoh, config.insecure_loopback_commands)
                self.diagnose("commands", level, text)
                self._no_commands = text if level == ERROR else ""
            if not client:
                self.opened(RosSession(self._zenoh, config.domain))
        except (ZenohError, MessageError, FileNotFoundError, registry.RegistryError) as error:
            raise NodeError(str(error)) from None
        if client:  # its router may start later
            self._opener = self.background(self.open, self.opened)
            self._opener.submit(None)
            self.timer(_AGAIN_S, self.try_again)
        self.timer(config.discovery_period_s, self.look)
        self.timer(1.0, self.report)

    def open(self, _: None) -> RosSession | ZenohError:
        """Try to reach the router (background thread)."""
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
        config, namespace = self.config, Namespace(self.config.namespace)
        self.session = session
        own = RosNode(session, namespace.ros, self.node_name)
        self.outgoing = Outgoing(self, session, namespace, own, config.publish)
        self.incoming = Incoming(self, namespace, own, config.subscribe, config.commands, self.gate, self._no_commands)
        self.outgoing.brought_in = self.incoming.wants
        session.watch(self.incoming.on_token)
        self.look()

    def try_again(self) -> None:
        if self.session is None and not self._opener.busy:
            self._opener.submit(None)

    def look(self) -> None:
        if self.session is None:
            return
        self.outgoing.reconcile(self._watch.topics())
        self.incoming.reconcile()

    def report(self) -> None:
        if self.session is None:
            return
        routers, peers = self.session.routers(), self.session.peers()
        if routers or peers:
            self.diagnose("link", OK, f"{len(routers)} routers, {len(peers)} peers")
        else:
            where = ", ".join(self.config.connect) or self.config.session_file or "tcp/localhost:7447"
            self.diagnose("link", WARN, f"no router answers at {where}: is it running? (ic run zenoh_router)")
        text, lost, values = topic_counts(self.outgoing, self.incoming)
        level = WARN if lost > self._lost else OK
        self._lost = lost
        refused = {f"refused: {verdict.name.lower()}": count for verdict, count in self.gate.refused.items()}
        self.diagnose("topics", level, text, **values, **refused)

    def teardown(self) -> None:
        if self.session is not None:
            self.session.close()


if __name__ == "__main__":
    main(ZenohGatewayNode)
