"""Generated buildings of plain walls, and logs of drives through them with ground-truth poses.

They have long loops, bare corridors, rooms that look alike, and the lasers of public logs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from instant_ic.experiments.slam_logs import LogEntry
from instant_ic.geometry.poses import compose2, relative2, wrap_angle
from instant_ic.sim.world import Material, WorldBuilder
from instant_ic.slam import Scan
from instant_ic.slam.scan import FloatArray

Wall = tuple[float, float, float, float]


@dataclass(frozen=True)
class Laser:
    """A planar laser.

    Attributes:
        beams: number of beams per scan.
        field_of_view_deg: 360 for a full circle.
        range_max: metres; a beam has no return beyond it.
        noise_m: standard deviation of a range.
        mount: base_from_laser (3,).
    """

    beams: int
    field_of_view_deg: float
    range_max: float
    noise_m: float = 0.015
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def angles(self) -> FloatArray:
        """Beam angles in the laser's frame (n,)."""
        whole = self.field_of_view_deg >= 360
        span = math.radians(self.field_of_view_deg)
        step = span / (self.beams if whole else self.beams - 1)
        return np.asarray(-span / 2 + step * np.arange(self.beams), dtype=np.float64)


LASERS = {
    "vlp16": Laser(720, 360.0, 30.0, 0.02),
    "sick180": Laser(180, 179.0, 80.0, 0.01, (0.1, 0.0, 0.0)),
}


@dataclass(frozen=True)
class Drive:
    """A drive: scans with odometry, and ground-truth poses (n, 3) in the frame of the first pose."""

    entries: list[LogEntry]
    truth: FloatArray


def drive(
    walls: Sequence[Wall],
    waypoints: Sequence[tuple[float, float]],
    laser: Laser,
    seed: int = 0,
    *,
    step_m: float = 0.1,
    step_rad: float = 0.1,
) -> Drive:
    """Drive between waypoints, turning on the spot, with a scan every ``step_m`` or ``step_rad``.

    Each odometry step has noise of 5 % (1σ) of its size; all steps share a scale error of up to 3 %.

    Args:
        walls: walls of the building.
        waypoints: at least two points (x, y) in metres.
        laser: laser of the robot.
        seed: seed of all noise.
        step_m: metres between scans.
        step_rad: radians between scans.
    """
    rng = np.random.default_rng(seed)
    builder = WorldBuilder()
    for x0, y0, x1, y1 in walls:
        builder.wall((x0, y0), (x1, y1), 0.0, 1.0, Material("white"))
    caster = builder.build("walls", 1.0, (0.0, 0.0, 0.0)).caster
    poses = _poses_along(np.array(waypoints, dtype=np.float64), step_m, step_rad)
    factor = 1.0 + 0.03 * rng.uniform(-1.0, 1.0, 3)
    odometry = np.zeros(3)
    mount = np.array(laser.mount)
    entries = []
    for index, pose in enumerate(poses):
        if index:
            step = relative2(poses[index - 1], pose)
            size = np.array([math.hypot(step[0], step[1])] * 2 + [abs(step[2]) + 0.1 * abs(step[0])])
            rng.random()  # unused; keeps the random sequence, and so the noise, of the published figures
            odometry = compose2(odometry, factor * step + 0.05 * size * rng.standard_normal(3))
        at = compose2(pose, mount)
        angles = laser.angles + at[2]
        rays = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(laser.beams)]).astype(np.float32)
        hits, _ = caster.cast(np.array([at[0], at[1], 0.5], np.float32), rays)
        ranges = hits.astype(np.float64) + laser.noise_m * rng.standard_normal(laser.beams)
        ranges[ranges >= laser.range_max] = np.inf
        increment = float(laser.angles[1] - laser.angles[0])
        scan = Scan(ranges, float(laser.angles[0]), increment, 0.02, laser.range_max, (index + 1) * 100_000_000)
        entries.append(LogEntry(scan, odometry, mount))
    return Drive(entries, np.array([relative2(poses[0], pose) for pose in poses]))


def _poses_along(points: FloatArray, step_m: float, step_rad: float) -> list[FloatArray]:
    """Return poses (3,) along the lines between points (n, 2), with turns on the spot."""
    poses = [np.array([*points[0], math.atan2(*(points[1] - points[0])[::-1])])]
    for target in points[1:]:
        way = target - poses[-1][:2]
        turn = wrap_angle(math.atan2(way[1], way[0]) - float(poses[-1][2]))
        turns = math.ceil(abs(turn) / step_rad)
        for _ in range(turns):
            poses.append(compose2(poses[-1], [0.0, 0.0, turn / turns]))
        length = math.hypot(way[0], way[1])
        steps = max(1, math.ceil(length / step_m))
        for _ in range(steps):
            poses.append(compose2(poses[-1], [length / steps, 0.0, 0.0]))
    return poses


def ring(seed: int = 0) -> tuple[list[Wall], list[tuple[float, float]]]:
    """Return walls and waypoints of a ring of corridors with niches and a few open rooms.

    The centre line is 210 m long; only the niches distinguish one stretch from the next. It is driven twice, then once
    in reverse.
    """
    rng = np.random.default_rng(seed)
    corners = [(0.0, 0.0), (60.0, 0.0), (60.0, 45.0), (0.0, 45.0)]
    walls: list[Wall] = []
    for k in range(4):
        for side in (-1.0, 1.0):  # right (outer) and left (inner) wall
            walls += _niche_wall(np.array(corners[k]), np.array(corners[(k + 1) % 4]), side, rng)
    loop = [(2.0, 0.0), *corners[1:], corners[0]]
    back = [(2.0, 0.0), corners[0], *corners[:0:-1], corners[0]]
    return walls, [*loop, *loop, (6.0, 0.0), *back, (6.0, 0.0)]


def _niche_wall(start: FloatArray, end: FloatArray, side: float, rng: np.random.Generator) -> list[Wall]:
    """Return a corridor's wall on one side (1 left, −1 right) of its centre line, with niches of random depth."""
    half, width = 1.1, 0.9
    length = math.hypot(*(end - start))
    along = (end - start) / length
    outwards = side * np.array([-along[1], along[0]])
    begins, at = [], 1.0
    while at < length - 3.0 and (at := at + float(rng.uniform(1.5, 7.0))) <= length - 2.5:
        begins.append(at)
        at += width
    outline = [(side * half, 0.0)]  # metres along the wall, and into it
    for begin in begins:
        deep = float(rng.choice([0.12, 0.2, 0.3, 3.0], p=[0.4, 0.3, 0.2, 0.1]))
        outline += [(begin, 0.0), (begin, deep), (begin + width, deep), (begin + width, 0.0)]
    outline.append((length - side * half, 0.0))
    points = [start + a * along + (half + into) * outwards for a, into in outline]
    return [(*a.tolist(), *b.tolist()) for a, b in pairwise(points)]


def cells(rooms: int = 9) -> tuple[list[Wall], list[tuple[float, float]]]:
    """Return walls and waypoints of a corridor with identical, identically furnished rooms, some of them visited."""
    length = 4.0 * rooms
    walls: list[Wall] = [(0.0, -1.0, length, -1.0), (0.0, -1.0, 0.0, 1.0), (length, -1.0, length, 1.0)]
    for x in 4.0 * np.arange(rooms):
        walls += [(x, 1.0, x + 1.5, 1.0), (x + 2.5, 1.0, x + 4.0, 1.0)]  # beside the door
        walls += [(x, 1.0, x, 5.0), (x + 4.0, 1.0, x + 4.0, 5.0), (x, 5.0, x + 4.0, 5.0)]
        walls += _box(x + 0.6, 4.2, 1.4, 0.7) + _box(x + 3.4, 2.6, 0.5, 1.0)
    path = [(1.0, 0.0)]
    for x in 4.0 * np.arange(0, rooms, 2) + 2.0:
        path += [(x, 0.0), (x, 3.0), (x + 0.5, 2.0), (x, 0.0)]
    path += [(length - 1.0, 0.0)]
    for x in 4.0 * np.arange(rooms - 1, -1, -3) + 2.0:
        path += [(x, 0.0), (x, 3.0), (x, 0.0)]
    return walls, [*path, (1.0, 0.0)]


def _box(x: float, y: float, w: float, h: float) -> list[Wall]:
    return [(x, y, x + w, y), (x + w, y, x + w, y + h), (x + w, y + h, x, y + h), (x, y + h, x, y)]
