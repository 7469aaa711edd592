"""Selection of the node whose commands the base obeys, with a warning about every other publisher."""

from __future__ import annotations

from collections.abc import Callable

from instant_ic.base.config import CrawlerBaseConfig
from instant_ic.control.command_gate import CommandGate, GateLimits
from instant_ic.util.diagnosis import Diagnosis, Level, RecentCount


class CommandSource:
    """Decides which commands may drive; reports dropped commands and publishers that are not obeyed.

    Args:
        config: parameters.
        on_stranger: called once per publisher that is not obeyed, with its name.

    Attributes:
        driver: the obeyed node; with any source allowed, the last publisher.
        dropped: number of refused commands.
        publishers: diagnosis of nodes that publish commands but are not obeyed.
        command: diagnosis of the newest command; None before the first.
    """

    def __init__(self, config: CrawlerBaseConfig, on_stranger: Callable[[str], None]) -> None:
        self.config = config
        self.driver = config.command_source
        self.dropped = 0
        # The sender of /cmd_vel uses the base's own clock, so no stamp can be ahead.
        limits = GateLimits(config.command_timeout_s, max_ahead_s=0.0, accept_unstamped=config.accept_unstamped)
        self._gate = CommandGate(limits)
        self.publishers = Diagnosis("publishers", Level.OK, "no second publisher of /cmd_vel")
        self.command: Diagnosis | None = None
        self._drops = RecentCount(config.recent_s)
        self._on_stranger = on_stranger
        self._strangers: dict[str, int] = {}  # publishers that are not obeyed -> steady time of their newest message

    def admit_publisher(self, publisher: str, steady_ns: int) -> bool:
        """Return whether this publisher's commands are obeyed. Warn if it is not the only publisher."""
        if not self.config.command_source and publisher != self.driver:
            if self.driver:
                self._warn_of(self.driver, steady_ns)
            self.driver = publisher
        if publisher == self.driver:
            return True
        self._warn_of(publisher, steady_ns)
        self._refuse(f"{publisher} may not drive, only {self.driver} (command_source)", steady_ns)
        return False

    def admit(self, v: float, w: float, stamp_ns: int, received_ns: int, steady_ns: int) -> bool:
        """Return whether a command of the driving node, v in m/s and w in rad/s, is obeyed.

        ``stamp_ns`` is 0 without a stamp. ``received_ns`` is the time of arrival on the stamp's clock.
        """
        refusal = self._gate.admit(v, w, (received_ns - stamp_ns) / 1e9 if stamp_ns else None)
        if refusal is not None:
            self._refuse(refusal.text, steady_ns)
        elif not self._drops.count(steady_ns):
            self._set(Level.OK, "driving by /cmd_vel")
        return refusal is None

    def update(self, steady_ns: int) -> None:
        """Clear warnings whose cause is older than ``recent_s``."""
        recent = f"in the last {self.config.recent_s:g} s"
        if self.dropped and not self._drops.count(steady_ns):
            self._set(Level.OK, f"none dropped {recent}")
        if self._strangers and steady_ns - max(self._strangers.values()) > self.config.recent_s * 1e9:
            self._strangers.clear()
            self.publishers = Diagnosis("publishers", Level.OK, f"no second publisher of /cmd_vel {recent}")

    def _warn_of(self, publisher: str, steady_ns: int) -> None:
        if publisher not in self._strangers:
            self._on_stranger(publisher)
        self._strangers[publisher] = steady_ns
        text = f"/cmd_vel is also published by {publisher}: stop that node"
        self.publishers = Diagnosis("publishers", Level.WARN, text)

    def _refuse(self, reason: str, steady_ns: int) -> None:
        self.dropped += 1
        self._drops.add(1, steady_ns)
        self._set(Level.WARN, f"dropped: {reason}")

    def _set(self, level: Level, text: str) -> None:
        self.command = Diagnosis("command", level, text, {"dropped": self.dropped})
