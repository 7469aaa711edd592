"""The pace of a simulated stack: its time, its file in the run directory, and a real base that refuses it."""

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instant_ic.base.config import RoboclawConfig
from instant_ic.base.pace import refuse_pace
from instant_ic.base.roboclaw import open_serial
from instant_ic.bus.clock import SystemClock
from instant_ic.util import pace
from instant_ic.util.pace import Pace, PaceError, PaceFiles


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


@given(st.lists(st.tuples(st.integers(0, 10**9), st.floats(pace.SLOWEST, pace.FASTEST)), min_size=1, max_size=20))
def test_time_is_continuous_monotonic_and_the_same_in_all_processes(tmp_path_factory, changes):
    """Processes that look often, seldom, and for the first time."""
    folder, now = tmp_path_factory.mktemp("r"), [7_000_000_000]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("time.monotonic_ns", lambda: now[0])
        patch.setattr("time.time_ns", lambda: 10**18)
        files = PaceFiles([folder], 0.5, adapts=True)
        often, seldom = pace.read(folder), pace.read(folder)
        last = often.now_ns(), often.steady_ns()
        for wait_ns, factor in changes:
            files.change(factor)
            for ns in (wait_ns // 2, wait_ns - wait_ns // 2, 1):
                before = often.factor
                now[0] += ns
                time_ns = often.now_ns(), often.steady_ns()
                most = max(before, often.factor, pace.read(folder).factor) * ns + 2
                assert all(0 <= after - earlier <= most for earlier, after in zip(last, time_ns, strict=True))
                assert time_ns[0] - time_ns[1] == 10**18  # stamps and timers do not drift apart
                last = time_ns
            fresh = pace.read(folder)  # of a process that has just been restarted
            assert (fresh.now_ns(), fresh.steady_ns()) == last
            if wait_ns % 2:  # a process that slept through some changes
                assert (seldom.now_ns(), seldom.steady_ns()) == last


def test_a_change_takes_effect_at_its_time_and_waits_reach_across_it(machine, tmp_path):
    files = PaceFiles([tmp_path], 0.5, adapts=True)
    made = pace.read(tmp_path)
    assert (made.factor, made.real, made.adapts) == (0.5, False, True)
    machine(1_000_000_000)
    files.change(1.0)
    files.change(0.1)  # too soon after the change before, which has not happened yet
    assert (made.factor, files.factor) == (0.5, 1.0)
    # 0.2 s at half the machine's speed, then 0.4 s at the machine's.
    assert made.wait_s(0.5) == pytest.approx(0.6)
    assert made.wait_s(0.1) == pytest.approx(0.2)
    machine(200_000_000)
    assert (made.factor, made.steady_ns()) == (1.0, 600_000_000)
    # A packet of 0.3 s ago: 0.2 s of them passed before the change, at half speed.
    machine(100_000_000)
    assert made.now_ns() - made.stamp_ns(11_300_000_000 - 300_000_000) == 200_000_000


def test_sleep_follows_changes(machine, tmp_path, monkeypatch):
    files = PaceFiles([tmp_path], 0.1, adapts=True)
    made, slept = pace.read(tmp_path), []

    def sleep(seconds):
        slept.append(seconds)
        machine(round(seconds * 1e9))
        files.change(1.0)

    monkeypatch.setattr("time.sleep", sleep)
    made.sleep(1.0)
    assert made.steady_s() == pytest.approx(1.0, abs=1e-6)
    assert sum(slept) == pytest.approx(1.36, abs=0.01)  # 0.4 s until the change, then 0.96 s in real time


def test_all_folders_of_a_stack_have_one_time(machine, tmp_path):
    folders = [tmp_path / name for name in "ab"]
    for folder in folders:
        folder.mkdir()
    files = PaceFiles(folders, 0.5, adapts=True)
    machine(300_000_000)
    files.change(0.25)
    machine(900_000_000)
    first, second = map(pace.read, folders)
    assert first.now_ns() == second.now_ns() and first.factor == second.factor == 0.25
    pace.remove_files(folders)
    assert pace.read(folders[0]).real and not list(folders[0].iterdir())


def test_a_record_that_is_being_written_is_left_for_the_next_look(tmp_path):
    files = PaceFiles([tmp_path], 0.5, adapts=True)
    made = pace.read(tmp_path)
    (record,) = files._records
    before = record[:]
    files.change(2.0)
    whole = record[:]
    record[:40] = whole[:40]
    record[40:] = before[40:]
    assert made._stretches == (made._stretches[0],) * 2 and made.steady_ns() >= 0
    assert made._number == 1
    record[:] = whole
    made.steady_ns()
    assert made._number == 2 and made._stretches[1].factor == 2.0


@pytest.mark.parametrize("content", [b"", b"[1]", b"x" * 88, b"\0" * 88])
def test_damaged_file_is_named(tmp_path, content):
    (tmp_path / pace.FILE).write_bytes(content)
    with pytest.raises(PaceError, match=r"pace: not a valid pace.*restart the stack"):
        pace.read(tmp_path)


@pytest.mark.parametrize("factor", [0.0, -1.0, 11.0, float("nan"), float("inf")])
def test_pace_out_of_range_is_refused(tmp_path, factor):
    with pytest.raises(PaceError, match="must lie in"):
        Pace.from_now(factor)
    with pytest.raises(PaceError, match="must lie in"):
        PaceFiles([tmp_path], factor)


def test_time_outs_on_the_machines_clock_hold_at_every_pace_that_may_come(tmp_path):
    assert Pace().timeout_s(0.1) == 0.1
    assert Pace.from_now(0.5).timeout_s(0.1) == 0.2
    PaceFiles([tmp_path], 1.0, adapts=True)
    assert pace.read(tmp_path).timeout_s(0.1) == pytest.approx(1.0)  # the pace may fall to 0.1
    other_end, end = os.openpty()
    pace.use(Pace.from_now(0.5))
    port = open_serial(RoboclawConfig(port=os.ttyname(end), reply_timeout_s=0.1))
    assert port.timeout == 0.2
    port.close()
    os.close(other_end)
    os.close(end)


def test_real_base_refuses_slow_motion_and_the_simulators_does_not(tmp_path):
    simulated = f"{tmp_path}/dev/roboclaw"
    refuse_pace(pace.current(), "/dev/ttyACM0", tmp_path)
    pace.use(Pace.from_now(0.5))
    refuse_pace(pace.current(), simulated, tmp_path)
    with pytest.raises(PaceError, match=r"pace 0\.5, for simulated devices only, and /dev/ttyACM0 is not"):
        refuse_pace(pace.current(), "/dev/ttyACM0", tmp_path)
