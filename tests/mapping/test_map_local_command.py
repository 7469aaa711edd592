"""`ic map local` against a stand-in for the node over the real bus."""

from __future__ import annotations

import tempfile
import threading
from pathlib import Path

import numpy as np
import pytest

from instant_ic.bus import RELIABLE
from instant_ic.bus.topics import Publisher
from instant_ic.cli.main import main
from instant_ic.cli.observer import TopicObserver
from instant_ic.msg import PointCloud2, cloud_of_points, type_name

S = 1_000_000_000


@pytest.fixture(autouse=True)
def run_dir(monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="ic-"))
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(folder))
    return folder


def read_ply(path: Path) -> np.ndarray:
    return np.frombuffer(path.read_bytes().partition(b"end_header\n")[2], "<f4").reshape(-1, 3)


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
