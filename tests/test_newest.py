"""``make newest``: which interpreter and which packages it takes, and what it skips without torch."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from scripts import newest

ROOT = Path(__file__).resolve().parents[1]


def test_newest_interpreter_that_works_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for version, status in (("3.14", 127), ("3.13", 0), ("3.11", 0)):  # a shim of pyenv for another version fails
        python = tmp_path / f"python{version}"
        python.write_text(f"#!/bin/sh\nexit {status}\n")
        python.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert newest.newest_python() == str(tmp_path / "python3.13")
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    with pytest.raises(SystemExit, match="none of Python"):
        newest.newest_python()


def test_nothing_is_pinned_and_torch_is_apart() -> None:
    asked = newest.requirements()
    assert {"numpy>=2.0", "pytest>=8.3", "sympy"} <= set(asked)
    assert not [one for one in asked if "==" in one.partition(";")[0] or one.startswith(("torch", "triton"))]


def test_what_imports_torch_is_skipped_by_name_where_it_is_missing_and_fails_otherwise(tmp_path: Path) -> None:
    (tmp_path / "torch.py").write_text("raise ModuleNotFoundError('no torch here', name='torch')\n")
    (tmp_path / "test_module.py").write_text("import torch\n\ndef test_it():\n    pass\n")
    (tmp_path / "test_function.py").write_text("def test_it():\n    import torch\n\ndef test_other():\n    pass\n")

    def outcome(*options: str) -> str:
        run = [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", "-p", "tests.conftest", *options]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
        done = subprocess.run(
            [*run, "--rootdir", tmp_path, tmp_path],
            capture_output=True,
            text=True,
            timeout=120,
            env=environment,
            cwd=ROOT,
        )
        return done.stdout

    without = outcome("--without-torch")
    assert "1 passed, 2 skipped" in without and without.count("torch is missing") >= 1, without
    assert "error" in outcome() and "skipped" not in outcome()


def test_make_newest_takes_the_given_interpreter_and_cleans_up() -> None:
    def recipe(*words: str) -> str:
        environment = {
            key: value for key, value in os.environ.items() if not key.startswith(("MAKE", "MFLAGS", "PYTHON"))
        }
        made = subprocess.run(
            ["make", "-n", *words], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True, env=environment
        )
        return made.stdout

    assert "newest.py .venv-newest )" in recipe("newest") and 'pytest -n 2 --dist loadgroup -m "not system"' in recipe(
        "newest"
    )
    assert "newest.py .venv-newest --python python3.12)" in recipe("newest", "PYTHON=python3.12")
    assert ".venv-newest" in recipe("clean")
