"""Diagnoses of the base: serial link, replies, encoders, battery, faults of the controller."""

from __future__ import annotations

from collections.abc import Iterator

from instant_ic.base.config import CrawlerBaseConfig
from instant_ic.base.controller import BaseController, Health
from instant_ic.base.roboclaw import ControllerStatus
from instant_ic.util.diagnosis import Diagnosis, Level, RecentCount

_CONNECT_GRACE_S = 5.0  # time after the start during which a missing controller is only a warning


class BaseReport:
    """Turns states and counters of a controller into diagnoses.

    Args:
        config: parameters; the attribute of this name may be replaced at any time.
        controller: source of the counters.
        started_ns: steady time of the start.
    """

    def __init__(self, config: CrawlerBaseConfig, controller: BaseController, started_ns: int) -> None:
        self.config = config
        self._controller = controller
        self._started_ns = started_ns
        self._linked = False  # true once the controller has been connected
        self._fault = ""  # newest faults of the controller since the last release of the stop
        self._repeats, self._jumps = RecentCount(config.recent_s), RecentCount(config.recent_s)

    def link(self, connected: bool, text: str, steady_ns: int) -> Diagnosis:
        """Diagnose a change of the serial link. Soon after the start, a missing controller is only a warning."""
        self._linked |= connected
        starting = not self._linked and steady_ns - self._started_ns < _CONNECT_GRACE_S * 1e9
        return Diagnosis("link", Level.OK if connected else Level.WARN if starting else Level.ERROR, text)

    def recent(self, steady_ns: int) -> Iterator[Diagnosis]:
        """Yield the diagnoses of repeated commands and impossible encoder readings in the last ``recent_s``."""
        counters, recent = self._controller.roboclaw.counters, f"the last {self.config.recent_s:g} s"
        repeated = self._repeats.rise(counters.retries, steady_ns)
        values = {
            "repeated": counters.retries,
            "timeouts": counters.timeouts,
            "crc_errors": counters.crc_errors,
            "stops": counters.stops,
        }
        text = f"{repeated} commands repeated in {recent}" if repeated else "no command had to be repeated"
        yield Diagnosis("replies", Level.WARN if repeated else Level.OK, text, values)
        rejected = self._controller.odometry.rejected
        jumps = self._jumps.rise(rejected, steady_ns)
        text = f"{jumps} impossible encoder jumps ignored in {recent}" if jumps else "plausible"
        yield Diagnosis("encoders", Level.WARN if jumps else Level.OK, text, {"rejected": rejected})

    def tracks(self, fault: str = "") -> Diagnosis:
        """Diagnose whether both tracks follow. A fault is shown until the stop is released."""
        stopped = f"{fault}. The robot has stopped; release the emergency stop to try again"
        return Diagnosis("tracks", Level.ERROR if fault else Level.OK, stopped if fault else "both follow")

    def battery(self, health: Health) -> Diagnosis:
        empty_v = self.config.battery_empty_v
        low = health.battery_v < empty_v
        text = f"{health.battery_v:.1f} V" + (f", below {empty_v} V: charge it" if low else "")
        return Diagnosis("battery", Level.WARN if low else Level.OK, text)

    def restarted(self) -> None:
        """Record a restart. It is shown as a fault until the stop is released, though it is already over."""
        self._fault = "the motor controller has restarted: check its supply voltage"

    def controller(self, status: ControllerStatus) -> Diagnosis:
        """Diagnose faults and warnings of the controller. A fault is shown until the stop is released."""
        faults, warnings = ", ".join(status.faults), ", ".join(status.warnings)
        self._fault = faults or self._fault
        values = {"status": f"0x{status.value:0{2 * status.size}x}"}
        if self._fault:
            advice = "Remove the cause, then" if faults else "The fault is gone;"
            text = f"{self._fault}. The robot has stopped. {advice} release the emergency stop"
            return Diagnosis("controller", Level.ERROR, text, values)
        return Diagnosis("controller", Level.WARN if warnings else Level.OK, warnings or "no faults", values)

    def release(self) -> None:
        """Forget a fault of the controller after the operator has released the stop."""
        self._fault = ""

    def charge(self, health: Health) -> float:
        """Return the battery's charge, 0 to 1, estimated from its voltage."""
        empty_v, full_v = self.config.battery_empty_v, self.config.battery_full_v
        return min(1.0, max(0.0, (health.battery_v - empty_v) / (full_v - empty_v)))
