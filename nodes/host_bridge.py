"""Carries topics between two machines over one encrypted TCP connection: the robot listens, stations connect."""

from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from instant_ic.base.recent import RecentCount
from instant_ic.bridge.host_bus import ExportedTopics, ImportedTopics
from instant_ic.bridge.host_connector import ConnectingLink
from instant_ic.bridge.host_keys import KeyFileError, KeyStore
from instant_ic.bridge.host_link import (
    Failed,
    HostLink,
    LinkError,
    LinkEvent,
    PeerStatus,
    Problem,
    Stranger,
    check_endpoint,
)
from instant_ic.bridge.host_listener import ListeningLink
from instant_ic.bridge.host_session import Announced, Arrived, ClockStepped, Ended, LinkTimes, Refused, Side, Up
from instant_ic.bridge.host_topics import TopicCounts, parse_rules
from instant_ic.bus import ERROR, OK, WARN, Node, NodeError, main
from instant_ic.config.ranges import Positive, check_ranges
from instant_ic.msg import type_hash

LOOK_S = 0.5
LATE_READERS_S = 0.1
RECENT_S = 10.0
UNLISTED = "of no list"


@dataclass(frozen=True)
class HostBridgeConfig:
    """Parameters.

    Attributes:
        listen: robot: tcp://0.0.0.0:7450.
        connect: station: tcp://ADDRESS:7450.
        peer: station: name of the robot among the allowed hosts; empty: the only one.
        keys: key folder; empty: $XDG_CONFIG_HOME/instant_ic/keys.
        driver: robot: host that drives; empty: the first driver connected, until it leaves.
        max_offset_ms: ms; clock offset between the hosts above which the bridge warns.
        to_station: topics that the robot sends, one per line (form: docs/bridge.md).
        to_robot: topics that a station sends; not /cmd_vel, which only the arbiter publishes.
    """

    listen: str = ""
    connect: str = ""
    peer: str = ""
    keys: str = ""
    driver: str = ""
    max_offset_ms: Positive = 50.0
    link: LinkTimes = field(default_factory=LinkTimes)
    to_station: tuple[str, ...] = ()
    to_robot: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_ranges(self)
        if bool(self.listen) == bool(self.connect):
            raise ValueError("one of listen (on the robot) and connect (at the station) must be given, not both")
        try:
            check_endpoint(self.listen or self.connect, listening=bool(self.listen))
        except LinkError as error:
            raise ValueError(f"{'listen' if self.listen else 'connect'}: {error}") from None
        for key in ("to_station", "to_robot"):
            try:
                parse_rules(getattr(self, key))
            except ValueError as error:
                raise ValueError(f"{key}: {error}") from None
        if not self.to_station and not self.to_robot:
            raise ValueError("to_station and to_robot are empty: give --params-file config/bridge.yaml")


class HostBridgeNode(Node[HostBridgeConfig]):
    """Connects a :class:`HostLink` to this host's topics and reports the state of the link."""

    name = "host_bridge"
    live_parameters = ("driver", "max_offset_ms")
    link: HostLink | None = None

    def setup(self) -> None:
        config = self.config
        if self.lockstep or self.run_dir is None:
            raise NodeError("the bridge needs the real bus: in replay there is no other machine")
        listening = bool(config.listen)
        to_station, to_robot = parse_rules(config.to_station), parse_rules(config.to_robot)
        exports, imports = (to_station, to_robot) if listening else (to_robot, to_station)
        store = KeyStore(Path(config.keys).expanduser() if config.keys else None)
        self.incoming = ImportedTopics(self, imports, lambda topic, text: self.call_soon(self.trouble, topic, text))
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
        except (KeyFileError, LinkError) as error:
            raise NodeError(str(error)) from None
        self.outgoing = ExportedTopics(self, exports, self.link, self.trouble)
        self.problem = ""
        self.lost_link = ""
        self.strangers = RecentCount(RECENT_S)
        self.misses = RecentCount(RECENT_S)
        self.missed = 0
        self.clock_told: set[str] = set()
        self.next_step_s = 0.0
        self.troubled: set[str] = set()
        self.listed = {*to_station, *to_robot}
        self.outgoing.look()
        self.link.start()
        self.timer(LOOK_S, self.outgoing.look)
        self.timer(LATE_READERS_S, self.incoming.serve_late_readers)
        self.timer(1.0, self.tell)

    def teardown(self) -> None:
        if self.link is not None:
            self.link.stop()

    def reconfigure(self, config: HostBridgeConfig) -> None:
        """Apply a change of the driving host."""
        super().reconfigure(config)
        if isinstance(self.link, ListeningLink):
            self.link.wanted_driver = config.driver

    # -- from the link -----------------------------------------------------------------------------

    def on_event(self, event: LinkEvent) -> None:
        """Publish arriving messages at once, on the link's thread; pass all other events to the node's thread."""
        if isinstance(event.event, Arrived):
            self.incoming.take(event.event)
        elif isinstance(event.event, Announced):
            self.incoming.open(event.event.announce)
        else:
            self.call_soon(self.on_change, event.peer, event.event)

    def on_change(self, peer: str, event: Any) -> None:
        """Report new and lost links, and refused hosts."""
        match event:
            case Up():
                self.log.info("linked with %s", peer)
                for topic in self.troubled:
                    self.diagnose(f"topic {topic}", OK, "no fault since the newest link")
                self.troubled.clear()
                self.tell()
            case Ended():
                self.lost_link = f"the link with {peer} ended: {event.reason}"
                self.log.warning("%s", self.lost_link)
                self.tell()
            case Refused():
                where = "here" if event.here else f"by {peer}"
                self.trouble(event.topic, f"refused {where}: {event.reason}")
            case ClockStepped():
                if time.monotonic() >= self.next_step_s:  # a peer must not fill the disk
                    self.next_step_s = time.monotonic() + 1.0
                    self.log.warning("the clock of %s jumped by %+.3f s", peer, event.step_ns / 1e9)
            case Stranger():
                self.strangers.add(1, time.time_ns())
                self.log.warning(
                    "refused: %s, key %s, %d attempts since the last such line (allowed hosts: ic keys list)",
                    event.address,
                    event.fingerprint,
                    event.times,
                )
            case Failed():
                self.log.error("%s", event.text)
                self.stop()  # the launcher restarts it
            case Problem():
                self.problem = event.text
                self.tell()

    def trouble(self, topic: str, text: str) -> None:
        """Report a topic that is not transferred; topics on no list of this host share one diagnosis."""
        if topic not in self.listed:
            topic, text = UNLISTED, f"{topic}: {text}"
        self.troubled.add(topic)
        self.diagnose(f"topic {topic}", ERROR, text)

    # -- reports -------------------------------------------------------------------------------------

    def tell(self) -> None:
        """Report the state of the link, clocks, topics and strangers."""
        assert self.link is not None
        peers = self.link.peers()
        self.tell_link(peers)
        for peer in peers:
            if not math.isnan(peer.offset_ms):  # not yet known right after the handshake
                self.tell_clock(peer)
        for name in self.clock_told - {peer.name for peer in peers}:
            self.diagnose(f"clock of {name}", OK, "no link, not measured")
        self.clock_told = {peer.name for peer in peers}
        out, into = self.link.counts()
        bad = sum(counts.bad for counts in (*out.values(), *into.values()))
        self.misses.add(bad - self.missed, time.time_ns())
        self.missed = bad
        recent = self.misses.count(time.time_ns())
        text = f"{recent} messages missed in the last {RECENT_S:g} s" if recent else "nothing missed lately"
        self.diagnose("topics", WARN if recent else OK, text, **_numbers("out", out), **_numbers("in", into))
        if isinstance(self.link, ListeningLink):
            strangers = self.strangers.count(time.time_ns())
            text = "refused a host without an allowed key" if strangers else "no host refused recently"
            self.diagnose("door", WARN if strangers else OK, text, tries=self.link.strangers)

    def tell_link(self, peers: list[PeerStatus]) -> None:
        """Report which hosts are linked, or why none is."""
        if self.problem:
            self.diagnose("link", ERROR, self.problem)
        elif not peers:
            self.diagnose("link", WARN, self.lost_link or "no station is connected")
        else:
            notices = [text for peer in peers for text in peer.notices.values()]
            driver = next((peer.name for peer in peers if peer.drives), "nobody")
            words = ", ".join(f"{peer.name} ({peer.address}, {peer.rtt_ms:.1f} ms)" for peer in peers)
            if isinstance(self.link, ListeningLink):
                words += f"; {driver} drives"
            values = {f"{peer.name} {key}": value for peer in peers for key, value in _values(peer).items()}
            self.diagnose("link", WARN if notices else OK, "; ".join([f"linked with {words}", *notices]), **values)

    def tell_clock(self, peer: PeerStatus) -> None:
        """Report the offset of the other host's clock."""
        level, text = judge_clock(peer.offset_ms, peer.rtt_ms, self.config.max_offset_ms)
        values = {"offset_ms": peer.offset_ms, "rtt_ms": peer.rtt_ms, "jitter_ms": peer.jitter_ms}
        self.diagnose(f"clock of {peer.name}", level, text, **{key: round(value, 3) for key, value in values.items()})


def judge_clock(offset_ms: float, rtt_ms: float, max_offset_ms: float) -> tuple[int, str]:
    """Level and text for a clock that is ``offset_ms`` ahead: stamps in messages are not changed on the way."""
    text = f"{abs(offset_ms):.1f} ms {'ahead of' if offset_ms > 0 else 'behind'} this one"
    if abs(offset_ms) <= max_offset_ms + rtt_ms / 2:  # half the round trip is uncertainty
        return OK, text
    return WARN, f"{text}, more than {max_offset_ms:g} ms: run chrony on both (sudo apt install chrony)"


def _values(peer: PeerStatus) -> dict[str, Any]:
    return {
        "role": peer.role,
        "fingerprint": peer.fingerprint,
        "up_s": round(peer.up_s, 1),
        "rtt_ms": round(peer.rtt_ms, 3),
        "window_bytes": peer.window_bytes,
    }


def _numbers(direction: str, topics: dict[str, TopicCounts]) -> dict[str, str]:
    """One line per topic: what was transferred, and why the rest was not."""
    lines = {}
    for topic, counts in sorted(topics.items()):
        words = [f"{counts.messages} messages", f"{counts.bytes} bytes"]
        for name in ("thinned", "superseded", "expired", "overflowed", "lost", "not_driving"):
            if number := getattr(counts, name):
                words.append(f"{number} {name.replace('_', ' ')}")
        lines[f"{direction} {topic}"] = ", ".join(words)
    return lines


if __name__ == "__main__":
    main(HostBridgeNode)
