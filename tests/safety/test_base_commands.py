"""Whose commands the base obeys: the arbiter's alone, and nobody's while the emergency stop is latched."""

import logging

import pytest
from base_line import NodeBench

from instant_ic.bus import OK, WARN
from instant_ic.msg import HARD_STOP, Twist, Vector3

ZERO = Vector3(x=0.0, y=0.0, z=0.0)


def test_a_second_publisher_is_refused_named_and_drives_nothing(caplog: pytest.LogCaptureFixture) -> None:
    bench = NodeBench()
    bench.run(0.5)
    assert bench.diagnosis("publishers")[0] == OK
    with caplog.at_level(logging.WARNING):
        bench.run(1.0, v=0.3, publisher="bag_player")
    assert bench.line.travelled_m == 0.0
    level, text = bench.diagnosis("publishers")
    assert level == WARN and "bag_player" in text
    named = [record for record in caplog.records if "also published by bag_player" in record.getMessage()]
    assert len(named) == 2  # the warning once and the diagnosis once, not a line a message
    assert bench.node.source.dropped == 20
    bench.run(11.2)
    assert bench.diagnosis("publishers")[0] == OK


def test_the_arbiter_drives_on_beside_a_second_publisher() -> None:
    bench = NodeBench()
    for _ in range(20):
        bench.command(-0.3, "bag_player")
        bench.run(0.05, v=0.3)
        bench.command(-0.3, "bag_player")
    assert bench.line.robot.pose[0] > 0.1
    assert bench.line.robot.twist[0] == pytest.approx(0.3, abs=0.01)


def test_a_bag_of_plain_twists_beside_a_running_stack_with_the_stop_latched_drives_nothing() -> None:
    bench = NodeBench()
    bench.run(0.5)
    bench.estop(True)
    for _ in range(24):
        bench.bus.publish("/cmd_vel", Twist(linear=Vector3(x=0.3, y=0.0, z=0.0), angular=ZERO), publisher="bag_player")
        bench.run(0.05, v=0.0)
    assert bench.line.travelled_m == 0.0
    assert bench.diagnosis("publishers")[0] == WARN


def test_any_source_is_obeyed_only_if_the_parameter_says_so_and_two_are_warned_of() -> None:
    bench = NodeBench(command_source="", unprotected=True)
    bench.run(1.0, v=0.3, publisher="script")
    assert bench.line.speed == pytest.approx(0.3, abs=0.01)
    assert bench.diagnosis("publishers")[0] == OK
    bench.command(0.3, "other_script")
    assert bench.diagnosis("publishers")[0] == WARN and "script" in bench.diagnosis("publishers")[1]


def test_nothing_drives_while_the_stop_is_latched_not_even_the_arbiter_nor_any_source() -> None:
    for source in ("arbiter", ""):
        bench = NodeBench(command_source=source, unprotected=True)
        bench.run(0.5)
        bench.estop(True)
        bench.run(1.0, v=0.4)
        assert bench.line.travelled_m == 0.0
        level, text = bench.diagnosis("emergency stop")
        assert level == WARN and "Latched by console" in text


def test_no_command_given_before_the_release_drives_after_it() -> None:
    bench = NodeBench()
    bench.run(0.5)
    bench.estop(True)
    bench.run(0.2, v=0.4)
    bench.estop(False)
    bench.run(0.5)
    assert bench.line.travelled_m == 0.0
    bench.run(1.0, v=0.4)
    assert bench.line.travelled_m > 0.1


def test_an_old_release_of_another_client_does_not_end_the_stop(caplog: pytest.LogCaptureFixture) -> None:
    bench = NodeBench()
    bench.estop(False, "foxglove_bridge")
    bench.run(0.5)
    bench.estop(True, "console")
    kept = bench.bus.latched["/operator/estop"]["foxglove_bridge"]
    bench.bus.deliver(bench.bus.subscriptions["/operator/estop"][0], kept)  # the bridge connects again
    bench.run(1.0, v=0.4)
    assert bench.line.travelled_m == 0.0
    assert "emergency stop not released: the release by foxglove_bridge is older" in caplog.text


def test_a_restarted_base_takes_the_latched_stop_over() -> None:
    bench = NodeBench()
    bench.run(0.5)
    bench.estop(True)
    again = bench.bus.add(type(bench.node), bench.node.config, name="crawler_base_again")
    assert again.latch.stopped and again.latch.publisher == "console"


def test_a_button_of_another_node_stops_and_is_released_first() -> None:
    bench = NodeBench()
    bench.run(1.0, v=0.38)
    bench.estop(True, "second_button", "/robot/estop")
    bench.stopping(0.38)
    bench.estop(False)
    bench.run(0.5, v=0.38)
    assert bench.line.speed == 0.0
    bench.estop(False, "second_button", "/robot/estop")
    bench.run(0.5, v=0.38)
    assert bench.line.speed == 0.0  # the operator has not released it since
    bench.estop(False)
    bench.run(1.0, v=0.38)
    assert bench.line.speed == pytest.approx(0.38, abs=0.01)


def test_the_controllers_own_button_latches_the_base() -> None:
    bench = NodeBench()
    bench.run(1.0, v=0.38)
    bench.line.emulator.status = 0x1
    bench.run(0.5, v=0.38)
    assert bench.line.speed == 0.0
    bench.line.emulator.status = 0
    bench.run(0.5, v=0.38)
    assert bench.line.speed == 0.0
    assert [message.data for message in bench.bus.messages("/robot/estop")] == [False, True, False]
    bench.estop(False)
    bench.run(1.0, v=0.38)
    assert bench.line.speed == pytest.approx(0.38, abs=0.01)


def test_a_hard_stop_never_drives_whatever_twist_it_carries() -> None:
    bench = NodeBench()
    bench.run(0.5)
    for _ in range(20):
        bench.command(0.4, frame_id=HARD_STOP)
        bench.run(0.05)
    assert bench.line.travelled_m == 0.0
