"""An installed wheel holds all that the stack needs: nodes, launch files, configuration, model, page."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "-o", str(out), str(ROOT)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert result.returncode == 0, result.stdout + result.stderr
    return next(out.glob("*.whl"))


def test_wheel_holds_every_shipped_file(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, timeout=60)
    if tracked.returncode != 0:
        pytest.skip("not a git checkout")
    for name in tracked.stdout.splitlines():
        if name.startswith("instant_ic/"):
            assert name in names
        elif name.startswith(("nodes/", "launch/", "config/", "models/")):
            assert f"instant_ic/share/{name}" in names


def test_installed_wheel_finds_its_files(wheel, tmp_path):
    site = tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", str(site), str(wheel)]
    subprocess.run(pip, check=True, timeout=240)
    environment = {**os.environ, "PYTHONPATH": str(site), "INSTANT_IC_RUN_DIR": str(tmp_path / "r")}

    def python(*arguments: str) -> str:
        command = [sys.executable, *arguments]
        result = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=120)
        assert result.returncode == 0, result.stderr
        return result.stdout

    found = python("-c", "import instant_ic.paths as p; print(p.shipped_file('launch', 'sim.yaml'))")
    assert Path(found.strip()) == site / "instant_ic/share/launch/sim.yaml"
    assert "console_port" in python("-m", "instant_ic.cli.main", "launch", "sim", "--show-args")
    assert "--params-file" in python("-m", "instant_ic.cli.main", "run", "simulator", "--help")
