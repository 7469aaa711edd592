"""No process of a pool outlives its block, at whatever stage of its start-up the block is interrupted."""

import os
import signal
import time
from collections.abc import Iterator
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from pathlib import Path

import pytest

from instant_ic.experiments.processes import process_pool


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

    with pytest.raises(KeyboardInterrupt), process_pool(1, prepare) as pool:
        pool.submit(drive)
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
    with pytest.raises(KeyboardInterrupt), process_pool(1, prepare) as pool:
        pool.submit(drive)
    assert len(started) == 1 and gone(started)


def test_a_result_cut_short_does_not_hold_up_the_end(
    started: list[SpawnProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    halted = work("result", tmp_path, monkeypatch)
    from slow_start import begin_a_result, prepare

    with pytest.raises(KeyboardInterrupt), process_pool(1, prepare) as pool:
        future = pool.submit(begin_a_result)
        thread = pool._executor_manager_thread  # type: ignore[attr-defined]
        wait_for(halted)
        raise KeyboardInterrupt
    thread.join(120.0)  # an interpreter that ends joins it without a time-out
    assert not thread.is_alive()
    assert future.done() and gone(started)


def test_results_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work("nowhere", tmp_path, monkeypatch)
    from slow_start import prepare

    with process_pool(2, prepare) as pool:
        assert [future.result(120.0) for future in [pool.submit(abs, -n) for n in range(4)]] == [0, 1, 2, 3]
