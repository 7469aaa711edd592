"""How the base stops: soft, hard and at once, in the simulated robot's dynamics."""

import threading
from itertools import pairwise

import pytest
from base_line import Base, NodeBench

from instant_ic.base.controller import BaseState, ControllerThread
from instant_ic.msg import HARD_STOP


def driving(bench: NodeBench, phase_s: float = 0.0) -> None:
    bench.run(1.5 + phase_s, v=0.38)
    assert bench.line.robot.twist[0] == pytest.approx(0.38, abs=0.005)


@pytest.mark.parametrize("phase_s", [0.0, 0.017])
def test_the_emergency_stop_stands_within_0_25_s_and_0_06_m(phase_s: float) -> None:
    bench = NodeBench()
    driving(bench, phase_s)
    bench.estop(True)
    stand_s, distance_m = bench.stopping(0.38)  # the arbiter goes on as if nothing had happened
    assert stand_s <= 0.25
    assert distance_m <= 0.06


@pytest.mark.parametrize("phase_s", [0.0, 0.017])
def test_a_lost_arbiter_commands_zero_within_0_3_s_and_stands_within_0_55_s(phase_s: float) -> None:
    bench = NodeBench()
    driving(bench, phase_s)
    bench.command(0.38)  # the last one: the loss right after it is the worst
    lost_s = bench.line.time_s
    before = len(bench.line.written)
    stand_s, distance_m = bench.stopping()
    speeds = [
        (at_s, int.from_bytes(frame[6:10], "big")) for at_s, frame in bench.line.written[before:] if frame[1] == 40
    ]
    slowing_s = min(at_s for at_s, speed in speeds if speed < 1500) - lost_s
    assert slowing_s <= 0.3
    assert stand_s <= 0.55
    assert distance_m <= 0.16


def test_a_hard_stop_of_the_arbiter_stands_within_0_25_s() -> None:
    """0.3 s to notice a loss and this make 0.55 s."""
    bench = NodeBench()
    driving(bench)
    bench.command(0.0, frame_id=HARD_STOP)
    for _ in range(10):
        bench.run(0.05)
        bench.command(0.0, frame_id=HARD_STOP)
    assert bench.line.speed == 0.0
    assert bench.line.moved_s - (bench.line.time_s - 0.5) <= 0.25


def test_a_released_key_keeps_the_soft_ramp() -> None:
    bench = NodeBench()
    driving(bench)
    stand_s, _ = bench.stopping(0.0)
    assert stand_s >= 0.38 / 0.8


def test_the_simulated_tracks_do_not_stop_in_no_time() -> None:
    """Motors and traction bound the deceleration: the figures above are not those of a set point."""
    bench = NodeBench()
    driving(bench)
    bench.estop(True)
    speeds = [bench.line.speed]
    for _ in range(20):
        bench.run(0.01)
        speeds.append(bench.line.speed)
    robot = bench.line.robot.config
    most = robot.track_acceleration + robot.rolling_resistance
    drops = [(before - after) / 0.01 for before, after in pairwise(speeds)]
    assert max(drops) == pytest.approx(most, rel=0.02)
    assert speeds[10] > 0.1  # after 0.1 s it still moves


def test_a_base_that_was_frozen_starts_again_from_a_stand() -> None:
    """After SIGCONT the motors have been stopped by the watchdog: the next command ramps up from zero."""
    base = Base()
    base.run(2.0, 0.4)
    base.line.advance(0.7)  # nothing runs but the robot
    assert base.line.emulator.watchdog_fired and base.line.speed == 0.0
    base.controller.command(0.4, 0.0, base.steady_ns())
    state = base.step()
    assert state.v == 0.0
    base.run(1.0, 0.4)
    assert base.line.speed == pytest.approx(0.4, abs=0.01)


class _Counted:
    """Stands for a controller whose steps are counted."""

    def __init__(self) -> None:
        self.steps = 0
        self.stepped = threading.Event()

    def step(self) -> BaseState:
        self.steps += 1
        self.stepped.set()
        return BaseState(connected=True)

    def close(self) -> str:
        return ""


def test_a_stop_does_not_wait_for_the_next_period_of_the_serial_thread() -> None:
    controller = _Counted()
    thread = ControllerThread(controller, 1e-3, lambda state: None, lambda fault, unstopped: None)  # type: ignore[arg-type]
    thread.start()
    try:
        for steps in (1, 2, 3):  # the first by the rate, each other because it was asked for: the period is 1000 s
            assert controller.stepped.wait(60.0)
            controller.stepped.clear()
            assert controller.steps == steps
            thread.hurry()
    finally:
        assert thread.end(60.0)


def test_a_hard_stop_while_turning_brakes_both_tracks() -> None:
    base = Base()
    base.run(2.0, 0.3, w=0.8)
    left, right = base.line.robot.tracks
    assert right - left == pytest.approx(0.48, abs=0.02)
    stand_s, _ = base.until_standing()
    assert stand_s <= 0.25 + 0.034 + 0.54 / 4.0 + 0.15  # the outer track runs 0.54 m/s
