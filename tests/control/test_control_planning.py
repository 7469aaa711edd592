"""Subgoal, planner, follower: known places, known ways, known reasons."""

from __future__ import annotations

import math

import numpy as np
import pytest
from control_world import Base, World, corridor, draw_map, matrix, rectangle

from instant_ic.control.costmap import (
    LETHAL,
    UNKNOWN,
    Costmap,
    CostmapConfig,
    RollingCostmap,
    StaticMap,
    scan_rays,
)
from instant_ic.control.follower import FollowerConfig, PathFollower
from instant_ic.control.footprint import Footprint
from instant_ic.control.kinematics import MotionLimits
from instant_ic.control.navigator import Navigator
from instant_ic.control.planner import HybridPlanner, Plan
from instant_ic.control.prediction import PredictionConfig, Predictor
from instant_ic.control.subgoal import choose_subgoal
from instant_ic.control.walls import WallMap

PREDICTOR = Predictor(PredictionConfig(), MotionLimits(), Footprint())
PLANNER = HybridPlanner()


def costmap_of(segments: np.ndarray, at: tuple[float, float] = (0.0, 0.0)) -> Costmap:
    """Everything known: the drawn segments, free elsewhere."""
    n = 320
    grid = StaticMap(np.zeros((n, n), np.int8), 0.05, np.array([-8.0, -8.0]))
    drawn = draw_map(segments, (-8.0, -8.0, 8.0, 8.0))
    grid.occupancy[:] = np.maximum(drawn.occupancy[20:-20, 20:-20], 0)
    return RollingCostmap(CostmapConfig(), Footprint()).update(np.array([*at, 0.0]), grid, None)


class TestSubgoal:
    box = rectangle(1.5, -0.25, 2.0, 0.25)
    costmap = costmap_of(np.concatenate([corridor(10.0), box]), at=(2.0, 0.0))

    def choose(self, pose: list[float], command: tuple[float, float], extend_m: float = 3.0) -> object:
        vbot = np.array(pose)
        prediction = PREDICTOR.predict(vbot, command, command, self.costmap)
        return choose_subgoal(self.costmap, vbot, prediction, command[0] >= 0, None, extend_m)

    def test_a_free_vbot_is_the_subgoal(self) -> None:
        found = self.choose([0.0, 0.0, 0.1], (0.4, 0.0))
        assert found.rule == "vbot"
        np.testing.assert_allclose(found.pose, [0.0, 0.0, 0.1])

    def test_a_vbot_leaving_the_obstacle_sends_the_robot_to_the_farthest_free_point(self) -> None:
        found = self.choose([2.2, 0.0, 0.0], (0.4, 0.0))
        assert found.rule == "trajectory"
        # 0.78 m and the braking distance ahead is where the prediction ends, and it is free there.
        assert 2.9 < found.pose[0] < 3.1

    def test_a_vbot_entering_it_sends_the_robot_to_the_first_free_place_behind(self) -> None:
        found = self.choose([1.3, 0.0, 0.0], (0.1, 0.0))
        assert found.rule == "ahead"
        # Back face at 2.0 (cell centre 2.025); cost 150 is 0.25 + ln(252/150)/3 = 0.423 m from it.
        assert found.pose[0] == pytest.approx(2.025 + 0.423, abs=0.06)

    def test_standing_inside_without_free_space_ahead_it_is_beside(self) -> None:
        found = self.choose([1.75, 0.0, 0.0], (0.0, 0.0), extend_m=0.2)
        assert found.rule == "around"
        assert self.costmap.cost_at(found.pose[:2]) <= 150
        assert np.linalg.norm(found.pose[:2] - [1.75, 0.0]) < 0.9

    def test_anticipation_looks_behind_the_obstacle_but_not_behind_a_wall(self) -> None:
        assert self.choose([0.7, 0.0, 0.0], (0.4, 0.0)).rule == "ahead"
        walls = WallMap(draw_map(np.array([[[1.5, -1.2], [1.5, 1.2]]]), (-2, -1.2, 6, 1.2)))
        vbot = np.array([0.7, 0.0, 0.0])
        prediction = PREDICTOR.predict(vbot, (0.4, 0.0), (0.4, 0.0), self.costmap)
        assert choose_subgoal(self.costmap, vbot, prediction, True, walls, 3.0).rule == "vbot"

    def test_nothing_free_is_no_subgoal(self) -> None:
        full = Costmap(np.full((80, 80), LETHAL, np.uint8), 0.05, np.array([-2.0, -2.0]))
        prediction = PREDICTOR.predict(np.zeros(3), (0.0, 0.0), (0.0, 0.0), full)
        assert choose_subgoal(full, np.zeros(3), prediction, True, None, 3.0) is None


class TestPlanner:
    def test_open_space_gives_the_straight_line(self) -> None:
        plan = PLANNER.plan(costmap_of(np.zeros((0, 2, 2))), np.zeros(3), np.array([3.0, 1.0, 0.7]))
        assert plan.reached
        assert plan.whole_length_m == pytest.approx(math.hypot(3, 1), abs=0.02)
        np.testing.assert_allclose(plan.poses[-1], [3.0, 1.0, 0.7])
        np.testing.assert_allclose(plan.poses[1:-1, 2], math.atan2(1, 3), atol=0.05)
        assert np.linalg.norm(np.diff(plan.poses[:, :2], axis=0), axis=1).max() <= 0.051

    def test_a_robot_outside_the_costmap_gets_no_path(self) -> None:
        plan = PLANNER.plan(costmap_of(np.zeros((0, 2, 2))), np.array([50.0, 0.0, 0.0]), np.zeros(3))
        assert len(plan.poses) == 0
        assert "outside" in plan.reason


def follow(
    goal: tuple[float, float, float], seconds: float, start: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> list:
    """States and poses of a robot that is sent to a goal in open space."""
    costmap = costmap_of(np.zeros((0, 2, 2)))
    navigator = Navigator(PLANNER, PathFollower(FollowerConfig(), MotionLimits()))
    base, log = Base(np.array(start)), []
    for k in range(round(seconds * 20)):
        step = navigator.step(base.pose, base.v, np.array(goal), costmap, k * 50_000_000)
        base.step(step.command, 0.05)
        log.append((step.state, base.pose.copy(), step.command))
    return log


class TestFollower:
    @pytest.mark.parametrize(
        "goal",
        [
            (1.5, 1.0, 0.0),
            (-1.5, 0.3, 0.5),
            (0.0, 0.0, 3.0),
            (0.4, 0.1, 0.0),
        ],
    )
    def test_it_arrives_with_the_yaw_asked_for_and_stays(self, goal: tuple[float, float, float]) -> None:
        log = follow(goal, 15.0)
        assert {state for state, *_ in log[-20:]} == {"arrived"}
        end = log[-1][1]
        assert np.linalg.norm(end[:2] - goal[:2]) < 0.12
        assert abs(math.remainder(end[2] - goal[2], 2 * math.pi)) < 0.09

    def test_a_goal_close_behind_is_reached_backwards(self) -> None:
        log = follow((-0.4, 0.0, 0.0), 6.0)
        assert "reverse" in {state for state, *_ in log}
        assert max(abs(pose[2]) for _, pose, _ in log) < 0.3

    def test_it_catches_up_with_a_goal_that_drives_on(self) -> None:
        # 0.6 m behind, 0.4 m/s against 0.5 m/s.
        costmap = costmap_of(np.zeros((0, 2, 2)))
        navigator = Navigator(PLANNER, PathFollower(FollowerConfig(), MotionLimits()))
        base, goal = Base(np.array([-3.0, -0.2, 0.3])), np.array([-2.4, 0.0, 0.0])
        for k in range(20 * 16):
            goal = goal + [0.4 * 0.05, 0.0, 0.0]
            costmap = costmap_of(np.zeros((0, 2, 2)), at=(0.0, 0.0)) if k == 0 else costmap
            base.step(navigator.step(base.pose, base.v, goal, costmap, k * 50_000_000, (0.4, 0.0)).command, 0.05)
        assert np.linalg.norm(base.pose[:2] - goal[:2]) < 0.1
        assert abs(base.pose[2]) < 0.03

    def test_it_stands_without_a_path(self) -> None:
        empty = Plan(np.zeros((0, 3)), False, "none", math.inf)
        assert PathFollower(FollowerConfig(), MotionLimits()).step(np.zeros(3), 0.0, empty).command == (0.0, 0.0)


class TestRecovery:
    """A robot that is told to move and does not."""

    def test_it_backs_off_then_tries_forward_and_only_when_stuck(self) -> None:
        costmap = costmap_of(np.zeros((0, 2, 2)))
        navigator = Navigator(PLANNER, PathFollower(FollowerConfig(), MotionLimits()))
        goal, seen = np.array([2.0, 0.0, 0.0]), []
        for k in range(20 * 7):  # held in place for 7 s
            seen.append(navigator.step(np.zeros(3), 0.0, goal, costmap, k * 50_000_000))
        assert {step.state for step in seen[:30]} == {"pursue"}
        recovering = [step.command for step in seen if step.state == "recover"]
        assert recovering[0] == (-0.15, 0.0)
        assert recovering[-1] == (0.15, 0.0)
        assert seen[65].state == "pursue"  # in between it tries again

    def test_standing_at_the_goal_is_not_being_stuck(self) -> None:
        assert "recover" not in {state for state, *_ in follow((0.5, 0.0, 0.0), 15.0)}


def test_the_robot_gets_behind_a_box_that_it_only_ever_sees_from_where_it_is() -> None:
    """No map: what is behind the box is unknown until the robot has driven up to see it."""
    world = World(np.concatenate([corridor(10.0), rectangle(1.5, -0.3, 2.1, 0.3)]))
    rolling = RollingCostmap(CostmapConfig(), Footprint())
    navigator = Navigator(PLANNER, PathFollower(FollowerConfig(), MotionLimits()))
    base, goal, reasons = Base(), np.array([3.2, 0.0, 0.0]), set()
    for k in range(20 * 25):
        if k % 4 == 0:
            ranges = world.cast(*base.pose)
            rays = scan_rays(ranges, -math.pi, 2 * math.pi / len(ranges), 0.3, 20.0, matrix(base.pose), CostmapConfig())
            costmap = rolling.update(base.pose, None, rays)
        step = navigator.step(base.pose, base.v, goal, costmap, k * 50_000_000)
        reasons.add(step.plan.reason)
        base.step(step.command, 0.05)
        assert not world.contact(base.pose)
        assert costmap.cost_at(base.pose[:2]) != UNKNOWN
    assert np.linalg.norm(base.pose[:2] - goal[:2]) < 0.12
    assert any("not seen yet" in reason for reason in reasons)
