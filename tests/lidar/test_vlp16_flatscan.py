"""The flat scan: geometry by hand, motion taken out, REP-117."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lidar_streams import SECOND

from instant_ic.geometry.poses import inverse, matrix_from_pose2, pose_matrix
from instant_ic.lidar.config import FlatScanConfig
from instant_ic.lidar.decode import POINT_DTYPE
from instant_ic.lidar.flatscan import flat_scan
from instant_ic.lidar.motion import MotionError, PlanarMotion
from instant_ic.lidar.stream import Revolution

MOUNT = pose_matrix(z=0.6)
CONFIG = FlatScanConfig(min_height=0.1, max_height=1.3)
START = 1_700_000_000 * SECOND


def revolution(
    points: list[tuple[float, float, float, float]], looked: bool = True, close: tuple[int, ...] = ()
) -> Revolution:
    """A revolution of 0.1 s with points (x, y, z, time); the head turns clockwise from behind."""
    array = np.zeros(len(points), POINT_DTYPE)
    for name, column in zip(("x", "y", "z", "time"), zip(*points, strict=True), strict=False):
        array[name] = column
    count = 1800 if looked else 0
    turn = np.arange(count) / max(1, count)
    too_close = np.zeros(count, bool)
    too_close[list(close)] = True
    return Revolution(
        points=array,
        stamp_ns=START,
        end_ns=START + SECOND // 10,
        firing_azimuth=((turn * 2.0 * np.pi + np.pi) % (2.0 * np.pi)).astype(np.float32),
        firing_time=(0.1 * turn).astype(np.float32),
        firing_too_close=too_close,
        duration_s=0.1,
        complete=True,
    )


def beam(angle_deg: float) -> int:
    """Index of the beam that looks to an angle, counter-clockwise from ahead."""
    return round((np.radians(angle_deg) + np.pi) / (2.0 * np.pi / 720)) % 720


def test_nearest_point_of_the_band_counts_for_its_beam() -> None:
    scan = flat_scan(
        revolution(
            [
                (3.0, 0.0, 0.2, 0.05),  # ahead, 0.8 m above the ground
                (2.0, 0.0, 0.71, 0.05),  # nearer, but 1.31 m high
                (1.0, 0.0, -0.51, 0.05),  # nearer, but 0.09 m high
                (4.0, 0.0, 0.0, 0.05),  # behind the first
                (0.0, 2.5, -0.49, 0.02),  # to the left, 0.11 m high
            ]
        ),
        MOUNT,
        CONFIG,
    )
    assert scan[beam(0.0)] == pytest.approx(3.0)
    assert scan[beam(90.0)] == pytest.approx(2.5)
    assert np.isposinf(scan[beam(180.0)])  # looked at, nothing met
    assert np.isfinite(scan).sum() == 2


def test_directions_that_were_not_looked_into_are_unknown() -> None:
    scan = flat_scan(revolution([(3.0, 0.0, 0.0, 0.05)], looked=False), MOUNT, CONFIG)
    assert scan[beam(0.0)] == pytest.approx(3.0)
    assert np.isnan(np.delete(scan, beam(0.0))).all()


def test_too_close_is_told_apart_from_nothing() -> None:
    # Firing 900 of 1800 looks ahead.
    scan = flat_scan(revolution([(0.3, 0.3, 0.0, 0.03), (2.0, 0.0, 0.0, 0.05)], close=(900,)), MOUNT, CONFIG)
    assert np.isneginf(scan[beam(0.0)])
    assert np.isneginf(scan[beam(45.0)]) or scan[beam(45.0)] == pytest.approx(0.3 * 2**0.5)


def test_mount_on_its_side_keeps_the_height_band_level() -> None:
    # The sensor looks to the robot's left: ahead of it is at 0 degrees of its own frame.
    mount = pose_matrix(x=0.2, z=0.6, yaw=np.pi / 2, pitch=np.radians(10.0))
    point_in_base = np.array([0.2, 3.0, 0.6, 1.0])
    x, y, z = (inverse(mount) @ point_in_base)[:3]
    scan = flat_scan(revolution([(x, y, z, 0.05)]), mount, CONFIG)
    found = np.flatnonzero(np.isfinite(scan))
    assert found.tolist() == [beam(0.0)]
    assert scan[found[0]] == pytest.approx(np.hypot(x, y), rel=1e-6)


def moving(v: float, w: float, samples: int = 7) -> PlanarMotion:
    """The base on an arc: poses from 50 ms before the revolution to 50 ms after it."""
    times = np.linspace(-0.05, 0.15, samples)
    radius = v / w if abs(w) > 1e-6 else 0.0
    x = radius * np.sin(w * times) if radius else v * times
    y = radius * (1.0 - np.cos(w * times)) if radius else 0.0 * times
    return PlanarMotion(START + (times * SECOND).astype(np.int64), np.stack([x, y, w * times], axis=1))


def test_drive_ahead_is_taken_out_by_hand() -> None:
    # 0.5 m/s: a point seen at the start is 0.05 m nearer at the end, one seen at the end where it is.
    motion = moving(0.5, 0.0)
    cloud = revolution([(3.0, 0.0, 0.0, 0.0), (0.0, 2.0, 0.0, 0.1), (-2.0, 0.0, 0.0, 0.05)])
    scan = flat_scan(cloud, MOUNT, CONFIG, motion)
    assert scan[beam(0.0)] == pytest.approx(2.95, abs=1e-5)
    assert scan[beam(90.0)] == pytest.approx(2.0, abs=1e-5)
    assert scan[beam(180.0)] == pytest.approx(2.025, abs=1e-5)


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.5, 0.5), st.floats(-1.0, 1.0), st.floats(-0.3, 0.3), st.floats(-3.0, 3.0))
def test_standing_things_come_out_where_they_stand(v: float, w: float, mount_x: float, mount_yaw: float) -> None:
    """World points seen from the moving sensor, each at its own time, and brought to the end: exact positions."""
    mount = pose_matrix(x=mount_x, z=0.6, yaw=mount_yaw)
    motion = moving(v, w, samples=81)
    times = np.linspace(0.0, 0.1, 50)
    stamps = START + (times * SECOND).astype(np.int64)
    angle = np.linspace(-3.0, 3.0, 50)
    world = np.stack([4.0 * np.cos(angle), 3.0 * np.sin(angle), np.full(50, 0.7), np.ones(50)], axis=1)
    seen = [
        (inverse(matrix_from_pose2(pose) @ mount) @ point)[:3]
        for pose, point in zip(motion.at(stamps), world, strict=True)
    ]
    cloud = revolution([(*position, time) for position, time in zip(seen, times, strict=True)])
    end_from_world = inverse(matrix_from_pose2(motion.at(cloud.end_ns)) @ mount)
    expected = (world @ end_from_world.T)[:, :3]
    ranges = flat_scan(cloud, mount, CONFIG, motion)
    beams = np.round((np.arctan2(expected[:, 1], expected[:, 0]) + np.pi) / (2.0 * np.pi / 720)).astype(int)
    for index, at in enumerate(beams):
        near = ranges[[(at - 1) % 720, at % 720, (at + 1) % 720]]
        assert np.nanmin(np.abs(near - np.hypot(*expected[index, :2]))) < 2e-3


def test_motion_interpolates_goes_on_and_ends_somewhere() -> None:
    motion = PlanarMotion(np.array([START, START + SECOND // 10]), np.array([[0.0, 0.0, 3.1], [0.1, 0.0, -3.1]]))
    middle = motion.at(START + SECOND // 20)
    assert middle[0] == pytest.approx(0.05)
    assert abs(middle[2]) == pytest.approx(np.pi)  # the short way over the wrap
    assert motion.at(START + SECOND // 5)[0] == pytest.approx(0.2)
    with pytest.raises(MotionError, match=r"no pose of the base within 0.2 s"):
        motion.at(START + SECOND)
