"""An installed wheel holds all that the stack needs: nodes, launch files, configuration, model, page."""

import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import time
import zipfile
from pathlib import Path

import pytest

from instant_ic.bus import registry
from instant_ic.experiments.stack import free_ports, processes_of
from instant_ic.launch.pacing import machine_pace

ROOT = Path(__file__).resolve().parents[1]
PURELIB = "import sysconfig; print(sysconfig.get_paths()['purelib'])"
ENVIRONMENT = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "INSTANT_IC_RUN_DIR")}
NODES = {"simulator", "theta_camera", "vlp16_driver", "crawler_base", "grid_slam", "depth_scaler", "arbiter"}


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


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A new environment with the wheel; its dependencies are those of this interpreter, without the checkout."""
    folder = tmp_path_factory.mktemp("installed")
    python = folder / "venv/bin/python"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder / "venv")], check=True, timeout=240)
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--no-deps", "--no-index", str(wheel)]
    subprocess.run(pip, check=True, timeout=240, env=ENVIRONMENT)
    site = Path(subprocess.check_output([python, "-c", PURELIB], text=True, timeout=60).strip())
    # The line of a .pth file adds a folder, but does not read its .pth files: the editable install stays unseen.
    (site / "dependencies.pth").write_text(f"{sysconfig.get_paths()['purelib']}\n")
    take_compiled_kernels(site)
    return python


def take_compiled_kernels(site):
    """Copy the checkout's compiled kernels: to compile them again takes two minutes of a core, and needs no wheel.

    Numba uses them where the source file has the same time and size.
    """
    for source in (ROOT / "instant_ic").rglob("*.py"):
        stat, copy = source.stat(), site / source.relative_to(ROOT)
        os.utime(copy, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        for kernel in source.parent.glob(f"__pycache__/{source.stem}.*.nb[ic]"):
            shutil.copy2(kernel, copy.parent / "__pycache__")


def run(installed, folder, *arguments):
    """Output of a command in the new environment, outside the checkout."""
    result = subprocess.run(
        [installed, *arguments], env=ENVIRONMENT, cwd=folder, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_installed_wheel_finds_its_files(installed, tmp_path):
    found = Path(
        run(
            installed, tmp_path, "-c", "import instant_ic.util.paths as p; print(p.shipped_file('launch', 'sim.yaml'))"
        ).strip()
    )
    assert found.is_relative_to(installed.parents[1]) and found.parts[-4:-1] == ("instant_ic", "share", "launch")
    assert "console_port" in run(installed, tmp_path, "-m", "instant_ic.cli.main", "launch", "sim", "--show-args")
    assert "--params-file" in run(installed, tmp_path, "-m", "instant_ic.cli.main", "run", "simulator", "--help")


@pytest.mark.system
@pytest.mark.timeout(1800)
def test_installed_wheel_runs_the_simulated_stack(installed, tmp_path):
    run_dir = Path(tempfile.mkdtemp(prefix="ic-"))
    ports = [f"{name}:={value}" for name, value in free_ports().items()]
    ic = installed.parent / "ic"
    environment = {**ENVIRONMENT, "INSTANT_IC_RUN_DIR": str(run_dir)}
    log = (tmp_path / "log").open("w+")
    launch = subprocess.Popen(
        [ic, "launch", "sim", "--plain", "--pace", str(machine_pace()), "headless:=true", "vspace:=false", *ports],
        env=environment, cwd=tmp_path, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
    )  # fmt: skip
    try:
        deadline_s = time.monotonic() + 1200  # without compiled kernels a minute, or many on a busy machine
        while not {node.name for node in registry.list_nodes(run_dir)} >= NODES:
            assert launch.poll() is None and time.monotonic() < deadline_s, Path(log.name).read_text()
            time.sleep(0.2)
        echo = [ic, "topic", "echo", "/pose", "--once", "--timeout", "90"]
        assert subprocess.run(echo, env=environment, cwd=tmp_path, stdout=log, timeout=120).returncode == 0
        assert {process.cmdline()[0] for process in processes_of(run_dir)} == {str(installed)}
        launch.send_signal(signal.SIGINT)
        assert launch.wait(90) == 0, Path(log.name).read_text()
        assert [process.cmdline() for process in processes_of(run_dir)] == []
        assert "Traceback" not in Path(log.name).read_text()
    finally:
        for process in [launch, *processes_of(run_dir)]:
            process.kill()
        launch.wait(30)
        log.close()
        shutil.rmtree(run_dir, ignore_errors=True)
