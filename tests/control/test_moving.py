"""People found by their motion, and a goal to which nothing comes nearer."""

from __future__ import annotations

import math

import numpy as np
import pytest

from instant_ic.control.heights import HeightConfig, SortedPoints, sort_points
from instant_ic.control.moving import MovingThings
from instant_ic.control.planner import Plan, no_plan
from instant_ic.control.progress import Progress
from instant_ic.experiments import follow_worlds as worlds
from instant_ic.geometry.poses import matrix_from_pose2

ROOM = np.array(
    [
        (5.0, 0.0, 5.0, 0.05, 0.0, 0.0, 2.5),
        (5.0, 8.0, 5.0, 0.05, 0.0, 0.0, 2.5),
        (0.0, 4.0, 0.05, 4.0, 0.0, 0.0, 2.5),
        (10.0, 4.0, 0.05, 4.0, 0.0, 0.0, 2.5),
        (4.0, 5.5, 0.3, 0.3, 0.5, 0.0, 1.0),
        (4.0, 2.5, 0.03, 0.03, 0.0, 0.0, 1.5),
    ]
)


def seen(pose: np.ndarray, person: np.ndarray | None, rng: np.random.Generator) -> SortedPoints:
    """A sweep in the room, with a box and a pole, placed in the room's frame."""
    people = [] if person is None else [(*person, 0.2, 0.2, 0.0, 0.0, 1.7)]
    points = worlds.look(worlds.made(np.array([*ROOM, *people]), np.array([10.0, 8.0])), pose, rng).astype(np.float32)
    level = matrix_from_pose2(pose)
    level[2, 3] = worlds.LIDAR_HEIGHT_M
    return sort_points(points, np.zeros(len(points), np.float32), level[None], 0.0, HeightConfig())


def test_a_person_has_the_velocity_at_which_they_walk() -> None:
    things, rng = MovingThings(), np.random.default_rng(1)
    pose = np.array([2.0, 4.0, 0.3])
    for k in range(15):  # from 3.5 m away to 2.1 m away at 1.0 m/s, past the robot by 0.5 m
        things.update(seen(pose, np.array([5.5 - 0.1 * k, 4.5]), rng), 0.1 * k)
    found = things.moving(1.4)
    assert len(found.points) > 5
    assert found.velocities.mean(axis=0) == pytest.approx([-1.0, 0.0], abs=0.15)
    assert found.points.mean(axis=0) == pytest.approx([4.1, 4.5], abs=0.25)
    # Out of sight, they are expected to go on: 0.5 m in half a second.
    moved = things.moving(1.9).points.mean(axis=0) - found.points.mean(axis=0)
    assert moved == pytest.approx([-0.5, 0.0], abs=0.08)


def test_walls_boxes_and_poles_do_not_move_when_the_robot_drives() -> None:
    things, rng = MovingThings(), np.random.default_rng(2)
    for k in range(40):  # 0.5 m/s and turning, with 1.5 cm of noise on the ranges
        pose = np.array([2.0 + 0.05 * k, 4.0 + 0.5 * math.sin(0.1 * k), 0.05 * k])
        things.update(seen(pose, None, rng), 0.1 * k)
        assert len(things.moving(0.1 * k).points) == 0


def straight(length_m: float, reached: bool) -> Plan:
    """A path of this length from the origin."""
    x = np.linspace(0.0, length_m, 1 + round(length_m / 0.05))
    return Plan(np.stack([x, 0 * x, 0 * x], axis=1), reached, "" if reached else "closed", length_m)


GOAL = np.array([5.0, 0.0, 0.0])


def lost(progress: Progress, plan: Plan, second: float) -> bool:
    return progress.lost(plan, np.zeros(3), GOAL, round(1e9 * second))


def test_a_way_that_opens_and_closes_is_given_up_within_ten_seconds() -> None:
    progress = Progress(2.0)
    answers = [lost(progress, straight(5.0, True) if k % 2 else straight(3.0, False), 0.2 * k) for k in range(50)]
    assert answers.index(True) < 20  # 4 s: two other ways, each with two seconds, at most
    assert all(answers[answers.index(True) :])


def test_a_robot_that_drives_is_not_given_up_and_a_new_goal_starts_anew() -> None:
    progress = Progress(2.0)
    assert not any(lost(progress, straight(5.0 - 0.05 * k, True), 0.2 * k) for k in range(100))
    assert [lost(progress, no_plan("closed"), t) for t in (30.0, 31.9, 32.1)] == [False, False, True]
    assert not progress.lost(no_plan("closed"), np.zeros(3), GOAL + 1.0, round(33e9))


def test_a_way_must_stay_open_longer_each_time() -> None:
    progress, way = Progress(2.0), straight(5.0, True)  # a way that the robot cannot drive
    assert [lost(progress, way, t) for t in (0.0, 1.9, 2.0, 2.9, 3.1)] == [False, False, True, True, False]  # 1 s
    assert [lost(progress, way, t) for t in (3.2, 5.1, 5.3, 7.2, 7.4)] == [False, False, True, True, False]  # 2 s
