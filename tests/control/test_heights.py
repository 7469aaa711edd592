"""3D points sorted by height, and the layer that remembers low and hanging things: places and bands by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from instant_ic.control.costmap import FREE, LETHAL, CostmapConfig, RollingCostmap, ScanRays
from instant_ic.control.footprint import Footprint
from instant_ic.control.heights import HeightConfig, HeightLayer, SortedPoints, sort_points

CONFIG = HeightConfig()
LIDAR_M = 0.6


def at(*places: tuple[float, float, float]) -> np.ndarray:
    """Points given by place over ground and height, in the frame of a LiDAR 0.6 m above the origin."""
    return np.array(places, np.float32).reshape(-1, 3) - np.array([0, 0, LIDAR_M], np.float32)


def mount(x: float = 0.0, y: float = 0.0, yaw: float = 0.0, roll: float = 0.0) -> np.ndarray:
    c, s, a, b = math.cos(yaw), math.sin(yaw), math.cos(roll), math.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, a, -b], [0, b, a]])
    pose[:3, 3] = [x, y, LIDAR_M]
    return pose


def sort(points: np.ndarray, pose: np.ndarray | None = None, config: HeightConfig = CONFIG) -> SortedPoints:
    return sort_points(
        points, np.zeros(len(points), np.float32), (mount() if pose is None else pose)[None], 0.0, config
    )


@pytest.mark.parametrize(
    ("place", "kind"),
    [
        ((2.0, 0.0, 0.0), "ground"),
        # At 2 m a tilt of 0.8° is 2.8 cm: with min_obstacle_height 0.05, up to 7.8 cm is ground.
        ((2.0, 0.0, 0.075), "ground"),
        ((2.0, 0.0, 0.081), "obstacle"),
        ((2.0, 0.0, 1.29), "obstacle"),  # hangs at the height of the mast
        ((2.0, 0.0, 1.31), "overhead"),
        ((0.3, 0.3, 0.6), "near"),  # 0.42 m: the robot itself
        ((0.4, 0.3, 0.6), "obstacle"),  # 0.50 m
    ],
)
def test_each_point_is_counted_as_what_it_is(place: tuple[float, float, float], kind: str) -> None:
    counts = sort(at(place)).counts
    assert counts == {"ground": 0, "obstacle": 0, "overhead": 0, "near": 0} | {kind: 1}


def test_what_is_no_number_is_left_out_and_nothing_is_nothing() -> None:
    points = np.array([[np.nan, 1, 0], [1, np.inf, 0]], np.float32)
    assert sum(sort(points).counts.values()) == 0
    assert sum(sort(np.zeros((0, 3), np.float32)).counts.values()) == 0


def test_heights_are_taken_in_the_level_frame() -> None:
    # A LiDAR rolled by 10° sees the ground 3 m to the left at 3 sin 10° = 0.52 m above its own plane less its height.
    ground = np.array([[0.0, 3.0, 0.0]]) - [0, 0, LIDAR_M]
    tilted = mount(roll=math.radians(10))
    points = (ground @ tilted[:3, :3]).astype(np.float32)
    assert sort(points, tilted).counts["ground"] == 1


def test_points_are_placed_by_where_the_sensor_was_when_it_saw_them() -> None:
    # The robot drives 0.4 m ahead during the sweep; the same post, 2 m ahead at its start, is seen three times.
    post = np.array([[2.0, 0, 0], [1.8, 0, 0], [1.6, 0, 0]], np.float32)
    poses = np.stack([mount(), mount(0.2), mount(0.4)])
    sweep = sort_points(post, np.array([0.0, 0.05, 0.1], np.float32), poses, 0.1, CONFIG)
    np.testing.assert_allclose(sweep.obstacles[:, :2], [[2.0, 0.0]] * 3, atol=2e-3)
    np.testing.assert_allclose(sweep.origin, [0.4, 0.0, 0.6])


def test_nearest_of_each_direction() -> None:
    sweep = sort(at((2.0, 0.001, 0.3), (1.5, 0.001, 1.0), (1.0, 0.001, 0.0), (0.0, 3.0, 0.5)))
    nearest = sweep.nearest[np.argsort(sweep.nearest[:, 1])]
    np.testing.assert_allclose(nearest, [[1.5, 0.001], [0.0, 3.0]], atol=1e-6)  # the ground point is none


FIVE_BINS = [0.25, 0.75, 1.25, 1.75, 2.25]
"""Azimuths in degrees, one a bin, over the cell at (1.025, 0.025): its 5 cm are 2.8° wide."""


def rings(x: float, azimuths_deg: list[float]) -> list[tuple[float, float, float]]:
    """Where the beams of three rings meet a surface across the x axis, heights above the ground."""
    return [
        (x, x * math.tan(math.radians(azimuth)), LIDAR_M + x * math.tan(math.radians(elevation)))
        for azimuth in azimuths_deg
        for elevation in (-3, -1, 1)
    ]


class TestLayer:
    origin = np.array([-3.0, -3.0])

    def layer(self) -> HeightLayer:
        return HeightLayer(CONFIG, 120, 0.05)

    def seen(self, layer: HeightLayer, *places: tuple[float, float, float], pose: np.ndarray | None = None) -> None:
        layer.update(
            sort(at(*places) if pose is None else np.array(places, np.float32), pose), np.zeros(3), self.origin
        )

    @staticmethod
    def marked(layer: HeightLayer) -> list[tuple[float, float]]:
        rows, columns = np.nonzero(layer.occupied())
        return [
            (round(-3 + (c + 0.5) * 0.05, 3), round(-3 + (r + 0.5) * 0.05, 3))
            for r, c in zip(rows, columns, strict=True)
        ]

    def test_two_points_make_a_mark_one_does_not(self) -> None:
        layer = self.layer()
        self.seen(layer, (2.01, 0.01, 0.1))
        assert self.marked(layer) == []
        self.seen(layer, (2.02, 0.02, 0.12))
        assert self.marked(layer) == [(2.025, 0.025)]

    def test_a_low_thing_stays_when_beams_pass_over_it_and_when_nobody_looks(self) -> None:
        layer = self.layer()
        self.seen(layer, (2.01, 0.01, 0.10), (2.02, 0.01, 0.10))
        # Level with the LiDAR a beam goes on to a wall at 4 m; it was 0.5 m over the thing.
        self.seen(layer, (4.0, 0.0494, 0.60), (4.0, 0.0494, 0.60))
        assert (2.025, 0.025) in self.marked(layer)
        self.seen(layer)
        assert (2.025, 0.025) in self.marked(layer)

    def test_a_beam_at_its_own_height_that_goes_on_clears_it(self) -> None:
        layer = self.layer()
        self.seen(layer, (2.17, 0.01, 0.085), (2.18, 0.01, 0.115))
        assert self.marked(layer) == [(2.175, 0.025)]
        # The ring at -13° is 0.098 m high there (0.6 - 2.175 tan 13°), and meets the ground at 2.599 m.
        self.seen(layer, (2.599, 0.0299, 0.0))
        assert self.marked(layer) == []

    def test_a_beam_just_over_a_low_thing_does_not_clear_it(self) -> None:
        layer = self.layer()
        # The top of a thing 0.13 m high. From 1.675 m away the lowest ring (-15°) passes 2 cm over it: 0.151 m there
        # (0.6 - 1.675 tan 15°); it meets the ground at 2.239 m. No ring ever reaches the thing from nearer.
        self.seen(layer, (1.66, 0.01, 0.09), (1.68, 0.01, 0.13))
        self.seen(layer, (2.239, 0.0299, 0.0))
        assert self.marked(layer) == [(1.675, 0.025)]

    def test_a_beam_just_under_a_hanging_thing_does_not_clear_it(self) -> None:
        layer = self.layer()
        # Its lower edge is 1.06 m high. From 1.675 m away the highest ring (15°) passes under it: 1.049 m there.
        self.seen(layer, (1.66, 0.01, 1.06), (1.68, 0.01, 1.20))
        self.seen(layer, (2.2, 0.0294, 0.6 + 2.2 * math.tan(math.radians(15))))
        assert self.marked(layer) == [(1.675, 0.025)]

    def test_a_person_who_goes_away_is_cleared(self) -> None:
        layer = self.layer()
        person = [(2.01, 0.01, z) for z in (0.3, 0.6, 0.9, 1.2)]
        self.seen(layer, *person)
        assert self.marked(layer) == [(2.025, 0.025)]
        self.seen(layer, *[(4.0, 0.0494, LIDAR_M + 2 * (z - LIDAR_M)) for _, _, z in person])  # a wall behind
        assert self.marked(layer) == []

    def test_what_still_stands_is_not_cleared_by_beams_past_its_edge(self) -> None:
        layer = self.layer()
        thing = [(2.01, 0.01, 0.5), (2.02, 0.01, 0.7)]
        self.seen(layer, *thing)
        self.seen(layer, (4.0, 0.0494, 0.58), *thing)
        assert (2.025, 0.025) in self.marked(layer)

    def test_noise_before_a_surface_is_dismissed_and_a_thing_that_comes_there_is_not(self) -> None:
        layer = self.layer()
        # The surface is at 1.08 m, its marks at 1.075 m. A point of each ring strays into the mark at 1.025 m.
        surface = rings(1.08, FIVE_BINS)
        self.seen(layer, *rings(1.02, [0.25]), *surface)
        assert (1.025, 0.025) in self.marked(layer)
        self.seen(layer, *surface)
        self.seen(layer, *surface)
        assert (1.025, 0.025) not in self.marked(layer)
        assert (1.075, 0.025) in self.marked(layer)
        for _ in range(2):
            self.seen(layer, *rings(1.02, FIVE_BINS))
        assert (1.025, 0.025) in self.marked(layer)

    def test_a_post_narrower_than_a_cell_is_not_taken_for_noise_of_the_wall_behind_it(self) -> None:
        layer = self.layer()
        for _ in range(40):
            self.seen(layer, *rings(1.08, FIVE_BINS[1:]), *rings(1.02, FIVE_BINS[:1]))
        assert (1.025, 0.025) in self.marked(layer)

    def test_a_ring_that_ends_on_the_top_of_a_low_thing_does_not_dismiss_its_edge(self) -> None:
        layer = self.layer()
        # Front at 1.56 m, top at 0.17 m. The lowest ring (-15°) passes 1 cm over the edge and ends on top at 1.605 m.
        edge = [1.56 * math.tan(math.radians(azimuth)) for azimuth in FIVE_BINS[:4]]
        self.seen(layer, *[(1.56, y, z) for y in edge for z in (0.09, 0.17)])
        for _ in range(40):
            self.seen(layer, *[(1.605, 1.605 / 1.56 * y, 0.17) for y in edge])
        assert (1.575, 0.025) in self.marked(layer)

    def test_marks_move_with_the_window(self) -> None:
        layer = self.layer()
        self.seen(layer, (2.01, 0.01, 0.1), (2.02, 0.01, 0.1))
        layer.shift(10, -4)
        rows, columns = np.nonzero(layer.occupied())
        assert (rows[0], columns[0]) == (60 + 4, 100 - 10)

    def test_a_sweep_is_placed_in_the_map(self) -> None:
        layer = self.layer()
        sweep = sort(at((2.0, 0.01, 0.5), (2.0, 0.01, 0.6)))
        layer.update(sweep, np.array([0.5, -1.0, math.pi / 2]), self.origin)  # odom in the map
        assert self.marked(layer) == [(0.475, 1.025)]  # (0.5 - 0.01, -1 + 2.0)

    def test_a_low_thing_may_begin_before_where_the_lowest_ring_meets_its_top_and_a_wall_does_not(self) -> None:
        # -15° ends at 1.605 m on a top of 0.17 m, or on a wall; -13° on the floor at 2.6 m, or on the same wall.
        top, floor, wall = (1.605, 0.02, 0.17), (2.6, 0.032, 0.0), (1.605, 0.02, 0.2295)
        low, high = self.layer(), self.layer()
        for _ in range(3):
            self.seen(low, top, floor)
            self.seen(high, top, wall)
        assert {(1.625, 0.025), (1.575, 0.025), (1.525, 0.025)} == set(self.marked(low))
        assert {(1.625, 0.025)} == set(self.marked(high))


def test_low_and_hanging_things_are_lethal_where_the_flat_scan_sees_free_ground() -> None:
    config = CostmapConfig(width=6.0)
    rolling = RollingCostmap(config, Footprint())
    wall = ScanRays(np.zeros(2), np.array([[2.9, 0.01]]), np.array([True]))
    sweep = sort(at((2.01, 0.01, 0.1), (2.02, 0.01, 0.1), (1.51, 0.01, 1.2), (1.52, 0.01, 1.2)))
    costmap = rolling.update(np.zeros(3), None, wall, sweep)
    for x in (2.01, 1.51):
        assert costmap.cost_at(np.array([x, 0.01])) == LETHAL
    assert sorted(costmap.remembered[:, 0].round(3)) == [1.525, 2.025]
    # Scan after scan passes over them.
    costmap = rolling.update(np.zeros(3), None, wall)
    assert costmap.cost_at(np.array([2.01, 0.01])) == LETHAL
    rolling.reset()
    assert rolling.update(np.zeros(3), None, wall).cost_at(np.array([1.0, 0.01])) == FREE
    assert len(rolling.update(np.zeros(3), None, wall).remembered) == 0


def test_a_scan_hit_where_3d_points_show_noise_of_a_surface_is_no_obstacle() -> None:
    rolling = RollingCostmap(CostmapConfig(width=6.0), Footprint())
    surface = rings(1.08, FIVE_BINS)
    stray = ScanRays(np.zeros(2), np.array([[1.02, 0.01]]), np.array([True]))
    place = np.array([1.02, 0.01])
    rolling.update(np.zeros(3), None, stray, sort(at(*rings(1.02, [0.25]), *surface)))
    assert rolling.update(np.zeros(3), None, stray).cost_at(place) == LETHAL
    for _ in range(2):
        costmap = rolling.update(np.zeros(3), None, stray, sort(at(*surface)))
    assert costmap.cost_at(place) < LETHAL


def test_memory_near_the_robot_in_its_own_frame() -> None:
    rolling = RollingCostmap(CostmapConfig(width=8.0), Footprint())
    sweep = sort(at((2.01, 0.01, 0.1), (2.02, 0.01, 0.1), (0.01, 3.51, 0.1), (0.02, 3.52, 0.1)))
    costmap = rolling.update(np.zeros(3), None, None, sweep)
    np.testing.assert_allclose(costmap.memory_near(np.zeros(3), 0.45, 2.5), [[2.025, 0.025]], atol=1e-9)
    turned = costmap.memory_near(np.array([0.025, 0.025, math.pi / 2]), 0.45, 2.5)
    np.testing.assert_allclose(turned, [[0.0, -2.0]], atol=1e-9)


def test_standing_beside_a_remembered_thing_does_not_wipe_it_out() -> None:
    rolling = RollingCostmap(CostmapConfig(width=6.0), Footprint())
    # The front reaches x = 0.30: a cell at 0.275..: within a cell of the outline.
    sweep = sort(at((0.51, 0.01, 0.1), (0.52, 0.01, 0.1)))
    rolling.update(np.zeros(3), None, None, sweep)
    beside = rolling.update(np.array([0.24, 0.0, 0.0]), None, None)  # the pose is off by a few centimetres
    assert len(beside.remembered) == 1
    on_it = rolling.update(np.array([0.5, 0.0, 0.0]), None, None)
    assert len(on_it.remembered) == 0
