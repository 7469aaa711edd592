"""A drive of ``ic study`` with a real stack, which an operator's program drives over the page's WebSocket."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

import pytest

from instant_ic.bag import BagReader
from instant_ic.console.client import ConsoleClient
from instant_ic.experiments.study.plan import StudyPlan
from instant_ic.experiments.study.trial import Trial, arguments

pytestmark = [pytest.mark.system, pytest.mark.xdist_group("stack"), pytest.mark.timeout(300)]


def test_a_drive_is_recorded_and_measured(tmp_path: Path) -> None:
    """One metre with the robot that stops: the cheapest stack that is real."""
    plan = StudyPlan(worlds=("corridor-free",) * 3)
    given = arguments(tmp_path, plan, 0, "stop", tmp_path / "drive1") | {"depth_source": "lidar"}
    trial = Trial(given, goal_m=1.0, limit_s=60.0)

    async def drive() -> None:
        async with ConsoleClient(trial.console) as console:
            await console.acquire()
            while trial.status == "ready":
                console.drive(0.4, 0.0)
                await asyncio.sleep(0.05)

    try:
        deadline = time.monotonic() + 240.0
        while trial.status == "starting" and time.monotonic() < deadline:
            time.sleep(0.1)
        asyncio.run(drive())
    finally:
        trial.end(60.0)
    assert trial.status == "done"
    assert (trial.result["end"], trial.result["contacts"]) == ("arrived", 0)
    assert 0.9 < trial.result["driven_m"] < 2.0 and 0.0 < trial.result["obedience"] <= 1.0
    with BagReader(tmp_path / "drive1") as bag:
        topics = {one.topic for one in bag.topics}
    assert {"/operator/cmd_vel", "/ic/state", "/camera/image/compressed", "/lidar/packets"} <= topics
