"""``make newest``: which packages it takes, and what it skips without torch."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from scripts import newest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(("version", "status"), [("2.13.0", 1), ("2.13.0+cpu", 0)])
def test_a_cuda_build_of_torch_is_never_installed_whichever_index_offers_it(
    version: str, status: int, tmp_path: Path
) -> None:
    python, installed = tmp_path / "python", tmp_path / "installed"
    report = f'{{"metadata": {{"version": "{version}", "description": "pip install torch+cpu"}}}}'
    python.write_text(
        f'#!/bin/sh\ncase "$*" in -\\ *) exit 1;; *--dry-run*) echo \'{report}\';; *) echo "$*" > {installed};; esac\n'
    )
    python.chmod(0o755)
    done = subprocess.run(
        [ROOT / "scripts/install_torch.sh", python, "torch"], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == status, done.stderr
    assert installed.exists() == (status == 0)
    assert "no index offers a CPU build of torch" in done.stderr or status == 0


def test_nothing_is_pinned_and_torch_is_apart() -> None:
    asked = newest.requirements()
    assert {"numpy>=2.0", "pytest>=8.3", "sympy"} <= set(asked)
    assert not [one for one in asked if "==" in one.partition(";")[0] or one.startswith(("torch", "triton"))]


def test_what_imports_torch_is_skipped_by_name_where_it_is_missing(tmp_path: Path) -> None:
    (tmp_path / "torch.py").write_text("raise ModuleNotFoundError('no torch here', name='torch')\n")
    (tmp_path / "test_module.py").write_text("import torch\n\ndef test_it():\n    pass\n")
    (tmp_path / "test_function.py").write_text("def test_it():\n    import torch\n\ndef test_other():\n    pass\n")

    run = [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", "-p", "tests.conftest"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    without = subprocess.run(
        [*run, "--without-torch", "--rootdir", tmp_path, tmp_path],
        capture_output=True, text=True, timeout=120, env=environment, cwd=ROOT,
    ).stdout  # fmt: skip
    assert "1 passed, 2 skipped" in without, without
    assert "test_module.py needs torch" in without and "test_function.py needs torch" in without, without
