"""Collision monitor: each action of a polygon by hand, the most restrictive wins, old points stop."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_frozen_nodes import KEY, stack_in

from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.commands import CommandRules
from instant_ic.control.costmap import CostmapConfig, RollingCostmap
from instant_ic.control.footprint import Footprint
from instant_ic.control.heights import sort_points
from instant_ic.control.moving import MovingPoints
from instant_ic.control.safety import (
    ApproachConfig,
    CollisionMonitor,
    CollisionMonitorConfig,
    PolygonConfig,
    SlowdownConfig,
)
from instant_ic.control.snapshot import ArbiterInputs
from instant_ic.control.states import Mode
from instant_ic.msg import twist_values

WIDE = 0.7
"""Padding of a polygon whose front is at 1.0 m and whose sides are at 0.95 m."""


def monitor(**polygons: PolygonConfig) -> CollisionMonitor:
    off = {"stop": PolygonConfig(False), "slowdown": SlowdownConfig(False), "approach": ApproachConfig(False)}
    return CollisionMonitor(CollisionMonitorConfig(**(off | polygons)), Footprint())


def post(x: float, y: float = 0.0, points: int = 3) -> np.ndarray:
    return np.array([[x, y + 0.001 * k] for k in range(points)])


def test_slowdown_takes_its_share_while_something_is_inside() -> None:
    slow = monitor(slowdown=SlowdownConfig(padding_m=WIDE, slowdown_ratio=0.4))
    found = slow.limit((0.5, 0.2), post(0.9))
    assert found.command == pytest.approx((0.2, 0.08))
    assert (found.action, found.polygon) == ("slowdown", "slowdown")
    assert slow.limit((0.5, 0.2), post(1.1)).action == "free"
    assert slow.limit((0.5, 0.2), post(0.9, 1.0)).action == "free"


def test_stop_holds_what_leads_deeper_and_lets_out_what_leads_away() -> None:
    stop = monitor(stop=PolygonConfig(padding_m=WIDE))
    assert stop.limit((0.3, 0.0), post(0.9)).command == (0.0, 0.0)
    assert stop.limit((0.3, 0.0), post(0.9)).polygon == "stop"
    assert stop.limit((-0.3, 0.0), post(0.9)).action == "free"
    assert stop.limit((0.3, 0.0), post(1.1)).action == "free"  # it looks at what is inside, not ahead


def test_approach_slows_in_proportion_to_the_time_to_contact() -> None:
    # Padded nose at 0.34 m, wall at 0.64 m: 0.30 m at 0.5 m/s is 0.6 s of 1.2 s.
    wall = np.column_stack([np.full(81, 0.641), np.linspace(-0.5, 0.5, 81)])
    found = monitor(approach=ApproachConfig()).limit((0.5, 0.0), wall)
    assert found.action == "approach"
    assert found.command[0] == pytest.approx(0.25, abs=0.025)
    assert found.time_to_collision_s == pytest.approx(0.6, abs=0.051)


def test_the_most_restrictive_wins() -> None:
    both = monitor(slowdown=SlowdownConfig(padding_m=WIDE, slowdown_ratio=0.4), approach=ApproachConfig())
    # 0.56 m before the padded nose: 1.12 s of 1.2 s at 0.5 m/s, or 0.37 s at 1.5 m/s.
    assert both.limit((0.5, 0.0), post(0.9)).polygon == "slowdown"
    assert both.limit((1.5, 0.0), post(0.9)).polygon == "approach"
    everything = CollisionMonitor(CollisionMonitorConfig(), Footprint())
    assert everything.limit((0.5, 0.0), post(0.345)).command == (0.0, 0.0)


def test_few_points_are_noise() -> None:
    slow = monitor(slowdown=SlowdownConfig(padding_m=WIDE, min_points=3))
    assert slow.limit((0.5, 0.0), post(0.9, points=2)).action == "free"
    assert slow.limit((0.5, 0.0), post(0.9, points=3)).action == "slowdown"


@pytest.mark.parametrize("age", [0.51, math.inf, math.nan])
def test_points_that_are_too_old_stop_the_robot(age: float) -> None:
    watched = CollisionMonitor(CollisionMonitorConfig(), Footprint())
    assert watched.limit((0.5, 0.0), post(5.0), 0.49).action == "free"
    found = watched.limit((0.5, 0.0), post(5.0), age)
    assert (found.command, found.polygon) == ((0.0, 0.0), "source_timeout")


def test_the_arbiter_holds_before_a_low_thing_that_only_its_memory_knows() -> None:
    """A kerb 0.10 m high, 0.5 m ahead: the LiDAR does not see it from here, and the operator drives on."""
    rolling = RollingCostmap(CostmapConfig(width=6.0), Footprint())
    kerb = np.array([[0.62 + 0.01 * i, y, 0.1] for i in range(5) for y in np.arange(-0.4, 0.4, 0.01)], np.float32)
    pose = np.eye(4)
    pose[0, 3], pose[2, 3] = -2.0, 0.6  # seen from 2 m farther back
    points = (kerb - pose[:3, 3]).astype(np.float32)
    sweep = sort_points(points, np.zeros(len(points), np.float32), pose[None], 0.0, CostmapConfig().points)
    costmap = rolling.update(np.zeros(3), None, None, sweep)
    rules = CommandRules(ArbiterConfig())
    inputs = ArbiterInputs(
        robot_pose=np.zeros(3),
        costmap=costmap,
        ages=dict.fromkeys(["scan", "odometry", "pose", "camera", "command"], 0.0),
    )
    sent = rules.monitored((0.4, 0.0), inputs)
    # Padded nose at 0.34 m, kerb from 0.625 m: 0.285 m at 0.4 m/s is 0.71 s of 1.2 s.
    assert sent.action == "approach"
    assert sent.command[0] == pytest.approx(0.4 * 0.71 / 1.2, abs=0.03)
    assert rules.monitored((-0.4, 0.0), inputs).action == "free"
    old = ArbiterInputs(**{**vars(inputs), "ages": {**inputs.ages, "points": 0.6}})
    assert rules.monitored((-0.4, 0.0), old).polygon == "source_timeout"


def test_a_robot_that_is_faster_than_its_command_needs_its_braking_distance() -> None:
    wall = np.array([[0.44, y] for y in (-0.1, 0.0, 0.1)])
    approach = CollisionMonitor(CollisionMonitorConfig(), Footprint())
    # 0.10 m before the padded nose at 0.34 m. At 0.1 m/s the point enters in the step that starts at 1.0 s.
    assert approach.limit((0.1, 0.0), wall).time_to_collision_s == pytest.approx(1.0, abs=0.051)
    # From 0.5 m/s down by 0.8 m/s2 in steps of 0.05 s: 0.023, 0.044, 0.063, 0.080, 0.095, 0.108 m.
    found = approach.limit((0.1, 0.0), wall, velocity=(0.5, 0.0))
    assert found.time_to_collision_s == pytest.approx(0.25)
    assert found.command[0] == pytest.approx(0.1 * 0.25 / 1.2)


@pytest.mark.parametrize(("place_m", "time_s", "speed"), [(1.14, 0.65, 0.2 * 0.65 / 1.2), (1.04, 0.55, 0.0)])
def test_the_robot_stands_when_a_person_arrives(place_m: float, time_s: float, speed: float) -> None:
    # 0.80 m (0.70 m) before the padded nose, closing at 1.0 + 0.2 m/s: in the step from 0.65 s (0.55 s) on.
    person = np.array([[place_m, y] for y in (-0.05, 0.0, 0.05)])
    moving = MovingPoints(person, np.tile([-1.0, 0.0], (3, 1)))
    watched = CollisionMonitor(CollisionMonitorConfig(), Footprint())
    found = watched.limit((0.2, 0.0), person, moving=moving)
    assert found.time_to_collision_s == pytest.approx(time_s)
    assert found.command[0] == pytest.approx(speed)
    assert watched.limit((0.2, 0.0), person).action == "free"
    assert watched.limit((0.2, 0.0), person, moving=MovingPoints(person, -moving.velocities)).action == "free"


@pytest.mark.parametrize("mode", [Mode.REAL, Mode.VIRTUAL, Mode.RETURNING])
def test_every_command_of_every_mode_passes_the_monitor(mode: Mode) -> None:
    """The corridor's walls are in a polygon that slows the key's speed to a quarter."""
    stack = stack_in(mode)
    assert stack.bus.last("/ic/state").mode == mode
    slowdown = "collision_monitor.slowdown."
    stack.arbiter.parameters.set({slowdown + "padding_m": 1.0, slowdown + "slowdown_ratio": 0.25})
    before = len(stack.bus.records("/cmd_vel"))
    stack.drive(0.5, KEY)
    speeds = [abs(twist_values(message)[0]) for message in stack.bus.messages("/cmd_vel")[before:]]
    assert 0.05 < max(speeds) <= 0.1 + 1e-6
