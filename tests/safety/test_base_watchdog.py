"""The controller's own watchdog: set, read back, and set again when the controller has restarted."""

import numpy as np
import pytest
from base_line import RATE_HZ, Base

from instant_ic.base.config import ControllerConfig, RoboclawConfig
from instant_ic.base.protocol import Command, write_frame
from nodes.crawler_base import CrawlerBaseConfig


def test_the_shipped_watchdog_stops_the_motors_within_0_3_s_and_outlasts_missed_commands() -> None:
    config = CrawlerBaseConfig()
    assert config.roboclaw.watchdog_s <= 0.3
    assert config.roboclaw.watchdog_s * config.rate_hz >= 3
    with pytest.raises(ValueError, match="watchdog_s must span 3 periods"):
        CrawlerBaseConfig(rate_hz=8.0)


@pytest.mark.parametrize(("asked_s", "tenths"), [(0.19, 1), (0.3, 3), (1.0, 10)])
def test_the_watchdog_is_never_longer_than_asked_for(asked_s: float, tenths: int) -> None:
    """Command 14 counts tenths of a second."""
    base = Base(ControllerConfig(roboclaw=RoboclawConfig(port="memory", watchdog_s=asked_s)))
    base.run(0.1)
    frames = [frame for _, frame in base.line.written if frame[1] == Command.SET_TIMEOUT]
    assert [frame[2] for frame in frames] == [tenths]
    assert base.line.emulator.timeout_s == pytest.approx(tenths / 10)


@pytest.mark.parametrize("phase_s", [0.0, 0.1])
def test_a_watchdog_that_was_cleared_stops_the_tracks_and_is_set_again(phase_s: float) -> None:
    base = Base()
    base.run(2.0 + phase_s, 0.4)
    base.line.emulator.timeout_s = 0.0
    cleared_s, before = base.line.time_s, len(base.line.written)
    while base.line.emulator.timeout_s == 0.0 and base.line.time_s < cleared_s + 10.0:
        base.run(0.01, 0.4)
    stops_s = [at_s for at_s, frame in base.line.written[before:] if frame[1] == Command.DUTY_ACCELERATION_BOTH]
    assert stops_s[0] - cleared_s <= base.config.health_period_s + 1.0 / RATE_HZ
    assert base.line.time_s - cleared_s <= 0.55
    assert base.line.speed < 0.1  # it has braked since
    assert any("watchdog is 0.0 s instead of 0.3 s" in state.link for state in base.states)
    assert base.line.opened == 2
    base.run(1.0, 0.4)
    assert base.line.emulator.timeout_s == pytest.approx(0.3) and base.states[-1].connected


@pytest.mark.parametrize("driven_s", [0.3, 3.0], ids=["few counts", "many counts"])
def test_counts_that_jump_to_zero_force_a_reconnect_at_once(driven_s: float) -> None:
    base = Base()
    base.run(driven_s, 0.4)
    poses = [state.odometry.pose[0] for state in base.states if state.odometry is not None]
    base.line.brown_out()
    base.line.motors.blocked[:] = True  # so that the counts are still zero when they are read
    lost_s = base.line.time_s
    while base.line.opened < 2 and base.line.time_s < lost_s + 10.0:
        base.run(0.01, 0.4)
    stops_s = [at_s for at_s, frame in base.line.written if frame[1] == Command.DUTY_ACCELERATION_BOTH]
    assert min(at_s for at_s in stops_s if at_s > lost_s) - lost_s <= 3.0 / RATE_HZ + 0.03
    base.line.motors.blocked[:] = False
    assert base.line.emulator.timeout_s == pytest.approx(0.3)
    restarted = [frame[1] for at_s, frame in base.line.written if at_s >= lost_s]
    stops = restarted.index(Command.DUTY_ACCELERATION_BOTH)
    assert stops < restarted.index(Command.SET_TIMEOUT), "stopped before it is set up"
    base.run(0.2, 0.4)
    after = [state.odometry.pose[0] for state in base.states if state.odometry is not None]
    assert np.abs(np.diff(after)).max() < 0.03, "no leap of the odometry"
    assert after[-1] >= poses[-1] - 0.01


def test_counts_of_zero_on_the_way_are_no_restart() -> None:
    base = Base()
    base.line.motors.counted = base.line.motors.counted - 0.075  # the counts begin at -300 and pass zero
    base.run(0.4)
    base.run(2.0, 0.4)
    assert base.line.opened == 1


def test_a_restart_during_a_lost_link_makes_no_leap_of_the_odometry() -> None:
    base = Base()
    base.run(3.0, 0.4)
    base.line.back = lambda reply: b""
    base.run(1.0, 0.4)
    base.line.brown_out()
    base.line.back = bytes
    base.run(3.0, 0.0)
    assert base.states[-1].connected
    poses = [state.odometry.pose[0] for state in base.states if state.odometry is not None]
    assert np.abs(np.diff(poses)).max() < 0.15


def test_a_controller_that_takes_no_watchdog_is_not_driven() -> None:
    base = Base()
    off = write_frame(0x80, Command.SET_TIMEOUT, bytes((0,)))
    base.line.forward = lambda frame: off if frame[1] == Command.SET_TIMEOUT else frame  # acknowledged, and of no use
    base.run(3.0, 0.4)
    assert base.line.travelled_m == 0.0
    assert not any(state.connected for state in base.states)
    assert "watchdog is 0.0 s instead of 0.3 s" in base.states[0].link
