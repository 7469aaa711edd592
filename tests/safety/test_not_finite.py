"""No value that is not finite becomes motion: each function refuses it by itself, whoever has checked it before."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from instant_ic.base.config import LimitsConfig
from instant_ic.base.limits import TwistLimiter
from instant_ic.config.robot import MotionLimits
from instant_ic.console.drive import DriveConfig, DriveGate
from instant_ic.control.costmap import Costmap
from instant_ic.control.follower import FollowerConfig, PathFollower
from instant_ic.control.footprint import Footprint
from instant_ic.control.kinematics import accelerate, extrapolate
from instant_ic.control.navigator import Navigator, meeting_pose
from instant_ic.control.planner import HybridPlanner
from instant_ic.control.robot_lease import Verdict
from instant_ic.control.safety import CollisionMonitor, CollisionMonitorConfig
from instant_ic.control.vbot import VbotConfig, VirtualRobot
from instant_ic.slam.contradiction import ContradictionMonitor
from instant_ic.util.contradiction import Contradiction

LIMITS = MotionLimits()
STANDS = (0.0, 0.0)
ODD = pytest.mark.parametrize("odd", [math.nan, math.inf, -math.inf])
FREE = Costmap(np.zeros((120, 120), np.uint8), 0.05, np.array([-3.0, -3.0]))


def spoilt(values: tuple[float, ...], odd: float) -> list[NDArray[np.float64]]:
    """``values`` with one of them replaced, each in turn."""
    return [np.where(np.arange(len(values)) == index, odd, values) for index in range(len(values))]


@ODD
def test_fault_a_gate_turns_a_command_that_is_no_number_into_full_speed(odd: float) -> None:
    for age_s, linear, angular in spoilt((0.0, 0.1, 0.1), odd):
        gate = DriveGate(DriveConfig())
        gate.request(1, 0.0)
        assert gate.receive(1, 1, float(age_s), float(linear), float(angular), 0.0) is not Verdict.ACCEPTED
        assert gate.command == STANDS and gate.take_due(0.0) == STANDS
        assert gate.receive(1, 2, 0.0, 0.1, 0.0, 0.0) is Verdict.ACCEPTED


@ODD
def test_limits_refuse_what_is_no_number(odd: float) -> None:
    limiter = TwistLimiter(LimitsConfig())
    for command in spoilt((0.1, 0.1), odd):
        assert LIMITS.clip(*command) == STANDS
        assert accelerate((0.01, -0.01), (command[0], command[1]), LIMITS, 0.1) == STANDS
        with pytest.raises(ValueError, match="must be finite"):
            limiter.step(*command, 0.1)
    assert (limiter.v, limiter.w) == STANDS


@ODD
def test_fault_a_virtual_robot_drives_without_a_speed_limit_that_is_a_number(odd: float) -> None:
    robot = VirtualRobot(VbotConfig(), LIMITS)
    if odd != math.inf:  # no limit
        robot.step((0.5, 0.0), np.zeros(3), 0.1, speed_limit_m_s=odd)
        assert robot.velocity == STANDS
    for command in spoilt((0.5, 0.5), odd):
        robot.step((command[0], command[1]), np.zeros(3), 0.1)
        robot.ease(np.zeros(3), (command[0], command[1]), 0.1)
    assert robot.velocity == STANDS and not robot.pose.any()


@ODD
def test_a_pose_is_not_moved_on_by_what_is_no_number(odd: float) -> None:
    for linear, angular in spoilt((0.5, 0.5), odd):
        assert not extrapolate(np.zeros(3), (linear, angular), 0.1).any()
    if math.isnan(odd):  # else as old as it can be
        assert not extrapolate(np.zeros(3), (0.5, 0.5), odd).any()


@ODD
def test_fault_a_navigator_recovers_from_a_place_that_is_no_number(odd: float) -> None:
    """It takes a robot that never comes nearer for one that is stuck, and backs."""
    for wrong in spoilt((0.0, 0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.1, 0.1), odd):
        navigator = Navigator(HybridPlanner(), PathFollower(FollowerConfig(), LIMITS))
        for second in range(6):
            pose, speed, subgoal, velocity = wrong[:3], float(wrong[3]), wrong[4:7], (wrong[7], wrong[8])
            step = navigator.step(pose, speed, subgoal, FREE, second * 10**9, velocity)
            assert step.command == STANDS, (wrong, step.state)


@ODD
def test_a_subgoal_meets_no_pose_that_is_no_number(odd: float) -> None:
    for robot in spoilt((0.0, 0.0, 0.0), odd)[:2]:
        assert not meeting_pose(np.zeros(3), np.zeros(3), robot).any()


@ODD
def test_fault_a_monitor_lets_a_robot_pass_whose_speed_is_no_number(odd: float) -> None:
    monitor = CollisionMonitor(CollisionMonitorConfig(), Footprint())
    nothing = np.zeros((0, 2))
    assert monitor.limit((0.1, 0.0), nothing, 0.0, (0.1, 0.0)).action == "free"
    for v, w, now_v, now_w, age_s in spoilt((0.1, 0.1, 0.1, 0.1, 0.0), odd):
        if age_s != -math.inf:
            assert monitor.limit((v, w), nothing, float(age_s), (now_v, now_w)).command == STANDS


@ODD
def test_fault_one_step_that_is_no_number_ends_the_watch_over_wheels_and_scans(odd: float) -> None:
    for wrong in spoilt((0.03, 0.0, 0.0, 0.03, 0.0, 0.0, 0.1), odd):
        monitor, sigma = ContradictionMonitor(), np.full(3, 0.001)
        monitor.update(wrong[:3], wrong[3:6], float(wrong[6]), sigma)
        for _ in range(10):
            monitor.update(np.array([0.03, 0.0, 0.0]), np.array([-0.03, 0.0, 0.0]), 0.1, sigma)
        assert monitor.state is Contradiction.OTHER_WAY, wrong
