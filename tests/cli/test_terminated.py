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


def test_a_command_cleans_up_and_reports_the_signal() -> None:
    process = waiting()
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=60)
    assert (out, process.returncode) == ("removed\n", 143)


# As sh starts `COMMAND &`, and as nohup starts a command; 143, had the hangup counted.
@pytest.mark.parametrize(("ignored", "sent"), [(signal.SIGINT, []), (signal.SIGHUP, [signal.SIGHUP])])
def test_sigint_ends_a_command_and_an_ignored_hangup_does_not(
    ignored: signal.Signals, sent: list[signal.Signals]
) -> None:
    process = waiting(ignored)
    for signum in (*sent, signal.SIGINT):
        process.send_signal(signum)
    assert process.wait(60) == 130
