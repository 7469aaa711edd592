"""The GPU benchmark at tiny sizes on the CPU: all its steps run and write their files."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import torch  # noqa: F401 - the benchmark does, in a process of its own

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "gpu.py"


def run(*arguments):
    return subprocess.run(
        [sys.executable, str(SCRIPT), *arguments], capture_output=True, text=True, timeout=600, check=False
    )


def test_a_dry_run_writes_every_steps_figures(tmp_path):
    done = run("--dry-run", "--out", str(tmp_path))
    assert done.returncode == 0, done.stderr[-2000:]
    found = {path.stem: json.loads(path.read_text()) for path in tmp_path.glob("*.json")}
    assert set(found) == {"kernels", "train", "views", "field-or-warp"}
    assert all(step["targets"] and step["machine"] == "dry run on the CPU" for step in found.values())
    kernels = found["kernels"]["result"]
    for keyframes in ("one", "three"):  # numba's values are torch's
        first = kernels[keyframes]["step_errors"]["first"]
        assert abs(first[0][0] / first[1][0] - 1) < 0.05
        assert kernels[keyframes]["view, panorama 1, depth 1"]["same_depth"] > 0.9
    assert found["train"]["result"]["corridor"]["cpu"]["iterations"] > 0
    assert found["views"]["result"]["cpu"]["as shown"]["fps_64x36"] > 0
    compared = found["field-or-warp"]["result"]["corridor"]["depth 0% off"]
    assert compared["one"]["warp"]["psnr_db"]["0.5 m"] > 15
    assert set(compared["three, one ahead"]["gain_db"]) == {"field", "taught", "density"}
    for name in ("train", "field-or-warp"):
        assert cv2.imread(str(tmp_path / f"{name}.png")) is not None


def test_a_wrong_step_is_refused(tmp_path):
    done = run("--step", "speed", "--out", str(tmp_path))
    assert done.returncode == 2 and "no such step: speed; there are kernels, train" in done.stderr
