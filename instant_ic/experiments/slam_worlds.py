"""Generated buildings of plain walls, and logs of drives through them with ground-truth poses.

They replace public logs that are not available. They have long loops, bare corridors, rooms that look alike, and the
lasers of those logs (180° and 361 beams, 240° and 4 m, 8 m maxima).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from instant_ic.experiments.slam_logs import LogEntry
from instant_ic.geometry.poses import compose2, relative2, wrap_angle
from instant_ic.slam import Scan
from instant_ic.slam.scan import FloatArray

Wall = tuple[float, float, float, float]


@njit(cache=True)
def cast_rays(walls, x, y, angles):  # type: ignore[no-untyped-def]
    """Distance to the first wall along each angle (n,), inf if there is none; ``walls`` (m, 4): x0 y0 x1 y1."""
    out = np.full(angles.shape[0], np.inf)
    for i in range(angles.shape[0]):
        dx, dy = math.cos(angles[i]), math.sin(angles[i])
        for k in range(walls.shape[0]):
            sx, sy = walls[k, 0] - x, walls[k, 1] - y
            ex, ey = walls[k, 2] - walls[k, 0], walls[k, 3] - walls[k, 1]
            cross = dx * ey - dy * ex
            if abs(cross) < 1e-12:
                continue
            along_ray = (sx * ey - sy * ex) / cross
            along_wall = (sx * dy - sy * dx) / cross
            if 0.0 < along_ray < out[i] and 0.0 <= along_wall <= 1.0:
                out[i] = along_ray
    return out


@dataclass(frozen=True)
class Laser:
    """A planar laser.

    Attributes:
        beams: per scan.
        field_of_view_deg: 360 for a full circle.
        range_max: metres; beyond it the beam has no return.
        noise_m: standard deviation (1σ).
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
    "sick361": Laser(361, 180.0, 50.0, 0.01, (0.1, 0.0, 0.0)),
    "sick8m": Laser(181, 180.0, 8.183, 0.01),
    "hokuyo": Laser(682, 240.0, 4.0, 0.01, (0.145, 0.0, 0.0)),
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
    noise: float = 0.05,
    scale: float = 0.03,
    slip: float = 0.0,
) -> Drive:
    """Drive between waypoints, at least two, turning on the spot, with a scan every ``step_m`` or ``step_rad``.

    Args:
        noise: standard deviation (1σ) of each odometry step, relative to its size.
        scale: largest systematic odometry error, relative, for translation and rotation each.
        slip: share of steps, 0..1, in which the tracks spin: the encoders count up to half as much again.
    """
    rng = np.random.default_rng(seed)
    world = np.array(walls, dtype=np.float64)
    points = np.array(waypoints, dtype=np.float64)
    start = np.array([*points[0], math.atan2(*(points[1] - points[0])[::-1])])
    poses = [start]
    for target in points[1:]:
        way = target - poses[-1][:2]
        heading = math.atan2(way[1], way[0])
        turn = wrap_angle(heading - float(poses[-1][2]))
        turns = math.ceil(abs(turn) / step_rad)
        for _ in range(turns):
            poses.append(compose2(poses[-1], [0.0, 0.0, turn / turns]))
        length = math.hypot(way[0], way[1])
        steps = max(1, math.ceil(length / step_m))
        for _ in range(steps):
            poses.append(compose2(poses[-1], [length / steps, 0.0, 0.0]))
    factor = 1.0 + scale * rng.uniform(-1.0, 1.0, 3)
    odometry = np.zeros(3)
    mount = np.array(laser.mount)
    entries = []
    for index, pose in enumerate(poses):
        if index:
            step = relative2(poses[index - 1], pose)
            size = np.array([math.hypot(step[0], step[1])] * 2 + [abs(step[2]) + 0.1 * abs(step[0])])
            spun = 1.0 + (rng.uniform(0.0, 0.5, 3) if rng.random() < slip else 0.0)
            odometry = compose2(odometry, factor * spun * step + noise * size * rng.standard_normal(3))
        at = compose2(pose, mount)
        ranges = cast_rays(world, at[0], at[1], laser.angles + at[2])
        ranges = ranges + laser.noise_m * rng.standard_normal(laser.beams)
        ranges[ranges >= laser.range_max] = np.inf
        increment = float(laser.angles[1] - laser.angles[0])
        scan = Scan(ranges, float(laser.angles[0]), increment, 0.02, laser.range_max, (index + 1) * 100_000_000)
        entries.append(LogEntry(scan, odometry, mount))
    return Drive(entries, np.array([relative2(start, pose) for pose in poses]))


def _line(x0: float, y0: float, x1: float, y1: float, doors: Sequence[tuple[float, float]] = ()) -> list[Wall]:
    """A wall with openings, given as (distance from its start, width)."""
    length = math.hypot(x1 - x0, y1 - y0)
    ux, uy = (x1 - x0) / length, (y1 - y0) / length
    cuts = [0.0]
    for at, width in sorted(doors):
        cuts += [at, at + width]
    cuts.append(length)
    return [
        (x0 + ux * a, y0 + uy * a, x0 + ux * b, y0 + uy * b)
        for a, b in zip(cuts[::2], cuts[1::2], strict=True)
        if b > a
    ]


def _box(x: float, y: float, w: float, h: float) -> list[Wall]:
    return [(x, y, x + w, y), (x + w, y, x + w, y + h), (x + w, y + h, x, y + h), (x, y + h, x, y)]


def ring(seed: int = 0) -> tuple[list[Wall], list[tuple[float, float]]]:
    """A ring of corridors with closed doors set back in niches and a few open rooms; driven twice, once in reverse.

    The centre line is 210 m long; only the niches distinguish one stretch from the next.
    """
    rng = np.random.default_rng(seed)
    width, depth, half = 60.0, 45.0, 1.1
    walls: list[Wall] = []
    corners = [(0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth)]
    for k in range(4):
        (ax, ay), (bx, by) = corners[k], corners[(k + 1) % 4]
        length = math.hypot(bx - ax, by - ay)
        ux, uy = (bx - ax) / length, (by - ay) / length
        for side in (-1.0, 1.0):  # right (outer) and left (inner) wall
            extent = half if side < 0 else -half
            at, doors = 1.0, []
            while at < length - 3.0:
                at += float(rng.uniform(1.5, 7.0))
                if at > length - 2.5:
                    break
                doors.append((at + extent, 0.9))
                at += 0.9
            sx = ax - ux * extent - side * uy * half
            sy = ay - uy * extent + side * ux * half
            ex = bx + ux * extent - side * uy * half
            ey = by + uy * extent + side * ux * half
            walls += _line(sx, sy, ex, ey, doors)
            for start, w in doors:
                deep = float(rng.choice([0.12, 0.2, 0.3, 3.0], p=[0.4, 0.3, 0.2, 0.1]))
                px, py = sx + ux * start, sy + uy * start
                qx, qy = px + ux * w, py + uy * w
                nx, ny = -side * uy * deep, side * ux * deep
                walls += [(px, py, px + nx, py + ny), (px + nx, py + ny, qx + nx, qy + ny), (qx + nx, qy + ny, qx, qy)]
    loop = [(2.0, 0.0), *corners[1:], corners[0]]
    back = [(2.0, 0.0), corners[0], *corners[:0:-1], corners[0]]
    return walls, [*loop, *loop, (6.0, 0.0), *back, (6.0, 0.0)]


def cells(rooms: int = 9) -> tuple[list[Wall], list[tuple[float, float]]]:
    """A straight corridor with identical rooms on one side, identically furnished; some are visited."""
    room, hall = 4.0, 2.0
    length = rooms * room
    doors = [(k * room + 1.5, 1.0) for k in range(rooms)]
    walls = _line(0.0, 1.0, length, 1.0, doors) + _line(0.0, 1.0 - hall, length, 1.0 - hall)
    walls += [(0.0, 1.0 - hall, 0.0, 1.0), (length, 1.0 - hall, length, 1.0)]
    for k in range(rooms):
        x = k * room
        walls += [(x, 1.0, x, 5.0), (x + room, 1.0, x + room, 5.0), (x, 5.0, x + room, 5.0)]
        walls += _box(x + 0.6, 4.2, 1.4, 0.7) + _box(x + 3.4, 2.6, 0.5, 1.0)
    path = [(1.0, 0.0)]
    for k in range(0, rooms, 2):
        x = k * room + 2.0
        path += [(x, 0.0), (x, 3.0), (x + 0.5, 2.0), (x, 0.0)]
    path += [(length - 1.0, 0.0)]
    for k in range(rooms - 1, -1, -3):
        x = k * room + 2.0
        path += [(x, 0.0), (x, 3.0), (x, 0.0)]
    return walls, [*path, (1.0, 0.0)]


def office(seed: int = 0) -> tuple[list[Wall], list[tuple[float, float]]]:
    """Two corridors joined by crossings, offices with furniture on both sides, driven in figures of eight."""
    rng = np.random.default_rng(seed)
    walls: list[Wall] = [(-1.0, -1.0, -1.0, 13.0), (31.0, -1.0, 31.0, 13.0)]
    crossings = [(0.0, 2.0), (14.0, 2.0), (30.0, 2.0)]
    for y in (1.0, 11.0):
        walls += _line(-1.0, y, 31.0, y, [(x, w) for x, w in crossings])
    for x in (1.0, 13.0, 15.0, 29.0):
        walls.append((x, 1.0, x, 11.0))
    for side in (-1.0, 1.0):
        wall_y, back_y = (-1.0, -5.5) if side < 0 else (13.0, 17.5)
        xs = [-1.0]
        while xs[-1] < 27.0:
            xs.append(xs[-1] + float(rng.uniform(3.0, 5.0)))
        xs[-1] = 31.0
        walls += _line(-1.0, wall_y, 31.0, wall_y, [((a + b) / 2 - 0.5 + 1.0, 1.0) for a, b in itertools.pairwise(xs)])
        walls += [(-1.0, back_y, 31.0, back_y)] + [(x, wall_y, x, back_y) for x in xs]
        for a, b in itertools.pairwise(xs):
            for _ in range(3):
                w, h = rng.uniform(0.4, 1.4, 2)
                x = float(rng.uniform(a + 0.1, b - 0.1 - w))
                y = float(rng.uniform(1.6, 4.3 - h))
                walls += _box(x, wall_y - y - h if side < 0 else wall_y + y, float(w), float(h))
    eight = [(0.0, 0.0), (14.0, 0.0), (14.0, 12.0), (30.0, 12.0), (30.0, 0.0), (14.0, 0.0), (14.0, 12.0), (0.0, 12.0)]
    return walls, [*eight, *eight, (0.0, 0.0), (14.0, 0.0), (14.0, 12.0), (0.0, 12.0), (0.0, 0.0), (2.0, 0.0)]


def trajectory_errors(estimate: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance in metres and angle in degrees of each pose (n, 3) from ground truth (n, 3)."""
    rest = np.array([relative2(a, b) for a, b in zip(truth, estimate, strict=True)])
    return np.hypot(rest[:, 0], rest[:, 1]), np.degrees(np.abs(rest[:, 2]))
