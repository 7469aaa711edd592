"""What users of other launchers complain of, each by name, and the failures that issue lists name."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import psutil
import pytest

from instant_ic.cli.main import main
from instant_ic.launch import NodeSpec, outlet, process
from instant_ic.launch import supervisor as supervision
from instant_ic.launch.outlet import LogFile, Outlet
from instant_ic.launch.process import ManagedProcess, RespawnLimit, State
from instant_ic.launch.rundir import stack_lock
from instant_ic.launch.supervisor import STOP_SCHEDULE, Supervisor

SLEEPER = "import time; print('ready', flush=True); time.sleep(600)"


class Beats:
    """Heartbeats as a test wants them: ``beating`` names the nodes that go on sending them."""

    def __init__(self) -> None:
        self.beating: set[str] = set()
        self.seen: dict[tuple[str, int], float] = {}

    def poll(self) -> None:
        pass

    def beat_s(self, spec: NodeSpec, pid: int) -> float | None:
        if spec.name in self.beating:
            self.seen[spec.name, pid] = time.monotonic()
        return self.seen.get((spec.name, pid))

    def close(self) -> None:
        pass


class Recorder:
    """Keeps what is said, and calls ``act`` in each round; gives up after a minute."""

    def __init__(self, act: Callable[["Recorder", dict[str, ManagedProcess]], bool] = lambda *_: False) -> None:
        self.lines: list[tuple[str, str]] = []
        self.events: list[str] = []
        self.act = act
        self.supervisor: Supervisor | None = None
        self.limit_s = time.monotonic() + 60
        self.timed_out = False

    def node_line(self, node: str, text: str) -> None:
        self.lines.append((node, text))

    def event(self, text: str, bad: bool = False) -> None:
        self.events.append(text)

    def refresh(self, processes: Sequence[ManagedProcess]) -> None:
        assert self.supervisor is not None
        self.timed_out = time.monotonic() > self.limit_s
        if self.timed_out or self.act(self, {p.spec.name: p for p in processes}):
            self.supervisor.request_stop()

    def stopping(self) -> None:
        pass

    def said(self, node: str, text: str) -> bool:
        return (node, text) in self.lines


@pytest.fixture
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("r")
    (folder / "log").mkdir()
    return folder


def program(name: str, code: str, **options: object) -> NodeSpec:
    return NodeSpec(name, name, (sys.executable, "-c", textwrap.dedent(code)), **options)  # type: ignore[arg-type]


def supervise(run_dir: Path, nodes: list[NodeSpec], output: Recorder, **options: object) -> int:
    output.supervisor = Supervisor(nodes, run_dir, output, **options)  # type: ignore[arg-type]
    status = output.supervisor.run()
    assert not output.timed_out, output.events
    return status


def gone(pid: int, within_s: float = 20.0) -> bool:
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        if not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE:
            return True
        time.sleep(0.02)
    return False


# -- nothing is left behind ----------------------------------------------------------------------

FORKING = f"""
import subprocess, sys
code = {SLEEPER!r}
child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
daemon = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, start_new_session=True)
for started in (child, daemon):
    started.stdout.readline()
import os
print("pids", os.getpid(), child.pid, daemon.pid, flush=True)
import time
time.sleep(600)
"""


def test_launch_545_632_666_no_orphans_when_the_launcher_is_killed(run_dir: Path) -> None:
    """Not even of a node's children, nor of those that have made a session of their own."""
    launcher = f"""
import pathlib, sys
from instant_ic.launch import NodeSpec
from instant_ic.launch.supervisor import Supervisor
class Output:
    def node_line(self, node, text): print(text, flush=True)
    def event(self, text, bad=False): pass
    def refresh(self, processes): pass
    def stopping(self): pass
node = NodeSpec("forker", "forker", (sys.executable, "-c", {FORKING!r}))
Supervisor([node], pathlib.Path({str(run_dir)!r}), Output()).run()
"""
    launched = subprocess.Popen([sys.executable, "-c", launcher], stdout=subprocess.PIPE, text=True)
    assert launched.stdout is not None
    try:
        pids = [int(word) for word in launched.stdout.readline().split()[1:]]
        assert len(pids) == 3 and os.getsid(pids[2]) == pids[2]
        reapers = [c.pid for c in psutil.Process(launched.pid).children() if "reaper.py" in " ".join(c.cmdline())]
        launched.kill()
        launched.wait(timeout=10)
        assert all(gone(pid) for pid in pids)
        assert len(reapers) == 1 and gone(reapers[0])  # nor of the launcher's own helper
    finally:
        launched.kill()
        launched.stdout.close()


def test_a_node_that_forks_leaves_nothing_at_the_end_of_the_stack(run_dir: Path) -> None:
    output = Recorder(lambda self, _: any(text.startswith("pids") for _, text in self.lines))
    assert supervise(run_dir, [program("forker", FORKING)], output) == 0
    pids = [int(word) for word in output.lines[0][1].split()[1:]]
    assert all(gone(pid) for pid in pids)
    assert any(f"killed a process that a node left behind: {pids[2]}" in event for event in output.events)


def test_children_of_a_node_that_crashed_are_gone_before_it_starts_again(run_dir: Path) -> None:
    """A daemon that still holds the serial port would make the next start fail."""
    code = FORKING.removesuffix("time.sleep(600)\n") + "os.abort()\n"

    def second_start(self: Recorder, _: object) -> bool:
        return len([text for _, text in self.lines if text.startswith("pids")]) == 2

    output = Recorder(second_start)
    supervise(run_dir, [program("forker", code, respawn=True, respawn_delay_s=0.1)], output)
    first = [int(word) for word in next(text for _, text in output.lines if text.startswith("pids")).split()[1:]]
    assert any(f"killed a process that forker left behind: {first[2]}" in event for event in output.events)
    assert all(gone(pid, 0.5) for pid in first)


def test_dora_2152_a_node_that_does_not_exit_is_killed(run_dir: Path) -> None:
    code = f"import signal\nfor s in (2, 15): signal.signal(s, signal.SIG_IGN)\n{SLEEPER}"
    output = Recorder(lambda self, _: self.said("stays", "ready"))
    schedule = [(signum, 0.2 if signum is not signal.SIGKILL else 20.0) for signum, _ in STOP_SCHEDULE]
    assert supervise(run_dir, [program("stays", code)], output, stop_schedule=schedule) == 0
    assert [event for event in output.events if event.startswith("SIG")] == ["SIGTERM to stays", "SIGKILL to stays"]


def test_a_node_may_be_given_more_time_to_end(run_dir: Path) -> None:
    """As ROS 2's sigterm_timeout: a recorder that closes a large file."""
    code = """
    import signal, sys, time
    signal.signal(signal.SIGINT, lambda *_: (time.sleep(1.0), print("closed", flush=True), sys.exit(0)))
    print("ready", flush=True)
    time.sleep(600)
    """
    output = Recorder(lambda self, _: self.said("slow", "ready"))
    schedule = [(signum, 0.1) for signum, _ in STOP_SCHEDULE]
    node = program("slow", code, sigterm_timeout_s=30.0)
    assert supervise(run_dir, [node], output, stop_schedule=schedule) == 0
    assert output.said("slow", "closed") and not any(event.startswith("SIG") for event in output.events)


# -- a node that hangs ---------------------------------------------------------------------------


def test_a_node_that_hangs_is_told_killed_and_started_again_with_its_stack_in_the_log(run_dir: Path) -> None:
    code = "import time\ndef stuck_here():\n    print('ready', flush=True)\n    time.sleep(600)\nstuck_here()"
    beats = Beats()
    stopped: list[int] = []

    def act(self: Recorder, processes: dict[str, ManagedProcess]) -> bool:
        node = processes["stuck"]
        if self.said("stuck", "ready") and not stopped:
            assert node.pid is not None
            beats.beat_s(node.spec, node.pid)
            if beats.beating:  # it has sent a heartbeat, and is stopped as by a debugger that went away
                os.kill(node.pid, signal.SIGSTOP)
                stopped.append(node.pid)
                beats.beating.clear()
            else:
                beats.beating.add("stuck")
        return self.lines.count(("stuck", "ready")) == 2

    output = Recorder(act)
    node = program("stuck", code, respawn=True, respawn_delay_s=0.1, hang_timeout_s=0.5)
    assert supervise(run_dir, [node, program("other", SLEEPER)], output, make_health=lambda: beats) == 0
    assert any(event.startswith("stuck hangs: no heartbeat for ") for event in output.events)
    assert "SIGABRT to stuck" in output.events and "SIGKILL to stuck" not in output.events
    assert any("stuck ended (hangs: no heartbeat for" in e and "restarts in 0.1 s" in e for e in output.events)
    log = (run_dir / "log" / "stuck.log").read_text()
    assert "Fatal Python error: Aborted" in log and "in stuck_here" in log


def test_a_required_node_that_hangs_ends_the_stack_with_1(run_dir: Path) -> None:
    beats = Beats()
    beats.beating.add("vital")

    def act(self: Recorder, processes: dict[str, ManagedProcess]) -> bool:
        if self.said("vital", "ready") and beats.seen:
            beats.beating.clear()
        return False

    output = Recorder(act)
    node = program("vital", SLEEPER, required=True, hang_timeout_s=0.3)
    assert supervise(run_dir, [node], output, make_health=lambda: beats) == 1
    assert any("vital ended (hangs" in event and "it is required" in event for event in output.events)


def test_a_node_that_never_sent_a_heartbeat_or_has_no_time_out_is_left_alone(run_dir: Path) -> None:
    beats = Beats()
    beats.beating.add("patient")
    started_s = time.monotonic()

    def act(self: Recorder, processes: dict[str, ManagedProcess]) -> bool:
        beats.beating.discard("patient" if beats.seen else "")
        return time.monotonic() - started_s > 1.5

    output = Recorder(act)
    nodes = [program("young", SLEEPER, hang_timeout_s=0.2), program("patient", SLEEPER, hang_timeout_s=0.0)]
    assert supervise(run_dir, nodes, output, make_health=lambda: beats) == 0
    assert beats.seen and output.events == ["stopping 2 nodes"]


def test_a_node_that_computes_is_given_more_time(run_dir: Path) -> None:
    """A compiler at its first picture holds the node's thread for longer than a heartbeat."""
    beats = Beats()
    beats.beating.add("compiler")
    code = "print('ready', flush=True)\nwhile True: pass"

    def act(self: Recorder, processes: dict[str, ManagedProcess]) -> bool:
        if self.said("compiler", "ready") and beats.seen:
            beats.beating.clear()
        return False

    output = Recorder(act)
    node = program("compiler", code, required=True, hang_timeout_s=0.5)
    started_s = time.monotonic()
    assert supervise(run_dir, [node], output, make_health=lambda: beats) == 1
    assert "but it is computing; it will be killed after 3 s" in output.events[0]
    assert "hangs: no heartbeat for 3 s" in output.events[1] and time.monotonic() - started_s > 3.0


def test_a_node_that_waits_for_a_cpu_is_busy_before_the_kernel_has_counted_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel adds a wait when it ends: on a loaded machine a starved node was killed as one that hangs."""
    monkeypatch.setattr(supervision, "_active_s", lambda pid: 0.0)
    silence = supervision._Silence()
    silence.look(1.0, os.getpid(), 0.1)
    silence.look(1.0, os.getpid(), 0.5)
    assert silence.busy(os.getpid())
    with subprocess.Popen(["sleep", "60"]) as sleeper:
        try:
            deadline_s = time.monotonic() + 60
            while silence.busy(sleeper.pid):  # it is still starting
                assert time.monotonic() < deadline_s
                time.sleep(0.01)
        finally:
            sleeper.kill()


def test_a_launcher_that_was_held_up_itself_does_not_blame_the_nodes() -> None:
    silence = supervision._Silence()
    silence.look(1.0, os.getpid(), 0.1)
    silence.look(1.0, os.getpid(), 3600.0)  # it was stopped for an hour
    assert silence.lasts_s == 0.5
    silence.look(2.0, os.getpid(), 0.1)
    assert silence.lasts_s == 0.0


def test_respawn_max_retries_counts_in_all() -> None:
    limit = RespawnLimit(0.0, max_retries=2)
    assert [limit.next_delay_s(now) for now in (0.0, 100.0, 200.0)] == [0.0, 0.0, None]
    assert str(limit) == "2 restarts"


# -- output --------------------------------------------------------------------------------------


def test_a_node_that_floods_its_output_holds_up_nobody(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "OUTPUT_BYTES_PER_S", 1 << 16)
    monkeypatch.setattr(process, "_BURST_BYTES", float(1 << 17))
    flood = "line = 'x' * 99\nwhile True:\n    print(line)"
    talker = "import time\nfor i in range(20):\n    print('word', i, flush=True)\n    time.sleep(0.05)\nprint('done')"
    output = Recorder(lambda self, _: self.said("talker", "done"))
    nodes = [program("flood", flood), program("talker", talker)]
    began_s = time.monotonic()
    assert supervise(run_dir, nodes, output) == 0
    # The burst, the rate, a read that exceeds them, and the notes about what is missing.
    most_bytes = (1 << 17) + 1.01 * (1 << 16) * (time.monotonic() - began_s + 1.0)
    assert [text for name, text in output.lines if name == "talker"] == [*(f"word {i}" for i in range(20)), "done"]
    written = (run_dir / "log" / "flood.log").stat().st_size
    assert written < most_bytes
    assert "bytes dropped: more than 65536 a second]" in (run_dir / "log" / "flood.log").read_text()


def test_a_terminal_that_takes_nothing_does_not_hold_up_the_launcher() -> None:
    """Ctrl-S, or a dead ssh connection: who waits for it would let the nodes' pipes fill, and the nodes stand still."""
    held, done = threading.Event(), threading.Event()
    outlet = Outlet("terminal", limit=10)
    outlet.put(lambda: (held.wait(240), None)[1])
    taken = [outlet.put(lambda: None) for _ in range(1000)]
    assert not held.is_set()  # nobody waited for the terminal
    assert 9 <= sum(taken) <= 10
    assert outlet.put(done.set, always=True)  # the few words that matter
    assert not outlet.close(timeout_s=0.05)
    held.set()
    assert outlet.close(timeout_s=30) and done.is_set()


def test_a_stack_whose_terminal_takes_nothing_runs_on_and_ends_when_it_is_asked_to(tmp_path: Path) -> None:
    flood = "while :; do echo xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx; done"
    file = launch_file(
        tmp_path,
        f"""launch:
- executable: {{cmd: "{flood}", shell: true, name: flood}}
- executable: {{cmd: "i=0; while :; do i=\\\\$((i+1)); echo line $i; sleep 0.05; done", shell: true, name: talker}}
""",
    )
    log = tmp_path / "r" / "log" / "talker.log"
    command = [sys.executable, "-m", "instant_ic.cli.main", "launch", file, "--run-dir", str(tmp_path / "r"), "--plain"]
    launched = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    try:
        assert launched.stdout is not None
        assert launched.stdout.read(1000)  # it has begun; from now on nobody reads
        limit_s = time.monotonic() + 60
        while not log.exists() or "line 60" not in log.read_text():  # 3 s after the pipe to the terminal is full
            assert time.monotonic() < limit_s
            time.sleep(0.05)
        launched.send_signal(signal.SIGINT)
        assert launched.wait(30) == 0
    finally:
        launched.kill()
        launched.wait()
        launched.stdout.close()


def test_a_stack_goes_on_and_ends_well_when_the_reader_of_its_output_has_gone(tmp_path: Path) -> None:
    """As in ``ic launch ... | head -1``."""
    talk = "while :; do echo tick; sleep 0.02; done"
    file = launch_file(tmp_path, f"launch:\n- executable: {{cmd: '{talk}', shell: true, name: talker}}\n")
    log = tmp_path / "r" / "log" / "talker.log"
    command = [sys.executable, "-m", "instant_ic.cli.main", "launch", file, "--run-dir", str(tmp_path / "r"), "--plain"]
    launched = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        assert launched.stdout is not None
        assert b"1 node of" in launched.stdout.readline()
        launched.stdout.close()
        limit_s = time.monotonic() + 60
        while not log.exists() or log.stat().st_size < 500:
            assert time.monotonic() < limit_s and launched.poll() is None
            time.sleep(0.05)
        launched.send_signal(signal.SIGINT)
        _, errors = launched.communicate(timeout=30)
        assert launched.returncode == 0 and errors == b""
    finally:
        launched.kill()
        launched.wait()


def test_output_whose_reader_has_gone_is_given_up_and_the_stack_goes_on() -> None:
    def broken() -> None:
        raise BrokenPipeError(32, "Broken pipe")

    outlet = Outlet("terminal", limit=10)
    outlet.put(broken)
    assert outlet.close(30)
    assert isinstance(outlet.broken, BrokenPipeError) and not outlet.put(lambda: None)


def test_full_disk_for_a_log_is_told_once_and_what_is_missing_is_noted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    path = tmp_path / "node.log"
    log = LogFile(path, told.append)
    with monkeypatch.context() as full_disk:
        path.write_bytes(b"")
        full_disk.setattr(outlet, "open_file", lambda path, flags: os.open("/dev/full", os.O_WRONLY))
        for _ in range(3):
            log.write(b"lost line\n")
    assert told == [f"{path} cannot be written (No space left on device); its lines are lost until there is space"]
    log._next_try_s = 0.0
    log.write(b"kept line\n")
    assert told[1] == f"{path} can be written again; 30 bytes are missing in it"
    log.close()
    assert path.read_text() == "[launch: 30 bytes are missing here: writing failed]\nkept line\n"


def test_a_log_folder_that_cannot_be_written_does_not_keep_the_node_from_running(run_dir: Path) -> None:
    (run_dir / "log").rmdir()
    (run_dir / "log").write_text("a file where the folder should be")
    output = Recorder(lambda self, _: self.said("talker", "ready"))
    assert supervise(run_dir, [program("talker", SLEEPER)], output) == 0
    assert any("talker.log cannot be written" in event for event in output.events)


def test_a_log_that_grows_without_end_is_cut_into_two(tmp_path: Path) -> None:
    log = LogFile(tmp_path / "node.log", lambda text: None, max_bytes=100)
    for number in range(25):
        log.write(f"line {number:4d}\n".encode())  # ten bytes each
    log.close()
    assert (tmp_path / "node.log").read_text().split("\n")[0] == "line   20"
    assert (tmp_path / "node.log.1").stat().st_size == 100


# -- run directory -------------------------------------------------------------------------------


def launch_file(folder: Path, text: str) -> str:
    file = folder / "stack.yaml"
    file.write_text(text)
    return str(file)


def test_unwritable_run_directory_is_told_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = launch_file(tmp_path, "launch:\n- executable: {cmd: touch started, cwd: " + str(tmp_path) + "}\n")
    (tmp_path / "taken").write_text("a file")
    for folder in (tmp_path / "taken" / "r", Path("/proc/r")):
        assert main(["launch", file, "--run-dir", str(folder)]) == 1
        told = capsys.readouterr().err
        assert f"run directory {folder} cannot be used" in told and "set INSTANT_IC_RUN_DIR to another" in told
    assert not (tmp_path / "started").exists()


def test_two_stacks_in_one_run_directory_also_where_it_is_a_groups(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    group = "launch:\n- group: {run_dir: left, launch: [{executable: {cmd: touch started}}]}\n"
    file = launch_file(tmp_path, group)
    (tmp_path / "r" / "left").mkdir(parents=True)
    for held in (tmp_path / "r", tmp_path / "r" / "left"):
        with stack_lock(held, "sim.yaml"):
            assert main(["launch", file, "--run-dir", str(tmp_path / "r")]) == 1
        assert f"a stack already runs in {held} (pid {os.getpid()}, sim.yaml)" in capsys.readouterr().err


# -- the whole launcher --------------------------------------------------------------------------


def test_timer_log_shutdown_and_executables(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = launch_file(
        tmp_path,
        """launch:
- log: {message: begins}
- executable: {cmd: "sh -c 'echo $COLOUR; sleep 600'", name: first, env: [{name: COLOUR, value: red}]}
- timer:
    period: 0.3
    launch:
    - executable: {cmd: "sh -c 'echo later; sleep 600'", name: second}
    - timer: {period: 1.5, launch: [{shutdown: {reason: enough}}]}
""",
    )
    assert main(["launch", file, "--run-dir", str(tmp_path / "r")]) == 0
    lines = [line.strip() for line in capfd.readouterr().out.splitlines()]
    order = ["launch │ begins", "second │ later", "launch │ stopping the stack: enough"]
    assert [line for line in lines if line in order] == order and "first │ red" in lines
    assert (tmp_path / "r" / "log" / "second.log").read_text() == "later\n"


def test_states_of_a_stack_that_has_ended(run_dir: Path) -> None:
    output = Recorder()
    nodes = [program("good", "pass"), program("bad", "raise SystemExit(3)")]
    assert supervise(run_dir, nodes, output) == 1
    assert output.supervisor is not None
    assert [(p.state, p.exit_status) for p in output.supervisor.processes] == [(State.ENDED, 0), (State.FAILED, 3)]


def test_show_args_tells_types_choices_and_what_included_files_keep(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "part.yaml").write_text("launch:\n- arg: {name: speed, default: 3}\n")
    file = launch_file(
        tmp_path,
        """launch:
- arg: {name: port, type: int, default: 80, description: of the page}
- arg: {name: mode, choices: [fast, slow]}
- include: {file: part.yaml}
""",
    )
    assert main(["launch", file, "--show-args"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "arguments of stack.yaml:",
        "  port: int (default: '80')",
        "      of the page",
        "  mode: fast | slow (required)",
        "the included part.yaml keeps its own defaults of: speed '3'",
    ]
