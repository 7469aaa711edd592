"""``ic study`` end to end: a simulated participant through the real pages drives a real stack, up to the report."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
import yaml

from instant_ic.bag import BagReader
from instant_ic.cli.main import main
from instant_ic.experiments.study.plan import save

pytestmark = [
    pytest.mark.system,
    pytest.mark.browser,
    pytest.mark.xdist_group("stack"),
    pytest.mark.timeout(900),
    pytest.mark.skipif(
        shutil.which("chromium") is None and os.environ.get("CI") != "true",
        reason="chromium is missing: apt install chromium",
    ),
]


def test_a_simulated_participant_from_the_plan_to_the_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One drive of one metre, without a virtual space: the cheapest stack that is real."""
    folder, out = tmp_path / "study", tmp_path / "report"
    assert main(["study", "new", str(folder), "--participants", "4"]) == 0
    plan = yaml.safe_load((folder / "study.yaml").read_text())
    plan |= {"worlds": ["corridor-free"], "participants": {"P01": ["stop"]}, "goal_m": 1.0}
    plan |= {"arguments": {"vspace": False, "depth_source": "lidar"}}
    save(folder / "study.yaml", yaml.safe_dump(plan))
    assert main(["study", "simulate", str(folder), "--timeout", "800"]) == 0, capsys.readouterr().err
    kept = json.loads((folder / "participants/P01/answers.json").read_text())
    drive = kept["steps"]["drive1"]
    assert (kept["state"], drive["end"], drive["contacts"]) == ("done", "arrived", 0)
    assert 0.9 < drive["driven_m"] < 2.0 and 0.0 < drive["obedience"] <= 1.0
    with BagReader(folder / "participants/P01/drive1") as bag:
        topics = {one.topic for one in bag.topics}
        begin_ns, end_ns = (one.stamp_ns for one in bag.messages({"/study/event"}))
        states_ns = [one.stamp_ns for one in bag.messages({"/ic/state"})]
    assert begin_ns < end_ns <= states_ns[-1]  # in slow motion too
    assert {
        "/study/event",
        "/study/answers",
        "/operator/cmd_vel",
        "/ic/state",
        "/camera/image/compressed",
        "/lidar/packets",
    } <= topics
    assert main(["study", "report", str(folder), "-o", str(out)]) == 0
    assert "Too few participants" in (out / "report.html").read_text()
    assert main(["study", "delete", str(folder), "P01"]) == 0
    assert not (folder / "participants/P01").exists()
