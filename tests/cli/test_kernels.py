"""Kernels are compiled ahead: once, for one caller at a time, and noted beside numba's cache."""

import fcntl
import importlib
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from instant_ic.cli import kernels
from instant_ic.cli.main import main
from instant_ic.control import costmap
from instant_ic.control.footprint import Footprint
from instant_ic.control.walls import StaticMap
from instant_ic.slam import loop_search
from instant_ic.vspace import fill_kernels


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_a_part_is_compiled_into_the_cache_and_noted(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "PARTS", ("lidar",))
    shares: list[float] = []
    assert not kernels.are_compiled()
    assert kernels.compile_all(shares.append) == []
    assert kernels.are_compiled() and shares[-1] == 1.0
    assert list(folder.rglob("*.nbi"))
    monkeypatch.setattr(kernels, "PARTS", ("no such part would be compiled again",))
    assert kernels.compile_all(shares.append) == []


def test_a_part_that_fails_is_reported_and_nothing_noted(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "PARTS", ("slam",))
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "no number")
    monkeypatch.setenv("PYTHONPATH", f"{folder / 'empty'}")
    (folder / "empty" / "numba").mkdir(parents=True)
    (folder / "empty" / "numba" / "__init__.py").write_text("raise ImportError('numba is broken')")
    monkeypatch.chdir(Path(kernels.__file__).parents[2])
    (problem,) = kernels.compile_all(lambda share: None)
    assert problem == "the kernels of slam cannot be compiled: ImportError: numba is broken"
    assert not kernels.are_compiled()


def test_a_second_caller_waits_and_then_has_nothing_to_do(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "PARTS", ("no such part",))
    folder.mkdir()
    second = threading.Thread(target=kernels.compile_all, args=(lambda share: None,))
    with (folder / "kernels.lock").open("w") as first:
        fcntl.flock(first, fcntl.LOCK_EX)
        second.start()
        second.join(0.3)
        assert second.is_alive()
        (folder / "kernels.txt").write_text(kernels.source_key())
    second.join(60)
    assert not second.is_alive() and kernels.are_compiled()


def test_a_changed_source_and_a_read_only_installation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert kernels.cache_folder() == tmp_path / "home" / "instant_ic"
    (tmp_path / "kernel.py").write_text("import numba\n")
    before = kernels.source_key(tmp_path)
    (tmp_path / "other.py").write_text("no kernel\n")
    assert kernels.source_key(tmp_path) == before
    (tmp_path / "kernel.py").write_text("import numba  # changed\n")
    assert kernels.source_key(tmp_path) != before


def test_ctrl_c_ends_the_compilers(folder: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "instant_ic.cli.main", "compile"],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr is not None and process.stderr.readline().startswith("compiling kernels")
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(30) == 130
    with pytest.raises(ProcessLookupError):
        for _ in range(600):
            os.killpg(process.pid, 0)
            threading.Event().wait(0.05)


def test_the_command_has_nothing_to_do_once_all_is_compiled(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder.mkdir()
    (folder / "kernels.txt").write_text(kernels.source_key())
    monkeypatch.setattr(kernels, "PARTS", ("no such part",))
    assert main(["compile"]) == 0
    assert capsys.readouterr().err == ""


def test_without_a_folder_for_the_cache_the_nodes_compile_for_themselves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    assert main(["compile"]) == 1
    assert "ic: the kernels cannot be compiled ahead: " in capsys.readouterr().err


def test_what_the_first_drive_needs_is_compiled_ahead_in_one_variant() -> None:
    """A later variant, for a map that may not be written or arrays in another order, would hold up the robot."""
    for part in ("slam", "control"):
        for module in kernels.PARTS[part]:
            importlib.import_module(f"instant_ic.{part}.{module}").warm_up()
    assert loop_search.score_volume.signatures
    read_only = np.zeros((20, 20), np.int8)
    read_only.flags.writeable = False
    for occupancy in (read_only, read_only.copy()):
        window = costmap.RollingCostmap(costmap.CostmapConfig(width=4.0), Footprint())
        window.update(np.zeros(3), StaticMap(occupancy, 0.1, np.zeros(2)), None, None)
    assert len(costmap._join.signatures) == 1
    for weight in (np.ones((4, 8), np.float32), np.ones((8, 4), np.float32).T):
        fill_kernels.fill(np.ones((4, 8, 3), np.float32), weight)
    assert len(fill_kernels.pull_push.signatures) == 1


def test_nodes_without_kernels_do_not_load_numba() -> None:
    code = "import sys\nfrom instant_ic.bus.node_files import node_class\n"
    code += "for name in ('virtual_robot', 'crawler_base', 'theta_camera', 'console'): node_class(name)\n"
    code += "print('numba' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True, timeout=120) == "False\n"


def test_the_first_kernel_loads_no_linear_algebra() -> None:
    code = (
        "from instant_ic.lidar.flatscan import warm_up\nwarm_up()\n"
        "import sys; print('scipy.linalg' in sys.modules, 'numba' in sys.modules)"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True, timeout=300) == "False True\n"
