"""``make test`` reports unit and system tests, whichever of them fail."""

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}
"""Without what the make that runs these tests hands on to one below it."""


@pytest.mark.parametrize(("unit", "system"), [(0, 0), (1, 0)])
def test_both_halves_run_and_either_failure_counts(unit: int, system: int, tmp_path: Path) -> None:
    python = tmp_path / "python"
    python.write_text(
        f'#!/bin/sh\ncase "$*" in *"not system"*) echo units; exit {unit};; esac\necho systems; exit {system}\n'
    )
    python.chmod(0o755)
    made = subprocess.run(
        ["make", "-o", "check", "-o", "install-tests", "-o", "chromium", "test", f"BIN={tmp_path}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        env=ENVIRONMENT,
    )
    outcome = ["passed", "FAILED"]
    assert made.stdout.splitlines()[:3] == [
        "units",
        "systems",
        f"make test: unit tests {outcome[unit]}, system tests {outcome[system]}",
    ], made.stderr
    assert (made.returncode == 0) == (unit == system == 0)
