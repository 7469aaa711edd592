"""Two doors to one robot: its lease belongs to one operator, and what the others send changes nothing."""

from __future__ import annotations

import math
from itertools import count

import numpy as np
import pytest
from control_world import rectangle
from test_control_nodes import Stack

from instant_ic.control.kinematics import MotionLimits
from instant_ic.control.operator_commands import OperatorCommands
from instant_ic.control.reasons import Notice
from instant_ic.control.robot_lease import LEASE_S, RELEASED
from instant_ic.control.snapshot import ArbiterInputs
from instant_ic.control.states import Reason
from instant_ic.msg import (
    HARD_STOP,
    Bool,
    ControlState,
    ShownPictures,
    header,
    pose_message,
    to_time,
    twist_stamped,
    twist_values,
)

FIRST = "/base_link"
"""The stack's own operator, as the arbiter names him."""
SECOND = "second_console/page 1"


def command(stack: Stack, speed: float, sender: str = SECOND) -> None:
    node, _, client = sender.partition("/")
    stack.bus.publish("/operator/cmd_vel", twist_stamped(speed, 0.0, stack.now, client), publisher=node)


def drive(stack: Stack, seconds: float, first: float | None, second: float | None) -> list[ControlState]:
    """Both operators command; None: silent."""
    states = []
    for _ in range(round(seconds * 20)):
        if second is not None:
            command(stack, second)
        states.append(stack.step(None if first is None else (first, 0.0)))
    return states


def estop(stack: Stack, pressed: bool, node: str) -> None:
    stack.bus.publish("/operator/estop", Bool(data=pressed), latched=True, publisher=node)


def sent(stack: Stack, after: int = 0) -> list[float]:
    return [twist_values(message)[0] for message in stack.bus.messages("/cmd_vel")[after:]]


@pytest.fixture
def free() -> Stack:
    """A stack in free space that its own operator can drive."""
    stack = Stack(np.zeros((0, 2, 2)))
    stack.drive(1.5, (0.0, 0.0))
    return stack


def test_idle_zeros_of_a_second_console_do_not_keep_the_robot_driving_in_virtual() -> None:
    stack = Stack(rectangle(2.5, -0.25, 3.0, 0.25))
    stack.drive(1.5, (0.0, 0.0))
    assert drive(stack, 6.0, 0.4, 0.0)[-1].mode == ControlState.VIRTUAL
    assert sent(stack)[-1] > 0.1
    before, place = len(stack.bus.records("/cmd_vel")), stack.base.pose[:2].copy()
    states = drive(stack, 4.0, None, 0.0)
    stopped = sent(stack, before)
    assert not any(stopped[round(0.3 * 20) + 2 :])  # the timer's steps, and one more at the time-out
    assert stack.bus.messages("/cmd_vel")[-1].header.frame_id == HARD_STOP
    assert math.dist(place, stack.base.pose[:2]) < 0.35  # it was 1.78 m
    assert ControlState.STOPPED in {state.mode for state in states}
    assert states[-1].holder == SECOND and states[-1].mode == ControlState.REAL  # it may drive, and does not


def test_a_command_of_who_does_not_drive_refreshes_no_age_and_is_not_shown(free: Stack) -> None:
    drive(free, 0.5, 0.3, None)
    states = drive(free, 1.0, None, 0.3)
    assert free.arbiter.inbox.ages(free.arbiter.config.timeouts)["command"] == pytest.approx(1.0, abs=0.06)
    assert free.bus.messages("/cmd_vel")[-1].header.frame_id == HARD_STOP
    assert twist_values(states[-1].operator_command) == (0.0, 0.0)


def test_a_node_that_claims_to_be_the_driver_does_not_drive(free: Stack) -> None:
    command(free, 0.0, "console/page 1")  # in vain: the stack's own operator drives
    drive(free, LEASE_S + 0.5, None, None)
    command(free, 0.0, "console/page 1")
    assert free.step(None).holder == "console/page 1"
    before = len(free.bus.records("/cmd_vel"))
    for _ in range(10):
        command(free, 0.0, "console/page 1")
        command(free, 0.3, "liar/page 1")
        command(free, 0.3, "liar/console/page 1")
        assert free.step(None).holder == "console/page 1"
    assert not any(sent(free, before))


def test_the_virtual_robot_obeys_only_what_the_arbiter_granted() -> None:
    stack = Stack(rectangle(2.5, -0.25, 3.0, 0.25))
    stack.drive(1.5, None)
    assert stack.drive(6.0, (0.4, 0.0))[-1].mode == ControlState.VIRTUAL
    drive(stack, 1.0, 0.0, None)
    place = stack.bus.last("/vbot/odom").pose.pose.position.x
    for _ in range(20):
        stack.step((0.0, 0.0))
        command(stack, 0.4)
    assert stack.bus.last("/vbot/odom").pose.pose.position.x == pytest.approx(place, abs=0.01)


def test_the_lease_of_a_lost_driver_is_taken_once_the_robot_stands_by_hands_that_are_off(free: Stack) -> None:
    drive(free, 0.5, 0.4, 0.3)
    assert drive(free, LEASE_S - 0.2, None, 0.3)[-1].holder == FIRST
    states = drive(free, 1.0, None, 0.3)
    assert states[-1].holder == FIRST  # the key of the second one was held in vain
    states = drive(free, 0.2, None, 0.0)
    assert states[-1].holder == SECOND
    assert twist_values(drive(free, 0.5, 0.4, 0.3)[-1].applied_command)[0] == pytest.approx(0.3)


@pytest.mark.parametrize(("after_s", "ends"), [(0.3, "cleanly"), (1.9, "killed"), (3.0, "killed")])
def test_a_console_restarted_behind_a_bridge_does_not_drive_under_the_held_key(
    free: Stack, after_s: float, ends: str
) -> None:
    """The arbiter sees the bridge's identity alone; the names of the pages are new with each start of a console."""
    before, after = (f"host_bridge/station/console/page 1 {start}" for start in ("1f", "2e"))
    command(free, 0.0, FIRST + RELEASED)
    free.drive(0.3, None)

    def hold(page: str, seconds: float, speed: float = 0.3) -> list[ControlState]:
        states = []
        for _ in range(round(seconds * 20)):
            command(free, speed, page)
            states.append(free.step(None))
        return states

    hold(before, 0.5, 0.0)
    assert hold(before, 1.0)[-1].holder == before and free.base.v > 0.2
    if ends == "cleanly":
        command(free, 0.0, before)
        command(free, 0.0, before + RELEASED)
    free.drive(after_s, None)
    hold(after, 0.05, 0.0)  # the console's first zero, before it hears of the key
    already = len(sent(free))
    hold(after, 2.0)
    assert not any(sent(free, already))
    hold(after, 2.5, 0.0)
    assert hold(after, 1.0)[-1].mode == ControlState.REAL and free.base.v > 0.2


@pytest.mark.parametrize("ends", ["released", "silent"])
def test_a_key_held_while_another_had_the_lease_waits_for_a_release(free: Stack, ends: str) -> None:
    """The other operator has let go; that is no release of the first one's key."""
    drive(free, 1.0, 0.4, None)
    drive(free, LEASE_S + 0.5, None, None)
    assert drive(free, 1.0, None, 0.0)[-1].holder == SECOND
    if ends == "released":
        command(free, 0.0, SECOND + RELEASED)
    drive(free, LEASE_S + 0.5, None, None)
    drive(free, 0.05, 0.0, None)  # the console's first zero, before it hears of the key
    already = len(sent(free))
    assert drive(free, 2.0, 0.4, None)[-1].holder == FIRST
    assert not any(sent(free, already))
    drive(free, 1.0, 0.0, None)
    assert drive(free, 1.0, 0.4, None)[-1].mode == ControlState.REAL and free.base.v > 0.2


def test_a_key_held_in_vain_through_a_lost_page_waits_for_a_release(free: Stack) -> None:
    """The console sends one zero at the loss, and one before it hears of the key again."""
    drive(free, 0.5, 0.0, 0.0)
    assert drive(free, 1.0, 0.0, 0.4)[-1].holder == FIRST
    command(free, 0.0)
    drive(free, 0.5, 0.0, None)
    command(free, 0.0, FIRST + RELEASED)
    drive(free, 0.5, None, None)
    already = len(sent(free))
    command(free, 0.0)
    assert drive(free, 2.0, None, 0.4)[-1].holder == SECOND
    assert not any(sent(free, already))
    drive(free, 1.0, None, 0.0)
    assert drive(free, 1.0, None, 0.4)[-1].mode == ControlState.REAL and free.base.v > 0.2


def test_zeros_of_the_sender_before_are_no_release() -> None:
    """The robot stands before an obstacle while the key is held, so that the lease can pass on at once."""
    operator, steps = OperatorCommands(), (("a", 0.3), ("a", 0.0), ("", 0.0), ("b", 0.0), ("b", 0.3))
    notices = []
    for k, (holder, speed) in enumerate(steps):
        inputs = ArbiterInputs(
            operator_command=(speed, 0.0), holder=holder, holder_sends_zeros=holder != "", ages={"command": 0.0}
        )
        notices.append(operator.step(inputs, True, MotionLimits(), 1.5, k * 60_000_000))
    assert notices == [None] * 4 + [Notice(Reason.OPERATOR_LOST, "The operator's link was lost.")]


def test_a_driver_who_gives_the_lease_back_while_driving_stops_the_robot(free: Stack) -> None:
    drive(free, 1.0, 0.4, None)
    command(free, 0.0, FIRST + RELEASED)
    assert twist_values(free.bus.last("/cmd_vel")) == (0.0, 0.0)
    assert drive(free, 0.2, None, 0.0)[-1].holder == ""  # it still rolls


def test_anybody_presses_the_emergency_stop_and_only_the_driver_releases_it(free: Stack) -> None:
    drive(free, 0.5, 0.3, 0.0)
    estop(free, True, "second_console")
    assert drive(free, 0.1, 0.0, 0.0)[-1].estop
    estop(free, False, "second_console")
    assert drive(free, 0.5, 0.0, 0.0)[-1].estop
    estop(free, False, "")
    assert not drive(free, 0.1, 0.0, 0.0)[-1].estop


def test_with_the_driver_lost_who_takes_the_lease_releases_the_emergency_stop(free: Stack) -> None:
    estop(free, True, "")
    drive(free, LEASE_S + 0.5, None, None)
    estop(free, False, "second_console")
    assert drive(free, 0.1, None, None)[-1].estop  # he has not taken it yet
    assert drive(free, 0.1, None, 0.0)[-1].holder == SECOND
    estop(free, False, "second_console")
    assert not drive(free, 0.1, None, 0.0)[-1].estop


def test_another_consoles_lost_driver_and_images_are_not_the_drivers(free: Stack) -> None:
    views = count(1000)

    def report(**values: object) -> None:
        fields = {
            "header": header("map", free.now),
            "picture_stamp": to_time(free.now),
            "picture_age_s": 0.0,
            "view_id": next(views),
            "view_pose": pose_message(np.eye(4)),
            "view_age_s": 0.0,
            "view_delay_s": 0.0,
            "operator_lost": to_time(0),
        }
        free.bus.publish("/view/shown", ShownPictures(**fields | values), publisher="second_console")

    drive(free, 1.0, 0.3, None)
    for _ in range(10):
        free.step((0.3, 0.0))
        report(operator_lost=to_time(free.now), picture_age_s=5.0)
        assert twist_values(free.bus.last("/cmd_vel"))[0] == pytest.approx(0.3)
    free.silent.add("/camera/image/compressed")  # the driver's page gets none; the robot and the other page do
    for _ in range(20):
        free.arbiter.view.camera_image(free.arbiter.clock.steady_ns())
        state = free.step((0.3, 0.0))
        report()
    assert state.reason_code == Reason.CAMERA_STALE
