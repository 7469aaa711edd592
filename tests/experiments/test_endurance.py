"""What benchmarks/endurance.py judges by: growth of a process, motion after a loss, messages missing in a bag."""

import argparse
import random
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from instant_ic.bag.writer import BagWriter
from instant_ic.bus.qos import SENSOR

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def endurance() -> Any:
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import endurance
    finally:
        sys.path.remove(str(BENCHMARKS))
    return endurance


@pytest.fixture
def soak(endurance: Any) -> Any:
    words = argparse.Namespace(seed=1, minutes=1.0, only=[], light=False, stand=0.55)
    return endurance.Soak(words, 1.0)


def test_a_slope_of_memory_or_descriptors_is_a_leak_and_noise_is_not(endurance: Any) -> None:
    levels, rng = endurance.Levels(), random.Random(1)
    times = [5.0 * k for k in range(200)]  # 1000 s
    start = 200.0  # while it starts, a process grows
    levels._rows["level", 1] = [(t, 300.0 + min(t, 100.0) + rng.uniform(-8, 8), 40 + rng.randint(0, 3)) for t in times]
    levels._rows["memory", 2] = [(t, start + 0.05 * t, 40) for t in times]
    levels._rows["descriptors", 3] = [(t, start, 40 + int(t / 100)) for t in times]
    levels._rows["short", 4] = [(t, start + t, 40) for t in times if t < 300.0]
    judged = levels.judge()
    assert {name: row["leak"] for name, row in judged.items()} == {"level": False, "memory": True, "descriptors": True}


def test_motion_counts_from_the_stated_time_to_stand(endurance: Any, soak: Any) -> None:
    speeds = [0.38, 0.3, 0.1, 0.0, 0.0, 0.05, 0.0]  # each tenth of a second
    truth = [SimpleNamespace(at_ns=round(1e8 * k), speed=v) for k, v in enumerate(speeds)]
    made = SimpleNamespace(truth=truth, state=SimpleNamespace(mode=0))
    soak._stood(made, "console frozen", round(2.5e8), round(4.5e8))
    assert soak.figures.found == []
    soak._stood(made, "console frozen", round(2.5e8), round(9e8))
    (found,) = soak.figures.found
    assert found["kind"] == "moved" and found["most_m_s"] == 0.05 and found["last_s"] == 0.25


@pytest.mark.parametrize(("acknowledged", "lost"), [(3, False), (4, True)])
def test_a_bag_that_holds_less_than_was_acknowledged_is_a_loss(
    endurance: Any, soak: Any, acknowledged: int, lost: bool, tmp_path: Path
) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    recording = endurance.Recording(SimpleNamespace(run_dir=tmp_path), disk, soak.figures)
    recording._number = 1
    recording._process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    with BagWriter(disk / "bag1") as writer:
        for k in range(3):
            writer.write("/text", "std_msgs/msg/String", b"\0\1\0\0\1\0\0\0\0", 10**9 + k, SENSOR)
    recording._acknowledged = [(0.0, acknowledged)]
    recording.end("recorder killed", killed=True)
    assert [found["kind"] for found in soak.figures.found] == (["lost"] if lost else [])
    assert list(disk.iterdir()) == []
