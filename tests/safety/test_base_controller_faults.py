"""The controller's own stop: the robot's stop button at its pin, and its faults, each latched until it is released."""

from itertools import pairwise

import pytest
from base_line import RATE_HZ, TICK_S, Base, NodeBench

from instant_ic.base.config import ControllerConfig, RoboclawConfig
from instant_ic.base.protocol import STATUS_FAULTS, STATUS_FAULTS_2_BYTES
from instant_ic.bus import ERROR, OK, WARN
from nodes.crawler_base import CrawlerBaseConfig

FAULTS = [(0x1000, 4, STATUS_FAULTS[0x1000]), (0x0008, 2, STATUS_FAULTS_2_BYTES[0x0008])]


def driving() -> NodeBench:
    bench = NodeBench()
    bench.run(1.0, v=0.38)
    assert bench.line.speed == pytest.approx(0.38, abs=0.02)
    return bench


def test_20_of_20_presses_of_0_06_s_latch_even_if_the_pin_does_not() -> None:
    bench = driving()
    bench.line.emulator.pins[0] = 0x01  # it was set while the base ran
    for press in range(20):
        bench.run(0.1 + press * 0.0017, v=0.38)  # in every phase of the control cycle
        bench.line.emulator.press(True)
        bench.run(0.06, v=0.38)
        bench.line.emulator.press(False)
        bench.run(0.1, v=0.38)
        assert bench.node.latch.stopped and not bench.line.motors.power.any()
        assert bench.bus.last("/robot/estop").data is False, "let go, so that the operator can release it"
        assert [message.data for message in bench.bus.messages("/robot/estop")].count(True) == press + 1
        bench.estop(False)
        assert not bench.node.latch.stopped


def test_the_status_is_read_in_every_control_cycle_and_fits_the_line_at_38400_baud() -> None:
    base = Base()
    base.run(1.0, 0.2)
    base.run(1.0, 0.2)
    read_s = [at_s for at_s, frame in base.line.written if frame == b"\x80\x5a" and at_s > 1.0]
    assert len(read_s) >= RATE_HZ - 1
    assert max(after - before for before, after in pairwise(read_s)) < 1.0 / RATE_HZ + 3 * TICK_S
    CrawlerBaseConfig(roboclaw=RoboclawConfig(baud=38400))
    with pytest.raises(ValueError, match=r"roboclaw\.baud 38400: raise it, or lower rate_hz to 60"):
        CrawlerBaseConfig(rate_hz=100.0, roboclaw=RoboclawConfig(baud=38400))
    with pytest.raises(ValueError, match=r"roboclaw\.baud 9600: raise it; above 0\.06 s the tracks cannot be watched"):
        CrawlerBaseConfig(rate_hz=10.0, roboclaw=RoboclawConfig(baud=9600))


def connection(pins: list[int], status_bytes: int = 4, pin: str = "S3") -> Base:
    base = Base(ControllerConfig(roboclaw=RoboclawConfig(port="memory", estop_pin=pin)))
    base.line.emulator.pins, base.line.emulator.status_bytes = pins, status_bytes
    base.run(0.8, 0.2)
    return base


@pytest.mark.parametrize(
    ("pins", "status_bytes", "pin"),
    [
        ([0, 0, 0, 0, 0], 4, "S3"),  # as delivered: latching in the packet serial modes
        ([0x81, 0, 0, 0, 0], 4, "S3"),
        ([0x62, 0, 0x81, 0, 0], 4, "S5"),
        ([0x01, 0, 0], 2, "S3"),
        ([0x04, 0x12, 0x12, 0, 0], 4, ""),  # no button
    ],
)
def test_a_latching_button_or_none_lets_the_base_drive(pins: list[int], status_bytes: int, pin: str) -> None:
    assert connection(pins, status_bytes, pin).line.speed > 0.15


@pytest.mark.parametrize(
    ("pins", "status_bytes", "pin"),
    [
        ([0x01, 0, 0, 0, 0], 4, "S3"),  # a stop while it is pressed
        ([0x02, 0, 0], 2, "S3"),
        ([0x62, 0, 0, 0, 0], 4, "S3"),  # a home switch
        ([0x81, 0, 0, 0, 0], 4, "S4"),  # disabled
        ([], 4, "S3"),  # not readable
    ],
)
def test_a_button_that_does_not_latch_is_an_error_that_says_how_to_set_it(
    pins: list[int], status_bytes: int, pin: str
) -> None:
    base = connection(pins, status_bytes, pin)
    assert base.line.travelled_m == 0.0 and not any(state.connected for state in base.states)
    text = next(state.link for state in base.states if state.link)
    assert f"Set {pin} to E-Stop (latching)" in text and "The robot does not drive" in text


@pytest.mark.parametrize(("bit", "status_bytes", "name"), FAULTS)
def test_a_fault_of_the_controller_stops_and_latches_with_its_name(bit: int, status_bytes: int, name: str) -> None:
    """The controller lets the motors run again as soon as the fault is over; the key is held all the time."""
    bench = NodeBench()
    emulator = bench.line.emulator
    emulator.status_bytes = status_bytes
    emulator.pins = [0x81 if status_bytes == 4 else 0x01, 0, 0]
    bench.run(0.6, v=0.3)
    assert bench.line.speed > 0.2
    emulator.status = bit
    bench.run(0.06, v=0.3)
    level, text = bench.diagnosis("controller")
    assert level == ERROR and text.startswith(f"{name}. The robot has stopped. Remove the cause")
    assert bench.bus.last("/robot/estop").data is True, "the arbiter stops too"
    bench.estop(False)
    assert bench.node.latch.stopped, "no release while the fault lasts"
    emulator.status = 0
    bench.run(0.4, v=0.3)
    assert bench.line.speed == 0.0 and not emulator.closed_loop
    level, text = bench.diagnosis("controller")
    assert level == ERROR and text.startswith(f"{name}. The robot has stopped. The fault is gone; release")
    bench.estop(False)
    bench.run(0.4, v=0.3)
    assert bench.line.speed > 0.1
    assert bench.diagnosis("controller") == (OK, "no faults")


@pytest.mark.parametrize("silent_s", [0.0, 1.0])
def test_a_controller_that_restarted_stops_and_latches_with_its_name(silent_s: float) -> None:
    """A brown-out is a fault that takes its own status bits with it; the key is held all the time."""
    bench = driving()
    line = bench.line
    line.brown_out()
    line.forward = line.back = lambda data: b""
    bench.run(silent_s, v=0.38)
    line.forward = line.back = bytes
    # After it, the first try to connect may fail half-way, when the watchdog is set again already.
    line.emulator.pins = [0x01, 0, 0, 0, 0]
    bench.run(0.6, v=0.38)
    line.emulator.pins = [0x81, 0, 0, 0, 0]
    before_m = line.travelled_m
    bench.run(2.5, v=0.38)
    assert line.travelled_m == before_m and not line.emulator.closed_loop
    assert [message.data for message in bench.bus.messages("/robot/estop")][-2:] == [True, False], "the arbiter too"
    level, text = bench.diagnosis("controller")
    assert level == ERROR and text.startswith("the motor controller has restarted: check its supply voltage. The robot")
    bench.estop(False)
    bench.run(0.4, v=0.38)
    assert line.speed > 0.1 and bench.diagnosis("controller") == (OK, "no faults")


def test_a_warning_of_the_controller_is_a_diagnosis_and_drives_on() -> None:
    bench = driving()
    bench.line.emulator.status = 0x00080000  # main voltage low
    bench.run(0.3, v=0.38)
    assert bench.diagnosis("controller")[0] == WARN
    assert bench.line.speed == pytest.approx(0.38, abs=0.01)
