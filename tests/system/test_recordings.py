"""The real recordings through the whole stack, as ``ic evaluate recordings`` does it."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from instant_ic.experiments.recordings import evaluate_recordings
from instant_ic.launch.pacing import machine_pace

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"
PCAP, PHOTO = DATA / "vlp16" / "einride_recording.pcap", DATA / "pano" / "library_a.jpg"
MISSING = [str(path) for path in (PCAP, PHOTO) if not path.is_file()]
pytestmark = [
    pytest.mark.system,
    pytest.mark.real_data,
    pytest.mark.xdist_group("stack"),
    pytest.mark.timeout(900),
    pytest.mark.skipif(bool(MISSING), reason=f"recordings are missing: {', '.join(MISSING)}"),
]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings") / "out"
    evaluate_recordings(PCAP, PHOTO, folder, timeout_s=300.0, pace=machine_pace())
    return folder


@pytest.fixture(scope="module")
def summary(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return found


def test_capture_becomes_scans_at_its_own_pace_and_a_map(summary: dict[str, Any]) -> None:
    assert summary["scans"] >= 50
    # 10 a second, less what is cut short where the capture of 1.3 s starts again.
    assert 8.0 < summary["scan_rate_hz"] < 10.5
    assert summary["map_cells_occupied"] > 100
    assert summary["map_cells_known"] > 2000


def test_summary_says_that_the_depth_was_not_scaled(summary: dict[str, Any]) -> None:
    assert summary["depth_fit"] and summary["depth_scale"] == 1.0
    assert "not compared with the LiDAR" in summary["depth_message"]
    assert "not compared with the LiDAR" in summary["depth_from"]


def test_virtual_space_looks_like_the_photo(summary: dict[str, Any]) -> None:
    assert set(summary["view_psnr_db"]) == {"0", "90", "180", "-90"}
    assert min(summary["view_psnr_db"].values()) > 22.0


def test_pictures_are_pictures(out: Path) -> None:
    for name in ("view.png", "depth.png", "map.png"):
        picture = cv2.imread(str(out / name), cv2.IMREAD_GRAYSCALE)
        assert picture is not None, name
        assert min(picture.shape) >= 500, name
        counts = np.bincount(picture.ravel(), minlength=256) / picture.size
        assert counts.max() < 0.95, name
        assert (counts > 1e-4).sum() > 10, name


def test_bag_holds_the_run(out: Path) -> None:
    with AnyReader([out / "bag"]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    for topic in ("/camera/image/compressed", "/lidar/packets", "/scan", "/map", "/keyframe", "/vspace/view"):
        assert counts.get(topic, 0) >= 1, topic


def test_nothing_failed_on_the_way(out: Path) -> None:
    log = (out / "launch.log").read_text()
    assert "Traceback" not in log
    assert "too few points" not in log
    assert "SIGTERM" not in log
