"""All experiments of the paper in their quick form, by the command."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from instant_ic.cli.main import main
from instant_ic.experiments.lab import EXPERIMENTS


@pytest.mark.system
@pytest.mark.timeout(1500)
def test_all_experiments_give_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", "all", "--quick", "--jobs", "2", "-o", str(tmp_path)]) == 0, capsys.readouterr().err
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert all(f'<h2 id="{name}">' in page for name in EXPERIMENTS)
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert {unit["experiment"] for unit in report["units"]} == set(EXPERIMENTS)
    held = report["verdict"]
    assert report["paper"]["flow"]["figures"].startswith("1 of 1 drives, simulated, without contact")
    assert held["ablation"]["corridor: the depth prior improves the view (paper), PSNR and SSIM"] is True
