"""The pace of a simulated stack: its time, its file in the run directory, and a real base that refuses it."""

import json
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instant_ic import pace
from instant_ic.bus import NodeError
from instant_ic.bus.clock import SystemClock
from instant_ic.pace import Pace, PaceError
from nodes.crawler_base import CrawlerBaseNode


@pytest.fixture(autouse=True)
def real_time_again():
    yield
    pace.use(Pace())


@pytest.fixture
def machine(monkeypatch):
    """The machine's clocks, as lists of one that tests set."""
    wall, steady = [10_000_000_000], [5_000_000_000]
    monkeypatch.setattr("time.time_ns", lambda: wall[0])
    monkeypatch.setattr("time.monotonic_ns", lambda: steady[0])

    def go_on(ns):
        wall[0] += ns
        steady[0] += ns

    return go_on


def test_time_goes_at_the_pace_from_the_moment_it_began(machine):
    half = Pace.from_now(0.5)
    pace.use(half)
    assert SystemClock().now_ns() == 10_000_000_000
    machine(2_000_000_000)
    assert SystemClock().now_ns() == 11_000_000_000
    assert SystemClock().steady_ns() == 1_000_000_000
    assert half.steady_s() == 1.0
    assert half.wait_s(0.3) == 0.6


def test_stamp_of_the_machines_clock_becomes_one_of_the_stack(machine):
    quarter = Pace.from_now(0.25)
    machine(8_000_000_000)  # the stack: 2 s on, at 12 s; a packet was stamped 0.4 s ago, 0.1 s of the stack
    assert quarter.stamp_ns(18_000_000_000 - 400_000_000) == 11_900_000_000
    assert Pace().stamp_ns(123) == 123


def test_real_time_is_the_machines(machine):
    clock = SystemClock()
    machine(1_000)
    assert (clock.now_ns(), clock.steady_ns()) == (10_000_001_000, 5_000_001_000)


@given(st.floats(pace.SLOWEST, pace.FASTEST), st.integers(0, 2**62), st.integers(0, 2**62))
def test_pace_comes_back_from_its_file(tmp_path_factory, factor, epoch_ns, monotonic_ns):
    folder = tmp_path_factory.mktemp("r")
    written = Pace(factor, epoch_ns, monotonic_ns)
    pace.write(folder, written)
    read = pace.read(folder)
    assert read == (written if factor != 1.0 else Pace())
    pace.write(folder, Pace())
    assert pace.read(folder).real and not list(folder.iterdir())


@pytest.mark.parametrize("text", ["", "[1]", '{"factor": 0.5}', '{"factor": "x", "epoch_ns": 1, "monotonic_ns": 1}'])
def test_damaged_file_is_named(tmp_path, text):
    (tmp_path / pace.FILE).write_text(text)
    with pytest.raises(PaceError, match=r"pace\.json.*restart the stack"):
        pace.read(tmp_path)


@pytest.mark.parametrize("factor", [0.0, -1.0, 11.0, float("nan"), float("inf")])
def test_pace_out_of_range_is_refused(tmp_path, factor):
    with pytest.raises(PaceError, match="must lie in"):
        Pace.from_now(factor)
    (tmp_path / pace.FILE).write_text(json.dumps({"factor": factor, "epoch_ns": 1, "monotonic_ns": 1}))
    with pytest.raises(PaceError, match="must lie in"):
        pace.read(tmp_path)


def test_launcher_refuses_a_pace_out_of_range():
    command = [sys.executable, "-m", "instant_ic.cli.main", "launch", "sim", "--check", "--pace=50"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "pace must lie in 0.02..10 (got 50)" in done.stderr


class _Base:
    """What ``refuse_pace`` looks at."""

    def __init__(self, run_dir, port):
        self.run_dir = run_dir
        self.config = type("C", (), {"roboclaw": type("R", (), {"port": port})})


def test_real_base_refuses_slow_motion_and_the_simulators_does_not(tmp_path):
    real, simulated = _Base(tmp_path, "/dev/ttyACM0"), _Base(tmp_path, f"{tmp_path}/dev/roboclaw")
    CrawlerBaseNode.refuse_pace(real)
    pace.use(Pace.from_now(0.5))
    CrawlerBaseNode.refuse_pace(simulated)
    with pytest.raises(NodeError, match=r"pace 0\.5, for simulated devices only, and /dev/ttyACM0 is not"):
        CrawlerBaseNode.refuse_pace(real)
