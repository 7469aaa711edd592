"""The machine's clock is set while nodes run: timers neither burst nor stall, and nothing becomes fresh again."""

from dataclasses import dataclass

import pytest

from instant_ic.bus import SENSOR
from instant_ic.bus.clock import ManualClock
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.bus.node import Node
from instant_ic.bus.transport import Received
from instant_ic.msg import String

S = 1_000_000_000
HOUR = 3600 * S
START = 1_700_000_000 * S


class SetClock(ManualClock):
    """A machine's clock that somebody sets: ``set_by`` nanoseconds beside the steady one."""

    set_by = 0

    def now_ns(self) -> int:
        return self._now_ns + self.set_by

    def steady_ns(self) -> int:
        return self._now_ns


@dataclass(frozen=True)
class TickerConfig:
    pass


class Ticker(Node[TickerConfig]):
    name = "ticker"

    def setup(self) -> None:
        self.ticks = 0
        self.heard = self.latest("/chatter", String, max_age_s=0.5, qos=SENSOR)
        self.timer(0.1, self.tick)

    def tick(self) -> None:
        self.ticks += 1


@pytest.fixture
def bus() -> LockstepBus:
    bus = LockstepBus(START)
    bus.clock = SetClock(START)
    return bus


def run_for(bus: LockstepBus, node: Ticker, seconds: float) -> int:
    """Moves both clocks on in steps of 10 ms; how often the timer fired."""
    before = node.ticks
    for _ in range(round(seconds * 100)):
        bus.clock.set(bus.clock.steady_ns() + S // 100)
        node.spin_once()
    return node.ticks - before


@pytest.mark.parametrize("jump", [-HOUR, HOUR], ids=["back", "forward"])
def test_timers_go_on_evenly_when_the_clock_is_set(bus: LockstepBus, jump: int) -> None:
    node = bus.add(Ticker)
    assert run_for(bus, node, 1.0) == 10
    bus.clock.set_by = jump
    assert run_for(bus, node, 1.0) == 10  # no burst, no pause


@pytest.mark.parametrize("jump", [-HOUR, HOUR], ids=["back", "forward"])
def test_age_of_the_latest_message_is_not_changed_by_setting_the_clock(bus: LockstepBus, jump: int) -> None:
    node = bus.add(Ticker)
    bus.publish("/chatter", String(data="here"))
    assert node.heard.message.data == "here"
    bus.clock.set_by = jump
    run_for(bus, node, 0.4)
    assert node.heard.message.data == "here" and node.heard.age_s == pytest.approx(0.4)
    run_for(bus, node, 0.2)
    assert node.heard.message is None  # who is silent does not stay fresh for an hour


def test_waiting_in_the_queue_counts_as_age(bus: LockstepBus) -> None:
    node = bus.add(Ticker)
    came_ns = bus.clock.steady_ns() - 3 * S // 10
    node.heard.put(String(data="old"), Received("/chatter", "", b"", 0, 0, 0, steady_ns=came_ns))
    assert node.heard.age_s == pytest.approx(0.3)
