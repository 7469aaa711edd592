"""Diagnostics of the link between two machines: hosts, clocks, topics, refused hosts."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from instant_ic.bridge.host_link import HostLink, PeerStatus
from instant_ic.bridge.host_listener import ListeningLink
from instant_ic.bridge.host_topics import TopicCounts
from instant_ic.bus import ERROR, OK, WARN
from instant_ic.util.diagnosis import RecentCount

RECENT_S = 10.0
UNLISTED = "of no list"


class LinkReport:
    """Turns the state of a link into diagnoses.

    Args:
        diagnose: sets a diagnosis, as :meth:`Node.diagnose`.
        listed: topics on this host's lists.

    Attributes:
        problem: reason why no link is possible; empty if there is none.
        lost_link: text on how the last link ended.
    """

    def __init__(self, link: HostLink, diagnose: Callable[..., None], listed: set[str]) -> None:
        self.problem = ""
        self.lost_link = ""
        self._link, self._diagnose, self._listed = link, diagnose, listed
        self._strangers = RecentCount(RECENT_S)
        self._misses = RecentCount(RECENT_S)
        self._clocks: set[str] = set()
        self._troubled: set[str] = set()

    def trouble(self, topic: str, text: str) -> None:
        """Report a topic that is not transferred; topics on no list of this host share one diagnosis."""
        if topic not in self._listed:
            topic, text = UNLISTED, f"{topic}: {text}"
        self._troubled.add(topic)
        self._diagnose(f"topic {topic}", ERROR, text)

    def clear_troubles(self) -> None:
        """Withdraw the reports on topics after a reconnect."""
        for topic in self._troubled:
            self._diagnose(f"topic {topic}", OK, "no fault since the newest link")
        self._troubled.clear()

    def stranger(self) -> None:
        """Count a refused host."""
        self._strangers.add(1, time.monotonic_ns())

    def update(self, max_offset_ms: float) -> None:
        """Report link, clocks, topics and refused hosts."""
        peers = self._link.peers()
        self._report_link(peers)
        for peer in peers:
            if not math.isnan(peer.offset_ms):  # not yet known right after the handshake
                level, text = judge_clock(peer.offset_ms, peer.rtt_ms, max_offset_ms)
                values = {"offset_ms": peer.offset_ms, "rtt_ms": peer.rtt_ms, "jitter_ms": peer.jitter_ms}
                rounded = {key: round(value, 3) for key, value in values.items()}
                self._diagnose(f"clock of {peer.name}", level, text, **rounded)
        for name in self._clocks - {peer.name for peer in peers}:
            self._diagnose(f"clock of {name}", OK, "no link, not measured")
        self._clocks = {peer.name for peer in peers}
        out, into = self._link.counts()
        bad = sum(counts.bad for counts in (*out.values(), *into.values()))
        recent = self._misses.rise(bad, time.monotonic_ns())
        text = f"{recent} messages missed in the last {RECENT_S:g} s" if recent else "nothing missed lately"
        self._diagnose("topics", WARN if recent else OK, text, **_counts("out", out), **_counts("in", into))
        if isinstance(self._link, ListeningLink):
            strangers = self._strangers.count(time.monotonic_ns())
            text = "refused a host without an allowed key" if strangers else "no host refused recently"
            self._diagnose("door", WARN if strangers else OK, text, tries=self._link.strangers)

    def _report_link(self, peers: list[PeerStatus]) -> None:
        if self.problem:
            self._diagnose("link", ERROR, self.problem)
        elif not peers:
            self._diagnose("link", WARN, self.lost_link or "no station is connected")
        else:
            notices = [text for peer in peers for text in peer.notices.values()]
            driver = next((peer.name for peer in peers if peer.drives), "nobody")
            hosts = ", ".join(f"{peer.name} ({peer.address}, {peer.rtt_ms:.1f} ms)" for peer in peers)
            if isinstance(self._link, ListeningLink):
                hosts += f"; {driver} drives"
            values = {f"{peer.name} {key}": value for peer in peers for key, value in _values(peer).items()}
            self._diagnose("link", WARN if notices else OK, "; ".join([f"linked with {hosts}", *notices]), **values)


def judge_clock(offset_ms: float, rtt_ms: float, max_offset_ms: float) -> tuple[int, str]:
    """Return level and text for a clock that is ``offset_ms`` ahead; the link does not convert stamps in messages."""
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


def _counts(direction: str, topics: dict[str, TopicCounts]) -> dict[str, str]:
    """Return a line per topic: messages that were transferred, and why others were not."""
    lines = {}
    for topic, counts in sorted(topics.items()):
        parts = [f"{counts.messages} messages", f"{counts.bytes} bytes"]
        missed = {name: number for name, number in vars(counts).items() if name not in ("messages", "bytes")}
        parts += [f"{number} {name.replace('_', ' ')}" for name, number in missed.items() if number]
        lines[f"{direction} {topic}"] = ", ".join(parts)
    return lines
