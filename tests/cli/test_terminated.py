"""SIGTERM ends a command as Ctrl-C does."""

import signal
import subprocess
import sys

import pytest

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


@pytest.mark.parametrize(("signum", "status"), [(signal.SIGTERM, 143)])
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
