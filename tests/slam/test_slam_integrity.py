"""Integrity of the pose: rays against the map, the monitor's odds, and robots carried off in the simulator."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.slam_faults import evaluate_faults, kidnap
from instant_ic.experiments.slam_logs import LogEntry
from instant_ic.experiments.slam_sim import round_trip
from instant_ic.sim.worlds import make_world
from instant_ic.slam import GridSlam
from instant_ic.slam.integrity import (
    BOUND_SIGMAS,
    TUNING,
    IntegrityMonitor,
    contradiction,
    mixture,
)
from instant_ic.slam.scan import ScanPoints

KNOWN_FREE, WALL = -3.0, 3.0


def wall_map() -> tuple[np.ndarray, np.ndarray]:
    """8 m × 4 m of 5 cm cells from (0, 0): free, a wall along x = 4 m, and unknown from x = 5 m on."""
    cells = np.full((80, 160), KNOWN_FREE, dtype=np.float32)
    cells[:, 80] = WALL
    seen = np.ones((80, 160), dtype=np.int32)
    seen[:, 100:] = 0
    return cells, seen


def hits(*points: tuple[float, float]) -> ScanPoints:
    """Thirty equal hits each, so that the least number of rays is reached."""
    repeated = np.repeat(np.array(points, dtype=np.float64), 30, axis=0)
    return ScanPoints(repeated, np.zeros(len(repeated), dtype=np.bool_), np.zeros(2))


@pytest.mark.parametrize(
    ("points", "share"),
    [
        (((3.0, 0.0),), 0.0),  # from x = 1 m: on the wall
        (((3.2, 0.0),), 0.0),  # within the slack of it
        (((1.5, 0.0),), 1.0),  # in free space
        (((5.5, 0.0),), 1.0),  # through the wall
        (((3.0, 0.0), (1.5, 0.0)), 0.5),
        (((-3.0, 0.0),), 0.0),  # off the map: something new
    ],
)
def test_share_of_rays_that_contradict_the_map(points: tuple[tuple[float, float], ...], share: float) -> None:
    cells, seen = wall_map()
    assert contradiction(cells, seen, np.zeros(2), 0.05, np.array([1.0, 2.0, 0.0]), hits(*points)) == share


def test_cells_that_only_older_scans_have_seen_count_as_unknown() -> None:
    cells, seen = wall_map()
    seen[seen > 0] = 7
    seen[:, 80] = 6  # the wall
    pose, through = np.array([1.0, 2.0, 0.0]), hits((5.5, 0.0))
    assert contradiction(cells, seen, np.zeros(2), 0.05, pose, through, since=6) == 1.0
    assert contradiction(cells, seen, np.zeros(2), 0.05, pose, through, since=7) == 0.0


def steady(scans: int = 30) -> IntegrityMonitor:
    monitor = IntegrityMonitor()
    for _ in range(scans):
        monitor.matched(0.02, 0.9, 0.1)
    return monitor


def test_three_contradicted_scans_take_the_trust() -> None:
    # Full evidence is 2 a scan at 10 Hz, from -6: at 0 after three scans.
    monitor = steady()
    lost = []
    for _ in range(3):
        monitor.matched(0.5, 0.4, 0.1)
        assert monitor.doubts
        lost.append(monitor.lost)
    assert lost == [False, False, True]
    assert monitor.lost_probability == pytest.approx(TUNING.untrusted)


def test_evidence_counts_by_time() -> None:
    # At 40 Hz a scan has a quarter of the evidence: 12 scans instead of 3.
    monitor = steady()
    scans = 0
    while not monitor.lost:
        monitor.matched(0.5, 0.4, 0.025)
        scans += 1
    assert scans == 12


@pytest.mark.parametrize(("contradicted", "score"), [(0.5, 0.9), (0.02, 0.7)])
def test_neither_alone_takes_the_trust(contradicted: float, score: float) -> None:
    # A map that has drifted contradicts at a good score; a new place lowers the score without contradiction.
    monitor = steady()
    for _ in range(50):
        monitor.matched(contradicted, score, 0.1)
    assert monitor.lost_probability < 0.01


def test_scans_that_agree_with_the_provisional_map_alone_take_the_trust_by_the_way_driven() -> None:
    # -6 + 100 a metre · (0.3 - 0.1) · 0.1 m = -4, -2, 0.
    monitor = steady()
    lost = []
    for _ in range(3):
        monitor.compared(0.3, 0.1)
        monitor.compared(0.3, 0.0)  # a robot that stands learns nothing new
        monitor.matched(0.02, 0.9, 0.1)  # fits, by the score
        lost.append(monitor.lost)
    assert lost == [False, False, True]
    monitor.settled()
    assert not monitor.lost
    monitor.compared(0.1, 1.0)
    assert monitor.lost_probability == pytest.approx(1 / (1 + math.exp(6.0)))


@pytest.mark.parametrize(("contradicted", "score", "sign"), [(0.02, 0.9, False), (0.15, 0.65, True)])
def test_a_contradiction_with_a_drop_of_the_score_is_a_sign(contradicted: float, score: float, sign: bool) -> None:
    # sqrt(0.13 / 0.25 · 1) = 0.72: more than half of the full evidence.
    monitor = steady()
    monitor.matched(contradicted, score, 0.1)
    assert monitor.sign is sign


def test_a_doubt_ends_with_scans_that_fit() -> None:
    monitor = steady()
    monitor.matched(0.5, 0.4, 0.1)
    monitor.matched(0.02, 0.9, 0.1)
    assert not monitor.doubts


def test_a_scan_that_only_the_wide_search_finds_stays_out_of_the_map() -> None:
    monitor = steady()
    monitor.matched(0.02, 0.9, 0.1, recovered=True)
    assert monitor.doubts
    monitor.matched(0.02, 0.9, 0.1)
    assert not monitor.doubts


def test_time_without_scans_raises_the_probability_up_to_a_limit() -> None:
    # -6 + 0.6 · (6 s - 1 s) = -3; the limit is -1.
    monitor = steady()
    monitor.unmatched(False, 6.0)
    assert monitor.lost_probability == pytest.approx(1 / (1 + math.exp(3.0)))
    monitor.unmatched(False, 600.0)
    assert monitor.lost_probability == pytest.approx(1 / (1 + math.exp(1.0)))


def test_scans_at_a_low_rate_that_fit_raise_no_doubt() -> None:
    # Every scan comes after 5 s: that is the usual period, no time without scans.
    monitor = steady(0)
    for _ in range(10):
        monitor.matched(0.02, 0.9, 5.0)
        assert not monitor.doubts and not monitor.after_gap
    monitor.unmatched(False, 30.0)
    assert monitor.doubts and monitor.after_gap


@pytest.mark.parametrize(("moved_m", "sign"), [(0.1, True), (0.5, True), (1.0, False)])
def test_a_lower_score_is_no_sign_in_a_new_view(moved_m: float, sign: bool) -> None:
    # A drop of 0.4 alone is evidence of 0.4.
    monitor = steady()
    monitor.matched(0.02, 0.5, 0.1, moved_m=moved_m)
    assert monitor.sign is sign


def test_a_doubt_that_keeps_scans_out_of_the_map_makes_no_loss_by_itself() -> None:
    # The score falls as the robot drives on, because the map does not grow; nothing contradicts the map.
    monitor = steady()
    monitor.matched(0.3, 0.6, 0.1)
    assert monitor.doubts
    for _ in range(30):
        monitor.matched(0.02, 0.4, 1.0, moved_m=0.15)
        assert not monitor.lost
    assert not monitor.doubts


def test_a_scan_after_a_gap_that_fits_nowhere_is_after_a_gap() -> None:
    # The robot is where odometry says, within its error, and is searched for there.
    monitor = steady()
    monitor.unmatched(True, 10.0)
    assert monitor.after_gap and monitor.doubts
    monitor = steady()
    monitor.unmatched(True, 0.1)
    monitor.unmatched(True, 0.1)
    assert not monitor.after_gap and monitor.doubts


def test_covariance_and_bounds_follow_the_probability() -> None:
    own = np.diag([0.01, 0.0004, 0.0001])
    np.testing.assert_allclose(mixture(own, 0.0), own)
    np.testing.assert_allclose(
        mixture(own, 1.0), np.diag([TUNING.lost_sigma_m**2, TUNING.lost_sigma_m**2, math.pi**2 / 3])
    )
    trusted = steady().integrity(own, localized=True)
    assert trusted.trusted and trusted.position_bound_m == pytest.approx(BOUND_SIGMAS * 0.1)
    lost = steady().integrity(own, localized=False)
    assert not lost.trusted and lost.lost_probability == 1.0
    assert lost.position_bound_m == pytest.approx(BOUND_SIGMAS * TUNING.lost_sigma_m)
    assert lost.heading_bound_rad == math.pi


@pytest.fixture(scope="module")
def log() -> list[LogEntry]:
    return round_trip(make_world("corridor"), 0.2, seed=11, rounds=1).entries[:500]


def test_a_robot_carried_off_is_noticed_and_found_again(log: list[LogEntry]) -> None:
    report = evaluate_faults(log, places=1, seed=2, faults=("kidnapped_mapping", "kidnapped_localized"))
    assert report["clean"]["false_alarms"] == 0
    for fault in ("kidnapped_mapping", "kidnapped_localized"):
        figures = report[fault]
        assert figures["went_wrong"] == figures["detected"] == figures["places"] == 1
        assert figures["trusted_wrong_scans_max"] <= 10
        assert figures["recovered"] == 1, figures
        assert figures["end_error_m_max"] < 0.1


def test_scans_since_the_sign_of_a_loss_leave_no_copy_in_the_map(log: list[LogEntry]) -> None:
    slam = GridSlam()
    for entry in log[:250]:
        slam.process(entry.scan, entry.odom_pose)
    before = slam.grid().values
    there = kidnap(log, 250, 300, 60, np.random.default_rng(0))
    for entry in there.entries:
        slam.process(entry.scan, entry.odom_pose)
        if not slam.localized:
            break
    assert slam.saved is not None and not slam.localized
    np.testing.assert_array_equal(slam.saved.grid.values, before)
    assert all(keyframe.stamp_ns <= log[249].scan.stamp_ns for keyframe in slam.saved.keyframes)


def test_a_heading_that_jumps_leaves_no_turned_map(log: list[LogEntry]) -> None:
    report = evaluate_faults(log, places=1, seed=1, faults=("heading_jump_85deg",))
    assert report["heading_jump_85deg"]["trusted_wrong_scans_max"] <= 10
    assert report["heading_jump_85deg"]["right_at_end"] == 1
