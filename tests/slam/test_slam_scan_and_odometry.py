"""Scans, their points, odometry between samples, the smoothing of map→odom, parameters."""

from __future__ import annotations

import math

import numpy as np
import pytest

from instant_ic.geometry.poses import compose2
from instant_ic.slam import Scan
from instant_ic.slam.odometry import CorrectionLimiter, OdometryBuffer
from instant_ic.slam.scan import scan_points, thin


def make_scan(ranges: list[float], angle_min: float = 0.0, increment: float = math.pi / 2) -> Scan:
    return Scan(np.array(ranges), angle_min, increment, 0.5, 10.0, 1)


def test_points_follow_rep_117() -> None:
    # 0° at 2 m, 90° too near, 180° erroneous, 270° nothing met, 360° beyond the maximum.
    points = scan_points(make_scan([2.0, -math.inf, math.nan, math.inf, 10.5]), np.zeros(3))
    assert np.allclose(points.points, [[2.0, 0.0]])
    limits = scan_points(make_scan([0.5, 10.0]), np.zeros(3))
    assert np.allclose(limits.points, [[0.5, 0.0], [0.0, 10.0]], atol=1e-12)


def test_mount_moves_points_into_the_base_frame() -> None:
    # The laser stands 0.2 m ahead and looks left: its x is the base's y.
    points = scan_points(make_scan([2.0]), np.array([0.2, 0.0, math.pi / 2]))
    assert np.allclose(points.points, [[0.2, 2.0]], atol=1e-12)
    assert np.allclose(points.origin, [0.2, 0.0])


def test_neighbouring_hits_join_into_surfaces() -> None:
    # Three hits on a wall 5 cm apart, then a jump of 4 m to something behind, then a missing beam.
    scan = Scan(np.array([2.0, 2.0, 2.0, 6.0, np.nan, 6.0]), 0.0, 0.025, 0.5, 10.0, 1)
    joined = scan_points(scan, np.zeros(3)).joined
    assert joined.tolist() == [False, True, True, False, False]


def test_a_wall_seen_at_a_grazing_angle_stays_one_surface() -> None:
    # Wall y = 1, beams 1° apart from 8° on: hits up to 0.9 m apart, all in one line.
    angles = np.radians(np.arange(8, 30))
    scan = Scan(1.0 / np.sin(angles), float(angles[0]), math.radians(1.0), 0.5, 10.0, 1)
    points = scan_points(scan, np.zeros(3))
    assert np.hypot(*(points.points[1] - points.points[0])) > 0.5
    assert points.joined[1:].all()


def test_thinning_keeps_the_spacing_and_the_limit() -> None:
    points = np.stack([np.arange(100) * 0.01, np.zeros(100)], axis=1)
    joined = np.ones(100, dtype=bool)
    joined[0] = False
    kept = thin(points, joined, 1000)
    assert len(kept) == 25  # 1 m of wall, a point each 4 cm
    assert np.diff(kept[:, 0]).min() > 0.029
    few = thin(points, joined, 10)
    assert len(few) == 10 and np.diff(few[:, 0]).min() > 0.069 and few[-1, 0] > 0.85


@pytest.mark.parametrize(
    "arguments",
    [
        {"ranges": np.zeros((2, 2))},
        {"range_max": 0.0},
        {"range_min": -1.0},
        {"angle_min": math.nan},
    ],
)
def test_a_scan_that_makes_no_sense_is_refused(arguments: dict) -> None:
    good = {"ranges": np.ones(3), "angle_min": 0.0, "angle_increment": 0.1, "range_min": 0.1}
    good |= {"range_max": 10.0, "stamp_ns": 0}
    Scan(**good)
    with pytest.raises(ValueError, match=r"must be|need"):
        Scan(**{**good, **arguments})


def test_odometry_between_samples_lies_on_the_arc() -> None:
    # A quarter circle of radius 1 to the left in 1 s; after half the time the robot is at 45° of it.
    buffer = OdometryBuffer()
    buffer.add(0, np.zeros(3))
    buffer.add(1_000_000_000, np.array([1.0, 1.0, math.pi / 2]))
    half = buffer.at(500_000_000)
    assert half is not None
    assert np.allclose(half, [math.sin(math.pi / 4), 1 - math.cos(math.pi / 4), math.pi / 4])


def test_odometry_outside_its_time() -> None:
    buffer = OdometryBuffer(keep_s=1.0)
    assert buffer.at(0) is None
    assert buffer.add(1_000_000_000, np.zeros(3))
    assert buffer.add(1_100_000_000, np.array([0.1, 0.0, 0.0]))
    assert not buffer.add(1_100_000_000, np.zeros(3))
    assert not buffer.add(1_200_000_000, np.array([math.nan, 0.0, 0.0]))
    assert buffer.at(999_999_999) is None
    assert buffer.at(1_200_000_000) is None
    ahead = buffer.at(1_200_000_000, extrapolate_s=0.15)
    assert ahead is not None and np.allclose(ahead, [0.2, 0.0, 0.0])
    assert buffer.at(1_300_000_000, extrapolate_s=0.15) is None
    buffer.add(3_000_000_000, np.zeros(3))
    assert buffer.at(1_050_000_000) is None  # older than keep_s: forgotten


def test_small_corrections_pass_and_large_ones_arrive_at_the_given_speed() -> None:
    limiter = CorrectionLimiter()
    base = np.array([5.0, 0.0, 0.0])
    assert np.allclose(limiter.follow(np.zeros(3), base, 0), 0)
    small = np.array([0.03, 0.0, 0.0])
    assert np.allclose(limiter.follow(small, base, 100_000_000), small)
    # 0.4 m at 1 m/s and a scan each 0.1 s: four steps of 0.1 m.
    large = np.array([0.43, 0.0, 0.0])
    places = [limiter.follow(large, base, (k + 2) * 100_000_000)[0] for k in range(5)]
    assert np.allclose(places, [0.13, 0.23, 0.33, 0.43, 0.43])


def test_a_robot_that_was_carried_off_is_where_it_is_at_once() -> None:
    for moved in ([0.6, 0.0, 0.0], [0.0, 0.0, 0.6]):
        limiter = CorrectionLimiter()
        limiter.follow(np.zeros(3), np.zeros(3), 0)
        assert np.allclose(limiter.follow(np.array(moved), np.zeros(3), 100_000_000), moved)


def test_the_limit_of_a_turn_holds_at_the_robot_not_at_the_origin() -> None:
    # 0.004 rad about the origin moves a robot 100 m away by 0.4 m.
    limiter = CorrectionLimiter()
    base = np.array([100.0, 0.0, 0.0])
    limiter.follow(np.zeros(3), base, 0)
    limited = limiter.follow(np.array([0.0, 0.0, 0.004]), base, 100_000_000)
    moved = compose2(limited, base)
    assert math.hypot(moved[0] - 100.0, moved[1]) == pytest.approx(0.1, rel=1e-3)
