"""Beams of the scan that are measured no longer: the robot does not drive that way."""

from __future__ import annotations

import math

import numpy as np
import pytest
from control_world import Loop, World, corridor, draw_map, matrix

from instant_ic.control.costmap import CostmapConfig
from instant_ic.control.footprint import Footprint
from instant_ic.control.states import Mode, Reason
from instant_ic.control.surroundings import ArrivedScan, Surroundings
from instant_ic.geometry.transforms import TransformBuffer

BEAMS = 720
AHEAD = np.abs(np.arange(BEAMS) - 360) < 30  # 15 degrees to either side
BEHIND = np.roll(AHEAD, 360)
LEFT = np.roll(AHEAD, 180)
ONE_PACKET = np.abs(np.arange(BEAMS) - 360) < 5


class Driver:
    """A LiDAR that is mounted turned by a quarter, whose scans are placed one after the other."""

    def __init__(self) -> None:
        self.tf = TransformBuffer()
        self.tf.set("base_link", "velodyne", 0, matrix(np.array([0.1, 0.0, math.pi / 2])), static=True)
        self.surroundings = Surroundings(CostmapConfig(), Footprint(), self.tf)
        self.stamp_ns = 0

    def scan(self, unmeasured: np.ndarray, value: float = np.nan, beams: int = BEAMS) -> tuple[bool, bool]:
        """Place a scan whose beams (in base_link) are ``value``, and return the blind directions."""
        self.stamp_ns += 100_000_000
        self.tf.set("odom", "base_link", self.stamp_ns, np.eye(4))
        ranges = np.where(np.roll(unmeasured, -BEAMS // 4), value, 3.0)[:beams]
        angle = 2 * math.pi / beams
        scan = ArrivedScan("velodyne", self.stamp_ns, self.stamp_ns, ranges, -math.pi, angle, 0.4, 100.0)
        self.surroundings.near_points(scan)
        return self.surroundings.blind


def test_a_covered_sector_makes_blind_where_the_robot_would_drive_and_only_there() -> None:
    driver, nothing = Driver(), np.zeros(BEAMS, np.bool_)
    for covered, blind in ((AHEAD, (True, False)), (BEHIND, (False, True)), (LEFT, (False, False))):
        assert driver.scan(nothing) == (False, False)
        assert driver.scan(covered) == (False, False)  # one scan may lack packets
        assert [driver.scan(covered) for _ in range(20)] == [blind] * 20
    assert driver.scan(nothing) == (False, False)
    assert driver.scan(nothing[:BEAMS], beams=360) == (False, False)


def test_open_space_a_lost_packet_and_a_limited_field_of_view_do_not() -> None:
    driver, nothing = Driver(), np.zeros(BEAMS, np.bool_)
    for _ in range(5):
        driver.scan(nothing)
    assert not any(any(driver.scan(AHEAD, np.inf)) for _ in range(5))
    assert not any(any(driver.scan(ONE_PACKET)) for _ in range(5))
    limited = Driver()
    assert not any(any(limited.scan(BEHIND)) for _ in range(5))  # it has never looked there


@pytest.mark.parametrize(("blind", "command"), [((True, False), (0.3, 0.2)), ((False, True), (-0.3, 0.0))])
def test_a_blind_robot_does_not_drive_that_way_but_turns_and_drives_the_other_way(
    blind: tuple[bool, bool], command: tuple[float, float]
) -> None:
    walls = corridor(16.0)
    made = Loop(World(walls), draw_map(walls, (-2, -1.2, 14.0, 1.2)), start=(4.0, 0.0, 0.0))
    made.start()

    def drive(wanted: tuple[float, float]) -> tuple[float, float]:
        for _ in range(20):
            made.step(wanted)
        return made.frames[-1].command

    assert drive(command) != (0.0, 0.0)
    made.blind = blind
    assert drive(command) == (0.0, 0.0)
    decision = made.frames[-1].decision
    assert decision.hard and decision.blocked and decision.mode == Mode.REAL and decision.reason_code == Reason.BLIND
    assert "Uncover it" in decision.reason
    assert drive((0.0, 0.5)) == pytest.approx((0.0, 0.5))
    assert drive((-command[0], 0.0))[0] * command[0] < 0.0
