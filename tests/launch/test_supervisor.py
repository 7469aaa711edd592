"""Supervision with real processes: small Python programs that say when they are ready."""

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
from instant_ic.launch import NodeSpec, node_log, process
from instant_ic.launch.app import StackOutput
from instant_ic.launch.hang import HeartbeatSilence
from instant_ic.launch.node_log import NodeLog
from instant_ic.launch.process import ManagedProcess, ProcessState, RespawnLimit
from instant_ic.launch.rundir import StackRunningError, stack_lock
from instant_ic.launch.supervisor import STOP_SCHEDULE, Supervisor

SLEEPER = "import time; print('ready', flush=True); time.sleep(600)"
Act = Callable[["Recorder", dict[str, ManagedProcess]], bool]


class Beats:
    """Heartbeats: ``beating`` names the nodes that go on sending them."""

    def __init__(self, *beating: str) -> None:
        self.beating = set(beating)
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
    """Keeps lines and events, and calls ``act`` in each round, which may ask for the end; gives up after a minute."""

    def __init__(self, act: Act = lambda *_: False) -> None:
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

    def refresh(self, processes: Sequence[ManagedProcess], *_: object) -> None:
        assert self.supervisor is not None
        self.timed_out = time.monotonic() > self.limit_s
        if self.timed_out or self.act(self, {p.spec.name: p for p in processes}):
            self.supervisor.request_stop()

    def of(self, node: str) -> list[str]:
        return [text for name, text in self.lines if name == node]

    def pids(self) -> list[int]:
        """Process ids printed by ``FORKING``."""
        return [int(word) for _, text in self.lines if text.startswith("pids") for word in text.split()[1:]]


def until(node: str, *lines: str) -> Recorder:
    """A recorder that asks for the end once a node has printed these lines."""
    return Recorder(lambda self, _: set(lines) <= set(self.of(node)))


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    (tmp_path / "run" / "log").mkdir(parents=True)
    return tmp_path / "run"


def program(name: str, code: str, **options: object) -> NodeSpec:
    return NodeSpec(name, name, (sys.executable, "-S", "-c", textwrap.dedent(code)), **options)  # type: ignore[arg-type]


def supervise(
    run_dir: Path,
    nodes: list[NodeSpec],
    output: Recorder,
    ignored: Sequence[signal.Signals] = (),
    **options: object,
) -> int:
    """Run nodes; signals that are known to be ignored are waited for shortly, the others as long as it takes."""
    schedule = [(signum, 0.2 if signum in ignored else 20.0) for signum, _ in STOP_SCHEDULE]
    output.supervisor = Supervisor(nodes, run_dir, output, schedule, **options)  # type: ignore[arg-type]
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


# -- starts and ends -----------------------------------------------------------------------------


def test_output_goes_to_the_log_and_the_terminal_and_the_previous_log_is_kept(run_dir: Path) -> None:
    code = "import os, sys; print('one'); sys.stderr.write('two\\nno end'); print(os.environ['COLOUR'])"
    for colour in ("blue", "red"):
        output = Recorder()
        assert supervise(run_dir, [program("talker", code, env={"COLOUR": colour})], output) == 0
        assert output.of("talker") == ["one", "two", f"no end{colour}"]
    assert (run_dir / "log" / "talker.log").read_text() == "one\ntwo\nno endred\n"
    assert (run_dir / "log" / "talker.log.1").read_text() == "one\ntwo\nno endblue\n"


def test_respawn_with_growing_wait_until_given_up(run_dir: Path) -> None:
    output = Recorder()
    code = "import os; os.write(1, b'here\\n'); os._exit(3)"
    node = NodeSpec("crasher", "crasher", (sys.executable, "-I", "-S", "-c", code), respawn=True, respawn_delay_s=0.01)
    assert supervise(run_dir, [node], output) == 1
    assert output.of("crasher") == ["here"] * 6  # the first start and five more
    assert [event.split(";")[0] for event in output.events[:5]] == ["crasher ended (exit status 3)"] * 5
    assert "given up after 5 restarts within 60 s" in output.events[5]


def test_wrong_parameters_end_the_stack_at_once(run_dir: Path) -> None:
    output = Recorder()
    node = program("misfit", "raise SystemExit(2)", respawn=True)
    assert supervise(run_dir, [node], output) == 1
    assert "its parameters are wrong, so the stack ends" in output.events[0]


def test_respawn_limit_doubles_and_forgets() -> None:
    limit = RespawnLimit(delay_s=1.0)
    # 1, 2, 4, 8, then 16 cut to 15; the sixth within the window is refused; at 61.5 s the first two are forgotten.
    assert [limit.next_delay_s(now) for now in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)] == [1.0, 2.0, 4.0, 8.0, 15.0, None]
    assert limit.next_delay_s(61.5) == 8.0


@pytest.mark.parametrize(("code", "status"), [("raise SystemExit(7)", 1), ("pass", 0)])
def test_the_end_of_a_required_node_ends_the_stack(run_dir: Path, code: str, status: int) -> None:
    output = Recorder()
    # It ends only once the other is up, so there is something to stop.
    flag = run_dir / "up"
    other = program("other", f"import pathlib, time; pathlib.Path({str(flag)!r}).touch(); time.sleep(600)")
    wait = f"import pathlib, time\nwhile not pathlib.Path({str(flag)!r}).exists(): time.sleep(0.01)\n"
    assert supervise(run_dir, [other, program("vital", wait + code, required=True)], output) == status
    assert f"vital ended (exit status {7 * status}); it is required, so the stack ends" in output.events[0]
    assert output.events[1] == "stopping 1 node"


def test_states_and_status_of_a_stack_that_has_ended(run_dir: Path) -> None:
    output = Recorder()
    ghost = NodeSpec("ghost", "ghost", ("/no/such/program",))
    odd = NodeSpec("odd", "odd", (sys.executable, "-c", "pass\0"))
    assert supervise(run_dir, [program("good", "pass"), program("bad", "raise SystemExit(3)"), ghost, odd], output) == 1
    assert output.supervisor is not None
    states = [(p.state, p.exit_status) for p in output.supervisor.processes]
    assert states == [(ProcessState.ENDED, 0), *((ProcessState.FAILED, status) for status in (3, 1, 127))]
    assert any("FileNotFoundError" in line for line in output.of("ghost"))
    assert f"bad ended (exit status 3), see {run_dir}/log/bad.log" in output.events
    assert "odd cannot be started: embedded null byte" in output.events


@pytest.mark.parametrize(
    ("ignored", "sent"),
    [
        ([], []),
        ([signal.SIGINT], ["SIGTERM to stubborn"]),
        ([signal.SIGINT, signal.SIGTERM], ["SIGTERM to stubborn", "SIGKILL to stubborn"]),
    ],
)
def test_stop_gets_stronger_and_takes_the_whole_group(
    run_dir: Path, ignored: list[signal.Signals], sent: list[str]
) -> None:
    """dora 2152: a node that does not exit is killed, with its children."""
    grandchild = "import time; print('child', flush=True); time.sleep(600)"
    code = f"""
import signal, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-I", "-S", "-c", {grandchild!r}])
print("pids", child.pid, flush=True)
for s in {[int(signum) for signum in ignored]}:
    signal.signal(s, signal.SIG_IGN)
print("ready", flush=True)
time.sleep(600)
"""
    output = until("stubborn", "ready", "child")
    assert supervise(run_dir, [program("stubborn", code)], output, ignored=ignored) == 0
    assert [event for event in output.events if event.startswith("SIG")] == sent
    assert gone(output.pids()[0])


# -- nothing is left behind ----------------------------------------------------------------------

FORKING = f"""
import os, subprocess, sys, time
code = {SLEEPER!r}
child = subprocess.Popen([sys.executable, "-I", "-S", "-c", code], stdout=subprocess.PIPE)
daemon = subprocess.Popen([sys.executable, "-I", "-S", "-c", code], stdout=subprocess.PIPE, start_new_session=True)
for started in (child, daemon):
    started.stdout.readline()
print("pids", os.getpid(), child.pid, daemon.pid, flush=True)
time.sleep(600)
"""


def test_launch_545_632_666_no_orphans_when_the_launcher_is_killed(run_dir: Path) -> None:
    """Neither a node's children nor those that have made a session of their own survive."""
    launcher = f"""
import pathlib, sys
from instant_ic.launch import NodeSpec
from instant_ic.launch.supervisor import Supervisor
class Output:
    def node_line(self, node, text): print(text, flush=True)
    def event(self, text, bad=False): pass
    def refresh(self, *_): pass
node = NodeSpec("forker", "forker", (sys.executable, "-c", {FORKING!r}))
Supervisor([node], pathlib.Path({str(run_dir)!r}), Output()).run()
"""
    launched = subprocess.Popen([sys.executable, "-c", launcher], stdout=subprocess.PIPE, text=True)
    assert launched.stdout is not None
    try:
        pids = [int(word) for word in launched.stdout.readline().split()[1:]]
        assert len(pids) == 3 and os.getsid(pids[0]) == pids[0] and os.getsid(pids[2]) == pids[2]
        reapers = [c.pid for c in psutil.Process(launched.pid).children() if "reaper.py" in " ".join(c.cmdline())]
        launched.kill()
        launched.wait(timeout=10)
        assert all(gone(pid) for pid in pids)
        assert len(reapers) == 1 and gone(reapers[0])  # nor of the launcher's own helper
    finally:
        launched.kill()
        launched.stdout.close()


def test_a_node_that_forks_leaves_nothing_at_its_crash_and_at_the_end_of_the_stack(run_dir: Path) -> None:
    """A daemon that still holds the serial port would make the next start fail."""
    flag = run_dir / "crashed"
    crash = f"import pathlib\nflag = pathlib.Path({str(flag)!r})\nif not flag.exists(): flag.touch(); os.abort()\n"
    code = FORKING.removesuffix("time.sleep(600)\n") + crash + "time.sleep(600)\n"
    output = Recorder(lambda self, _: len(self.pids()) == 6)
    supervise(run_dir, [program("forker", code, respawn=True, respawn_delay_s=0.01)], output)
    pids = output.pids()
    assert any(f"killed a process that forker left behind: {pids[2]}" in event for event in output.events)
    assert any(f"killed a process that a node left behind: {pids[5]}" in event for event in output.events)
    assert all(gone(pid, 0.5) for pid in pids)


# -- a node that hangs ---------------------------------------------------------------------------


def test_a_node_that_hangs_is_killed_and_started_again_with_its_stack_in_the_log(run_dir: Path) -> None:
    code = "import time\ndef stuck_here():\n    print('ready', flush=True)\n    time.sleep(600)\nstuck_here()"
    beats = Beats()
    stopped: list[int] = []

    def act(self: Recorder, processes: dict[str, ManagedProcess]) -> bool:
        node = processes["stuck"]
        if "ready" in self.of("stuck") and not stopped:
            assert node.pid is not None
            beats.beat_s(node.spec, node.pid)
            if beats.beating:  # it has sent a heartbeat, and is stopped as by a debugger that went away
                os.kill(node.pid, signal.SIGSTOP)
                stopped.append(node.pid)
                beats.beating.clear()
            else:
                beats.beating.add("stuck")
        return len(self.of("stuck")) > 1 and self.of("stuck")[-1] == "ready"

    output = Recorder(act)
    node = program("stuck", code, respawn=True, respawn_delay_s=0.01, hang_timeout_s=0.3)
    assert supervise(run_dir, [node, program("other", SLEEPER)], output, make_health=lambda: beats) == 0
    assert any(event.startswith("stuck hangs: no heartbeat for ") for event in output.events)
    assert "SIGABRT to stuck" in output.events and "SIGKILL to stuck" not in output.events
    assert any("stuck ended (hangs: no heartbeat for" in e and "restarts in 0.0 s" in e for e in output.events)
    log = (run_dir / "log" / "stuck.log").read_text()
    assert "Fatal Python error: Aborted" in log and "in stuck_here" in log


def test_a_required_node_that_hangs_ends_the_stack_one_that_never_sent_a_heartbeat_does_not(run_dir: Path) -> None:
    beats = Beats("vital", "patient")

    def act(self: Recorder, processes: dict[str, ManagedProcess]) -> bool:
        if self.of("vital") and len(beats.seen) == 2:
            beats.beating.clear()
        return False

    output = Recorder(act)
    nodes = [
        program("vital", SLEEPER, required=True, hang_timeout_s=0.6),
        program("young", SLEEPER, hang_timeout_s=0.1),
        program("patient", SLEEPER, hang_timeout_s=0.0),
    ]
    assert supervise(run_dir, nodes, output, make_health=lambda: beats) == 1
    assert any("vital ended (hangs" in event and "it is required" in event for event in output.events)
    assert not any("young" in event or "patient" in event for event in output.events)


def test_a_node_that_computes_is_given_more_time(run_dir: Path) -> None:
    """A compiler at its first image holds the node's thread for longer than a heartbeat."""
    beats = Beats("compiler")

    def act(self: Recorder, processes: dict[str, ManagedProcess]) -> bool:
        if self.of("compiler") and beats.seen:
            beats.beating.clear()
        return False

    output = Recorder(act)
    node = program("compiler", "print('ready', flush=True)\nwhile True: pass", required=True, hang_timeout_s=0.25)
    assert supervise(run_dir, [node], output, make_health=lambda: beats) == 1
    assert "but it is computing; it will be killed after 2 s" in output.events[0]
    assert "hangs: no heartbeat for 2 s" in output.events[1]


def test_a_node_that_waits_for_a_cpu_is_busy_before_the_kernel_has_counted_it() -> None:
    """The kernel adds a wait when it ends: on a loaded machine a starved node was killed as one that hangs."""
    silence = HeartbeatSilence(active_s=lambda pid: 0.0)
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
    silence = HeartbeatSilence()
    silence.look(1.0, os.getpid(), 0.1)
    silence.look(1.0, os.getpid(), 3600.0)  # it was stopped for an hour
    assert silence.lasts_s == 0.5
    silence.look(2.0, os.getpid(), 0.1)
    assert silence.lasts_s == 0.0


# -- output --------------------------------------------------------------------------------------


def test_a_node_that_floods_its_output_holds_up_nobody(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "OUTPUT_BYTES_PER_S", 1 << 15)
    flood = "line = 'x' * 99\nwhile True:\n    print(line)"
    talker = "import time\nfor i in range(20):\n    print('word', i, flush=True)\n    time.sleep(0.05)\nprint('done')"
    output = until("talker", "done")
    began_s = time.monotonic()
    assert supervise(run_dir, [program("flood", flood), program("talker", talker)], output) == 0
    # The burst, the rate, a read that exceeds them, and the notes about what is missing.
    most_bytes = (1 << 17) + 1.01 * (1 << 15) * (time.monotonic() - began_s + 1.0) + (1 << 16)
    assert output.of("talker") == [*(f"word {i}" for i in range(20)), "done"]
    assert (run_dir / "log" / "flood.log").stat().st_size < most_bytes
    assert "bytes dropped: more than 32768 a second]" in (run_dir / "log" / "flood.log").read_text()


def test_output_whose_reader_has_gone_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """``ic launch sim | head``: the stack goes on, and the launcher ends without an error."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        output = StackOutput(["talker"], live=False, verbose=True)
        for _ in range(3):
            output.event("one")
            output.node_line("talker", "two")
        output.close(status=0)


def test_a_stack_runs_on_and_ends_well_while_its_terminal_takes_nothing(tmp_path: Path) -> None:
    (tmp_path / "flood.py").write_text("while True: print(99 * 'x')\n")
    (tmp_path / "talker.py").write_text(
        "import itertools, time\nfor i in itertools.count(): print('line', i, flush=True); time.sleep(0.02)\n"
    )
    file = tmp_path / "stack.yaml"
    file.write_text("launch:\n- node: {exec: talker.py}\n- node: {exec: flood.py}\n")
    log = tmp_path / "r" / "log" / "talker.log"
    command = [sys.executable, "-m", "instant_ic.cli.main", "launch", file, "--run-dir", str(tmp_path / "r"), "--plain"]
    launched = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        assert launched.stdout is not None
        assert launched.stdout.readline()  # it has begun; from now on nobody reads
        limit_s = time.monotonic() + 60
        while not log.exists() or "line 30" not in log.read_text():  # the pipe to the terminal is full
            assert time.monotonic() < limit_s and launched.poll() is None
            time.sleep(0.05)
        launched.send_signal(signal.SIGINT)
        assert launched.wait(30) == 0
        assert not (tmp_path / "r" / "run.json").exists()  # a clean end: the next start is not stopped
    finally:
        launched.kill()
        launched.wait()
        for pipe in (launched.stdout, launched.stderr):
            assert pipe is not None
            pipe.close()


def test_full_disk_for_a_log_is_reported_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[str] = []
    path = tmp_path / "node.log"
    log = NodeLog(path, reports.append)
    with monkeypatch.context() as full_disk:
        path.write_bytes(b"")
        full_disk.setattr(node_log, "open_file", lambda path, flags: os.open("/dev/full", os.O_WRONLY))
        for _ in range(3):
            log.write(b"lost line\n")
    [report] = reports
    assert report.startswith(f"{path} cannot be written (No space left on device)")
    log.write(b"kept line\n")
    log.close()
    assert len(reports) == 1 and path.read_text() == "kept line\n"


def test_a_log_is_not_closed_while_another_thread_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that outlives its node holds the old pipe: its end must not end the output of the new run."""
    reader, writer = os.pipe()
    (tmp_path / "node.log").write_bytes(b"")
    monkeypatch.setattr(node_log, "open_file", lambda path, flags: writer)
    log = NodeLog(tmp_path / "node.log", lambda text: None)
    (tmp_path / "node.log").write_bytes(b"")
    threads = [threading.Thread(target=log.write, args=(bytes(1 << 20),)), threading.Thread(target=log.close)]
    threads[0].start()
    with os.fdopen(reader, "rb") as pipe:
        pipe.read(1)  # the write has begun, and the pipe is full
        threads[1].start()
        threads[1].join(0.1)
        assert threads[1].is_alive()
        assert len(pipe.read()) == (1 << 20) - 1
    for thread in threads:
        thread.join()


def test_a_log_folder_that_cannot_be_written_does_not_keep_the_node_from_running(run_dir: Path) -> None:
    (run_dir / "log").rmdir()
    (run_dir / "log").write_text("a file where the folder should be")
    output = until("talker", "ready")
    assert supervise(run_dir, [program("talker", SLEEPER)], output) == 0
    assert any("talker.log cannot be written" in event for event in output.events)


def test_a_log_that_grows_without_end_is_cut_into_two(tmp_path: Path) -> None:
    log = NodeLog(tmp_path / "node.log", lambda text: None, max_bytes=100)
    for number in range(25):
        log.write(f"line {number:4d}\n".encode())  # ten bytes each
    log.close()
    assert (tmp_path / "node.log").read_text().split("\n")[0] == "line   20"
    assert (tmp_path / "node.log.1").stat().st_size == 100


# -- run directory -------------------------------------------------------------------------------


def test_second_stack_in_the_run_directory_is_refused(run_dir: Path) -> None:
    with stack_lock(run_dir, "sim.yaml"):
        with pytest.raises(StackRunningError, match=rf"pid {os.getpid()}, sim\.yaml"):
            with stack_lock(run_dir, "other.yaml"):
                pass
    with stack_lock(run_dir, "other.yaml"):
        pass


def test_a_run_directory_that_cannot_be_used_is_reported_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    started = tmp_path / "started"
    (tmp_path / "toucher.py").write_text(f"open({str(started)!r}, 'w')\n")
    file = tmp_path / "stack.yaml"
    file.write_text("launch:\n- group: {run_dir: left, launch: [{node: {exec: toucher.py}}]}\n")
    (tmp_path / "taken").write_text("a file")
    for folder in (tmp_path / "taken" / "r", Path("/proc/r")):
        assert main(["launch", str(file), "--run-dir", str(folder)]) == 1
        error = capsys.readouterr().err
        assert f"run directory {folder} cannot be used" in error and "set INSTANT_IC_RUN_DIR to another" in error
    (tmp_path / "r" / "left").mkdir(parents=True)
    for held in (tmp_path / "r", tmp_path / "r" / "left"):
        with stack_lock(held, "sim.yaml"):
            assert main(["launch", str(file), "--run-dir", str(tmp_path / "r")]) == 1
        assert f"a stack already runs in {held} (pid {os.getpid()}, sim.yaml)" in capsys.readouterr().err
    assert not started.exists()
