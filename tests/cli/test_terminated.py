"""SIGTERM ends a command as Ctrl-C does."""

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from instant_ic.experiments import recordings
from instant_ic.experiments.stack import StackError

WAITS = """
import sys, time
from instant_ic.cli import main as cli

def wait(args):
    try:
        print("waiting", flush=True)
        for _ in range(6000):  # in short steps: a signal just before a sleep begins is taken at its end
            time.sleep(0.01)
    finally:
        print("removed", flush=True)

parser = cli.build_parser()
cli.build_parser = lambda: parser
namespace = parser.parse_args(["node", "list"])
namespace.func = wait
parser.parse_args = lambda argv: namespace
sys.exit(cli.main())
"""


def waiting(ignored: signal.Signals | None = None) -> subprocess.Popen[str]:
    """A command that waits, started by a shell that ignores a signal, or none (``nohup make test`` ignores one)."""

    def ignore() -> None:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        if ignored:
            signal.signal(ignored, signal.SIG_IGN)

    process = subprocess.Popen([sys.executable, "-c", WAITS], stdout=subprocess.PIPE, text=True, preexec_fn=ignore)
    assert process.stdout is not None and process.stdout.readline() == "waiting\n"
    return process


@pytest.mark.parametrize(("signum", "status"), [(signal.SIGTERM, 143), (signal.SIGHUP, 143), (signal.SIGINT, 130)])
def test_a_command_cleans_up_and_reports_the_signal(signum: int, status: int) -> None:
    process = waiting()
    process.send_signal(signum)
    out, _ = process.communicate(timeout=60)
    assert (out, process.returncode) == ("removed\n", status)


def test_a_script_ends_a_command_in_the_background_by_sigint() -> None:
    process = waiting(ignored=signal.SIGINT)  # as sh starts `COMMAND &`
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 130


def test_a_hangup_that_nohup_ignores_stays_ignored() -> None:
    process = waiting(ignored=signal.SIGHUP)
    process.send_signal(signal.SIGHUP)
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 130  # 143, had the hangup counted


class Status:
    def __init__(self, name: str, message: str) -> None:
        self.name, self.message = name, message


class Silent:
    """A stack whose driver gets points and makes no scan of them."""

    pace, observer = 1.0, None

    def __init__(self) -> None:
        self.observer = self

    def collect(self, topic: str, *_: Any) -> list[Any]:
        array = type(
            "Array", (), {"status": [Status("vlp16_driver: packets", "9 incomplete revolutions gave no scan")]}
        )
        return [array] if topic == "/diagnostics" else []

    def subscribe(self, topic: str, kind: Any, callback: Any, qos: Any) -> None:
        assert topic == "/lidar/points"
        for _ in range(3):
            callback(None)

    def publisher(self, *_: Any) -> None:
        pass

    def wait_for(self, condition: Any, timeout_s: float, what: str) -> Any:
        raise StackError(f"no {what} within {timeout_s} s; the stack's output ends with: a long log")

    def check_alive(self, what: str) -> None:
        pass


def test_a_capture_without_scans_is_reported_with_the_drivers_reason(tmp_path: Path) -> None:
    with pytest.raises(StackError) as caught:
        recordings._watch(Silent(), tmp_path, 40.0, lambda text: None)  # type: ignore[arg-type]
    assert str(caught.value) == "the capture gives 3 point clouds and 0 scans (9 incomplete revolutions gave no scan)"
