"""Worlds for ``ic evaluate teleop``: random corridors with obstacles that the operator does not look at."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .follow_worlds import shortest_way

if TYPE_CHECKING:
    from ..sim.contact import OccupancyMask
    from ..sim.world import World

FloatArray = NDArray[np.float64]

RANDOM_CORRIDORS = "corridors"
BODY_M = (0.03, 0.9)
"""Heights in which a thing is run into, as ``sim.robot.RobotConfig``."""
SPARE_M = 0.10
"""Each obstacle can be passed by the true footprint with this much to spare on every side."""
FIRST_M, APART_M, LAST_M = 3.2, 3.8, 2.4
"""Metres from the start to the first obstacle, between two, and from the last to the goal, at least."""
_TALLER_THAN_THINGS_M = (1.9, 2.2)


@dataclass(frozen=True)
class Obstacle:
    """A box on the floor: centre (m), length and width (m), yaw (rad), height (m)."""

    x: float
    y: float
    length: float
    width: float
    yaw: float
    height: float


@dataclass(frozen=True)
class Course:
    """A world, and what the operator wants in it.

    Attributes:
        world: what the devices see; the robot starts at its ``spawn``.
        goals: (N, 2) places driven to one after another, in the world's frame.
        obstacles: what stands in the operator's way.
        way_m: metres from the start over the goals.
    """

    world: World
    goals: FloatArray
    obstacles: tuple[Obstacle, ...]

    @property
    def way_m(self) -> float:
        points = np.concatenate([[self.world.spawn[:2]], self.goals])
        return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def make_course(name: str, seed: int, index: int) -> Course:
    """``corridors`` gives another random corridor for each index; any name of ``sim.worlds.make_world`` that world.

    Raises:
        ValueError: no such world, or nowhere to drive to in it.
    """
    if name == RANDOM_CORRIDORS:
        return random_corridor(np.random.default_rng([47, seed, index]), f"corridors {seed}/{index}")
    from ..sim.worlds import make_world

    return straight_ahead(make_world(name))


def random_corridor(rng: np.random.Generator, name: str, attempts: int = 50) -> Course:
    """A straight or bent corridor, 2.0 to 2.6 m wide, with one to three boxes, posts or low things in the middle.

    Raises:
        ValueError: no passable corridor came up within ``attempts``.
    """
    for _ in range(attempts):
        course = _corridor(rng, name)
        if course is not None:
            return course
    raise ValueError(f"no passable corridor within {attempts} attempts")


def _corridor(rng: np.random.Generator, name: str) -> Course | None:
    from ..sim.building import Building, Zone
    from ..sim.world import Material
    from ..sim.worlds import decorate, random_finish, tint

    building = Building()
    finish, height = random_finish(rng), float(rng.uniform(2.4, 3.2))
    width = float(rng.uniform(2.0, 2.6))
    bent = rng.random() < 0.4
    length = float(rng.uniform(7.0, 8.5) if bent else rng.uniform(8.0, 11.5))
    arm = building.add(Zone(-1.5, -width / 2, length, width / 2, height, finish))
    legs = [(np.zeros(2), np.array([length - 1.0, 0.0]))]
    if bent:
        across, beyond = float(rng.uniform(2.0, 2.6)), float(rng.uniform(4.5, 6.5))
        low, high = (arm.y1, arm.y1 + beyond) if rng.random() < 0.5 else (arm.y0 - beyond, arm.y0)
        building.add(Zone(length - across, low, length, high, height, finish))
        turn = np.array([length - across / 2, 0.0])
        legs = [(np.zeros(2), turn), (turn, np.array([turn[0], high - 1.0 if low > 0 else low + 1.0]))]
    obstacles: list[Obstacle] = []
    for number, (start, end) in enumerate(legs):
        at = FIRST_M if number == 0 else APART_M - width / 2
        way = float(np.linalg.norm(end - start))
        at += float(rng.uniform(0.0, 1.0))
        while at < way - LAST_M:
            obstacles.append(_obstacle(rng, start, (end - start) / way, at))
            at += APART_M + float(rng.uniform(0.0, 2.0))
    if not obstacles:
        return None
    for zone in building.zones:
        building.lamps(zone, float(rng.uniform(1.8, 3.0)), float(rng.uniform(2.5, 5.0)), bool(rng.random() < 0.5))
        decorate(rng, building, zone)
    for one in obstacles:
        look = Material(str(rng.choice(["white", "metal", "wood", "fabric"])), 0.8, tint(rng, 0.4))
        building.builder.box((one.x, one.y), (one.length, one.width, one.height), yaw=one.yaw, side=look)
    goals = np.stack([end for _, end in legs])
    world = building.world(name, (0.0, 0.0, 0.0), light_cell_m=0.3, rays=12)
    start = np.zeros(3)
    if route(floor_plan(world), start, goals, SPARE_M) is None:
        return None
    return Course(world, goals, tuple(obstacles))


def _obstacle(rng: np.random.Generator, start: FloatArray, heading: FloatArray, at: float) -> Obstacle:
    """A box, a post or a low thing across the operator's line, ``at`` metres along it."""
    kind = str(rng.choice(["box", "box", "post", "low"]))
    aside = float(rng.uniform(-0.2, 0.2))
    x, y = start + at * heading + aside * np.array([-heading[1], heading[0]])
    if kind == "post":
        size = float(rng.uniform(0.08, 0.14))
        return Obstacle(float(x), float(y), size, size, float(rng.uniform(0, math.pi)), float(rng.uniform(0.7, 1.6)))
    length, width = (float(v) for v in rng.uniform(0.25, 0.5, 2))
    height = float(rng.uniform(0.15, 0.28) if kind == "low" else rng.uniform(0.4, 1.2))
    yaw = math.atan2(heading[1], heading[0]) + float(rng.uniform(-0.4, 0.4))
    return Obstacle(float(x), float(y), length, width, yaw, height)


def floor_plan(world: World, cell_m: float = 0.025) -> OccupancyMask:
    """Where the robot's body would meet something."""
    return world.occupied(*BODY_M, cell_m)


def route(mask: OccupancyMask, start: FloatArray, goals: FloatArray, spare_m: float) -> FloatArray | None:
    """Shortest way (N, 3) of the true footprint over all goals (M, 2); None where there is none."""
    way, pose = [np.asarray(start, np.float64)[None]], np.asarray(start, np.float64)
    for goal in goals:
        leg = shortest_way(mask, pose, np.array([*goal, 0.0]), 0.05, spare_m)
        if leg is None:
            return None
        way.append(leg[1:])
        pose = leg[-1]
    return np.concatenate(way)


def straight_ahead(world: World, most_m: float = 10.0, before_wall_m: float = 1.2) -> Course:
    """Any world: the operator drives straight on from its start, as far as the walls let him.

    What is taller than 1.9 m counts as wall, the rest in the way as obstacle.

    Raises:
        ValueError: a wall is too near.
    """
    x, y, yaw = world.spawn
    heading = np.array([math.cos(yaw), math.sin(yaw)])
    steps = np.arange(0.0, most_m + before_wall_m, 0.05)
    line = np.array([x, y]) + steps[:, None] * heading
    wall = np.flatnonzero(world.occupied(*_TALLER_THAN_THINGS_M, 0.05).at(line))
    reach = float(steps[wall[0]] if wall.size else steps[-1]) - before_wall_m
    if reach < 2.0:
        raise ValueError(
            f"world {world.name!r}: a wall stands {reach + before_wall_m:.1f} m ahead of the start; "
            "the operator drives straight on and needs 3.2 m"
        )
    across = np.linspace(-0.25, 0.25, 11)[:, None] * np.array([-heading[1], heading[0]])
    plan = floor_plan(world)
    strip = np.array([plan.at(point + across).any() for point in line[steps < reach]])
    begins = np.flatnonzero(strip & ~np.concatenate([[False], strip[:-1]]))
    ends = np.flatnonzero(strip & ~np.concatenate([strip[1:], [False]]))
    obstacles: list[Obstacle] = []
    for first, last in zip(begins, ends, strict=True):
        if obstacles and steps[first] - np.linalg.norm([obstacles[-1].x - x, obstacles[-1].y - y]) < 1.0:
            continue  # the other side of a hollow one
        centre = 0.5 * (line[first] + line[last])
        length = float(steps[last] - steps[first]) + 0.05
        obstacles.append(Obstacle(float(centre[0]), float(centre[1]), length, 0.5, yaw, BODY_M[1]))
    return Course(world, (np.array([x, y]) + reach * heading)[None], tuple(obstacles))
