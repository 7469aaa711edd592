"""Log readers, the relation metric, and short stretches of the real logs."""

from __future__ import annotations

import gzip
import math
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from slam_planar_world import box_room

from instant_ic.experiments.slam import (
    Relations,
    evaluate_log,
    interpolate_trajectory,
    read_relations,
    read_stamps,
    relation_error,
    run_log,
)
from instant_ic.experiments.slam_logs import LogEntry, LogError, read_carmen, read_log

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "slam2d"
real_data = [
    pytest.mark.real_data,
    pytest.mark.skipif(not DATA.is_dir(), reason=f"{DATA} is not here"),
]

FLASER = "FLASER 3 1.0 2.5 81.83 0.1 0.2 0.3 0.0 0.2 0.3 976052857.263914 host 976052857.3\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_flaser_by_hand(tmp_path: Path) -> None:
    (entry,) = read_carmen(write(tmp_path / "a.log", f"# comment\nODOM 1 2 3 0 0 0 1.0 h 1.0\n{FLASER}"))
    assert entry.scan.ranges.tolist() == [1.0, 2.5, math.inf]
    assert entry.scan.angle_min == -math.pi / 2
    assert entry.scan.angle_increment == math.radians(1.0)
    assert entry.scan.stamp_ns == 976052857_263914000
    assert entry.odom_pose.tolist() == [0.0, 0.2, 0.3]
    # The laser stands 0.1 m along the world's x from the robot, which is turned by 0.3 rad.
    assert np.allclose(entry.base_from_laser, [0.1 * math.cos(0.3), -0.1 * math.sin(0.3), 0.0])


def test_robotlaser_by_hand(tmp_path: Path) -> None:
    line = "ROBOTLASER1 0 -1.5 3.0 1.5 20.0 0.01 0 3 1.0 20.0 3.0 2 7 8 1.2 0 0 1.0 0 0 0 0 0 0 0 12.5 h 12.6\n"
    (entry,) = read_log(write(tmp_path / "a.log", line))
    assert entry.scan.ranges.tolist() == [1.0, math.inf, 3.0]
    assert (entry.scan.angle_min, entry.scan.angle_increment, entry.scan.range_max) == (-1.5, 1.5, 20.0)
    assert entry.odom_pose.tolist() == [1.0, 0.0, 0.0]
    assert entry.base_from_laser == pytest.approx([0.2, 0.0, 0.0])
    assert entry.scan.stamp_ns == 12_500_000_000


@pytest.mark.parametrize(
    ("bad", "what"),
    [
        ("FLASER 5 1.0 2.0\n", "truncated"),
        ("FLASER 1 x 0 0 0 0 0 0 1 h 1\n", "could not convert"),
        ("FLASER 1 nan 0 0 0 0 0 0 1 h 1\n", "finite"),
        ("FLASER -3 0 0 0 0 0 0 1 h 1\n", "out of range"),
        ("FLASER 1 1.0 0 0 0 0 0 0 soon h 1\n", "time stamp"),
    ],
)
def test_a_bad_line_is_named_by_its_number(tmp_path: Path, bad: str, what: str) -> None:
    path = write(tmp_path / "bad.log", FLASER + FLASER + bad)
    with pytest.raises(LogError, match=rf"bad\.log:3: .*({what})"):
        list(read_carmen(path))


def test_a_file_without_scans_says_so(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no FLASER"):
        list(read_log(write(tmp_path / "a.log", "hello\nworld\n")))


def flaser(ranges: list[float], laser: list[float], robot: list[float], stamp: float) -> str:
    numbers = [*ranges, *laser, *robot]
    return f"FLASER {len(ranges)} {' '.join(map(str, numbers))} {stamp} host {stamp - 100}\n"


def test_readings_that_pile_up_at_the_top_mean_nothing_was_met(tmp_path: Path) -> None:
    # A laser in millimetre mode: 8.183 m where nothing is, in one beam of four.
    rng = np.random.default_rng(0)
    lines = []
    for k in range(20):
        ranges = rng.uniform(0.5, 8.0, 180).round(2)
        ranges[::4] = 8.183
        lines.append(flaser(list(ranges), [k, 0, 0], [k, 0, 0], float(k + 200)))
    entries = list(read_carmen(write(tmp_path / "a.log", "".join(lines))))
    for entry in entries:
        assert np.isinf(entry.scan.ranges[::4]).all()
        assert np.isfinite(entry.scan.ranges).sum() == 135
    assert entries[3].scan.stamp_ns == 203_000_000_000
    # The same readings with a maximum that the log itself gives, and one that the caller gives.
    named = write(tmp_path / "b.log", "PARAM robot_front_laser_max 5.0 n 0 h 0\n" + "".join(lines))
    assert max(r for e in read_carmen(named) for r in e.scan.ranges if np.isfinite(r)) < 5.0
    # A wall at the far end of a room is no pile.
    wall = [6.0 + round(0.01 * (k % 3), 2) for k in range(20)]
    far = [flaser([3.0] * 160 + wall, [k, 0, 0], [k, 0, 0], float(k)) for k in range(200, 210)]
    assert np.isfinite(next(iter(read_carmen(write(tmp_path / "c.log", "".join(far))))).scan.ranges).all()


@pytest.mark.parametrize(("count", "first", "step"), [(180, -90, 1), (361, -90, 0.5), (401, -50, 0.25)])
def test_angles_follow_from_the_number_of_beams(tmp_path: Path, count: int, first: float, step: float) -> None:
    (entry,) = read_carmen(write(tmp_path / "a.log", flaser([1.0] * count, [0, 0, 0], [0, 0, 0], 1.0)))
    assert math.degrees(entry.scan.angle_min) == pytest.approx(first)
    assert math.degrees(entry.scan.angle_increment) == pytest.approx(step)


def test_a_clock_that_stands_still_or_steps_back_loses_no_scan() -> None:
    scan = box_room().scan(np.zeros(3), 10**12)
    first, later, last = (
        LogEntry(replace(scan, stamp_ns=10**12 + k * 10**8), np.zeros(3), np.zeros(3)) for k in (0, 1, 2)
    )
    again, run = evaluate_log([first, first, last, later], Relations(np.array([[1000.0, 1000.2]]), np.zeros((1, 3))))
    assert again["relations"] == 1 and again["translation_mean_m"] < 0.01
    assert again["scans"] == 4 and again["statuses"] == {"first": 1, "tracked": 3}
    assert run.trajectory[:, 0] == pytest.approx([1000.0, 1000.0, 1000.2, 1000.1])
    with pytest.raises(LogError, match="no scan"):
        evaluate_log([])


def mines_line(time_us: int, left: int, right: int, ranges: list[int]) -> str:
    return " ".join(map(str, [time_us, 0, left, right, *[0] * 20, *ranges])) + "\n"


def test_mines_by_hand(tmp_path: Path) -> None:
    ranges = [9999] * 70 + [1000] * 540 + [0, 3999] + [9999] * 70
    path = tmp_path / "m.dat.gz"
    # 2000 ticks of both wheels: a turn of the wheel, 2π·77 mm ahead; then ±1000: a turn on the spot to the left.
    text = mines_line(0, 0, 0, ranges) + mines_line(100, 2000, 2000, ranges) + mines_line(200, 1000, 3000, ranges)
    path.write_bytes(gzip.compress(text.encode()))
    first, second, third = read_log(path)
    assert first.scan.ranges.size == 542
    assert first.scan.ranges[0] == 1.0 and math.isnan(first.scan.ranges[540]) and first.scan.ranges[541] == 3.999
    assert first.scan.angle_min == pytest.approx(-math.radians(120 - 70 * 240 / 681))
    # Symmetric about the front but for half a beam on neither side.
    assert first.scan.angle_min + 541 * first.scan.angle_increment == pytest.approx(-first.scan.angle_min)
    assert second.scan.stamp_ns == 100_000
    assert second.odom_pose == pytest.approx([2 * math.pi * 0.077, 0.0, 0.0])
    assert third.odom_pose == pytest.approx([2 * math.pi * 0.077, 0.0, math.pi * 0.077 / 0.165])


def test_relation_error_by_hand() -> None:
    # The robot drives 1 m ahead and 1 m to the left between t = 0, 1, 2.
    trajectory = np.array([[0, 0, 0, 0], [1, 1, 0, math.pi / 2], [2, 1, 1, math.pi / 2]], dtype=float)
    times = np.array([[0.0, 1.0], [1.0, 2.0], [0.0, 9.0]])
    # First relation right; second 0.3 m too long and 10° too far; third ends after the trajectory.
    poses = np.array([[1.0, 0.0, math.pi / 2], [1.3, 0.0, math.radians(10)], [0.0, 0.0, 0.0]])
    summary = relation_error(trajectory, Relations(times, poses))
    assert summary["translation_max_m"] == pytest.approx(0.3)
    assert (summary["rotation_mean_deg"], summary["rotation_std_deg"]) == (pytest.approx(5.0), pytest.approx(5.0))
    assert summary["relations"] == 2
    assert summary["translation_mean_m"] == pytest.approx(0.15)
    assert summary["translation_std_m"] == pytest.approx(0.15)
    with pytest.raises(ValueError, match="none of 1 relations"):
        relation_error(trajectory, Relations(times[2:], poses[2:]))


def test_interpolation_goes_the_short_way_round() -> None:
    trajectory = np.array([[0, 0, 0, 3.0], [1, 2, 0, -3.0]])
    middle = interpolate_trajectory(trajectory, np.array([0.5]))[0]
    assert middle[0] == 1.0
    assert math.remainder(middle[2] - math.pi, 2 * math.pi) == pytest.approx(0.0, abs=1e-12)


def test_relations_at_exact_stamps(tmp_path: Path) -> None:
    path = write(tmp_path / "r.relations", "1.0 2.0 0.5 0 0 0 0 0.1\n1.0 3.0 1 0 0 0 0 0\n2.5 3.0 1 0 0 0 0 0\n")
    relations = read_relations(path)
    assert relations.poses[0].tolist() == [0.5, 0.0, 0.1]
    stamps = read_stamps(write(tmp_path / "s", "3.004\n1.0\n1.995\n"))
    kept = relations.at_stamps(stamps)
    assert kept.times_s.tolist() == [[1.0, 2.0], [1.0, 3.0]]
    assert len(relations.at_stamps(np.zeros(0))) == 0
    with pytest.raises(LogError, match=r"t\.relations:2: "):
        read_relations(write(tmp_path / "t.relations", "1 2 3 4 5 6 7 8\n1 2 3\n"))


@pytest.mark.parametrize("mark", [pytest.param(None, marks=real_data)])
def test_intel_start_beats_its_odometry(mark: None) -> None:
    entries = []
    for entry in read_log(DATA / "intel.log.gz"):
        entries.append(entry)
        if len(entries) == 600:
            break
    relations = read_relations(DATA / "intel.relations").at_stamps(read_stamps(DATA / "intel.exact_stamps"))
    report, result = evaluate_log(entries, relations)
    odometry = np.array([[e.scan.stamp_ns * 1e-9, *e.odom_pose] for e in entries])
    assert report["relations"] > 5
    assert report["translation_mean_m"] < 0.06
    assert report["rotation_mean_deg"] < 1.5
    assert report["translation_mean_m"] < 0.5 * relation_error(odometry, relations)["translation_mean_m"]
    assert len(result.trajectory) == report["scans"] == 600
    assert (np.diff(result.trajectory[:, 0]) > 0).all()


@pytest.mark.parametrize("use_wheel_odom", [pytest.param(True, marks=real_data), pytest.param(False, marks=real_data)])
def test_mines_is_tracked_through_with_and_without_wheels(use_wheel_odom: bool) -> None:
    entries = islice(read_log(DATA / "mines_exp1.dat.gz"), 150)
    result = run_log(entries, use_wheel_odom=use_wheel_odom)
    assert len(result.trajectory) == 150
    assert result.statuses.get("lost", 0) == 0
    assert result.scores.mean() > 0.75
    assert result.slam.contradiction.count == 0
    grid = result.slam.grid()
    # Crisp walls: few cells that hits and rays disagree about.
    sure = ((grid.values >= 0) & ((grid.values < 45) | (grid.values > 65))).sum()
    assert sure > 0.9 * (grid.values >= 0).sum()


@pytest.mark.parametrize("mark", [pytest.param(None, marks=real_data)])
def test_fault_scans_of_a_sound_robot_that_come_in_bursts_contradict_its_wheels(mark: None) -> None:
    """Intel's scans were sometimes kept back and stamped together: five contradictions in these."""
    result = run_log(islice(read_log(DATA / "intel.log.gz"), 2960, 3160))
    assert result.slam.contradiction.count == 0
