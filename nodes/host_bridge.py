"""Carries topics between two machines over one encrypted TCP connection: the robot listens, stations connect."""

from __future__ import annotations

import functools
import os
import time
from pathlib import Path

from instant_ic.bridge.host_bus import ExportedTopics, ImportedTopics
from instant_ic.bridge.host_config import HostBridgeConfig
from instant_ic.bridge.host_connector import ConnectingLink
from instant_ic.bridge.host_keys import KeyFileError, KeyStore
from instant_ic.bridge.host_link import Failed, HostLink, HostLinkError, LinkEvent, LinkProblem, Stranger
from instant_ic.bridge.host_listener import ListeningLink
from instant_ic.bridge.host_report import LinkReport
from instant_ic.bridge.host_session import Announced, Arrived, ClockStepped, Ended, Refused, Side, Up
from instant_ic.bridge.host_topics import parse_rules
from instant_ic.bus import LATCHED, Latest, Node, NodeError, main
from instant_ic.msg import ControlState, type_hash

LOOK_S = 0.5
LATE_READERS_S = 0.1
STATE_S = 1.0


class HostBridgeNode(Node[HostBridgeConfig]):
    """Connects a :class:`HostLink` to this host's topics and reports the state of the link."""

    name = "host_bridge"
    live_parameters = ("driver", "max_offset_ms")
    link: HostLink | None = None
    state: Latest | None = None

    def setup(self) -> None:
        config = self.config
        if self.lockstep or self.run_dir is None:
            raise NodeError("the bridge needs the real bus: in replay there is no other machine")
        listening = bool(config.listen)
        to_station, to_robot = parse_rules(config.to_station), parse_rules(config.to_robot)
        exports, imports = (to_station, to_robot) if listening else (to_robot, to_station)
        store = KeyStore(Path(config.keys).expanduser() if config.keys else None)
        try:
            identity = store.identity()
            side = Side(identity.name, os.urandom(8).hex(), imports, type_hash)
            if listening:
                self.link = ListeningLink(config.listen, side, exports, store, self.on_event, config.link)
                self.link.wanted_driver = config.driver
                self.log.info("listens on %s as %s (%s)", self.link.endpoint, identity.name, identity.fingerprint)
            else:
                robot = store.peer(config.peer)
                self.link = ConnectingLink(config.connect, robot, side, exports, store, self.on_event, config.link)
                self.log.info("connects to %s at %s as %s", robot.name, config.connect, identity.name)
        except (KeyFileError, HostLinkError) as error:
            raise NodeError(str(error)) from None
        self.report = LinkReport(self.link, self.diagnose, {*to_station, *to_robot})
        self.outgoing = ExportedTopics(self, exports, self.link, self.report.trouble)
        on_trouble = functools.partial(self.call_soon, self.report.trouble)
        self.state = self.latest("/ic/state", ControlState, STATE_S, LATCHED) if listening else None
        self.incoming = ImportedTopics(self, imports, on_trouble, self.holder)
        self.next_step_s = 0.0
        self.outgoing.look()
        self.link.start()
        self.timer(LOOK_S, self.outgoing.look)
        self.timer(LATE_READERS_S, self.incoming.serve_late_readers)
        self.timer(1.0, self.update)

    def teardown(self) -> None:
        if self.link is not None:
            self.link.stop()

    def reconfigure(self, config: HostBridgeConfig) -> None:
        super().reconfigure(config)
        if isinstance(self.link, ListeningLink):
            self.link.wanted_driver = config.driver

    # -- from the link -----------------------------------------------------------------------------

    def on_event(self, peer: str, event: LinkEvent) -> None:
        """Publish arriving messages at once, on the link's thread; pass all other events to the node's thread."""
        if isinstance(event, Arrived):
            self.incoming.take(peer, event)
        elif isinstance(event, Announced):
            self.incoming.open(event.announce)
        else:
            self.call_soon(self.on_change, peer, event)

    def on_change(self, peer: str, event: LinkEvent) -> None:
        """Report new and lost links, and refused hosts."""
        match event:
            case Up():
                self.log.info("linked with %s", peer)
                self.report.clear_troubles()
                self.update()
            case Ended():
                self.report.lost_link = f"the link with {peer} ended: {event.reason}"
                self.log.warning("%s", self.report.lost_link)
                self.update()
            case Refused():
                where = "here" if event.here else f"by {peer}"
                self.report.trouble(event.topic, f"refused {where}: {event.reason}")
            case ClockStepped():
                if time.monotonic() >= self.next_step_s:  # a peer must not fill the disk
                    self.next_step_s = time.monotonic() + 1.0
                    self.log.warning("the clock of %s jumped by %+.3f s", peer, event.step_ns / 1e9)
            case Stranger():
                self.report.stranger()
                self.log.warning(
                    "refused: %s, key %s, %d attempts since the last such line (allowed hosts: ic keys list)",
                    event.address,
                    event.fingerprint,
                    event.times,
                )
            case Failed():
                self.log.error("%s", event.text)
                self.stop()  # the launcher restarts the node
            case LinkProblem():
                self.report.problem = event.text
                self.update()

    def holder(self) -> str:
        """Return the holder of the robot's lease; empty if there is none or /ic/state is stale. Any thread may call."""
        state = None if self.state is None else self.state.message
        return "" if state is None else str(state.holder)

    def update(self) -> None:
        self.report.update(self.config.max_offset_ms)


if __name__ == "__main__":
    main(HostBridgeNode)
