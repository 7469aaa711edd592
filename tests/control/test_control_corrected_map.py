"""SLAM corrects the map while the robot drives: what only the costmap remembers stays before the robot."""

from __future__ import annotations

import math

import numpy as np
import pytest

from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.commands import CommandRules
from instant_ic.control.costmap import CostmapConfig
from instant_ic.control.footprint import Footprint
from instant_ic.control.snapshot import ArbiterInputs
from instant_ic.control.surroundings import ArrivedCloud, ArrivedScan, Surroundings
from instant_ic.geometry.poses import compose2, inverse2, matrix_from_pose2, pose_matrix
from instant_ic.geometry.transforms import TransformBuffer
from instant_ic.lidar.decode import POINT_DTYPE
from instant_ic.slam.odometry import CorrectionLimiter

NOSE_M = 0.30
BOX_M = 2.0  # ahead of the start: 0.1 m high, 0.2 m wide; nearer than 1.9 m no beam meets it
BOX = np.array(
    [[x, y, z] for x in np.arange(BOX_M, 2.3, 0.02) for y in np.arange(-0.1, 0.1, 0.02) for z in (0.08, 0.1)]
)


class Drive:
    """The arbiter's surroundings on a straight drive in odom at 10 Hz, and the shipped limiter of corrections."""

    def __init__(self, start_m: float) -> None:
        self.start_m, self.x_m = start_m, start_m
        self.tf, self.limiter, self.now_ns = TransformBuffer(), CorrectionLimiter(), 1_000_000_000
        self.tf.set("base_link", "velodyne", 0, pose_matrix(z=0.6), static=True)
        self.surroundings = Surroundings(CostmapConfig(), Footprint(), self.tf)
        self.map_from_odom = np.zeros(3)

    def step(self, sees_box: bool = False) -> ArbiterInputs:
        self.now_ns += 100_000_000
        now, base = self.now_ns, np.array([self.x_m, 0.0, 0.0])
        self.tf.set("odom", "base_link", now, matrix_from_pose2(base))
        self.tf.set("map", "odom", now, matrix_from_pose2(self.limiter.follow(self.map_from_odom, base, now)))
        points = np.zeros(len(BOX) if sees_box else 0, POINT_DTYPE)
        if sees_box:
            points["x"], points["y"], points["z"] = (BOX + [self.start_m - self.x_m, 0.0, -0.6]).T
        scan = ArrivedScan("velodyne", now, now, np.full(720, 7.0), -math.pi, 2 * math.pi / 720, 0.4, 20.0)
        self.surroundings.update_costmap(scan, ArrivedCloud("velodyne", now, now, points), None)
        near = self.surroundings.near_points(scan)
        return ArbiterInputs(
            robot_pose=self.surroundings.robot_pose(),
            costmap=self.surroundings.costmap,
            scan_points=near,
            ages={"scan": 0.0, "points": 0.0},
        )

    def correct(self, moved: tuple[float, float, float]) -> None:
        """The robot's pose in the map changes by ``moved``, in its own frame."""
        base = np.array([self.x_m, 0.0, 0.0])
        self.map_from_odom = compose2(compose2(compose2(self.map_from_odom, base), moved), inverse2(base))


@pytest.mark.parametrize(
    ("start_m", "moved"),
    [
        (0.0, (0.0, 0.45, 0.0)),
        (0.0, (0.0, -0.45, 0.0)),
        (0.0, (0.0, 0.0, math.radians(24))),
        (20.0, (0.0, 0.0, math.radians(3))),
    ],
    ids=["left", "right", "turned", "turned far from the origin of odom"],
)
def test_fault_a_correction_of_the_map_lets_the_robot_strike_a_low_box(
    start_m: float, moved: tuple[float, float, float]
) -> None:
    drive, rules = Drive(start_m), CommandRules(ArbiterConfig())
    for _ in range(3):
        drive.step(sees_box=True)
    while drive.x_m < start_m + 1.0:
        drive.x_m += 0.04
        drive.step()
    drive.correct(moved)
    for _ in range(6):  # the limiter needs up to half a second
        inputs = drive.step()
    for _ in range(60):
        sent = rules.monitored((0.4, 0.0), inputs)
        if sent.command[0] == 0.0:
            break
        drive.x_m += 0.1 * sent.command[0]
        assert drive.x_m + NOSE_M < start_m + BOX_M
        inputs = drive.step()
    assert BOX_M - 0.2 < drive.x_m - start_m + NOSE_M < BOX_M


def test_a_robot_that_was_carried_off_remembers_nothing_of_the_place_before() -> None:
    drive = Drive(0.0)
    inputs = drive.step(sees_box=True)
    assert len(inputs.costmap.remembered)
    drive.correct((0.0, 0.6, 0.0))
    assert len(drive.step().costmap.remembered) == 0
