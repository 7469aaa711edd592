"""Supervision with real processes: small Python programs that say when they are ready."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import psutil
import pytest

from instant_ic.launch import NodeSpec
from instant_ic.launch.process import ManagedProcess, RespawnLimit
from instant_ic.launch.rundir import StackRunningError, stack_lock
from instant_ic.launch.supervisor import STOP_SCHEDULE, Supervisor

IGNORES = """
import signal, time
for s in {signals}:
    signal.signal(s, signal.SIG_IGN)
print("ready", flush=True)
time.sleep(600)
"""


class Lines:
    """An output that remembers, and stops the supervisor once ``until`` holds."""

    def __init__(self, until: Callable[["Lines"], bool] = lambda lines: False) -> None:
        self.lines: list[tuple[str, str]] = []
        self.events: list[str] = []
        self.until = until
        self.supervisor: Supervisor | None = None
        self.limit_s = time.monotonic() + 60

    def node_line(self, node: str, text: str) -> None:
        self.lines.append((node, text))

    def event(self, text: str, bad: bool = False) -> None:
        self.events.append(text)

    def refresh(self, processes: Sequence[ManagedProcess]) -> None:
        if self.supervisor is not None and (self.until(self) or time.monotonic() > self.limit_s):
            self.supervisor.request_stop()

    def stopping(self) -> None:
        pass

    def of(self, node: str) -> list[str]:
        return [text for name, text in self.lines if name == node]


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    (tmp_path / "run" / "log").mkdir(parents=True)
    return tmp_path / "run"


def program(name: str, code: str, **options: object) -> NodeSpec:
    return NodeSpec(name, name, (sys.executable, "-c", textwrap.dedent(code)), **options)  # type: ignore[arg-type]


def supervise(
    run_dir: Path,
    nodes: list[NodeSpec],
    output: Lines,
    ignored: Sequence[signal.Signals] = (),
) -> int:
    """Runs nodes; signals that are known to be ignored are waited for shortly, the others as long as it takes."""
    schedule = [(signum, 0.3 if signum in ignored else 20.0) for signum, _ in STOP_SCHEDULE]
    supervisor = Supervisor(nodes, run_dir, output, schedule)
    output.supervisor = supervisor
    return supervisor.run()


def gone(pid: int, within_s: float = 10.0) -> bool:
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        if not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE:
            return True
        time.sleep(0.02)
    return False


def test_output_goes_to_the_log_and_the_terminal(run_dir: Path) -> None:
    output = Lines()
    code = "import os, sys; print('one'); sys.stderr.write('two\\nno end'); print(os.environ['COLOUR'])"
    status = supervise(run_dir, [program("talker", code, env={"COLOUR": "red"})], output)
    assert status == 0
    assert output.of("talker") == ["one", "two", "no endred"]
    assert (run_dir / "log" / "talker.log").read_text() == "one\ntwo\nno endred\n"


def test_respawn_with_growing_wait_until_given_up(run_dir: Path) -> None:
    output = Lines()
    node = program("crasher", "print('here'); raise SystemExit(3)", respawn=True, respawn_delay_s=0.01)
    assert supervise(run_dir, [node], output) == 1
    assert output.of("crasher") == ["here"] * 6  # the first start and five more
    assert [event.split(";")[0] for event in output.events[:5]] == ["crasher ended (exit status 3)"] * 5
    assert "given up" in output.events[5]


def test_wrong_parameters_end_the_stack_at_once(run_dir: Path) -> None:
    output = Lines()
    node = program("misfit", "raise SystemExit(2)", respawn=True)
    assert supervise(run_dir, [node], output) == 1
    assert "its parameters are wrong, so the stack ends" in output.events[0]


def test_respawn_limit_doubles_and_forgets() -> None:
    limit = RespawnLimit(delay_s=1.0)
    # 1, 2, 4, 8, then 16 cut to 15; the sixth within the window is refused; at 61.5 s the first two are forgotten.
    assert [limit.next_delay_s(now) for now in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)] == [1.0, 2.0, 4.0, 8.0, 15.0, None]
    assert limit.next_delay_s(61.5) == 8.0


def test_required_node_that_fails_ends_the_stack(run_dir: Path) -> None:
    output = Lines()
    # It fails only once the other has said that it is up, so there is something to stop.
    flag = run_dir / "up"
    other = program("other", f"import pathlib, time; pathlib.Path({str(flag)!r}).touch(); time.sleep(600)")
    fails = program(
        "vital",
        f"""
        import pathlib, time
        while not pathlib.Path({str(flag)!r}).exists(): time.sleep(0.01)
        raise SystemExit(7)
        """,
        required=True,
    )
    assert supervise(run_dir, [other, fails], output) == 1
    assert any("vital ended (exit status 7); it is required" in event for event in output.events)
    assert "stopping 1 node" in output.events


def test_required_node_that_ends_well_ends_the_stack_well(run_dir: Path) -> None:
    nodes = [program("other", "import time; time.sleep(600)"), program("player", "pass", required=True)]
    assert supervise(run_dir, nodes, Lines()) == 0


def test_failure_of_a_node_that_is_not_required_is_told(run_dir: Path) -> None:
    output = Lines(until=lambda lines: any("bad ended" in event for event in lines.events))
    nodes = [program("other", "import time; time.sleep(600)"), program("bad", "import os; os.abort()")]
    assert supervise(run_dir, nodes, output) == 0
    assert any(f"bad ended (killed by SIGABRT), see {run_dir}/log/bad.log" in event for event in output.events)


def test_program_that_does_not_exist(run_dir: Path) -> None:
    output = Lines()
    assert supervise(run_dir, [NodeSpec("ghost", "ghost", ("/no/such/program",))], output) == 1
    assert "ghost ended (exit status 1)" in output.events[0]
    assert any("FileNotFoundError" in line for line in output.of("ghost"))


@pytest.mark.parametrize(
    ("ignored", "told"),
    [
        ([], []),
        ([signal.SIGINT], ["SIGTERM"]),
        ([signal.SIGINT, signal.SIGTERM], ["SIGTERM", "SIGKILL"]),
    ],
)
def test_stop_gets_stronger_and_takes_the_whole_group(
    run_dir: Path, ignored: list[signal.Signals], told: list[str]
) -> None:
    grandchild = "import time; print('child', flush=True); time.sleep(600)"
    names = "[" + ", ".join(f"signal.{signum.name}" for signum in ignored) + "]"
    code = f"""
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", {grandchild!r}], start_new_session=False)
print("pid", child.pid, flush=True)
{IGNORES.format(signals=names)}
"""
    output = Lines(until=lambda lines: {"ready", "child"} <= set(lines.of("stubborn")))
    spec = NodeSpec("stubborn", "stubborn", (sys.executable, "-c", code))
    assert supervise(run_dir, [spec], output, ignored=ignored) == 0
    assert [event.split()[0] for event in output.events if event.startswith("SIG")] == told
    child_pid = next(int(line.split()[1]) for line in output.of("stubborn") if line.startswith("pid"))
    assert gone(child_pid)


def test_stopping_takes_less_than_five_seconds() -> None:
    assert sum(wait_s for _, wait_s in STOP_SCHEDULE) < 5.0
    assert [signum for signum, _ in STOP_SCHEDULE] == [signal.SIGINT, signal.SIGTERM, signal.SIGKILL]


def test_killed_launcher_leaves_no_orphan(run_dir: Path) -> None:
    launcher = f"""
import pathlib, sys
from instant_ic.launch import NodeSpec
from instant_ic.launch.supervisor import Supervisor
class Output:
    def node_line(self, node, text): print(text, flush=True)
    def event(self, text, bad=False): pass
    def refresh(self, processes): pass
    def stopping(self): pass
code = {("import os; print(os.getpid(), flush=True)" + IGNORES.format(signals="[signal.SIGINT, signal.SIGTERM]"))!r}
nodes = [NodeSpec(name, name, (sys.executable, "-c", code)) for name in ("a", "b")]
Supervisor(nodes, pathlib.Path({str(run_dir)!r}), Output()).run()
"""
    process = subprocess.Popen([sys.executable, "-c", launcher], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    said = [process.stdout.readline().strip() for _ in range(4)]
    pids = [int(line) for line in said if line.isdigit()]
    assert len(pids) == 2 and said.count("ready") == 2
    assert all(os.getsid(pid) == pid for pid in pids)  # each has a session of its own
    process.kill()
    process.wait(timeout=10)
    process.stdout.close()
    assert all(gone(pid) for pid in pids)


def test_second_stack_in_the_run_directory_is_refused(run_dir: Path) -> None:
    with stack_lock(run_dir, "sim.yaml"):
        with pytest.raises(StackRunningError, match=rf"pid {os.getpid()}, sim\.yaml"):
            with stack_lock(run_dir, "other.yaml"):
                pass
    with stack_lock(run_dir, "other.yaml"):
        pass


def test_previous_log_is_kept(run_dir: Path) -> None:
    for word in ("first", "second"):
        supervise(run_dir, [program("talker", f"print({word!r})")], Lines())
    assert (run_dir / "log" / "talker.log").read_text() == "second\n"
    assert (run_dir / "log" / "talker.log.1").read_text() == "first\n"


def test_command_that_the_kernel_cannot_be_given(run_dir: Path) -> None:
    output = Lines()
    assert supervise(run_dir, [NodeSpec("odd", "odd", (sys.executable, "-c", "pass\0"))], output) == 1
    assert "odd cannot be started: embedded null byte" in output.events[0]
