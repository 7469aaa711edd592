"""Costmap: inflation by hand, marking and clearing, the rolling window, the published form."""

from __future__ import annotations

import math

import numpy as np
import pytest
from control_world import BEAMS, LIDAR_MAX_M, LIDAR_MIN_M, World, corridor, draw_map, matrix, rectangle

from instant_ic.control.costmap import (
    FREE,
    INSCRIBED,
    LETHAL,
    UNKNOWN,
    Costmap,
    CostmapConfig,
    RollingCostmap,
    ScanRays,
    StaticMap,
    inflated_cost,
    scan_points,
    scan_rays,
)
from instant_ic.control.footprint import Footprint
from instant_ic.control.kinematics import MotionLimits

CONFIG = CostmapConfig(width=4.0, footprint_clearing_enabled=False)


def one_hit(x: float, y: float, hit: bool = True) -> ScanRays:
    return ScanRays(np.zeros(2), np.array([[x, y]]), np.array([hit]))


def update(rays: ScanRays | None, static: StaticMap | None = None, config: CostmapConfig = CONFIG) -> Costmap:
    return RollingCostmap(config, Footprint()).update(np.zeros(3), static, rays)


def open_map(size_m: float = 6.0) -> StaticMap:
    n = round(size_m / 0.05)
    return StaticMap(np.zeros((n, n), np.int8), 0.05, np.array([-size_m / 2, -size_m / 2]))


@pytest.mark.parametrize(
    ("metres", "cost"),
    [
        (0.0, LETHAL),
        (0.05, INSCRIBED),
        (0.25, INSCRIBED),  # the inscribed radius of 0.60 by 0.50 is 0.25
        (0.30, 216),  # 252 exp(-3 * 0.05) = 216.9
        (0.50, 119),  # 252 exp(-3 * 0.25) = 119.04
        (0.70, 65),  # 252 exp(-3 * 0.45) = 65.3
        (0.75, FREE),  # beyond the inflation radius
    ],
)
def test_inflation_follows_nav2s_formula(metres: float, cost: int) -> None:
    costmap = update(one_hit(1.025, 0.025), open_map())
    assert int(costmap.cost_at(np.array([1.025, 0.025 + metres]))) == cost
    assert inflated_cost(metres, CONFIG, Footprint()) == cost


def test_a_beam_clears_up_to_its_hit_and_no_farther() -> None:
    costmap = update(one_hit(1.525, 0.025))
    assert costmap.cost_at(np.array([1.525, 0.025])) == LETHAL
    assert costmap.cost_at(np.array([0.525, 0.025])) == FREE
    assert costmap.cost_at(np.array([1.275, 0.025])) == INSCRIBED
    # Behind it nothing was seen: unknown but for what the robot could not stand on anyway.
    assert costmap.cost_at(np.array([1.675, 0.025])) == INSCRIBED
    assert costmap.cost_at(np.array([1.925, 0.025])) == UNKNOWN


def test_a_beam_without_a_hit_clears_its_last_cell_too() -> None:
    rolling = RollingCostmap(CONFIG, Footprint())
    rolling.update(np.zeros(3), None, one_hit(1.0, 0.0))
    assert rolling.update(np.zeros(3), None, one_hit(1.0, 0.0, hit=False)).cost_at(np.array([1.0, 0.0])) == FREE


def test_every_cell_on_a_slanted_beam_is_cleared() -> None:
    costmap = update(one_hit(1.7, 1.1, hit=False))
    for share in np.linspace(0.0, 1.0, 200):
        assert costmap.cost_at(share * np.array([1.7, 1.1])) == FREE


def test_marks_stay_where_they_are_while_the_window_moves() -> None:
    rolling = RollingCostmap(CONFIG, Footprint())
    rolling.update(np.zeros(3), None, one_hit(1.025, 0.525))
    for pose in ([0.7, -0.6, 0.0], [-0.3, 0.4, 0.0], [0.2, 0.0, 0.0]):
        costmap = rolling.update(np.array(pose), None, None)
        assert costmap.cost_at(np.array([1.025, 0.525])) == LETHAL
    assert (rolling.update(np.array([9.0, 0.0, 0.0]), None, None).costs == UNKNOWN).all()
    assert (rolling.update(np.zeros(3), None, None).costs == UNKNOWN).all()  # what left the window is forgotten


def test_static_map_and_scan_are_joined_by_the_larger() -> None:
    static = open_map()
    static.occupancy[60 + 10, 60 + 20] = 100  # x 1.025, y 0.525
    static.occupancy[:, 100:] = -1  # x > 2: unknown
    costmap = update(one_hit(1.825, 0.025), static)
    assert costmap.cost_at(np.array([1.025, 0.525])) == LETHAL
    assert costmap.cost_at(np.array([1.825, 0.025])) == LETHAL
    assert costmap.cost_at(np.array([-1.5, -1.5])) == FREE


def test_the_robot_stands_on_free_ground() -> None:
    rays = ScanRays(np.zeros(2), np.array([[0.2, 0.1]]), np.array([True]))
    cleared = update(rays, config=CostmapConfig(width=4.0))
    assert cleared.cost_at(np.array([0.2, 0.1])) == FREE
    assert update(rays).cost_at(np.array([0.2, 0.1])) == LETHAL


def test_scan_values_by_rep_117() -> None:
    ranges = np.array([1.0, np.inf, -np.inf, np.nan, 0.1, 30.0, 6.0])
    config = CostmapConfig(raytrace_max_range=5.0, obstacle_max_range=4.0)
    rays = scan_rays(ranges, 0.0, 0.0, 0.5, 20.0, np.eye(4), config)
    # The two measured ones: the near one marks, the far one only clears.
    np.testing.assert_allclose(rays.ends, [[1.0, 0.0], [5.0, 0.0]])
    assert rays.hits.tolist() == [True, False]
    np.testing.assert_allclose(scan_points(ranges, 0.0, 0.0, 0.5, 20.0), [[1.0, 0.0], [6.0, 0.0]])


def test_scan_is_placed_by_the_sensors_pose() -> None:
    map_from_lidar = np.eye(4)
    map_from_lidar[:2, :2] = [[0, -1], [1, 0]]  # looking along +y
    map_from_lidar[:2, 3] = [2.0, 3.0]
    rays = scan_rays(np.array([1.5]), 0.0, 0.01, 0.1, 20.0, map_from_lidar, CONFIG)
    np.testing.assert_allclose(rays.ends, [[2.0, 4.5]], atol=1e-12)
    np.testing.assert_allclose(rays.origin, [2.0, 3.0])


def test_lethal_cells_near_the_robot_in_its_own_frame() -> None:
    costs = np.zeros((80, 80), np.uint8)
    costs[40 + 6, 40] = LETHAL  # centre (0.025, 0.325)
    costs[40 + 20, 40] = LETHAL  # a metre off
    costmap = Costmap(costs, 0.05, np.array([-2.0, -2.0]))
    found = costmap.lethal_near(np.array([0.025, 0.0, math.pi / 2]), 0.45)
    np.testing.assert_allclose(found, [[0.325, 0.0]], atol=1e-9)  # the robot looks at it
    assert costmap.lethal_near(np.array([0.0, -1.5, 0.0]), 0.45).shape == (0, 2)
    assert costmap.lethal_near(np.array([9.0, 9.0, 0.0]), 0.45).shape == (0, 2)


def test_published_form_comes_back() -> None:
    costs = np.arange(256, dtype=np.uint8).reshape(16, 16)
    costmap = Costmap(costs, 0.05, np.zeros(2))
    occupancy = costmap.occupancy()
    assert occupancy.ravel()[[0, 1, 252, 253, 254, 255]].tolist() == [0, 1, 98, 99, 100, -1]  # nav2's own table
    back = Costmap.from_occupancy(occupancy, 0.05, np.zeros(2)).costs.astype(int)
    assert np.abs(back - costs).max() <= 2
    for value in (FREE, INSCRIBED, LETHAL, UNKNOWN):
        assert back.ravel()[value] == value


def test_footprint_overlap_counts_lethal_points_under_the_rectangle() -> None:
    costs = np.zeros((80, 80), np.uint8)
    costs[40, 40 + 6] = LETHAL  # x 0.30..0.35, y 0..0.05
    costmap = Costmap(costs, 0.05, np.array([-2.0, -2.0]))
    body = Footprint().points(0.045)
    # Nose at 0.30 less 2 cm; at 0.35; the side, at 0.25, towards it; the nose past it, tail still over it.
    poses = np.array([[-0.02, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0, 0.0, math.pi / 2], [0.5, 0.0, 0.0]])
    overlap = costmap.lethal_overlap(poses, body)
    assert (overlap > 0).tolist() == [False, True, False, True]


class TestGhosts:
    """Cells that the map alone holds occupied, and scans look through."""

    def ghost(self) -> StaticMap:
        static = open_map()
        static.occupancy[60, 80:82] = 100  # x 1.0 to 1.1, y 0 to 0.05
        return static

    def test_what_only_the_map_holds_is_gone_after_as_many_scans_in_a_row_as_set(self) -> None:
        rolling, place = RollingCostmap(CONFIG, Footprint()), np.array([1.025, 0.025])
        beam = ScanRays(np.array([0.0, 0.025]), np.array([[1.825, 0.025]]), np.array([True]))
        for _ in range(CONFIG.static_seen_through - 1):
            assert rolling.update(np.zeros(3), self.ghost(), beam).cost_at(place) == LETHAL
        assert rolling.update(np.zeros(3), self.ghost(), beam).cost_at(place) < INSCRIBED
        # The window moves: what was found out moves with it.
        assert rolling.update(np.array([0.2, 0.0, 0.0]), self.ghost(), None).cost_at(place) < INSCRIBED
        # Hit again it is there again, and needs as many scans as before.
        rolling.update(np.zeros(3), self.ghost(), one_hit(1.025, 0.025))
        assert rolling.update(np.zeros(3), self.ghost(), beam).cost_at(place) == LETHAL

    def test_a_hit_beside_it_keeps_it(self) -> None:
        """A pose that is a cell off puts the wall's hits beside its cells: the wall is there all the same."""
        rolling, place = RollingCostmap(CONFIG, Footprint()), np.array([1.025, 0.025])
        beside = ScanRays(np.array([0.0, 0.025]), np.array([[1.825, 0.025], [1.025, 0.075]]), np.array([True, True]))
        for _ in range(100):
            costmap = rolling.update(np.zeros(3), self.ghost(), beside)
        assert costmap.cost_at(place) == LETHAL

    def test_what_no_scan_looks_through_stays_and_the_rule_can_be_switched_off(self) -> None:
        place = np.array([1.025, 0.025])
        elsewhere = ScanRays(np.zeros(2), np.array([[-1.0, 0.025]]), np.array([True]))
        through = ScanRays(np.array([0.0, 0.025]), np.array([[1.825, 0.025]]), np.array([True]))
        never = CostmapConfig(width=4.0, footprint_clearing_enabled=False, static_seen_through=0)
        for config, rays in ((CONFIG, elsewhere), (never, through)):
            rolling = RollingCostmap(config, Footprint())
            for _ in range(300):
                costmap = rolling.update(np.zeros(3), self.ghost(), rays)
            assert costmap.cost_at(place) == LETHAL

    def test_ghosts_beside_an_obstacle_close_the_way_round_only_for_a_while(self) -> None:
        """A map with two walls that are not there, from scans put in the wrong place on a busy machine."""
        from instant_ic.control.passage import PassageConfig, find_passage
        from instant_ic.control.planner import HybridPlanner
        from instant_ic.control.prediction import PredictionConfig, Predictor
        from instant_ic.control.states import Reason

        walls = corridor()
        ghosts = np.array([[[2.7, -1.2], [2.7, -0.3]], [[2.7, 0.3], [2.7, 1.2]]])
        world = World(np.concatenate([walls, rectangle(2.5, -0.25, 3.0, 0.25)]))
        static = draw_map(np.concatenate([walls, ghosts]), (-2, -1.2, 14, 1.2))
        robot, forward, config = np.array([1.7, 0.0, 0.0]), (0.4, 0.0), CostmapConfig()
        rays = scan_rays(
            world.cast(*robot), -math.pi, 2 * math.pi / BEAMS, LIDAR_MIN_M, LIDAR_MAX_M, matrix(robot), config
        )
        rolling, reasons = RollingCostmap(config, Footprint()), []
        predictor = Predictor(PredictionConfig(), MotionLimits(), Footprint())
        for k in range(config.static_seen_through + 1):
            costmap = rolling.update(robot, static, rays)
            if k in (0, config.static_seen_through):
                ahead = predictor.predict(robot, forward, forward, costmap)
                planner = HybridPlanner()
                reasons.append(find_passage(costmap, ahead, True, None, planner, PassageConfig()))
        assert reasons[0].reason == Reason.NO_WAY_ROUND
        assert "(no way to the goal: " in reasons[0].text
        assert reasons[1] is None
