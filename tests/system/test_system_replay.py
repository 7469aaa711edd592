"""The shipped bag through the real nodes: in lockstep, twice the same bits; and live, headless, to its end."""

import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from instant_ic.bag import BagReader
from instant_ic.geometry.poses import pose2_from_matrix, relative2
from instant_ic.launch.pacing import machine_pace
from instant_ic.msg import deserialize, grid_array, matrix_from_pose, stamp_ns

pytestmark = [pytest.mark.system, pytest.mark.xdist_group("stack"), pytest.mark.timeout(900)]
BAG = Path(__file__).resolve().parents[1] / "data" / "corridor_drive"
NODES = "vlp16_driver,grid_slam,depth_estimator,depth_scaler"
MADE = ("/lidar/points", "/scan", "/map", "/pose", "/depth/raw", "/depth/scaled", "/keyframe")


def ic(*words: str | Path, run_dir: Path | None = None) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-m", "instant_ic.cli.main", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=400,
        stdin=subprocess.DEVNULL,
        env={**os.environ, **({"INSTANT_IC_RUN_DIR": str(run_dir)} if run_dir else {})},
    )


def messages(bag: Path, topic: str) -> list[Any]:
    with BagReader(bag) as reader:
        return [deserialize(m.payload, m.type_name) for m in reader.messages({topic})]


def planar(message: Any) -> np.ndarray:
    return np.asarray(pose2_from_matrix(matrix_from_pose(message)))


def poses_in_truth(bag: Path) -> tuple[np.ndarray, np.ndarray]:
    """Poses of /pose and, at the same moments, where the robot truly was; both from the start, (N, 3)."""
    truth = messages(BAG, "/ground_truth/odom")
    start = planar(truth[0])
    stamps = np.array([stamp_ns(m) for m in truth], float)
    path = np.array([relative2(start, planar(m)) for m in truth])
    poses = messages(bag, "/pose")
    at = np.array([stamp_ns(m) for m in poses], float)
    return np.array([planar(m) for m in poses]), np.stack([np.interp(at, stamps, path[:, k]) for k in range(3)], axis=1)


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("replay")

    def replay(name: str) -> subprocess.CompletedProcess[str]:
        return ic("replay", BAG, "--nodes", NODES, "-p", "vlp16_driver.source:=topic", "-o", folder / name)

    with ThreadPoolExecutor() as pool:
        runs = list(pool.map(replay, ("first", "second")))
    for done in runs:
        assert done.returncode == 0, done.stderr
        # A WARNING or ERROR of a node would stand here.
        assert [line for line in done.stderr.splitlines() if not line.startswith("replaying ")] == []
    return folder / "first", folder / "second"


def test_lockstep_replay_is_the_same_twice_bit_for_bit(replayed: tuple[Path, Path]) -> None:
    done = ic("bag", "diff", *replayed)
    assert done.returncode == 0, done.stdout
    lines = [line.split() for line in done.stdout.splitlines()]
    same = {words[0]: int(words[1]) for words in lines if words[-1] == "same" and words[0].startswith("/")}
    assert set(MADE) <= set(same) and min(same[topic] for topic in MADE) >= 2


def test_rosbags_opens_the_shipped_bag_and_its_replay(replayed: tuple[Path, Path]) -> None:
    with AnyReader([BAG]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        packets = 0
        for connection, _, raw in reader.messages([c for c in reader.connections if c.topic == "/lidar/packets"]):
            message: Any = reader.deserialize(raw, connection.msgtype)
            packets += len(message.packets)
    assert counts["/camera/image/compressed"] >= 8 and counts["/ground_truth/odom"] >= 120
    # 600 rpm: 75.4 packets a revolution, but for the first, which begins behind the cut.
    assert packets / counts["/lidar/packets"] == pytest.approx(75.4, rel=0.02)
    with AnyReader([replayed[0]]) as reader:
        assert {c.topic for c in reader.connections} >= set(MADE)


def test_slam_knows_where_the_robot_was(replayed: tuple[Path, Path]) -> None:
    estimated, truth = poses_in_truth(replayed[0])
    assert truth[-1][0] > 1.0  # it did drive
    assert np.hypot(*(estimated - truth)[:, :2].T).max() < 0.05
    assert np.abs((estimated - truth)[:, 2]).max() < np.radians(1.5)


def test_map_has_the_corridors_walls_where_they_are(replayed: tuple[Path, Path]) -> None:
    grid, resolution, origin = grid_array(messages(replayed[0], "/map")[-1])
    rows, columns = np.nonzero(grid > 65)
    occupied = np.stack([columns, rows], axis=1) * resolution + np.asarray(origin) + resolution / 2
    assert len(occupied) > 150
    # Two straight walls along the way: most of what is occupied beside the robot lies on two lines of one y each.
    beside = occupied[(occupied[:, 0] > -0.5) & (occupied[:, 0] < 2.0)]
    left, right = beside[beside[:, 1] > 0.3], beside[beside[:, 1] < -0.3]
    for wall in (left, right):
        assert len(wall) > 20
        assert np.quantile(np.abs(wall[:, 1] - np.median(wall[:, 1])), 0.7) < 0.12
    assert (grid[grid >= 0] < 35).sum() > 4000  # free space of at least 10 m² at 5 cm


def test_depth_gets_its_scale_and_makes_fit_keyframes(replayed: tuple[Path, Path]) -> None:
    keyframes = messages(replayed[0], "/keyframe")
    assert keyframes[0].fit and keyframes[0].quality > 0.5, keyframes[0].message
    assert 0.5 < keyframes[0].scale < 2.0
    assert len(keyframes) >= 2 and all(k.fit for k in keyframes)  # 1.1 m at one each 0.6 m


def test_live_replay_ends_with_the_bag(tmp_path: Path) -> None:
    record = tmp_path / "again"
    rate = 0.5 * machine_pace()  # nodes that are too slow for the bag leave scans out
    with tempfile.TemporaryDirectory(prefix="ic-") as run_dir:
        words = (f"bag:={BAG}", "packets:=true", f"rate:={rate:.3f}", f"record:={record}")
        done = ic("launch", "replay", *words, run_dir=Path(run_dir))
        left = list(Path(run_dir).glob("topics/*/*.sock"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stdout
    assert left == [], done.stdout
    with AnyReader([record]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    for topic in (*MADE, "/wheel/odom", "/camera/image/compressed", "/clock"):
        assert counts.get(topic, 0) >= 1, topic
    assert counts["/scan"] >= 40
