"""The particle filter and its shared maps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from instant_ic.experiments.particle_slam import ParticleConfig, ParticleSlam
from instant_ic.experiments.slam import run_log
from instant_ic.experiments.slam_worlds import Laser, drive, trajectory_errors
from instant_ic.experiments.tile_maps import TILE, TileMaps, climb, score
from instant_ic.slam import SlamStatus
from tests.slam.slam_planar_world import box_room, rectangle

FEW = ParticleConfig(particles=10, linearUpdate=0.3, angularUpdate=0.2)
LASER = Laser(180, 360.0, 12.0, 0.01)
WALLS = [*rectangle(-2.0, -1.5, 6.0, 2.5), *rectangle(1.5, 1.0, 2.0, 1.4), *rectangle(4.0, -1.0, 4.4, -0.4)]
WAY = [(0.0, 0.0), (3.0, 0.5), (5.0, 1.5), (3.0, 0.5), (0.0, 0.0)]


def test_a_ray_by_hand() -> None:
    maps = TileMaps(1, 0.1, 20.0)
    # From (0.05, 0.05) along x to a hit at (0.45, 0.05): cells 0..3 passed, cell 4 hit there.
    maps.register(0, np.array([0.05, 0.05, 0.0]), np.zeros(2), np.array([[0.4, 0.0]]), 5.0)
    visits, hits, corner = maps.grid(0)
    assert corner.tolist() == [0.0, 0.0] and visits.shape == (TILE, TILE)
    assert visits[0, :6].tolist() == [1, 1, 1, 1, 1, 0] and visits.sum() == 5
    assert hits[0, :6].tolist() == [0, 0, 0, 0, 1, 0]
    # A hit beyond the usable range clears the way up to it and hits nothing.
    maps.register(0, np.array([0.05, 0.05, math.pi / 2]), np.zeros(2), np.array([[9.0, 0.0]]), 0.5)
    visits, hits, _ = maps.grid(0)
    assert hits.sum() == 1 and visits[:, 0].tolist()[:7] == [2, 1, 1, 1, 1, 1, 0]


def test_maps_are_shared_until_written_to() -> None:
    maps = TileMaps(3, 0.1, 20.0)
    origin, laser = np.array([0.05, 0.05, 0.0]), np.zeros(2)
    for k in range(3):
        maps.register(k, origin, laser, np.array([[0.4 + 0.5 * k, 0.0]]), 5.0)
    assert maps.tiles == 3
    maps.resample(np.array([2, 2, 0]))
    assert maps.tiles == 2  # the map of particle 1 is gone, that of 2 is shared
    before = maps.grid(1)[0].copy()
    maps.register(0, origin, laser, np.array([[0.0, 1.0]]), 5.0)
    assert maps.tiles == 3
    assert np.array_equal(maps.grid(1)[0], before)  # the other holder of the shared tile sees nothing of it
    assert maps.grid(0)[0].sum() == before.sum() + 11


def test_more_tiles_are_made_when_needed() -> None:
    maps = TileMaps(2, 0.05, 100.0)
    angles = np.linspace(0, 2 * math.pi, 400, endpoint=False)
    circle = 19.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    for k in range(2):
        maps.register(k, np.zeros(3), np.zeros(2), circle, 20.0)
    assert maps.tiles > 256 and maps.counters[1] == 0
    assert len(np.unique(maps.tables[maps.tables >= 0])) == maps.tiles


def test_the_climb_goes_back_to_where_the_scan_was_drawn() -> None:
    world = box_room()
    angles = np.linspace(-math.pi, math.pi, 180, endpoint=False)
    points = world.ranges(np.zeros(3), angles)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    maps = TileMaps(1, 0.05, 40.0)
    maps.register(0, np.zeros(3), np.zeros(2), points, 20.0)
    args = (np.zeros(2), points, 1, 0.05, 0.075)
    best, likelihood = score(maps.tables[0], maps.cells, 0.05, np.zeros(3), *args)
    worse, told = score(maps.tables[0], maps.cells, 0.05, np.array([0.15, 0.1, 0.05]), *args)
    assert best > 150 and worse < 0.6 * best and likelihood > told
    pose, found, _ = climb(maps.tables[0], maps.cells, 0.05, np.array([0.06, -0.05, 0.03]), *args, 0.05, 0.05, 5)
    assert np.hypot(pose[0], pose[1]) < 0.02 and abs(pose[2]) < 0.01
    assert found > 0.9 * best


def test_a_drive_on_bad_odometry() -> None:
    journey = drive(WALLS, WAY, LASER, 2, noise=0.1, scale=0.1, step_m=0.15)
    result = run_log(journey.entries, particles=FEW)
    wheels, _ = trajectory_errors(np.array([e.odom_pose for e in journey.entries]), journey.truth)
    online, degrees = trajectory_errors(result.online[:, 1:], journey.truth)
    final, _ = trajectory_errors(result.trajectory[:, 1:], journey.truth)
    assert wheels.max() > 0.3
    assert online.max() < 0.15 and final.max() < 0.15 and degrees.max() < 4.0
    assert result.statuses == {"first": 1, "tracked": len(journey.entries) - 1}
    assert result.slam.resampled > 0
    grid = result.slam.grid()
    assert set(np.unique(grid.values)) == {-1, 0, 100}
    # The wall at x = −2 stands in the map where it is.
    row, column = int((0.5 - grid.origin[1]) / 0.05), int((-2.0 - grid.origin[0]) / 0.05)
    assert (grid.values[row - 5 : row + 5, column - 2 : column + 3] == 100).any(axis=1).all()


def test_two_runs_are_the_same_and_another_seed_is_not() -> None:
    journey = drive(WALLS, WAY[:2], LASER, 3, step_m=0.15)
    runs = [run_log(journey.entries, particles=FEW).trajectory.tobytes() for _ in range(2)]
    assert runs[0] == runs[1]
    other = replace(FEW, seed=1)
    assert run_log(journey.entries, particles=other).trajectory.tobytes() != runs[0]


def test_without_odometry_scan_matching_stands_in() -> None:
    journey = drive(WALLS, WAY[:3], LASER, 4)
    result = run_log(journey.entries, particles=FEW, use_wheel_odom=False)
    online, _ = trajectory_errors(result.online[:, 1:], journey.truth)
    assert online.max() < 0.15


def test_empty_scans_and_time_going_backwards() -> None:
    slam = ParticleSlam(FEW)
    world = box_room()
    empty = replace(world.scan(np.zeros(3), 1, beams=180), ranges=np.full(180, np.inf))
    assert slam.process(empty, np.zeros(3)).status is SlamStatus.NO_POINTS
    assert slam.process(world.scan(np.zeros(3), 2, beams=180), np.zeros(3)).status is SlamStatus.FIRST
    assert slam.process(world.scan(np.zeros(3), 2, beams=180), np.zeros(3)).status is SlamStatus.TIME_BACKWARDS
    bridged = slam.process(replace(empty, stamp_ns=3), np.array([0.2, 0.0, 0.0]))
    assert bridged.status is SlamStatus.NO_POINTS
    assert bridged.map_from_base == pytest.approx([0.2, 0.0, 0.0])
    with pytest.raises(ValueError, match="not finite"):
        slam.process(world.scan(np.zeros(3), 9, beams=180), [math.nan, 0.0, 0.0])
