"""No process of a pool outlives its block, at whatever stage of its start-up the block is interrupted."""

import os
import signal
import time
from collections.abc import Iterator
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from pathlib import Path

import pytest

from instant_ic.experiments import processes
from instant_ic.experiments.processes import LostError, ProcessPool, run_all


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[SpawnProcess]]:
    """Processes that a test starts; they are killed after it."""
    processes: list[SpawnProcess] = []
    start = SpawnProcess.start

    def keep(self: SpawnProcess) -> None:
        processes.append(self)
        start(self)

    monkeypatch.setattr(SpawnProcess, "start", keep)
    yield processes
    for process in processes:
        process.kill()


@pytest.fixture(params=["obedient", "SIGTERM ignored"])
def inherited(request: pytest.FixtureRequest) -> Iterator[None]:
    """With the signal ignored where the program was started, its processes ignore it, too."""
    if request.param == "obedient":
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGTERM, before)


def work(stage: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make the pool's processes halt at ``stage``; return the file that appears then."""
    halted = folder / "halted"
    monkeypatch.setenv("HALT", "none")  # not in this process
    import slow_start  # noqa: F401

    monkeypatch.setenv("HALT", stage)
    monkeypatch.setenv("HALTED", str(halted))
    return halted


def wait_for(path: Path) -> None:
    deadline = time.monotonic() + 120.0
    while not path.exists():
        assert time.monotonic() < deadline, f"{path.name} did not appear"
        time.sleep(0.01)


def gone(processes: list[SpawnProcess]) -> bool:
    return len(wait([process.sentinel for process in processes], 0.0)) == len(processes)


@pytest.mark.parametrize("stopped", [False, True], ids=["running", "stopped"])
@pytest.mark.parametrize("stage", ["start", "import", "prepare", "drive"])
def test_an_interrupt_at_any_stage_leaves_no_process(
    stage: str,
    stopped: bool,
    inherited: None,
    started: list[SpawnProcess],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    halted = work(stage, tmp_path, monkeypatch)
    from slow_start import drive, prepare

    with pytest.raises(KeyboardInterrupt), ProcessPool(prepare) as pool:
        pool.start().send((drive, ()))
        if stage != "start":
            wait_for(halted)
        if stopped:
            assert started[0].pid is not None
            os.kill(started[0].pid, signal.SIGSTOP)
        raise KeyboardInterrupt
    assert len(started) == 1 and gone(started)


def test_an_interrupt_between_start_and_the_pools_own_list_leaves_no_process(
    started: list[SpawnProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work("drive", tmp_path, monkeypatch)
    from slow_start import drive, prepare

    start = SpawnProcess.start

    def interrupted(self: SpawnProcess) -> None:
        start(self)
        raise KeyboardInterrupt

    monkeypatch.setattr(SpawnProcess, "start", interrupted)
    with pytest.raises(KeyboardInterrupt), ProcessPool(prepare) as pool:
        pool.start().send((drive, ()))
    assert len(started) == 1 and gone(started)


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_call_that_hangs_or_dies_is_lost_and_the_others_are_done(jobs: int) -> None:
    from slow_start import behave, nothing

    lost = []

    def on_lost(number: int, error: LostError) -> str:
        lost.append((number, str(error)))
        return "lost"

    tasks = [("hang",), ("one",), ("die",), ("two",)]
    results = run_all(behave, tasks, jobs, nothing, None, 600.0, 20.0, on_lost)
    assert sorted(results) == ["lost", "lost", "one", "two"]
    assert sorted(lost) == [
        (0, "it took longer than 20 s and was ended"),
        (2, "its process died (out of memory?)"),
    ]


def test_without_a_result_for_lost_calls_the_run_ends(started: list[SpawnProcess]) -> None:
    from slow_start import behave, nothing

    with pytest.raises(LostError, match="task 0: its process died"):
        run_all(behave, [("die",), ("hang",)], 2, nothing)
    with pytest.raises(TimeoutError, match="0 of 1 are done"):
        run_all(behave, [("hang",)], 1, nothing, timeout_s=2.0, call_timeout_s=600.0)
    with pytest.raises(ValueError, match="no such thing"):
        run_all(behave, [("raise",), ("one",)], 2, nothing)
    assert gone(started)


def test_the_rest_of_a_result_is_not_awaited_for_ever(
    started: list[SpawnProcess], monkeypatch: pytest.MonkeyPatch
) -> None:
    from slow_start import behave, nothing

    monkeypatch.setattr(processes, "_REST_S", 0.5)
    with pytest.raises(LostError, match=r"task 0: the rest of its result did not arrive within 0.5 s"):
        run_all(behave, [("send a part",), ("hang",)], 2, nothing)
    assert gone(started)


def test_results_come_back() -> None:
    from slow_start import nothing

    assert sorted(run_all(abs, [(-n,) for n in range(4)], 2, nothing)) == [0, 1, 2, 3]
