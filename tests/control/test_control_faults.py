"""Faults in which the real robot started, or drove, by itself; each test failed before its fault was mended."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from control_world import BEAMS, LIDAR_MAX_M, LIDAR_MIN_M, Loop, World, corridor, draw_map, rectangle
from test_control_nodes import Stack

from instant_ic.console.drive import DriveConfig, DriveGate
from instant_ic.control.states import Mode
from instant_ic.msg import Bool, ControlState, odometry_message, scan_message, twist_stamped, twist_values
from nodes.virtual_robot import VirtualRobotNode

FORWARD, NOTHING = (0.4, 0.0), (0.0, 0.0)
BOX = rectangle(2.5, -0.25, 3.0, 0.25)


def stopped_under_a_held_key() -> Stack:
    stack = Stack(np.zeros((0, 2, 2)))
    stack.drive(1.5, None)
    stack.drive(1.0, FORWARD)
    stack.bus.publish("/operator/estop", Bool(data=True), latched=True)
    stack.drive(1.0, FORWARD)
    stack.bus.publish("/operator/estop", Bool(data=False), latched=True)
    assert stack.drive(1.0, FORWARD)[-1].mode == ControlState.STOPPED
    return stack


def test_fault_a_pause_of_the_link_starts_the_robot_under_a_held_key() -> None:
    stack = stopped_under_a_held_key()
    stack.drive(0.9, None)
    assert stack.drive(1.0, FORWARD)[-1].mode == ControlState.STOPPED
    assert twist_values(stack.bus.last("/cmd_vel")) == NOTHING
    stack.lost_ns = stack.now  # the page tells that nobody is there
    stack.drive(1.5, None)
    assert stack.drive(1.0, FORWARD)[-1].mode == ControlState.REAL


def test_fault_the_consoles_zero_after_a_pause_of_the_page_starts_the_robot_under_a_held_key() -> None:
    stack = stopped_under_a_held_key()
    gate, start_ns, there, sequence = DriveGate(DriveConfig()), stack.now, True, 0
    gate.request(1, 0.0)
    for k in range(60):
        now = (stack.now - start_ns) / 1e9
        if not 1.0 <= now < 1.4:  # the key is held all the time
            sequence += 1
            gate.receive(1, sequence, 0.0, *FORWARD, now)
        if (command := gate.take_due(now)) is not None:
            stack.send("/operator/cmd_vel", twist_stamped(*command, stack.now))
        if there and not gate.driver_alive(now):
            stack.lost_ns = stack.now
        there = gate.driver_alive(now)
        stack.show(stack.now)
        assert stack.step(None).mode == ControlState.STOPPED, k
    assert stack.lost_ns > start_ns


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("x_m", [math.nan, -1.0], ids=["nan", "leap"])
def test_fault_the_robot_follows_a_v_bot_to_where_nobody_drove_it(x_m: float) -> None:
    """With NaN, the nearest free place was the first free cell of the costmap: the robot drove back by 2.5 m."""
    stack = Stack(BOX)
    stack.drive(1.5, None)
    assert stack.drive(5.0, FORWARD)[-1].mode == ControlState.VIRTUAL
    node = next(node for node in stack.bus.nodes if isinstance(node, VirtualRobotNode))
    node.close()
    stack.bus.nodes.remove(node)
    for _ in range(20):
        message = odometry_message(np.eye(4), 0.0, 0.0, "map", "vbot_base_link", stack.now)
        message.pose.pose.position.x = x_m
        stack.send("/vbot/odom", message)
        stack.step(FORWARD)
    state = stack.bus.last("/ic/state")
    assert (state.mode, state.reason_code) == (ControlState.STOPPED, ControlState.REASON_RELEASE_CONTROLS)
    assert "The virtual robot's place on the map has jumped" in state.reason
    assert twist_values(stack.bus.last("/cmd_vel")) == NOTHING


def test_fault_a_scan_that_says_nothing_counts_as_free_space() -> None:
    spoilt = [
        ("angle_min", math.nan),
        ("angle_increment", math.nan),
        ("range_min", math.nan),
        ("range_max", math.nan),
        ("range_max", 0.0),
        ("ranges", np.zeros(0, np.float32)),
        ("ranges", np.full(BEAMS, np.nan, np.float32)),
    ]
    stack = Stack(np.zeros((0, 2, 2)))
    stack.drive(1.5, None)
    stack.drive(1.0, FORWARD)
    stack.silent.add("/scan")
    for k in range(21):
        ranges = stack.world.cast(*stack.base.pose)
        scan = scan_message(ranges, -math.pi, 2 * math.pi / BEAMS, LIDAR_MIN_M, LIDAR_MAX_M, "velodyne", stack.now)
        setattr(scan, *spoilt[k % 7])
        stack.bus.publish("/scan", scan)
        stack.step(FORWARD)
        assert k < 7 or twist_values(stack.bus.last("/cmd_vel")) == NOTHING, spoilt[k % 7]
    assert stack.bus.last("/ic/state").reason_code == ControlState.REASON_SCAN_STALE


def test_fault_the_robot_follows_a_v_bot_that_nobody_drives() -> None:
    """The operator's link is lost while the arbiter waits for a view: that was forgotten at the switch."""
    stack = Stack(BOX)
    stack.drive(1.5, None)
    stack.silent.add("views")
    while stack.step(FORWARD).mode != ControlState.ENTERING:
        pass
    stack.drive(0.5, None)
    stack.silent.clear()
    assert {state.mode for state in stack.drive(0.5, None)} == {ControlState.ENTERING}
    assert twist_values(stack.bus.last("/cmd_vel")) == NOTHING
    assert stack.drive(0.5, FORWARD)[-1].mode == ControlState.VIRTUAL


@functools.cache
def passage(lost: str = "", from_s: float = math.inf) -> Loop:
    """A drive through the box, in which a source falls silent."""
    walls = corridor()
    made = Loop(World(np.concatenate([walls, BOX])), draw_map(walls, (-2, -1.2, 14, 1.2)))
    made.start()
    while made.modes()[-3:] != ["VIRTUAL", "RETURNING", "REAL"] and made.k * made.dt < from_s + 0.35:
        if made.k * made.dt > from_s:
            made.ages[lost] = made.k * made.dt - from_s
        made.step(FORWARD)
    return made


@pytest.mark.parametrize("lost", ["view", "vbot"])
def test_fault_a_switch_renews_the_age_of_a_source_that_was_needed_before_it(lost: str) -> None:
    whole = passage()
    returning_s = next(frame.t for frame in whole.frames if frame.decision.mode == Mode.RETURNING)
    made = passage(lost, returning_s - 0.2)
    assert made.modes()[-1] == "RETURNING"
    assert made.frames[-1].command == NOTHING
