"""`ic map local` on a bag, and against a stand-in for the node over the real bus."""

from __future__ import annotations

import tempfile
import threading
from pathlib import Path

import numpy as np
import pytest

from instant_ic.bag.writer import BagWriter
from instant_ic.bus import LATCHED, RELIABLE, SENSOR
from instant_ic.bus.topics import Publisher
from instant_ic.cli.main import main
from instant_ic.cli.observer import TopicObserver
from instant_ic.geometry.poses import pose_matrix
from instant_ic.lidar.decode import POINT_DTYPE
from instant_ic.msg import (
    PointCloud2,
    TFMessage,
    cloud_message,
    cloud_of_points,
    serialize,
    transform_message,
    type_name,
)

S = 1_000_000_000


@pytest.fixture(autouse=True)
def run_dir(monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="ic-"))
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(folder))
    return folder


def write_bag(path: Path) -> None:
    """A robot that drives 0.6 m along x towards a wall 3 m from the origin, in the map turned by 90 degrees."""
    y, z = (each.ravel() for each in np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-0.5, 0.5, 40)))
    with BagWriter(path) as bag:

        def write(topic: str, message: object, stamp: int) -> None:
            qos = LATCHED if topic == "/tf_static" else SENSOR
            bag.write(topic, type_name(message), bytes(serialize(message)), stamp, qos)

        write("/tf_static", TFMessage([transform_message(pose_matrix(0, 0, 0.6), "base_link", "velodyne", S)]), S)
        for k in range(21):
            stamp, x = S + k * S // 10, 0.03 * k
            poses = [transform_message(pose_matrix(x, 0, 0), "odom", "base_link", stamp)]
            poses.append(transform_message(pose_matrix(0, 0, 0, yaw=np.pi / 2), "map", "odom", stamp))
            write("/tf", TFMessage(poses), stamp)
            cloud = np.zeros(len(y), POINT_DTYPE)
            cloud["x"], cloud["y"], cloud["z"] = 3.0 - x, y, z
            write("/lidar/points", cloud_message(cloud, "velodyne", stamp), stamp)


def read_ply(path: Path) -> np.ndarray:
    return np.frombuffer(path.read_bytes().partition(b"end_header\n")[2], "<f4").reshape(-1, 3)


def test_a_bag_gives_the_model_at_its_end_in_the_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_bag(tmp_path / "drive")
    assert main(["map", "local", str(tmp_path / "drive"), "-o", str(tmp_path / "cloud.ply")]) == 0
    points = read_ply(tmp_path / "cloud.ply")
    assert capsys.readouterr().out.endswith(f"cloud.ply: {len(points)} points\n") and len(points) > 300
    # The wall x = 3 m of odometry lies at y = 3 m of the map.
    assert np.abs(points[:, 1] - 3.0).max() < 0.03 and points[:, 0].min() > -1.05 and points[:, 0].max() < 1.05


def test_the_running_stack_is_asked(run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sent = np.array([[1.0, 2.0, 0.5], [1.0, 2.1, 0.5]], np.float32)
    end = threading.Event()

    def serve() -> None:
        with TopicObserver(["/nothing"], run_dir=run_dir) as observer:
            out = Publisher(observer.transport.advertise("/map/local", type_name(PointCloud2), RELIABLE))
            while not end.wait(0.05):
                if out.subscriber_count:
                    out.publish(cloud_of_points(sent, "map", S))

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        assert main(["map", "local", "-o", str(tmp_path / "cloud.ply")]) == 0
    finally:
        end.set()
        thread.join(10)
    np.testing.assert_array_equal(read_ply(tmp_path / "cloud.ply"), sent)


def test_nothing_runs_and_nowhere_to_write(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "local", "-o", str(tmp_path / "cloud.ply"), "--timeout", "0.3"]) == 1
    assert "no local model on /map/local within 0.3 s: depth_scaler is not running" in capsys.readouterr().err
    assert main(["map", "local", "-o", str(tmp_path / "none" / "cloud.ply")]) == 2
    assert "none does not exist" in capsys.readouterr().err
