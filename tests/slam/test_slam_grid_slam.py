"""The whole of GridSlam in worlds with exact scans."""

from __future__ import annotations

import math

import numpy as np
import pytest
from slam_planar_world import PlanarWorld, box_room, corridor, l_corridor

from instant_ic.geometry.poses import compose2, relative2
from instant_ic.slam import GridSlam, Scan, SlamResult, SlamStatus
from instant_ic.slam.front_end import TUNING

STEP_NS = 100_000_000


class Drive:
    """A robot that is driven through a world, its odometry with slip, SLAM beside it."""

    def __init__(
        self, world: PlanarWorld, noise_m: float = 0.015, mount: tuple[float, float, float] = (0, 0, 0)
    ) -> None:
        self.world, self.noise_m, self.mount = world, noise_m, np.array(mount, dtype=np.float64)
        self.slam = GridSlam()
        self.true = np.zeros(3)
        self.odometry: np.ndarray = np.zeros(3)
        self.stamp_ns = 0
        self.results: list[SlamResult] = []
        self.errors: list[tuple[float, float]] = []

    def go(
        self, v: float, w: float, scans: int, slip_v: float = 1.0, slip_w: float = 1.0, odometry: bool = True
    ) -> None:
        for _ in range(scans):
            step = np.array([v, 0.0, w]) * 0.1
            self.true = compose2(self.true, step)
            self.odometry = compose2(self.odometry, step * [slip_v, 1.0, slip_w])
            self.look(self.odometry if odometry else None)

    def look(self, odometry: np.ndarray | None) -> SlamResult:
        self.stamp_ns += STEP_NS
        scan = self.world.scan(compose2(self.true, self.mount), self.stamp_ns, noise_m=self.noise_m)
        result = self.slam.process(scan, odometry, self.mount)
        error = relative2(self.true, result.map_from_base)
        self.results.append(result)
        self.errors.append((math.hypot(error[0], error[1]), abs(float(error[2]))))
        return result


def test_l_corridor_there_and_back_on_slipping_tracks() -> None:
    drive = Drive(l_corridor())
    slip = {"slip_v": 1.15, "slip_w": 1.3}
    drive.go(0.5, 0.0, 20)
    drive.go(1.0, 0.0, 180, **slip)
    drive.go(0.0, 0.9, 17, **slip)
    drive.go(1.0, 0.0, 60, **slip)
    drive.go(0.0, -0.9, 35, **slip)
    drive.go(1.0, 0.0, 60, **slip)
    errors = np.array(drive.errors)
    odometry_error = relative2(drive.true, drive.odometry)
    assert math.hypot(odometry_error[0], odometry_error[1]) > 1.0  # what SLAM had to make good
    assert errors[:, 0].max() < 0.05
    assert errors[:, 1].max() < math.radians(0.5)
    assert {result.status for result in drive.results[1:]} == {SlamStatus.TRACKED}
    # All corrections are in map→odom; odometry itself is as it was given.
    assert np.array_equal(drive.slam.frames.odom_from_base, drive.odometry)
    again = compose2(drive.slam.frames.map_from_odom, drive.odometry)
    assert np.allclose(again, drive.slam.map_from_base, atol=1e-9)


def test_bare_corridor_follows_odometry_along_its_axis() -> None:
    drive = Drive(corridor())
    drive.go(0.5, 0.0, 160)
    errors = np.array(drive.errors)
    assert errors[:, 0].max() < 0.05  # over 8 m in which nothing but odometry tells how far
    assert errors[:, 1].max() < math.radians(0.2)


def test_without_odometry_the_scans_suffice() -> None:
    drive = Drive(box_room())
    drive.look(None)
    drive.go(0.4, 0.0, 30, odometry=False)
    drive.go(0.0, 0.8, 20, odometry=False)
    drive.go(0.4, 0.3, 20, odometry=False)
    assert np.array(drive.errors)[:, 0].max() < 0.03
    assert np.array(drive.errors)[:, 1].max() < math.radians(1.0)
    # LiDAR odometry carries odom→base_link; map→odom has nothing to correct.
    assert np.allclose(drive.slam.frames.odom_from_base, drive.slam.map_from_base, atol=1e-9)
    assert np.allclose(drive.slam.frames.map_from_odom, 0)


def test_odometry_that_stops_and_comes_back() -> None:
    drive = Drive(box_room())
    drive.go(0.4, 0.1, 20, slip_v=1.2)
    before = drive.slam.frames.map_from_odom.copy()
    drive.go(0.4, 0.1, 10, odometry=False)
    assert np.array_equal(drive.slam.frames.map_from_odom, before)
    assert np.allclose(compose2(before, drive.slam.frames.odom_from_base), drive.slam.map_from_base, atol=1e-9)
    drive.go(0.4, 0.1, 10, slip_v=1.2)
    assert np.array(drive.errors)[:, 0].max() < 0.03
    assert np.array_equal(drive.slam.frames.odom_from_base, drive.odometry)


def test_the_first_pose_is_odometrys() -> None:
    start = np.array([3.0, -2.0, 1.0])
    result = GridSlam().process(box_room().scan(np.zeros(3), 1), start)
    assert result.status is SlamStatus.FIRST
    assert result.keyframe_added
    assert np.array_equal(result.map_from_base, start)


def test_a_poor_first_scan_is_made_up_for_where_the_robot_stands() -> None:
    """Half a revolution, as a LiDAR gives that has just been switched on: the rest must not be looked for for ever."""
    drive = Drive(box_room())
    drive.stamp_ns += STEP_NS
    whole = drive.world.scan(drive.true, drive.stamp_ns, noise_m=0.015)
    half = np.where(np.arange(len(whole.ranges)) < 400, whole.ranges, np.inf)
    drive.slam.process(Scan(half, whole.angle_min, whole.angle_increment, 0.3, 30.0, drive.stamp_ns), np.zeros(3))
    drive.go(0.0, 0.0, 20)
    assert drive.results[0].score < TUNING.recovery_score
    assert [result.keyframe_added for result in drive.results] == [True] + [False] * 19
    assert min(result.score for result in drive.results[1:]) > 0.85
    assert max(error for error, _ in drive.errors) < 0.02


def test_keyframes_come_with_motion_only() -> None:
    drive = Drive(box_room())
    drive.go(0.0, 0.0, 20)
    assert sum(result.keyframe_added for result in drive.results) == 1
    version = drive.slam.map.version
    drive.go(0.5, 0.0, 20)  # 1 m: four keyframes a metre, the fourth perhaps just not reached
    assert 3 <= sum(result.keyframe_added for result in drive.results[20:]) <= 4
    assert drive.slam.map.version > version


def make_empty(kind: str, stamp_ns: int) -> Scan:
    ranges = np.zeros(0) if kind == "empty" else np.full(720, np.inf)
    return Scan(ranges, -math.pi, 2 * math.pi / 720, 0.3, 30.0, stamp_ns)


@pytest.mark.parametrize("kind", ["empty", "all inf"])
def test_a_scan_that_shows_nothing_is_bridged_by_odometry(kind: str) -> None:
    drive = Drive(box_room())
    drive.go(0.4, 0.0, 5)
    drive.true = compose2(drive.true, [0.2, 0.0, 0.1])
    drive.odometry = compose2(drive.odometry, [0.2, 0.0, 0.1])
    drive.stamp_ns += STEP_NS
    sure = drive.results[-1].covariance
    result = drive.slam.process(make_empty(kind, drive.stamp_ns), drive.odometry)
    assert result.status is SlamStatus.NO_POINTS and not result.status.matched
    assert result.score == 0.0 and not result.keyframe_added
    assert np.hypot(*relative2(drive.true, result.map_from_base)[:2]) < 0.02
    assert np.all(np.diag(result.covariance) > np.diag(sure))
    drive.go(0.4, 0.0, 3)
    assert drive.results[-1].status is SlamStatus.TRACKED
    assert drive.errors[-1][0] < 0.02


def test_an_empty_first_scan_starts_nothing() -> None:
    slam = GridSlam()
    assert slam.process(make_empty("all inf", 1), np.zeros(3)).status is SlamStatus.NO_POINTS
    assert slam.grid().values.size == 0
    assert slam.process(box_room().scan(np.zeros(3), 2), np.zeros(3)).status is SlamStatus.FIRST


@pytest.mark.parametrize("back_ns", [0, 10**12])
def test_time_that_does_not_go_forward_changes_nothing(back_ns: int) -> None:
    drive = Drive(box_room())
    drive.go(0.4, 0.2, 10)
    before = drive.slam.map_from_base.copy(), drive.slam.frames.map_from_odom.copy(), drive.slam.map.version
    scan = drive.world.scan(np.array([1.0, 0.0, 0.5]), drive.stamp_ns - back_ns)
    result = drive.slam.process(scan, np.array([1.0, 0.0, 0.5]))
    assert result.status is SlamStatus.TIME_BACKWARDS
    assert np.array_equal(result.map_from_base, before[0])
    assert np.array_equal(drive.slam.frames.map_from_odom, before[1])
    assert drive.slam.map.version == before[2]
    drive.go(0.4, 0.2, 5)
    assert drive.errors[-1][0] < 0.02


def test_odometry_that_jumps_is_found_out() -> None:
    # Tracks spin on the spot: odometry tells 0.8 m and 0.5 rad that never were. Beyond the window: the wide search.
    drive = Drive(box_room())
    drive.go(0.4, 0.0, 10)
    drive.odometry = compose2(drive.odometry, [0.8, 0.0, 0.9])
    result = drive.look(drive.odometry)
    assert result.status in (SlamStatus.TRACKED, SlamStatus.RECOVERED)
    assert drive.errors[-1][0] < 0.02 and drive.errors[-1][1] < 0.01


@pytest.mark.parametrize("turn_deg", [-85.0, 170.0])
def test_a_heading_that_jumps_in_one_scan_turns_nothing(turn_deg: float) -> None:
    drive = Drive(l_corridor())
    drive.go(0.5, 0.0, 10)
    drive.odometry = compose2(drive.odometry, [0.0, 0.0, math.radians(turn_deg)])
    assert drive.look(drive.odometry).status is SlamStatus.RECOVERED
    drive.go(0.5, 0.0, 10)
    assert max(error[1] for error in drive.errors[10:]) < 0.02
    assert max(error[0] for error in drive.errors[10:]) < 0.1


def test_stamps_a_millisecond_apart_make_no_speed() -> None:
    # Without odometry: a step of 5 cm that took 1 ms by its stamp does not go on at 50 m/s.
    drive = Drive(box_room())
    drive.go(0.0, 0.0, 1, odometry=False)
    drive.go(0.5, 0.0, 5, odometry=False)
    drive.stamp_ns -= STEP_NS - 1_000_000
    drive.go(0.5, 0.0, 1, odometry=False)
    drive.stamp_ns += STEP_NS - 1_000_000
    drive.go(0.5, 0.0, 5, odometry=False)
    assert all(result.status is not SlamStatus.LOST for result in drive.results)
    assert max(error[0] for error in drive.errors) < 0.03


@pytest.mark.parametrize("lost_after", [(25_000_000, 12), (700_000_000, 3)])
def test_a_lost_robot_starts_anew_after_0_3_s_and_three_scans_at_least(lost_after: tuple[int, int]) -> None:
    step_ns, scans = lost_after
    drive = Drive(box_room())
    drive.go(0.4, 0.0, 10)
    corners = [(-9.0, -5.0), (14.0, -7.0), (1.0, 16.0)]
    drive.world = PlanarWorld([(*corners[k], *corners[(k + 1) % 3]) for k in range(3)])
    drive.true = np.zeros(3)
    statuses = []
    for _ in range(scans):
        drive.stamp_ns += step_ns - STEP_NS
        statuses.append(drive.look(drive.odometry).status)
    assert statuses == [SlamStatus.LOST] * (scans - 1) + [SlamStatus.RESTARTED]


def test_odometry_that_is_not_finite_is_refused() -> None:
    with pytest.raises(ValueError, match="not finite"):
        GridSlam().process(box_room().scan(np.zeros(3), 1), [math.nan, 0.0, 0.0])
