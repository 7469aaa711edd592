"""Planner for the true footprint: known rooms, known ways, known reasons; a rectangle test of its own as oracle."""

from __future__ import annotations

import math

import numpy as np
import pytest

from instant_ic.control.costmap import LETHAL, UNKNOWN, Costmap, CostmapConfig, RollingCostmap
from instant_ic.control.follower import FollowerConfig, PathFollower
from instant_ic.control.footprint import Footprint
from instant_ic.control.kinematics import MotionLimits
from instant_ic.control.planner import HybridPlanner, Plan
from instant_ic.control.walls import StaticMap

CELL = 0.05
PLANNER = HybridPlanner()


def room(*boxes: tuple[float, float, float, float], size: float = 8.0, unknown: tuple[float, ...] = ()) -> Costmap:
    """A square round the origin, free but for boxes x0, y0, x1, y1 (and one box never seen)."""
    n = round(size / CELL)
    grid = np.zeros((n, n), np.int8)
    for value, box in [(100, b) for b in boxes] + ([(-1, unknown)] if unknown else []):
        x0, y0, x1, y1 = (round((v + size / 2) / CELL) for v in box)
        grid[max(y0, 0) : y1, max(x0, 0) : x1] = value
    static = StaticMap(grid, CELL, np.array([-size / 2, -size / 2]))
    config = CostmapConfig(width=size, footprint_clearing_enabled=False)
    return RollingCostmap(config, Footprint()).update(np.zeros(3), static, None)


def touches(costmap: Costmap, pose: np.ndarray, padding: float = 0.0) -> bool:
    """Whether the centre of a lethal cell lies in the rectangle: nothing of the code under test."""
    rows, columns = np.nonzero(costmap.costs == LETHAL)
    d = costmap.centres(rows, columns) - pose[:2]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    ahead, left = c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]
    return bool(((np.abs(ahead) < 0.30 + padding) & (np.abs(left) < 0.25 + padding)).any())


def plan(costmap: Costmap, start: tuple[float, ...], goal: tuple[float, ...], **values: object) -> Plan:
    planner = HybridPlanner(**values) if values else PLANNER  # type: ignore[arg-type]
    return planner.plan(costmap, np.array(start, float), np.array(goal, float))


def test_out_of_a_dead_end_and_round_it() -> None:
    # A U that opens to the left, the robot in it, the goal behind its closed end: wide enough to turn in.
    costmap = room((1.0, -0.7, 1.1, 0.7), (-0.8, 0.6, 1.0, 0.7), (-0.8, -0.7, 1.0, -0.6))
    found = plan(costmap, (0.4, 0.0, 0.0), (2.5, 0.0, 0.0))
    assert found.reached, found.reason
    assert not any(touches(costmap, pose) for pose in found.poses)
    # To the U's end at -0.8, out by half a width, and round its corners: nothing under 5.4 m.
    assert 5.4 < found.whole_length_m < 8.0


def test_out_of_a_dead_end_too_narrow_to_turn_in_it_backs() -> None:
    # 0.70 m wide: a body 0.60 by 0.50, 0.78 m across its corners, can only reverse.
    costmap = room((1.0, -0.45, 1.1, 0.45), (-1.0, 0.35, 1.0, 0.45), (-1.0, -0.45, 1.0, -0.35))
    found = plan(costmap, (0.6, 0.0, 0.0), (2.5, 0.0, 0.0))
    assert found.reached, found.reason
    assert found.reverse[1:25].all()
    assert np.ptp(found.poses[:25, 2]) < 0.25
    assert not any(touches(costmap, pose) for pose in found.poses)


@pytest.mark.parametrize("width", [0.60, 0.70, 0.90])
def test_a_narrow_door_is_found_and_passed_straight(width: float) -> None:
    costmap = room((1.5, -4.0, 1.6, -width / 2), (1.5, width / 2, 1.6, 4.0))
    found = plan(costmap, (0.0, 0.8, 0.0), (3.0, -0.8, 0.0))
    assert found.reached, found.reason
    assert not any(touches(costmap, pose) for pose in found.poses)
    assert found.whole_length_m < 1.25 * (math.hypot(1.5, 0.8) * 2)
    inside = found.poses[(found.poses[:, 0] > 1.4) & (found.poses[:, 0] < 1.7)]
    if width < 0.65:  # askew by more than asin(0.05 / 0.3) its corners would touch
        assert np.abs(inside[:, 2]).max() < 0.2


def test_a_door_narrower_than_the_robot_is_none() -> None:
    costmap = room((1.5, -4.0, 1.6, -0.20), (1.5, 0.20, 1.6, 4.0))
    found = plan(costmap, (0.0, 0.0, 0.0), (3.0, 0.0, 0.0))
    assert not found.reached
    assert "no way to the goal" in found.reason
    assert not any(touches(costmap, pose) for pose in found.poses)
    assert 1.0 < found.poses[-1, 0] < 1.5  # it goes up to it


def test_headings_matter_where_the_centre_alone_would_pass() -> None:
    """A corridor 0.56 m wide with a right angle: room for the centre, none for a body 0.78 m across its corners."""
    costmap = room((-4.0, 0.30, 1.02, 4.0), (-4.0, -4.0, 4.0, -0.26), (1.58, -0.26, 4.0, 4.0))
    found = plan(costmap, (-1.0, 0.02, 0.0), (1.30, 2.0, math.pi / 2))
    assert not found.reached
    assert not any(touches(costmap, pose) for pose in found.poses)
    wider = room((-4.0, 0.55, 0.85, 4.0), (-4.0, -4.0, 4.0, -0.45), (1.85, -0.45, 4.0, 4.0))
    assert plan(wider, (-1.0, 0.05, 0.0), (1.35, 2.0, math.pi / 2)).reached


def test_a_robot_that_stands_on_an_obstacle_leaves_it_and_never_goes_deeper() -> None:
    costmap = room((0.20, -1.0, 0.60, 1.0))  # under the robot's nose
    assert touches(costmap, np.zeros(3))
    found = plan(costmap, (0.0, 0.0, 0.0), (-1.5, 0.0, 0.0))
    assert found.reached, found.reason
    deep = [costmap.lethal_overlap(pose, Footprint().points(0.02))[0] for pose in found.poses]
    assert deep[0] > 0
    assert max(deep) <= deep[0] * 1.05
    assert deep[-1] == 0
    through = plan(costmap, (0.0, 0.0, 0.0), (1.5, 0.0, 0.0))
    assert through.reached
    assert (costmap.cost_at(through.poses[:, :2]) != LETHAL).all()


def test_unknown_space_is_driven_up_to() -> None:
    costmap = room(unknown=(1.5, -4.0, 4.0, 4.0))
    found = plan(costmap, (0.0, 0.0, 0.0), (2.5, 0.0, 0.0))
    assert not found.reached
    assert found.reason == "the way leads through space not seen yet"
    assert found.poses[-1, 0] == pytest.approx(1.5 - 0.3, abs=0.06)
    assert found.whole_length_m == pytest.approx(2.5, abs=0.05)
    # Round an unknown patch rather than through it.
    patch = room(unknown=(1.0, -0.5, 1.6, 0.5))
    round_it = plan(patch, (0.0, 0.0, 0.0), (3.0, 0.0, 0.0))
    assert round_it.reached
    assert (patch.cost_at(round_it.poses[:, :2]) != UNKNOWN).all()


def test_every_reason_says_why() -> None:
    closed = room((1.5, -4.0, 1.6, 4.0))
    assert "obstacles close it off" in plan(closed, (0.0, 0.0, 0.0), (3.0, 0.0, 0.0)).reason
    taken = plan(room((1.5, -0.5, 2.5, 0.5)), (0.0, 0.0, 0.0), (1.6, 0.0, 0.0))
    assert "the goal is on an obstacle" in taken.reason
    assert math.isfinite(taken.whole_length_m)
    assert "outside the costmap" in plan(room(), (0.0, 0.0, 0.0), (9.0, 0.0, 0.0)).reason
    assert "the robot is outside" in plan(room(), (9.0, 0.0, 0.0), (0.0, 0.0, 0.0)).reason
    maze = room((1.0, -3.0, 1.1, 4.0), (2.0, -4.0, 2.1, 3.0))
    assert "within 5 steps of the search" in plan(maze, (0, 0, 0), (3.0, 0, 0), max_iterations=5).reason


@pytest.mark.parametrize("seed", range(3))
def test_no_pose_of_any_path_touches_anything(seed: int) -> None:
    """Random posts and blocks; every pose and every 5 cm between them by the oracle above."""
    rng = np.random.default_rng(seed)
    boxes = []
    for _ in range(40):
        x, y = rng.uniform(-3.8, 3.8, 2)
        w, h = rng.uniform(0.05, 0.6, 2)
        if math.hypot(x + w / 2 + 3.2, y + h / 2 + 3.2) > 1.2:
            boxes.append((x, y, x + w, y + h))
    costmap = room(*boxes)
    for goal in ((3.2, 3.2, 0.0), (3.2, -3.0, 1.0), (-3.0, 3.0, -2.0)):
        found = plan(costmap, (-3.2, -3.2, 0.3), goal)
        assert not any(touches(costmap, pose) for pose in found.poses)
        assert np.linalg.norm(np.diff(found.poses[:, :2], axis=0), axis=1).max(initial=0.0) <= 0.051
        assert found.reached == (found.reason == "")
        if found.reached:
            np.testing.assert_allclose(found.poses[-1], goal, atol=1e-9)


def test_of_two_equal_ways_the_one_taken_before_is_kept() -> None:
    # A box straight ahead; the robot shakes from side to side by 12 cm.
    costmap = room((1.2, -0.4, 1.6, 0.4))
    before, sides = None, []
    for y in (0.12, -0.12, 0.12, -0.12):
        before = PLANNER.plan(costmap, np.array([0.0, y, 0.0]), np.array([3.0, 0.0, 0.0]), before)
        sides.append(np.sign(before.poses[len(before.poses) // 2, 1]))
    assert len(set(sides)) == 1
    assert (
        plan(costmap, (0.0, 0.12, 0.0), (3.0, 0.0, 0.0)).poses[30, 1]
        > 0
        > (plan(costmap, (0.0, -0.12, 0.0), (3.0, 0.0, 0.0)).poses[30, 1])
    )  # without the path before they do take turns


class TestFollowing:
    follower = PathFollower(FollowerConfig(), MotionLimits())

    def test_the_carrot_comes_nearer_where_the_arc_to_it_would_touch(self) -> None:
        # Ahead 0.6 m, then left round the corner of a block: the straight cut grazes it.
        costmap = room((0.10, 0.32, 0.42, 1.5))
        path = np.array(
            [*[[x, 0.0, 0.0] for x in np.arange(0, 0.81, 0.05)], *[[0.8, y, 1.57] for y in np.arange(0.05, 1.0, 0.05)]]
        )
        path = Plan(path, True, "", 1.75, np.zeros(len(path), bool))
        follower = PathFollower(FollowerConfig(min_lookahead_dist=0.9, max_lookahead_dist=1.2), MotionLimits())
        blind = follower.step(np.zeros(3), 0.5, path, costmap=None).command
        seeing = follower.step(np.zeros(3), 0.5, path, costmap=costmap).command
        assert blind[1] > 0.1
        assert abs(seeing[1]) < 0.02  # straight on first
        assert seeing[0] > 0.2

    def test_boxed_in_it_says_so(self) -> None:
        tight = room((-0.5, 0.27, 1.5, 0.4), (-0.5, -0.4, 1.5, -0.27), (0.33, -0.3, 0.5, 0.3), (-0.5, -0.3, -0.33, 0.3))
        path = Plan(np.array([[0.0, 0.0, 0.0], [0.0, 0.5, 1.57], [0.0, 1.0, 1.57]]), True, "", 1.0)
        self.follower.reset()
        assert self.follower.step(np.zeros(3), 0.0, path, costmap=tight).state == "blocked"

    def test_the_way_back_is_driven_before_the_way_on(self) -> None:
        back = [[-x, 0.0, 0.0] for x in np.arange(0, 0.51, 0.05)]
        on = [[-0.5 + x, x, 0.785] for x in np.arange(0.05, 1.0, 0.05)]
        path = Plan(np.array(back + on), True, "", 1.9, np.array([False] + [True] * 10 + [False] * 19))
        self.follower.reset()
        first = self.follower.step(np.zeros(3), 0.0, path)
        assert first.state == "reverse"
        assert first.command[0] < -0.2
        slow = self.follower.step(np.array([-0.44, 0.0, 0.0]), -0.1, path)
        assert slow.state == "reverse"
        assert -0.25 < slow.command[0] < 0.0  # brakes for the turning point
        turn = self.follower.step(np.array([-0.48, 0.0, 0.6]), 0.0, path)
        assert turn.state in ("pursue", "rotate")
        assert turn.command[0] >= 0.0

    def test_backwards_behind_a_v_bot_it_turns_towards_the_heading_of_the_v_bot(self) -> None:
        path = Plan(np.array([[0.0, 0.0, 0.0], [-0.1, 0.0, 0.1]]), True, "", 0.1, np.array([False, True]))
        self.follower.reset()
        step = self.follower.step(np.zeros(3), -0.3, path, goal_velocity=(-0.3, 0.0))
        assert step.state == "track"
        assert step.command == pytest.approx((-0.3 * math.cos(0.1) - 1.5 * 0.1, 0.3 * 3.0 * math.sin(0.1)))
