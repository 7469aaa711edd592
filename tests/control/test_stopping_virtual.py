"""In VIRTUAL too each loss commands a hard zero within 0.3 s, in simulated time."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from control_world import rectangle
from test_control_nodes import Stack

from instant_ic.bus.lockstep import LockstepBus
from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.snapshot import ArbiterInputs
from instant_ic.control.sources import SourceMonitor
from instant_ic.control.states import SOURCES, Mode, Reason
from instant_ic.msg import HARD_STOP, ControlState, twist_values
from nodes.navigator import NavigatorNode
from nodes.virtual_robot import VirtualRobotNode


def die(node_class: type) -> Callable[[Stack], None]:
    def lose(stack: Stack) -> None:
        victim = next(node for node in stack.bus.nodes if isinstance(node, node_class))
        stack.bus.nodes.remove(victim)

    return lose


def silence(*topics: str) -> Callable[[Stack], None]:
    return lambda stack: stack.silent.update(topics)


LOSSES: dict[str, Callable[[Stack], None]] = {
    "navigator": die(NavigatorNode),
    "virtual_robot": die(VirtualRobotNode),
    "nerf (its views)": silence("views"),
    "operator": silence("/operator/cmd_vel"),
    "LiDAR": silence("/scan"),
    "SLAM": silence("/pose"),
    "odometry": silence("/wheel/odom"),
}


@pytest.mark.parametrize("loss", LOSSES)
def test_each_loss_in_virtual_commands_a_hard_zero_within_0_3_s(loss: str) -> None:
    stack = Stack(rectangle(2.5, -0.25, 3.0, 0.25))
    stack.drive(1.5, None)
    assert stack.drive(5.0, (0.4, 0.0))[-1].mode == ControlState.VIRTUAL
    assert twist_values(stack.bus.last("/cmd_vel")) != (0.0, 0.0)
    LOSSES[loss](stack)
    began_ns, before = stack.now, len(stack.bus.records("/cmd_vel"))
    stack.drive(0.6, (0.4, 0.0))
    sent = list(zip(stack.bus.records("/cmd_vel"), stack.bus.messages("/cmd_vel"), strict=True))[before:]
    moving = [record.stamp_ns for record, message in sent if twist_values(message) != (0.0, 0.0)]
    stopped = [(record.stamp_ns, message) for record, message in sent if record.stamp_ns > max(moving, default=0)]
    assert (stopped[0][0] - began_ns) / 1e9 <= 0.3
    if loss == "navigator":  # at most 1 ms after its time-out, not at the next period of the loop
        assert (stopped[0][0] - stack.bus.records("/nav/cmd_vel")[-1].stamp_ns) / 1e9 <= 0.301 + 1e-6
    assert {message.header.frame_id for _, message in stopped} == {HARD_STOP}
    assert stack.drive(1.4, (0.4, 0.0))[-1].mode == ControlState.STOPPED
    before = len(stack.bus.records("/cmd_vel"))
    stack.silent.clear()  # back, under the held key
    assert stack.drive(1.5, (0.4, 0.0))[-1].reason_code == Reason.RELEASE_CONTROLS
    assert {twist_values(message) for message in stack.bus.messages("/cmd_vel")[before:]} == {(0.0, 0.0)}


@pytest.mark.parametrize(("late_s", "drives"), [(0.0, True), (0.55, False)])
def test_what_waited_while_a_node_was_busy_is_as_old_as_its_stamp(late_s: float, drives: bool) -> None:
    """All messages arrive only now, and are ``late_s`` older: the arbiter's state may be 0.3 s old, and 0.5 s."""
    stack = Stack(rectangle(2.5, -0.25, 3.0, 0.25))
    stack.drive(1.5, None)
    assert stack.drive(6.0, (0.4, 0.0))[-1].mode == ControlState.VIRTUAL
    with LockstepBus(stack.now + round(late_s * 1e9)) as bus:
        nodes = [bus.add(node) for node in (VirtualRobotNode, NavigatorNode)]
        for topic in ("/costmap", "/ic/subgoal", "/operator/cmd_vel", "/ic/state"):
            bus.publish(topic, stack.bus.last(topic))
        bus.advance(0.06)
        assert bool(bus.messages("/nav/cmd_vel")) is drives
        assert (nodes[0].diagnoses()["state"][1] == "The arbiter does not report. The v-bot stands") is not drives


def test_a_page_that_reports_no_number_as_the_age_of_its_view_shows_none() -> None:
    ages = dict.fromkeys([source.key for source in SOURCES if not source.optional], 0.0) | {"view": math.nan}
    stale = SourceMonitor(ArbiterConfig()).stale(ArbiterInputs(ages=ages), Mode.VIRTUAL, in_mode_s=10.0)
    assert [one.source.key for one in stale] == ["view"]
