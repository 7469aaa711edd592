"""Serves topics, parameters and the graph to Foxglove; forwards unchanged bytes, only of subscribed topics."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Annotated

from instant_ic.bag.choice import TopicChoice
from instant_ic.bridge.commands import CommandLimits
from instant_ic.bridge.foxglove_server import FoxgloveError, FoxgloveServer, ServerConfig
from instant_ic.bus import OK, WARN, Node, NodeError, main, registry
from instant_ic.bus.registry import TopicWatch
from instant_ic.config.ranges import Range
from instant_ic.util.diagnosis import RecentCount
from instant_ic.util.paths import sign_in_file
from instant_ic.util.web_access import AccessError, is_loopback, offer_sign_in

_TIME_S = 0.05
REFUSED_S = 10.0  # a refusal is a warning for this long
_LEAST_S = 0.02


@dataclass(frozen=True)
class FoxgloveBridgeConfig(ServerConfig):
    """Parameters, in addition to those of the server.

    Attributes:
        topics: names or patterns of the topics to offer; empty offers all.
        exclude: names or patterns of the topics to leave out.
        limits: limits on the clients' commands.
        discovery_period_s: seconds between searches for new and removed topics.
    """

    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    limits: CommandLimits = field(default_factory=CommandLimits)
    discovery_period_s: Annotated[float, Range(0.05, 10)] = 0.25


class FoxgloveBridgeNode(Node[FoxgloveBridgeConfig]):
    """Watches the registry and forwards subscribed topics."""

    name = "foxglove_bridge"
    server: FoxgloveServer | None = None

    def setup(self) -> None:
        config = self.config
        if self.run_dir is None:
            raise NodeError("the bridge needs the real bus: it cannot run in lockstep")
        self.gate = config.limits.gate()
        self._watch = TopicWatch(self.run_dir)
        choice = TopicChoice(config.topics, config.exclude)
        try:
            self.server = FoxgloveServer(self, self.run_dir, config, choice.takes, self.gate, self.use_sim_time)
        except FoxgloveError as error:
            raise NodeError(str(error)) from None
        address = f"{'wss' if config.tls_cert else 'ws'}://{config.host}:{self.server.port}"
        self.log.info("Foxglove: open %s", address)
        self._offer_sign_in(address)
        local = is_loopback(config.host)
        if not self.server.token and not (config.simulated and local):
            may = ["drive the robot"] * config.accept_operator + ["change parameters"] * config.set_parameters
            what = " and ".join(may or ["read everything"])
            text = f"anyone who reaches {config.host}:{self.server.port} can {what}, because sign_in is never"
            self.diagnose("access", WARN, text)
        elif not (local or config.tls_cert):
            self.diagnose("access", WARN, "token and data go over the network unencrypted; set tls_cert and tls_key")
        self._refused = RecentCount(REFUSED_S)
        # A thread, not a timer: with simulated time the timers may stand still while messages already arrive.
        self._look_thread = threading.Thread(target=self._look, name="discovery", daemon=True)
        self._look_thread.start()

    def _offer_sign_in(self, address: str) -> None:
        assert self.server is not None and self.run_dir is not None
        file = sign_in_file(self.run_dir, self.node_name)
        file.unlink(missing_ok=True)  # left by a bridge that was killed
        if self.server.token:
            try:
                offer_sign_in(f"{address}/?token={self.server.token}", file)
            except AccessError as error:
                raise NodeError(str(error)) from None

    def _look(self) -> None:
        assert self.server is not None
        next_s, sent_ns = 0.0, 0
        while not self.stopping:
            now_s = time.monotonic()
            if now_s >= next_s or self.server.wake.is_set():
                next_s = now_s + self.config.discovery_period_s
                self.server.wake.clear()
                self.call_soon(self.reconcile)
                time.sleep(_LEAST_S)  # limits the cost of a client that connects and disconnects without end
            if self.use_sim_time and (now_ns := self.clock.now_ns()) != sent_ns:
                sent_ns = now_ns
                self.server.send_time(now_ns)
            self.server.wake.wait(_TIME_S if self.use_sim_time else max(next_s - time.monotonic(), 0.0))

    def reconcile(self) -> None:
        """Update the offered topics to the present topics, nodes and subscribers."""
        if self.server is None or self.run_dir is None or self.stopping:
            return
        nodes = registry.list_nodes(self.run_dir)
        self.server.parameters.nodes = tuple(node.name for node in nodes)
        self.server.reconcile(self._watch.topics(), nodes)
        refused = {f"refused: {verdict.name.lower()}": count for verdict, count in self.gate.refused.items()}
        text = f"{len(self.server.watched)} of {len(self.server.topics)} topics watched"
        self.diagnose(
            "topics",
            OK,
            text,
            messages=self.server.count,
            megabytes=self.server.bytes / 1e6,
            dropped=self.server.dropped,
            **refused,
        )
        if self.server.refused:
            lately = self._refused.rise(self.server.refused, time.monotonic_ns())
            text = f"refused: {self.server.refusal}" if lately else "nobody refused lately"
            self.diagnose("door", WARN if lately else OK, text, requests=self.server.refused)

    def teardown(self) -> None:
        if self.server is not None:
            self.server.wake.set()
            self._look_thread.join(2.0)
            self.server.close()
            if self.run_dir is not None:
                sign_in_file(self.run_dir, self.node_name).unlink(missing_ok=True)


if __name__ == "__main__":
    main(FoxgloveBridgeNode)
