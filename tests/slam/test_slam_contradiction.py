"""Wheels against scans: what is a contradiction, when it counts and when it ends."""

from __future__ import annotations

import numpy as np
import pytest
from slam_planar_world import PlanarWorld, box_room, corridor, l_corridor

from instant_ic.geometry.poses import compose2
from instant_ic.slam import GridSlam
from instant_ic.slam.contradiction import AGREED_M, LONGEST_M, ContradictionMonitor
from instant_ic.util.contradiction import Contradiction

CLEAR = np.array([0.003, 0.003, 0.001])
ALONG_UNKNOWN = np.array([0.02, 0.003, 0.001])
SCAN_S = 0.1


def steps(
    monitor: ContradictionMonitor,
    count: int,
    wheels: tuple[float, float] = (0.0, 0.0),
    seen: tuple[float, float] = (0.0, 0.0),
    sigma: np.ndarray | None = CLEAR,
) -> int:
    """``count`` steps of 0.1 s: metres and radians by the wheels, and as seen; return the contradictions so far."""
    for _ in range(count):
        monitor.update(np.array([wheels[0], 0, wheels[1]]), np.array([seen[0], 0, seen[1]]), SCAN_S, sigma)
    return monitor.count


@pytest.mark.parametrize(
    ("wheels", "seen", "kind"),
    [
        ((0.038, 0.0), (0.0, 0.0), Contradiction.SLIPPING),
        ((0.0, 0.08), (0.0, 0.0), Contradiction.SLIPPING),
        ((0.0, 0.0), (0.03, 0.0), Contradiction.PUSHED),
        ((0.0, 0.0), (0.0, 0.1), Contradiction.PUSHED),
        ((0.03, 0.0), (-0.03, 0.0), Contradiction.OTHER_WAY),
        ((0.02, 0.06), (0.02, -0.06), Contradiction.OTHER_WAY),
        ((0.03, 0.0), (0.15, 0.0), Contradiction.FARTHER),
        ((0.0, 0.05), (0.0, 0.2), Contradiction.FARTHER),
    ],
)
def test_each_kind_is_found_within_half_a_second_or_0_15_m(
    wheels: tuple[float, float], seen: tuple[float, float], kind: Contradiction
) -> None:
    for speed in (1.0, 0.5, 0.25):
        monitor = ContradictionMonitor()
        steps(monitor, 20, (0.03, 0.0), (0.028, 0.0))
        a, b = np.array(wheels) * speed, np.array(seen) * speed
        apart_m = float((np.abs(a - b) * [1.0, 0.3]).sum())
        scans = 0
        while not steps(monitor, 1, tuple(a), tuple(b)):
            scans += 1
            assert scans * SCAN_S <= 0.5 or scans * apart_m <= 1.1 * LONGEST_M, f"{kind} at {speed} of the speed"
        assert monitor.state is kind and scans >= 2


def test_fault_a_pose_that_is_found_again_elsewhere_counts_as_motion_for_minutes() -> None:
    """The jump left a sum of metres, so that the next two scans with a millimetre of noise were a contradiction."""
    monitor = ContradictionMonitor()
    steps(monitor, 20, (0.03, 0.0), (0.03, 0.0))
    steps(monitor, 1, (0.03, 0.0), (-1.4, 2.5))
    for _ in range(50):
        steps(monitor, 1, seen=(0.002, 0.001))
        assert steps(monitor, 1, (0.0, 0.009), (-0.001, 0.009)) == 0


def test_ordinary_slip_wide_tracks_and_noise_are_none() -> None:
    monitor, rng = ContradictionMonitor(), np.random.default_rng(0)
    poses = np.zeros(3)
    for k in range(1000):
        v, w = 0.04 * np.sin(k / 70), 0.08 * np.sin(k / 31)
        wheels = np.array([v * rng.uniform(0.9, 1.3), 0.0, w * rng.uniform(1.0, 2.2)])
        noise, before = rng.normal(0.0, [0.005, 0.005, 0.003]), poses
        poses = noise
        # It turns about a point 8 cm behind base_link.
        monitor.update(wheels, np.array([v, 0.08 * w, w]) + noise - before, SCAN_S, CLEAR)
    assert monitor.count == 0 and monitor.state is Contradiction.NONE


@pytest.mark.parametrize("speed_m_s", [0.05, 0.005])
def test_fault_slow_tracks_that_slip_are_found_late_or_never(speed_m_s: float) -> None:
    """At 0.02 m/s it was found after 0.2 m, at 0.01 m/s never: the noise of each scan counted as motion."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        monitor, way_m, noise = ContradictionMonitor(), 0.0, np.zeros(3)
        while not monitor.count and way_m < 1.0:
            before, noise = noise, rng.normal(0.0, [0.001, 0.001, 0.0005])
            monitor.update(np.array([speed_m_s * SCAN_S, 0.0, 0.0]), noise - before, SCAN_S, CLEAR)
            way_m += speed_m_s * SCAN_S
        assert monitor.state is Contradiction.SLIPPING and way_m <= LONGEST_M


def test_fault_scans_that_come_in_a_burst_are_a_contradiction() -> None:
    """Scans that were kept back arrive together, with the odometry of that moment, beyond what they have seen."""
    monitor, wheels_m = ContradictionMonitor(), 0.35 * 0.6
    for _ in range(20):
        for elapsed_s in (*[0.6] * 6, 2.4, 0.002, 0.002, 0.002):
            wheels = wheels_m * round(elapsed_s / 0.6)
            monitor.update(np.array([wheels, 0, 0]), np.array([wheels_m, 0, 0]), elapsed_s, CLEAR)
    assert monitor.count == 0


def test_scans_measured_half_a_period_before_the_odometry_are_none() -> None:
    monitor, before = ContradictionMonitor(), np.zeros(3)
    for k in range(600):
        wheels = np.array([0.07, 0.0, 0.15]) * np.clip(1.5 * np.sin(k / 7), -1, 1)
        monitor.update(wheels, (wheels + before) / 2, SCAN_S, CLEAR)
        before = wheels
    assert monitor.count == 0


def test_fault_tracks_that_differ_by_a_tenth_turn_the_robot_and_are_a_contradiction() -> None:
    assert steps(ContradictionMonitor(), 300, (0.04, 0.0), (0.04, 0.012)) == 0


def test_what_the_scan_does_not_fix_is_no_contradiction() -> None:
    monitor = ContradictionMonitor()
    assert steps(monitor, 100, (0.04, 0.0), (0.0, 0.0), ALONG_UNKNOWN) == 0
    assert steps(monitor, 100, (0.04, 0.0), (0.0, 0.0), None) == 0  # not matched
    assert steps(monitor, 10, (0.04, 0.08), (0.0, 0.0), ALONG_UNKNOWN) == 1  # but the heading is


def test_one_bad_match_or_late_odometry_is_none() -> None:
    monitor = ContradictionMonitor()
    for _ in range(20):
        steps(monitor, 1, (0.03, 0.0), (0.25, 0.0))
        steps(monitor, 1, (0.03, 0.0), (-0.19, 0.0))
        steps(monitor, 10, (0.03, 0.0), (0.03, 0.0))
    assert monitor.count == 0


def test_a_contradiction_that_lasts_counts_again_and_ends_after_agreement() -> None:
    monitor = ContradictionMonitor()
    assert [steps(monitor, 1, (0.04, 0.0)) for _ in range(8)] == [0, 0, 0, 1, 1, 1, 1, 2]
    steps(monitor, 30)
    assert monitor.state is Contradiction.SLIPPING  # it stands: nothing is known
    ways = round(AGREED_M / 0.02)
    steps(monitor, ways - 3, (0.02, 0.0), (0.02, 0.0))
    assert monitor.state is Contradiction.SLIPPING
    steps(monitor, 10, (0.02, 0.0), (0.02, 0.0))
    assert monitor.state is Contradiction.NONE and monitor.count == 2


def drive(
    slam: GridSlam, world: PlanarWorld, true: tuple[float, float], wheels: tuple[float, float], scans: int
) -> int:
    """Drive from where the SLAM is, and return the scans until the first new contradiction, at most ``scans``."""
    before = slam.contradiction.count
    pose, odometry = slam.map_from_base, slam.frames.odom_from_base
    for k in range(scans):
        pose = compose2(pose, [true[0], 0.0, true[1]])
        odometry = compose2(odometry, [wheels[0], 0.0, wheels[1]])
        stamp_ns = drive.stamp_ns = getattr(drive, "stamp_ns", 0) + 100_000_000
        slam.process(world.scan(pose, stamp_ns, noise_m=0.015), odometry)
        if slam.contradiction.count > before:
            return k + 1
    return scans


@pytest.mark.parametrize("world", [box_room(), l_corridor()])
def test_the_slam_finds_them_by_its_scans(world: PlanarWorld) -> None:
    for true, wheels, within in (
        ((0.0, 0.0), (0.038, 0.0), 6),
        ((-0.03, 0.0), (0.03, 0.0), 5),
        ((0.0, -0.06), (0.0, 0.06), 7),
        ((0.1, 0.0), (0.02, 0.0), 5),
    ):
        slam = GridSlam()
        assert drive(slam, world, (0.02, 0.0), (0.021, 0.0), 10) == 10
        assert drive(slam, world, true, wheels, 20) <= within


def test_along_a_bare_corridor_slip_is_no_contradiction_but_a_wrong_turn_is() -> None:
    slam, world = GridSlam(), corridor()
    assert drive(slam, world, (0.04, 0.0), (0.04, 0.0), 60) == 60
    assert drive(slam, world, (0.0, 0.0), (0.04, 0.0), 40) == 40
    assert drive(slam, world, (0.0, -0.05), (0.0, 0.05), 20) <= 8
