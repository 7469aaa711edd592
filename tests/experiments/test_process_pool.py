"""Calls in processes: one that hangs or dies is lost, the others are done, and no process is left."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest

from instant_ic.experiments.processes import LostError, run_all


def nothing() -> None:
    pass


def behave(how: str, folder: Path) -> str:
    """Hang, die, raise or return the word; note the process first."""
    (folder / str(os.getpid())).touch()
    if how == "hang":
        time.sleep(600.0)
    if how == "die":
        os._exit(3)
    if how == "raise":
        raise ValueError("no such thing")
    return how


def left(folder: Path) -> list[Path]:
    """Processes of ``behave`` that are still there."""
    return [one for one in folder.iterdir() if Path("/proc", one.name).exists()]


def test_a_call_that_hangs_or_dies_is_lost_and_the_others_are_done(tmp_path: Path) -> None:
    tasks = [(how, tmp_path) for how in ("hang", "one", "die", "two")]
    results = list(run_all(behave, tasks, 2, nothing, 600.0, 4.0))
    assert sorted(one for one in results if isinstance(one, str)) == ["one", "two"]
    lost = [(one.number, str(one)) for one in results if isinstance(one, LostError)]
    assert sorted(lost) == [(0, "it took longer than 4 s and was ended"), (2, "its process died (out of memory?)")]
    assert not left(tmp_path)


@pytest.mark.parametrize(
    ("tasks", "timeout_s", "error", "words"),
    [
        (("die", "hang"), 600.0, LostError, "its process died"),
        (("hang", "hang"), 0.5, TimeoutError, "0 of 2 are done"),
        (("raise", "hang"), 600.0, ValueError, "no such thing"),
    ],
)
def test_the_run_ends_with_the_error_of_a_call(tasks, timeout_s, error, words, tmp_path: Path) -> None:
    with pytest.raises(error, match=words):
        list(run_all(behave, [(how, tmp_path) for how in tasks], 2, nothing, timeout_s))
    assert not left(tmp_path)


def test_an_interrupt_leaves_no_process(tmp_path: Path) -> None:
    def interrupt() -> None:
        while len(list(tmp_path.iterdir())) < 2:
            time.sleep(0.05)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=interrupt, daemon=True).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            list(run_all(behave, [("hang", tmp_path)] * 2, 2, nothing))
    finally:
        signal.signal(signal.SIGINT, before)
    assert not left(tmp_path)
