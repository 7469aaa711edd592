"""How a node's process begins and ends."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from instant_ic import launch
from instant_ic.cli.main import main

NODE_MAIN = Path(launch.__file__).with_name("node_main.py")


def run_file(folder: Path, code: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    file = folder / "its_node.py"
    file.write_text(textwrap.dedent(code))
    command = [sys.executable, str(NODE_MAIN), str(file), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(
    ("end", "status", "told"),
    [
        ("sys.exit(2)", 2, ""),
        ("sys.exit('no such port')", 1, "no such port"),
        ("raise ValueError('broken')", 1, "ValueError: broken"),
    ],
)
def test_exit_status_and_last_message_are_the_nodes_own(tmp_path: Path, end: str, status: int, told: str) -> None:
    done = run_file(tmp_path, f"import sys\nprint(sys.argv[1:], __name__)\n{end}\n", "--name", "x")
    assert done.returncode == status
    assert done.stdout == "['--name', 'x'] __main__\n"  # not lost, although the interpreter is not taken down
    assert told in done.stderr
    assert bool(told) == bool(done.stderr)


def test_interpreter_is_not_taken_down(tmp_path: Path) -> None:
    done = run_file(tmp_path, "import atexit\natexit.register(print, 'taken down')\nprint('done')\n")
    assert (done.returncode, done.stdout) == (0, "done\n")


def test_a_signal_while_a_node_is_still_imported_ends_it_quietly(tmp_path: Path) -> None:
    file = tmp_path / "its_node.py"
    file.write_text("import time\nprint('importing', flush=True)\ntime.sleep(60)\n")
    process = subprocess.Popen(
        [sys.executable, str(NODE_MAIN), str(file)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        assert process.stdout is not None and process.stdout.readline() == "importing\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert process.stdout.read() == ""
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_before_the_stack_is_up_ends_the_launcher_with_0(
    monkeypatch: pytest.MonkeyPatch, signum: signal.Signals
) -> None:
    def find(name: str) -> Path:
        os.kill(os.getpid(), signum)
        raise AssertionError("the signal did not end it")

    monkeypatch.setattr("instant_ic.launch.find_launch_file", find)
    here = signal.signal(signum, signal.default_int_handler)  # `nohup make test` ignores the hangup
    try:
        with pytest.raises(SystemExit) as end:
            main(["launch", "sim"])
        assert end.value.code == 0
        assert signal.getsignal(signum) is signal.default_int_handler
    finally:
        signal.signal(signum, here)


SLOW = """
import time
from dataclasses import dataclass
from instant_ic.bus import Node, main

@dataclass(frozen=True)
class Config:
    pass

class Slow(Node[Config]):
    name = "slow"
    def setup(self):
        print("setup", flush=True)
        for _ in range(600):
            time.sleep(0.1)

main(Slow)
"""


def test_a_signal_ends_a_node_that_is_still_compiling_in_its_setup(tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(SLOW)
    process = subprocess.Popen(
        [sys.executable, str(NODE_MAIN), str(tmp_path / "slow.py"), "--run-dir", str(tmp_path / "r")],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None and process.stdout.readline() == "setup\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
    finally:
        process.kill()
