"""Occupancy grid: values, geometry, growth."""

from __future__ import annotations

import math

import numpy as np
from slam_planar_world import box_room

from instant_ic.slam.config import MapConfig
from instant_ic.slam.occupancy import OccupancyGrid, OccupancyMap
from instant_ic.slam.scan import ScanPoints, scan_points


def hits(*points: tuple[float, float]) -> ScanPoints:
    array = np.array(points, dtype=np.float64).reshape(-1, 2)
    return ScanPoints(array, np.zeros(len(array), dtype=bool), np.zeros(2))


def value(grid: OccupancyGrid, x: float, y: float) -> int:
    column, row = np.floor((np.array([x, y]) - grid.origin) / grid.resolution).astype(int)
    return int(grid.values[row, column])


def test_one_ray_by_hand() -> None:
    occupancy = OccupancyMap(MapConfig())
    occupancy.insert(np.array([0.025, 0.025, 0.0]), hits((1.0, 0.0)))
    grid = occupancy.grid()
    assert grid.values.dtype == np.int8
    assert grid.resolution == 0.05
    assert value(grid, 1.03, 0.03) == 70  # hit_probability
    assert value(grid, 0.5, 0.03) == 40  # miss_probability
    assert value(grid, 0.03, 0.03) == 40
    assert value(grid, 1.08, 0.03) == -1  # behind the hit
    assert value(grid, 0.5, 0.08) == -1
    assert (grid.values >= 0).sum() == 21  # 20 free cells and the hit, nothing else


def test_evidence_adds_up_and_is_bounded() -> None:
    occupancy = OccupancyMap(MapConfig())
    pose = np.array([0.025, 0.025, 0.0])
    occupancy.insert(pose, hits((1.0, 0.0)))
    occupancy.insert(pose, hits((1.0, 0.0)))
    # odds (7/3)² = 49/9 → 49/58 = 84.5 %; (2/3)² = 4/9 → 4/13 = 30.8 %
    assert value(occupancy.grid(), 1.03, 0.03) == 84
    assert value(occupancy.grid(), 0.5, 0.03) == 31
    for _ in range(50):
        occupancy.insert(pose, hits((1.0, 0.0)))
    assert value(occupancy.grid(), 1.03, 0.03) == 97
    assert value(occupancy.grid(), 0.5, 0.03) == 3
    # What has gone is forgotten again: 97 % falls under 50 % after nine rays through it (ln 32.3 / ln 1.5 = 8.6).
    for _ in range(9):
        occupancy.insert(pose, hits((2.0, 0.0)))
    assert value(occupancy.grid(), 1.03, 0.03) < 50


def test_a_hit_outweighs_rays_of_the_same_scan() -> None:
    occupancy = OccupancyMap(MapConfig())
    occupancy.insert(np.array([0.025, 0.025, 0.0]), hits((1.0, 0.0), (2.0, 0.0)))
    grid = occupancy.grid()
    assert value(grid, 1.03, 0.03) == 70
    assert value(grid, 2.03, 0.03) == 70
    assert value(grid, 1.5, 0.03) == 40


def test_far_hits_only_clear() -> None:
    occupancy = OccupancyMap(MapConfig(max_range_m=3.0, max_size_m=20.0))
    occupancy.insert(np.array([0.025, 0.025, 0.0]), hits((5.0, 0.0)))
    grid = occupancy.grid()
    assert value(grid, 2.9, 0.03) == grid.values.max() == 40


def test_the_map_grows_and_keeps_its_place() -> None:
    occupancy = OccupancyMap(MapConfig())
    assert occupancy.grid().values.size == 0
    occupancy.insert(np.zeros(3), hits((1.0, 0.0)))
    small = occupancy.grid()
    occupancy.insert(np.array([-30.0, -10.0, math.pi / 2]), hits((2.0, 0.0)))
    large = occupancy.grid()
    assert large.values.size > small.values.size
    assert value(large, 1.01, 0.01) == value(small, 1.01, 0.01) == 70
    assert value(large, -29.99, -7.99) == 70
    # The corner lies on the lattice of cells, so a grown map does not shift by parts of a cell.
    cells = large.origin / large.resolution
    assert np.allclose(cells, np.round(cells), atol=1e-6)


def test_what_lies_beyond_the_largest_map_is_counted() -> None:
    for x in (0.0, 576.0):  # the limit is about the start, wherever the odometry begins
        occupancy = OccupancyMap(MapConfig(max_range_m=5.0, max_size_m=10.0))
        occupancy.insert(np.array([x, 0.0, 0.0]), hits((0.52, 0.0)))
        assert occupancy.clipped == 0
        occupancy.insert(np.array([x + 4.0, 0.0, 0.0]), hits((3.0, 0.0), (0.52, 0.0)))
        assert occupancy.clipped == 1
        assert value(occupancy.grid(), x + 4.51, 0.01) == 70


def test_a_room_is_drawn_where_it_is() -> None:
    room = box_room()
    occupancy = OccupancyMap(MapConfig())
    for k, pose in enumerate([[0.0, 0.0, 0.0], [0.5, 0.3, 1.0], [2.8, -0.5, -2.0]]):
        occupancy.insert(np.array(pose), scan_points(room.scan(np.array(pose), k + 1), np.zeros(3)))
    grid = occupancy.grid()
    rows, columns = np.nonzero(grid.values > 60)
    centres = np.stack([columns, rows], axis=1) * grid.resolution + grid.origin + grid.resolution / 2
    walls = room.walls
    distance = np.full(len(centres), np.inf)
    for x0, y0, x1, y1 in walls:
        start, way = np.array([x0, y0]), np.array([x1 - x0, y1 - y0])
        part = np.clip((centres - start) @ way / (way @ way), 0, 1)
        distance = np.minimum(distance, np.hypot(*(centres - start - part[:, None] * way).T))
    assert distance.max() <= 0.05
    assert max(value(grid, 0.0, 1.5), value(grid, 3.0, 1.8)) <= 40
    assert value(grid, 1.75, 1.2) == -1  # within the pillar
    assert value(grid, -2.5, 0.0) == -1  # outside
    assert len(centres) > 300  # 20 m of walls and 1.8 m of pillar, 20 cells a metre, most of them seen
