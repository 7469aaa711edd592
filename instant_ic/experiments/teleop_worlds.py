"""Worlds for ``ic evaluate teleop``: random corridors with obstacles that the operator does not look at."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.follow_worlds import shortest_way
from instant_ic.experiments.worlds import Obstacle, named_world, without

if TYPE_CHECKING:
    from instant_ic.sim.contact import OccupancyMask
    from instant_ic.sim.world import World

FloatArray = NDArray[np.float64]

RANDOM_CORRIDORS = "corridors"
BODY_M = (0.03, 0.9)
"""Height range in which an object blocks the robot, as in ``sim.robot.RobotConfig``."""
SPARE_M = 0.10
"""The true footprint can pass each obstacle with this margin on every side."""
FIRST_M, APART_M, LAST_M = 3.2, 3.8, 2.4
"""Minimum distance in metres from the start to the first obstacle, between two, and from the last to the goal."""
_TALLER_THAN_THINGS_M = (1.9, 2.2)
_LONGEST_DRIVE_M = 10.0
_BEFORE_WALL_M = 1.2
"""Distance from the wall at which a drive straight ahead ends."""


@dataclass(frozen=True)
class Course:
    """A world with the operator's goals.

    Attributes:
        world: world of the simulated devices; the robot starts at its ``spawn``.
        goals: (N, 2) positions to visit in order, in the world's frame.
        obstacles: objects on the operator's path.
        way_m: length of the straight lines from the start over the goals, metres.
    """

    world: World
    goals: FloatArray
    obstacles: tuple[Obstacle, ...]

    @property
    def free_world(self) -> World:
        """The world without the obstacles."""
        return functools.reduce(without, self.obstacles, self.world)

    @property
    def way_m(self) -> float:
        points = np.concatenate([[self.world.spawn[:2]], self.goals])
        return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def make_course(name: str, seed: int, index: int) -> Course:
    """Create a course: a random corridor, or a drive straight ahead in another world.

    Args:
        name: ``corridors``, or any name of ``sim.worlds.make_world``.
        seed: seed of the courses.
        index: number of the course; the same values give the same course.

    Raises:
        ValueError: no such world, or no possible drive in it.
    """
    if name == RANDOM_CORRIDORS:
        return random_corridor(np.random.default_rng([47, seed, index]), f"corridors {seed}/{index}")
    return straight_ahead(_world(name))


@functools.lru_cache(maxsize=1)
def _world(name: str) -> World:
    """Make a world; cached, because a mesh with its textures takes seconds to load."""
    return named_world(name)


def random_corridor(rng: np.random.Generator, name: str, attempts: int = 50) -> Course:
    """Make a corridor, straight or bent, 2.0 to 2.6 m wide, with one to three objects in the middle.

    Raises:
        ValueError: no passable corridor found within ``attempts``.
    """
    for _ in range(attempts):
        course = _corridor(rng, name)
        if course is not None:
            return course
    raise ValueError(f"no passable corridor found in {attempts} attempts")


def _corridor(rng: np.random.Generator, name: str) -> Course | None:
    from instant_ic.sim.building import Building, Zone
    from instant_ic.sim.world import Material
    from instant_ic.sim.worlds import decorate, random_finish, tint

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
    """Return a box, a post or a low object across the operator's line, ``at`` metres along it."""
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
    """Return the cells in which the robot's body would touch something."""
    return world.occupied(*BODY_M, cell_m)


def route(mask: OccupancyMask, start: FloatArray, goals: FloatArray, spare_m: float) -> FloatArray | None:
    """Return the shortest path (N, 3) of the true footprint over all goals (M, 2); None if there is none."""
    way, pose = [np.asarray(start, np.float64)[None]], np.asarray(start, np.float64)
    for goal in goals:
        leg = shortest_way(mask, pose, np.array([*goal, 0.0]), spare_m)
        if leg is None:
            return None
        way.append(leg[1:])
        pose = leg[-1]
    return np.concatenate(way)


def straight_ahead(world: World) -> Course:
    """Make a course in any world: straight ahead from the start, as far as the walls allow.

    Objects taller than 1.9 m count as walls; the others on the path count as obstacles.

    Raises:
        ValueError: a wall is too near.
    """
    x, y, yaw = world.spawn
    heading = np.array([math.cos(yaw), math.sin(yaw)])
    steps = np.arange(0.0, _LONGEST_DRIVE_M + _BEFORE_WALL_M, 0.05)
    line = np.array([x, y]) + steps[:, None] * heading
    wall = np.flatnonzero(world.occupied(*_TALLER_THAN_THINGS_M, 0.05).at(line))
    reach = float(steps[wall[0]] if wall.size else steps[-1]) - _BEFORE_WALL_M
    if reach < 2.0:
        raise ValueError(
            f"world {world.name!r}: a wall stands {reach + _BEFORE_WALL_M:.1f} m ahead of the start; "
            "the operator drives straight on and needs 3.2 m"
        )
    goal = np.array([x, y]) + reach * heading
    return Course(world, goal[None], things_between(floor_plan(world), np.array([x, y]), goal))


def things_between(plan: OccupancyMask, start: FloatArray, goal: FloatArray) -> tuple[Obstacle, ...]:
    """Return the objects on the straight path from (2,) to (2,) of a robot 0.5 m wide, as boxes across it."""
    length = float(np.linalg.norm(goal - start))
    heading = (goal - start) / length
    yaw = math.atan2(heading[1], heading[0])
    steps = np.arange(0.0, length, 0.05)
    line = start + steps[:, None] * heading
    across = np.linspace(-0.25, 0.25, 11)[:, None] * np.array([-heading[1], heading[0]])
    places = (line[:, None] + across).reshape(-1, 2)
    strip: NDArray[np.bool_] = np.asarray(plan.at(places).reshape(len(steps), -1).any(axis=1))
    begins = np.flatnonzero(strip & ~np.concatenate([[False], strip[:-1]]))
    ends = np.flatnonzero(strip & ~np.concatenate([strip[1:], [False]]))
    found: list[list[float]] = []  # first and last metre of each object
    for first, last in zip(steps[begins], steps[ends], strict=True):
        if found and first - 0.5 * sum(found[-1]) < 1.0:  # the far side of a hollow object
            found[-1][1] = float(last)
        else:
            found.append([float(first), float(last)])
    places = [start + 0.5 * (first + last) * heading for first, last in found]
    sizes = [last - first + 0.05 for first, last in found]
    return tuple(
        Obstacle(float(at[0]), float(at[1]), size, 0.5, yaw, BODY_M[1]) for at, size in zip(places, sizes, strict=True)
    )
