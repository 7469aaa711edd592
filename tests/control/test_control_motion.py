"""Kinematics, prediction, collision monitor, walls and v-bot: values worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from control_world import corridor, draw_map, rectangle

from instant_ic.control.costmap import LETHAL, Costmap
from instant_ic.control.footprint import Footprint
from instant_ic.control.kinematics import MotionLimits, accelerate, move
from instant_ic.control.navigator import meeting_pose
from instant_ic.control.prediction import PredictionConfig, Predictor
from instant_ic.control.safety import (
    CollisionMonitor,
    CollisionMonitorConfig,
    PolygonConfig,
    SlowdownConfig,
)
from instant_ic.control.vbot import VbotConfig, VirtualRobot
from instant_ic.control.walls import WallMap

LIMITS = MotionLimits()


def test_move_follows_the_exact_arc() -> None:
    # A quarter of a circle of radius 2 to the left, from (1, 1) facing +x, ends at (3, 3) facing +y.
    pose = move(np.array([1.0, 1.0, 0.0]), 2.0 * math.pi / 2, math.pi / 2, 1.0)
    np.testing.assert_allclose(pose, [3.0, 3.0, math.pi / 2], atol=1e-12)
    straight = move(np.array([0.0, 0.0, math.pi / 2]), 0.5, 0.0, 2.0)
    np.testing.assert_allclose(straight, [0.0, 1.0, math.pi / 2], atol=1e-12)


def test_twists_are_cut_with_their_curvature() -> None:
    assert LIMITS.clip(1.0, 1.0) == (0.5, 0.5)
    assert LIMITS.clip(0.4, -4.0) == pytest.approx((0.1, -1.0))
    assert LIMITS.clip(math.nan, 0.0) == (0.0, 0.0)
    assert accelerate((0.0, 0.0), (0.5, -1.0), LIMITS, 0.1) == pytest.approx((0.08, -0.2))


def box_ahead(face_m: float) -> Costmap:
    """Free 8 m window, lethal from ``face_m`` ahead of the origin, for |y| < 0.25."""
    costs = np.zeros((160, 160), np.uint8)
    costs[75:85, 80 + round(face_m / 0.05) : 80 + round(face_m / 0.05) + 10] = LETHAL
    return Costmap(costs, 0.05, np.array([-4.0, -4.0]))


class TestPrediction:
    predictor = Predictor(PredictionConfig(), LIMITS, Footprint())

    def test_horizon_is_the_stopping_distance_plus_the_margin(self) -> None:
        # 0.4 * 0.2 + 0.4² / (2 * 0.8) + 0.6
        assert self.predictor.horizon(0.4, 0.0) == pytest.approx(0.08 + 0.1 + 0.6)
        assert self.predictor.horizon(0.5, 0.0) > self.predictor.horizon(0.2, 0.0) > 0.6

    def test_time_to_obstacle_at_constant_speed(self) -> None:
        # Nose at 0.33 with padding, face at 1.0: 0.67 m at 0.4 m/s is 1.675 s.
        found = self.predictor.predict(np.zeros(3), (0.4, 0.0), (0.4, 0.0), box_ahead(1.0))
        assert found.time_to_obstacle_s == pytest.approx(1.675, abs=0.05)
        assert found.distance_m == pytest.approx(0.67, abs=0.02)

    def test_latency_and_acceleration_delay_the_start(self) -> None:
        found = self.predictor.predict(np.zeros(3), (0.0, 0.0), (0.4, 0.0), None)
        # 0.2 s nothing, then 0.8 m/s²: after 0.7 s at 0.4 m/s, having gone 0.4² / 1.6 = 0.1 m.
        assert found.poses[4, 0] == 0.0
        assert found.poses[14, 0] == pytest.approx(0.1, abs=0.015)

    def test_a_stop_is_followed_to_standstill(self) -> None:
        found = self.predictor.predict(np.zeros(3), (0.4, 0.0), (0.0, 0.0), None)
        # 0.2 s latency and 0.1 m of braking.
        assert found.poses[-1, 0] == pytest.approx(0.18, abs=0.015)
        assert found.hit_index is None

    def test_what_is_beyond_the_horizon_is_not_met(self) -> None:
        assert self.predictor.predict(np.zeros(3), (0.4, 0.0), (0.4, 0.0), box_ahead(1.3)).hit_index is None
        longer = self.predictor.predict(np.zeros(3), (0.4, 0.0), (0.4, 0.0), box_ahead(1.3), extra_m=0.5)
        assert longer.hit_index is not None

    def test_turning_on_the_spot_sees_the_corner_strike(self) -> None:
        costs = np.zeros((160, 160), np.uint8)
        costs[80 + 5 :, 80 + 4 : 80 + 6] = LETHAL  # a post front left, 0.25..0.3 to the side
        costmap = Costmap(costs, 0.05, np.array([-4.0, -4.0]))
        narrow = Predictor(PredictionConfig(padding_m=0.0), LIMITS, Footprint(width_m=0.48))
        turned = narrow.predict(np.zeros(3), (0.0, 0.0), (0.0, 0.8), costmap)
        assert turned.hit_index is not None
        assert narrow.predict(np.zeros(3), (0.3, 0.0), (0.3, 0.0), costmap).hit_index is None

    def test_backing_out_of_an_obstacle_is_free(self) -> None:
        assert self.predictor.predict(np.zeros(3), (0.0, 0.0), (-0.3, 0.0), box_ahead(0.25)).hit_index is None
        assert self.predictor.predict(np.zeros(3), (0.0, 0.0), (0.3, 0.0), box_ahead(0.25)).hit_index is not None


class TestCollisionMonitor:
    config = CollisionMonitorConfig(stop=PolygonConfig(enabled=False), slowdown=SlowdownConfig(enabled=False))
    monitor = CollisionMonitor(config, Footprint())

    @staticmethod
    def wall(x: float) -> np.ndarray:
        return np.column_stack([np.full(81, x), np.linspace(-0.5, 0.5, 81)])

    def test_turning_into_a_post_beside_the_robot_is_stopped(self) -> None:
        # 0.43 m off, outside the side at 0.29 but within the padded corner's reach of 0.447 m.
        post = np.array([[0.30, 0.30], [0.30, 0.305], [0.305, 0.30]])
        assert self.monitor.limit((0.0, 0.5), post).action != "free"
        assert self.monitor.limit((0.4, 0.0), post).action == "free"

    def test_approaching_never_touches(self) -> None:
        x, v = 0.0, 0.5
        for _ in range(400):  # 20 s at 20 Hz, base that brakes at 0.8 m/s²
            wanted = self.monitor.limit((0.5, 0.0), self.wall(1.5) - [x, 0.0]).command[0]
            v = max(wanted, v - 0.8 * 0.05)
            x += v * 0.05
        assert 1.0 < x + 0.30 < 1.5
        assert v == 0.0


class TestWalls:
    def test_long_runs_are_walls_and_boxes_are_not(self) -> None:
        segments = np.concatenate([corridor(8.0), rectangle(2.0, -0.5, 2.6, 0.1), rectangle(4.0, 0.6, 4.5, 1.2)])
        walls = WallMap(draw_map(segments, (-2, -1.2, 6, 1.2)))
        distance = walls.distance(np.array([[0.0, 0.0], [1.0, 1.1], [2.3, -0.5], [4.25, 0.6]]))
        # Walls at y = ±1.2 (their cells' centres 1.225): also beside the box that leans on one.
        np.testing.assert_allclose(distance, [1.2, 0.1, 0.7, 0.6], atol=0.08)

    def test_a_slanted_wall_is_a_wall(self) -> None:
        line = np.array([[[0.0, -1.0], [3.0, 0.7]]])
        walls = WallMap(draw_map(line, (-1, -2, 4, 2)))
        assert walls.mask.sum() > 0.8 * 3.4 / 0.05
        assert walls.distance(np.array([1.5, -0.15])) < 0.08


class TestVirtualRobot:
    @staticmethod
    def robot() -> VirtualRobot:
        return VirtualRobot(VbotConfig(max_lead_m=3.0, slow_lead_m=1.0, trail_slow=0.1, trail_m=0.15), LIMITS)

    @pytest.mark.parametrize(
        ("lead", "factor"),
        # A tenth slower from 0.15 m on, and less the farther it is ahead from 1 m to 3 m.
        [(0.0, 1.0), (0.03, 0.98), (0.15, 0.9), (1.0, 0.9), (2.0, 0.45), (2.5, 0.225), (3.0, 0.0), (4.0, 0.0)],
    )
    def test_it_is_slowed_as_it_draws_ahead(self, lead: float, factor: float) -> None:
        vbot = self.robot()
        vbot.place(np.array([lead, 0.0, 0.0]), (0.0, 0.0))
        assert vbot.lead_factor(0.4, np.zeros(3)) == pytest.approx(factor)
        assert vbot.lead_factor(-0.4, np.zeros(3)) == 1.0  # back towards the robot: free
        for _ in range(40):
            vbot.step((0.4, 0.0), np.array([vbot.pose[0] - lead, 0.0, 0.0]), 0.05)
        assert vbot.velocity[0] == pytest.approx(0.4 * factor)
        assert vbot.slowed_by == ("lead" if factor < 0.9 else "")

    def test_it_never_draws_farther_ahead_than_the_limit(self) -> None:
        vbot = self.robot()
        for _ in range(1200):  # a minute, the robot stuck
            vbot.step((0.5, 0.0), np.zeros(3), 0.05)
        assert 2.5 < vbot.pose[0] <= 3.0

    def test_it_stops_at_a_wall_and_turns_away(self) -> None:
        walls = WallMap(draw_map(corridor(5.0), (-2, -1.2, 3, 1.2)))
        vbot = self.robot()
        for _ in range(400):
            vbot.step((0.5, 0.0), vbot.pose, 0.05, walls)
        assert 2.40 < vbot.pose[0] < 2.62  # wall at 3.0, nose 0.30 ahead, clearance 0.12
        assert vbot.slowed_by == "wall"
        for _ in range(63):
            vbot.step((0.0, 1.0), vbot.pose, 0.05, walls)
        before = vbot.pose.copy()
        for _ in range(20):
            vbot.step((0.4, 0.0), vbot.pose, 0.05, walls)
        assert before[0] - vbot.pose[0] > 0.2

    def test_it_passes_a_box(self) -> None:
        segments = np.concatenate([corridor(8.0), rectangle(1.0, -0.25, 1.5, 0.25)])
        walls = WallMap(draw_map(segments, (-2, -1.2, 6, 1.2)))
        vbot = self.robot()
        for _ in range(120):
            vbot.step((0.5, 0.0), vbot.pose, 0.05, walls)
        assert vbot.pose[0] > 2.5


def test_the_robot_meets_the_vbot_with_the_picture_that_is_late() -> None:
    """The r-bot has driven 0.08 m on since the picture was taken, so it has to be that much ahead of the v-bot."""
    shown, robot = np.array([1.0, 2.0, math.pi / 2]), np.array([1.0, 2.08, math.pi / 2])
    vbot = np.array([3.0, 0.0, math.pi])
    np.testing.assert_allclose(meeting_pose(vbot, shown, robot), [2.92, 0.0, math.pi], atol=1e-12)
    np.testing.assert_allclose(meeting_pose(vbot, robot, robot), vbot, atol=1e-12)  # it stands
    far = meeting_pose(vbot, np.array([1.0, 0.0, math.pi / 2]), robot)
    np.testing.assert_allclose(far, [2.8, 0.0, math.pi], atol=1e-12)  # a camera that is so late is not made up for
