"""Rooms for ``ic evaluate follow``: walls with doors, boxes, low and hanging objects; and a simulated LiDAR.

The LiDAR is cast in the simulator's world, and the shortest path of the true footprint is searched here; neither shares
code with the code under evaluation.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.contact import OccupancyMask
from instant_ic.sim.world import Material, World, WorldBuilder

FloatArray = NDArray[np.float64]

LIDAR_HEIGHT_M = 0.60
RINGS_DEG = np.arange(-15, 16, 2)
AZIMUTHS = 1800
BEAMS = 720
RANGE_MIN_M, RANGE_MAX_M = 0.40, 30.0
SCAN_BAND_M = (0.10, 1.30)
"""Heights of the flat scan (config/robot.yaml)."""
IN_THE_WAY_M = (0.05, 1.25)
"""Height range in which an object blocks the robot, the crawler with its mast."""
LENGTH_M, WIDTH_M = 0.60, 0.50
WALL_M = 0.10
STEEPEST = math.tan(math.radians(15.0))
"""Slope of the lowest and the highest ring."""
WALL, BOX, LOW, HANGING = range(4)
"""Kinds of shapes."""


@dataclass(frozen=True)
class Room:
    """A floor plan with heights.

    Attributes:
        size: (2,) metres; the room extends from (0, 0) to this corner.
        shapes: (N, 7) centre x, y, half length, half width, yaw, lowest and highest z.
        kinds: (N,) ``WALL``, ``BOX``, ``LOW`` or ``HANGING``.
        start: (3,) pose of the r-bot.
        goal: (2,) goal of the v-bot.
        route: (M, 2) the v-bot's path to the goal: around walls, through everything else.
        world: the shapes on their floor.
    """

    size: FloatArray
    shapes: FloatArray
    kinds: NDArray[np.int64]
    start: FloatArray
    goal: FloatArray
    route: FloatArray
    world: World


def made(shapes: FloatArray, size: FloatArray) -> World:
    """Return the world of shapes (N, 7), see ``Room``, on a floor of ``size``."""
    builder = WorldBuilder()
    builder.panel((0.0, size[1], 0.0), (size[0], 0.0, 0.0), (0.0, -size[1], 0.0), Material("white"))
    for x, y, half_x, half_y, yaw, low, high in shapes:
        builder.box((x, y), (2 * half_x, 2 * half_y, high - low), low, yaw)
    return builder.build("room", 5.0, (0.0, 0.0, 0.0))


def make_room(rng: np.random.Generator, hidden: bool, attempts: int = 200) -> Room:
    """Generate a random room whose goal is at least 5 m from the start, by a path around the walls.

    ``hidden`` adds low and hanging objects, which the LiDAR sees only from some distance.

    Raises:
        ValueError: no such room found within ``attempts``.
    """
    for _ in range(attempts):
        size = np.array([rng.uniform(8.0, 12.0), rng.uniform(7.0, 10.0)])
        shapes, kinds = _walls(rng, size)
        walls = np.array(shapes)
        plan = made(walls, size).occupied(*IN_THE_WAY_M, 0.05)
        for _ in range(int(rng.integers(6, 14))):
            kind = int(rng.choice([BOX, BOX, BOX, LOW, HANGING])) if hidden else BOX
            shapes.append(_thing(rng, size, kind))
            kinds.append(kind)
        every = np.array(shapes)
        # Remove objects at the start and the goal.
        start = np.array([*rng.uniform([0.8, 0.8], size - 0.8), rng.uniform(-math.pi, math.pi)])
        goal = rng.uniform([0.8, 0.8], size - 0.8)
        # A robot that drove to its start has seen the low and hanging objects around it. A robot placed there has not:
        # no beam reaches them, so no planner could avoid them.
        clear = np.array(
            [
                k == WALL or (_away(s, start[:2]) > max(0.6, _blind_m(s, k)) and _away(s, goal) > 0.6)
                for s, k in zip(every, kinds, strict=True)
            ]
        )
        every, kept = every[clear], np.array(kinds)[clear]
        if min(_away(s, p) for s in walls for p in (start[:2], goal)) < 0.6:
            continue
        route = shortest_way(plan, start, np.array([*goal, 0.0]), 0.12)
        if route is None or _length(route) < 5.0:
            continue
        return Room(size, every, kept, start, goal, route[:, :2], made(every, size))
    raise ValueError(f"no room with a path of 5 m found in {attempts} attempts")


def _walls(rng: np.random.Generator, size: FloatArray) -> tuple[list[Sequence[float]], list[int]]:
    w, h, half = float(size[0]), float(size[1]), WALL_M / 2
    shapes: list[Sequence[float]] = [
        (w / 2, 0.0, w / 2 + half, half, 0.0, 0.0, 2.5),
        (w / 2, h, w / 2 + half, half, 0.0, 0.0, 2.5),
        (0.0, h / 2, half, h / 2 + half, 0.0, 0.0, 2.5),
        (w, h / 2, half, h / 2 + half, 0.0, 0.0, 2.5),
    ]
    for _ in range(int(rng.integers(0, 3))):  # walls across the room, each with a door
        across = rng.random() < 0.5
        length, other = (h, w) if across else (w, h)
        at = rng.uniform(2.5, other - 2.5)
        door, middle = rng.uniform(0.80, 1.20), rng.uniform(1.2, length - 1.2)
        for a, b in ((0.0, middle - door / 2), (middle + door / 2, length)):
            centre, reach = (a + b) / 2, (b - a) / 2
            shapes.append(
                (at, centre, half, reach, 0.0, 0.0, 2.5) if across else (centre, at, reach, half, 0.0, 0.0, 2.5)
            )
    return shapes, [WALL] * len(shapes)


def _thing(rng: np.random.Generator, size: FloatArray, kind: int) -> Sequence[float]:
    x, y = rng.uniform([0.4, 0.4], size - 0.4)
    half_x, half_y = rng.uniform(0.1, 0.45), rng.uniform(0.1, 0.45)
    if rng.random() < 0.2:
        half_x = half_y = rng.uniform(0.03, 0.06)  # a post or a table leg
    heights = {
        BOX: (0.0, rng.uniform(0.4, 1.8)),
        LOW: (0.0, rng.uniform(0.08, 0.25)),
        HANGING: (rng.uniform(0.75, 1.1), 2.0),
    }
    if kind == LOW:
        half_x, half_y = max(half_x, 0.1), max(half_y, 0.1)
    return (x, y, half_x, half_y, rng.uniform(-math.pi, math.pi), *heights[kind])


def _blind_m(shape: Sequence[float] | FloatArray, kind: int) -> float:
    """Return the distance within which a standing VLP-16 misses a low or hanging object; 0 for others."""
    return {LOW: LIDAR_HEIGHT_M, HANGING: float(shape[5]) - LIDAR_HEIGHT_M}.get(kind, 0.0) / STEEPEST


def _away(shape: Sequence[float] | FloatArray, point: FloatArray) -> float:
    """Return the distance from a point to a shape's outline; 0 inside."""
    cx, cy, half_x, half_y, yaw = (float(v) for v in shape[:5])
    dx, dy = float(point[0]) - cx, float(point[1]) - cy
    c, s = math.cos(yaw), math.sin(yaw)
    return math.hypot(max(abs(c * dx + s * dy) - half_x, 0.0), max(abs(c * dy - s * dx) - half_y, 0.0))


def _length(path: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum())


# -- the LiDAR


def look(world: World, pose: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the points (N, 3) of one revolution in the LiDAR's frame, with 1.5 cm of noise.

    z points up and x along the robot's heading.
    """
    angles = -math.pi + 2 * math.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
    beam, ring = np.meshgrid(angles, np.radians(RINGS_DEG), indexing="ij")
    directions = np.stack([np.cos(ring) * np.cos(beam), np.cos(ring) * np.sin(beam), np.sin(ring)], axis=-1)
    lidar = pose_matrix(pose[0], pose[1], LIDAR_HEIGHT_M, yaw=pose[2])
    rays = np.ascontiguousarray(directions.reshape(-1, 3) @ lidar[:3, :3].T, np.float32)
    ranges, _ = world.caster.cast(lidar[:3, 3].astype(np.float32), rays)
    ranges = ranges.reshape(beam.shape).astype(np.float64)
    seen = (ranges > RANGE_MIN_M) & (ranges < RANGE_MAX_M)
    noisy = ranges + rng.normal(0.0, 0.015, ranges.shape)
    return np.asarray(directions[seen] * noisy[seen][:, None])


def flat_ranges(points: FloatArray) -> FloatArray:
    """Return the driver's ``/scan``: (BEAMS,) nearest point within ``SCAN_BAND_M``; +inf if there is none."""
    z = points[:, 2] + LIDAR_HEIGHT_M
    band = points[(z >= SCAN_BAND_M[0]) & (z <= SCAN_BAND_M[1])]
    beams = np.floor((np.arctan2(band[:, 1], band[:, 0]) + math.pi) * BEAMS / (2 * math.pi)).astype(int) % BEAMS
    ranges = np.full(BEAMS, np.inf)
    np.minimum.at(ranges, beams, np.hypot(band[:, 0], band[:, 1]))
    ranges[ranges < RANGE_MIN_M] = -np.inf
    return ranges


# -- the shortest way

_STEPS = np.array(
    [(1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1)]
    + [(-1, 0), (-2, -1), (-1, -1), (-1, -2), (0, -1), (1, -2), (1, -1), (2, -1)]
)
"""Cells (dx, dy) of one step along each of 16 headings."""


def shortest_way(mask: OccupancyMask, start: FloatArray, goal: FloatArray, margin_m: float) -> FloatArray | None:
    """Return the shortest path (N, 3) of the true footprint with ``margin_m`` on every side; None if there is none.

    Search over 5 cm cells and 16 headings, with steps along the heading in both directions and turns on the spot at
    nearly no cost. With 16 directions, a straight path is at most 1.4 % too long.
    """
    import cv2

    fine = mask.cell_m
    every = max(1, round(0.05 / fine))
    middle = (slice(every // 2, None, every), slice(every // 2, None, every))
    free = np.empty((16, *mask.cells[middle].shape), dtype=bool)
    for h in range(8):
        yaw = math.atan2(_STEPS[h, 1], _STEPS[h, 0])
        reach = math.ceil(math.hypot(LENGTH_M / 2 + margin_m, WIDTH_M / 2 + margin_m) / fine)
        dx, dy = np.meshgrid(np.arange(-reach, reach + 1) * fine, np.arange(-reach, reach + 1) * fine)
        c, s = math.cos(yaw), math.sin(yaw)
        body = (np.abs(c * dx + s * dy) <= LENGTH_M / 2 + margin_m) & (
            np.abs(c * dy - s * dx) <= WIDTH_M / 2 + margin_m
        )
        touched = cv2.dilate(mask.cells.astype(np.uint8), body.astype(np.uint8)) > 0
        free[h] = free[h + 8] = ~touched[middle]
    step = fine * every
    (start_row, start_column), (goal_row, goal_column) = np.floor(
        (np.stack([start[:2], goal[:2]]) - mask.origin) / step
    ).astype(int)[:, ::-1]
    turn = round(float(start[2]) / (math.pi / 8)) % 16
    if not free[turn, start_row, start_column]:  # the start is free, but the bin's heading may be half a bin off
        fits = np.flatnonzero(free[:, start_row, start_column])
        if fits.size == 0:
            return None
        turn = int(fits[np.argmin(np.abs((fits - turn + 8) % 16 - 8))])
    cells = _dijkstra(free, _STEPS, turn, start_row, start_column, goal_row, goal_column)
    if len(cells) == 0:
        return None
    yaw = np.arctan2(_STEPS[cells[:, 0], 1], _STEPS[cells[:, 0], 0])
    way = np.column_stack([mask.origin + (cells[:, 2:0:-1] + 0.5) * step, yaw])
    way[0, :2], way[-1, :2] = start[:2], goal[:2]
    return way


@njit(cache=True)
def _dijkstra(free, steps, turn, row, column, goal_row, goal_column):  # type: ignore[no-untyped-def]
    """Return path cells (N, 3) heading, row, column to the goal at any heading; (0, 3) if there is none."""
    headings, height, width = free.shape
    best = np.full(free.size, np.inf)
    parent = np.full(free.size, -1, dtype=np.int64)
    done = np.zeros(free.size, dtype=np.bool_)
    first = (turn * height + row) * width + column
    best[first] = 0.0
    queue = [(math.hypot(goal_row - row, goal_column - column), first)]
    end = -1
    while len(queue) > 0:
        _, state = heapq.heappop(queue)
        if done[state]:
            continue
        done[state] = True
        c, r, h = state % width, state // width % height, state // (width * height)
        if r == goal_row and c == goal_column:
            end = state
            break
        for k in range(4):
            if k < 2:
                sign = 1 if k == 0 else -1
                dx, dy = sign * steps[h, 0], sign * steps[h, 1]
                other, y, x = h, r + dy, c + dx
                price = math.hypot(dx, dy)
            else:
                other, y, x = (h + (1 if k == 2 else -1)) % headings, r, c
                price = 0.02
            if y < 0 or x < 0 or y >= height or x >= width or not free[other, y, x]:
                continue
            knight = k < 2 and abs(dx) + abs(dy) == 3  # a knight's move passes between two cells
            if knight and not (free[h, r + dy // 2, c + dx // 2] and free[h, r + (dy + 1) // 2, c + (dx + 1) // 2]):
                continue
            new = best[state] + price
            key = (other * height + y) * width + x
            if new < best[key] - 1e-9:
                best[key] = new
                parent[key] = state
                heapq.heappush(queue, (new + math.hypot(goal_row - y, goal_column - x), key))
    count, walk_ = 0, end
    while walk_ >= 0:
        count += 1
        walk_ = parent[walk_]
    cells = np.empty((count, 3), dtype=np.int64)
    for i in range(count - 1, -1, -1):
        cells[i, 0], cells[i, 1], cells[i, 2] = end // (width * height), end // width % height, end % width
        end = parent[end]
    return cells
