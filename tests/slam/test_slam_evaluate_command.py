"""`ic evaluate slam` and `slam-sim`: what a user types, what comes out, what goes wrong."""

from __future__ import annotations

import dataclasses
import gzip
import json
import math
from pathlib import Path

import numpy as np
import pytest
from slam_planar_world import rectangle

from benchmarks.slam_worlds import Drive, Laser, drive
from instant_ic.bag import BagWriter
from instant_ic.cli.main import main
from instant_ic.experiments.slam_logs import read_bag
from instant_ic.experiments.slam_sim import evaluate_round_trip, round_trip
from instant_ic.geometry.poses import compose2, matrix_from_pose2, pose_matrix, relative2
from instant_ic.msg import TFMessage, odometry_message, scan_message, serialize, transform_message, type_name

LASER = Laser(180, 179.0, 80.0, 0.01, (0.1, 0.0, 0.0))
NAMES = {
    "translation_mean_m", "translation_std_m", "translation_median_m", "translation_max_m", "rotation_mean_deg",
    "rotation_std_deg", "relations", "scans", "cpu_ms_per_scan_mean", "cpu_ms_per_scan_p99", "peak_rss_mb",
}  # fmt: skip


@pytest.fixture(scope="module")
def journey() -> Drive:
    walls = [*rectangle(-2.0, -1.5, 6.0, 2.5), *rectangle(1.5, 1.0, 2.0, 1.4), *rectangle(4.0, -1.0, 4.4, -0.4)]
    return drive(walls, [(0.0, 0.0), (4.5, 0.5), (1.0, 0.3)], LASER, 0)


def stamp(entry: object) -> str:
    return f"{entry.scan.stamp_ns * 1e-9 + 1000:.6f}"  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def log(journey: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive as a CARMEN log."""
    lines = ["# made up\n"]
    for entry in journey.entries:
        ranges = np.where(np.isinf(entry.scan.ranges), 81.91, entry.scan.ranges)
        poses = [*compose2(entry.odom_pose, entry.base_from_laser), *entry.odom_pose]
        numbers = " ".join(f"{value:.4f}" for value in [*ranges, *poses])
        lines.append(f"FLASER {len(ranges)} {numbers} {stamp(entry)} nohost {stamp(entry)}\n")
    path = tmp_path_factory.mktemp("log") / "made.log.gz"
    path.write_bytes(gzip.compress("".join(lines).encode()))
    return path


@pytest.fixture(scope="module")
def relations(journey: Drive, log: Path) -> Path:
    """True relations, 20 scans apart."""
    lines = []
    for k in range(0, len(journey.entries) - 20, 10):
        x, y, yaw = relative2(journey.truth[k], journey.truth[k + 20])
        lines.append(f"{stamp(journey.entries[k])} {stamp(journey.entries[k + 20])} {x} {y} 0 0 0 {yaw}\n")
    path = log.with_name("made.relations")
    path.write_text("".join(lines))
    return path


def test_figures_trajectory_and_plot(
    log: Path, relations: Path, journey: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    stamps = tmp_path / "stamps"
    stamps.write_text("\n".join(stamp(e) for e in journey.entries[: len(journey.entries) // 2]) + "\n")
    words = ["evaluate", "slam", str(log), "--relations", str(relations), "--stamps", str(stamps)]
    assert main([*words, "--json", "out.json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report == json.loads((tmp_path / "out.json").read_text())
    assert set(report) >= NAMES
    assert report["scans"] == len(journey.entries)
    assert 0 < report["relations"] < sum(1 for _ in relations.open())
    assert report["translation_mean_m"] < 0.03 and report["rotation_mean_deg"] < 0.5
    assert report["translation_median_m"] <= report["translation_max_m"]
    assert 0 < report["cpu_ms_per_scan_mean"] < report["cpu_ms_per_scan_p99"] * 10 and report["peak_rss_mb"] > 50
    folder = Path(report["output"])
    assert report["bad_lines"] == 0 and sorted(file.name for file in tmp_path.iterdir() if file.is_dir()) == ["runs"]
    assert json.loads((folder / "figures.json").read_text()) == report
    rows = np.loadtxt(folder / "trajectory.txt")
    assert rows.shape == (len(journey.entries), 4)
    assert [f"{t:.6f}" for t in rows[:, 0]] == [stamp(e) for e in journey.entries]
    rest = relative2(relative2(journey.truth[0], journey.truth[-1]), relative2(rows[0, 1:], rows[-1, 1:]))
    assert math.hypot(rest[0], rest[1]) < 0.05
    assert (folder / "map.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (
            "hello\nFLASER 3 1.0 2.0\n",
            "bad.log:2: FLASER: expected 3 readings, found 2",
        ),
        ("hello\n", "bad.log: no FLASER or ROBOTLASER1 line"),
    ],
)
def test_a_bad_log_is_told_by_its_line(
    tmp_path: Path, text: str, what: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.log").write_text(text)
    assert main(["evaluate", "slam", "bad.log"]) == 1
    assert what in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["bad.log"]


def write_bag(path: Path, journey: Drive, scan_topics: tuple[str, ...] = ("/scan",)) -> Path:
    with BagWriter(path) as bag:
        mount = transform_message(pose_matrix(x=0.1, z=0.6), "base_link", "laser", 0)

        def put(topic: str, message: object, stamp_ns: int) -> None:
            bag.write(topic, type_name(message), bytes(serialize(message)), stamp_ns)

        put("/tf_static", TFMessage([mount]), 1)
        for entry in journey.entries:
            scan, now = entry.scan, entry.scan.stamp_ns
            pose = matrix_from_pose2(entry.odom_pose)
            put("/wheel/odom", odometry_message(pose, 0.0, 0.0, "odom", "base_link", now), now)
            for topic in scan_topics:
                message = scan_message(
                    scan.ranges, scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max, "laser", now
                )  # fmt: skip
                put(topic, message, now)
    return path


def test_a_bag_is_a_log_too(journey: Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_bag(tmp_path / "bag", journey)
    entries = list(read_bag(bag))
    assert len(entries) == len(journey.entries)
    assert entries[7].odom_pose == pytest.approx(journey.entries[7].odom_pose)
    assert entries[7].base_from_laser == pytest.approx([0.1, 0.0, 0.0])
    assert np.array_equal(np.isinf(entries[7].scan.ranges), np.isinf(journey.entries[7].scan.ranges))
    assert main(["evaluate", "slam", str(bag), "-o", str(tmp_path / "t")]) == 0
    assert json.loads(capsys.readouterr().out)["statuses"]["tracked"] == len(entries) - 1


def changing_beams() -> Drive:
    """A drive whose scans have 268, 271 and 274 beams in turn, as those of lasers whose speed varies."""
    walls = [*rectangle(-2.0, -1.5, 6.0, 2.5), *rectangle(1.5, 1.0, 2.0, 1.4), *rectangle(4.0, -1.0, 4.4, -0.4)]
    counts = (268, 271, 274)
    lasers = [Laser(count, 270.0, 80.0, 0.01, (0.1, 0.0, 0.0)) for count in counts]
    drives = [drive(walls, [(0.0, 0.0), (4.5, 0.5), (1.0, 0.3)], laser, 0) for laser in lasers]
    entries = []
    for index, entry in enumerate(drives[0].entries):
        entries.append(dataclasses.replace(entry, scan=drives[index % 3].entries[index].scan))
    return Drive(entries, drives[0].truth)


def test_a_bag_whose_scans_change_their_number_of_beams_gives_map_and_trajectory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Other mapping programs take the first scan's number for all, and drop every other scan."""
    made = changing_beams()
    bag = write_bag(tmp_path / "bag", made)
    assert [len(entry.scan.ranges) for entry in read_bag(bag)][:4] == [268, 271, 274, 268]
    assert main(["evaluate", "slam", str(bag), "-o", str(tmp_path / "out")]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["scans"] == len(made.entries)
    assert report["statuses"]["tracked"] == len(made.entries) - 1
    rows = np.loadtxt(tmp_path / "out" / "trajectory.txt")
    errors = [
        relative2(relative2(made.truth[0], true), relative2(rows[0, 1:], found))
        for true, found in zip(made.truth, rows[:, 1:], strict=True)
    ]
    assert max(math.hypot(x, y) for x, y, _ in errors) < 0.05
    assert max(abs(yaw) for _, _, yaw in errors) < math.radians(1.0)
    assert (tmp_path / "out" / "map.png").read_bytes().startswith(b"\x89PNG")


def test_the_simulated_crawler_on_slipping_tracks() -> None:
    from instant_ic.sim.worlds import corridor_world

    world = corridor_world(0, light_cell_m=0.5)
    route = ((0.0, 0.0), (3.0, 0.7), (5.2, 0.7), (6.5, 0.4), (5.2, 0.7), (3.0, 0.7), (0.0, 0.0))
    trip = round_trip(world, 0.2, 1, rounds=1, route=route)
    assert trip.driven_m > 11.0 and len(trip.entries) == len(trip.truth) > 200
    report, _ = evaluate_round_trip(trip)
    assert report["wheels_end_error_deg"] > 5.0  # what there was to correct
    assert report["end_error_m"] < 0.05 and report["end_error_deg"] < 1.0
    with pytest.raises(ValueError, match="hit an obstacle"):
        round_trip(world, 0.0, 0, 1, route=((0.0, 0.0), (8.0, 0.0)))  # through the obstacle
