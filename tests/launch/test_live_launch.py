"""The launcher with real nodes: a group's run directory, a node that hangs, a required node that is killed."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from instant_ic.bus import RELIABLE, registry
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.experiments.stack import processes_of
from instant_ic.msg import deserialize

pytestmark = pytest.mark.system

STACK = """
launch:
- node: {exec: ticker_node.py, name: vital, required: true}
- group:
    run_dir: left
    launch:
    - node: {exec: ticker_node.py, name: stuck, respawn: true, respawn_delay: 2, hang_timeout: 2}
"""


class Launched:
    """``ic launch`` with its output in a file."""

    def __init__(self, folder: Path) -> None:
        shutil.copy(Path(__file__).with_name("ticker_node.py"), folder)
        (folder / "stack.yaml").write_text(STACK)
        self.run_dir, self.log = folder / "r", folder / "out"
        with self.log.open("wb") as out:
            self.process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "instant_ic.cli.main",
                    "launch",
                    str(folder / "stack.yaml"),
                    "--plain",
                    "--verbose",
                ],
                env={**os.environ, "INSTANT_IC_RUN_DIR": str(self.run_dir)},
                stdout=out,
                stderr=subprocess.STDOUT,
            )

    def text(self) -> str:
        return self.log.read_text()

    def wait_for(self, condition: Callable[[], Any], what: str, timeout_s: float = 90.0) -> Any:
        deadline = time.monotonic() + timeout_s
        while not (value := condition()):
            assert time.monotonic() < deadline, f"no {what}; the output is:\n{self.text()}"
            time.sleep(0.05)
        return value

    def pid_of(self, name: str, group: str = "") -> int:
        return next((node.pid for node in registry.list_nodes(self.run_dir / group) if node.name == name), 0)


@pytest.fixture
def launched(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Launched]:
    launched = Launched(tmp_path_factory.mktemp("r"))
    yield launched
    if launched.process.poll() is None:
        launched.process.send_signal(signal.SIGINT)
        try:
            launched.process.wait(20)
        except subprocess.TimeoutExpired:
            launched.process.kill()
            launched.process.wait(20)


def test_hang_respawn_groups_and_the_end_by_a_required_node(launched: Launched) -> None:
    launched.wait_for(lambda: "all 2 nodes are up after" in launched.text(), "start")
    first, vital = launched.pid_of("stuck", "left"), launched.pid_of("vital")
    assert first and vital and launched.pid_of("stuck") == 0  # in its own registry only
    transport = LocalTransport(launched.run_dir / "left", "test", time.time_ns)
    try:
        inbox = transport.subscribe("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", RELIABLE, lambda: None)
        seen: set[tuple[int, str, str]] = set()

        def told() -> bool:
            for received in inbox.take():
                for status in deserialize(received.payload, received.type_name).status:
                    seen.add((int(status.level), status.name, status.message))
            return (2, "launch: stuck", "waiting to start") in seen

        os.kill(first, signal.SIGSTOP)
        launched.wait_for(told, "diagnosis of the launcher")
    finally:
        transport.close()
    # The dead one's entry may stand for a moment longer.
    launched.wait_for(lambda: launched.pid_of("stuck", "left") not in (0, first), "new start")
    second = launched.pid_of("stuck", "left")
    assert not psutil.pid_exists(first)
    assert "left/stuck hangs: no heartbeat for 2 s" in launched.text()
    assert "left/stuck ended (hangs: no heartbeat for 2 s); restarts in 2.0 s (1 of 5)" in launched.text()
    assert "Fatal Python error: Aborted" in (launched.run_dir / "left" / "log" / "stuck.log").read_text()
    launched.wait_for(lambda: "running" in launched.text().rpartition("restarts in")[2], "second start's first words")
    os.kill(vital, signal.SIGKILL)
    assert launched.process.wait(30) == 1
    assert "vital ended (killed by SIGKILL); it is required, so the stack ends" in launched.text()
    assert not psutil.pid_exists(second)
    assert registry.list_nodes(launched.run_dir) == [] == registry.list_nodes(launched.run_dir / "left")


PROGRAM = """
import signal, sys
from pathlib import Path
from instant_ic.experiments.stack import Stack
with Stack("stack.yaml", Path(sys.argv[1]), {}):
    print("started", flush=True)
    signal.pause()
"""


def test_a_stack_goes_with_the_program_that_started_it_also_when_that_is_killed(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    folder = tmp_path_factory.mktemp("r")
    shutil.copy(Path(__file__).with_name("ticker_node.py"), folder)
    (folder / "stack.yaml").write_text("launch:\n- node: {exec: ticker_node.py, name: ticker}\n")
    run_dir = folder / "r"
    # By file: a pipe would be held open by what is left, and reading it to its end would hang.
    with (folder / "out").open("wb") as out:
        program = subprocess.Popen([sys.executable, "-c", PROGRAM, str(run_dir)], cwd=folder, stdout=out, stderr=out)
    deadline = time.monotonic() + 90
    try:
        while not registry.list_nodes(run_dir):
            assert program.poll() is None and time.monotonic() < deadline, (folder / "out").read_text()
            time.sleep(0.05)
        assert len(processes_of(run_dir)) >= 2  # launcher and node
        program.kill()
        program.wait(30)
        while left := processes_of(run_dir):
            assert time.monotonic() < deadline, [process.cmdline() for process in left]
            time.sleep(0.05)
    finally:
        program.kill()
        for process in processes_of(run_dir):
            process.kill()
