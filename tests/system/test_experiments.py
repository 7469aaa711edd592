"""One experiment of the paper in its quick form, by the command: a drive through the obstacle, with its report."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from instant_ic.cli.main import main


@pytest.mark.system
@pytest.mark.timeout(600)
def test_the_drive_through_the_obstacle_gives_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["experiment", "teleoperation", "--quick", "--jobs", "1", "-o", str(tmp_path)]
    assert main(command) == 0, capsys.readouterr().err
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert '<h2 id="teleoperation">' in page and page.count("data:image/") >= 3
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert report["paper"]["flow"]["figures"].startswith("1 of 1 drives, simulated, without contact")
