"""A node that waits for others at the start says so calmly; what lasts, or was well before, is a fault."""

import logging
from dataclasses import dataclass
from pathlib import Path

import pytest

from instant_ic.bus import ERROR, OK, WARN, diagnostics
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.node import Node


@dataclass(frozen=True)
class DriverConfig:
    pass


class Driver(Node[DriverConfig]):
    name = "driver"


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(diagnostics.time, "monotonic", lambda: now[0])
    return now


@pytest.fixture
def driver(now: list[float], tmp_path_factory: pytest.TempPathFactory, caplog: pytest.LogCaptureFixture) -> Driver:
    caplog.set_level(logging.INFO)
    run_dir: Path = tmp_path_factory.mktemp("r")
    driver = Driver(DriverConfig(), LocalTransport(run_dir, "driver", SystemClock().now_ns), SystemClock())
    yield driver
    driver.close()


def told(caplog: pytest.LogCaptureFixture) -> list[tuple[str, str]]:
    return [(record.levelname, record.getMessage()) for record in caplog.records if record.name == "driver"]


def test_waiting_at_the_start_is_information_once_and_a_fault_when_it_lasts(
    driver: Driver, now: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    driver.diagnose("camera", WARN, "connecting")
    driver.diagnose("camera", ERROR, "connection refused")
    assert driver.diagnostics.worst[0] == ERROR  # diagnostics and heartbeat say what is
    now[0] += 14.0
    driver.diagnostics.end_start_grace()
    assert told(caplog) == [("INFO", "camera: connecting")]
    now[0] += 1.0
    driver.diagnostics.end_start_grace()
    driver.diagnostics.end_start_grace()
    assert told(caplog)[1:] == [("ERROR", "camera: connection refused")]


def test_what_was_well_and_fails_is_a_fault_at_once(driver: Driver, caplog: pytest.LogCaptureFixture) -> None:
    driver.diagnose("link", OK, "connected")
    driver.diagnose("link", ERROR, "cable is out")
    assert told(caplog) == [("ERROR", "link: cable is out")]


def test_what_becomes_well_in_time_is_never_a_fault(
    driver: Driver, now: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    driver.diagnose("scan", WARN, "none has come yet")
    driver.diagnose("scan", OK, "fresh")
    now[0] += 60.0
    driver.diagnostics.end_start_grace()
    driver.diagnose("new", WARN, "late trouble")
    assert told(caplog) == [
        ("INFO", "scan: none has come yet"),
        ("INFO", "scan: fresh"),
        ("WARNING", "new: late trouble"),
    ]
