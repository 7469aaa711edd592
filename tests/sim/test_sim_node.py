"""The simulator as a process: it starts, tells where its devices are, and leaves nothing behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from instant_ic.bus import NodeError
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.util.paths import node_file
from nodes.simulator import SimulatorConfig, SimulatorNode

CONFIG = Path(__file__).resolve().parents[2] / "config" / "sim.yaml"


def test_lockstep_is_refused() -> None:
    with pytest.raises(NodeError, match="real time"):
        LockstepBus().add(SimulatorNode, SimulatorConfig())


@pytest.mark.system
def test_process_starts_serves_and_ends(tmp_path: Path) -> None:
    panorama = tmp_path / "grey.png"
    cv2.imwrite(str(panorama), np.full((320, 640, 3), 90, np.uint8))
    log = tmp_path / "log.txt"
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, str(node_file("simulator")),
             "--run-dir", str(tmp_path),
             "--params-file", str(CONFIG), "-p", "world:=random:3", "-p", "camera.port:=0",
             "-p", "lidar.enabled:=false",
             "-p", f"panorama:={panorama}"],
            stdout=output, stderr=subprocess.STDOUT, env={**os.environ, "INSTANT_IC_RUN_DIR": str(tmp_path)},
        )  # fmt: skip
        try:
            link = tmp_path / "dev" / "roboclaw"
            deadline = time.monotonic() + 120
            while "running" not in log.read_text() and process.poll() is None and time.monotonic() < deadline:
                time.sleep(0.1)
            assert process.poll() is None, log.read_text()
            assert link.exists()
            assert "Theta Web API on http://127.0.0.1:" in log.read_text()
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 0, log.read_text()
            assert not link.is_symlink()
        finally:
            if process.poll() is None:
                process.kill()
                process.wait(10)
