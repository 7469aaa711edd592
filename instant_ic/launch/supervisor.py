"""Start the nodes of a launch description, watch them, stop them."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from instant_ic.launch.description import NodeSpec
from instant_ic.launch.hang import BUSY_FACTOR
from instant_ic.launch.health import HealthMonitor
from instant_ic.launch.process import USAGE_STATUS, ManagedProcess, ProcessState, Schedule, describe_exit
from instant_ic.launch.reaper import kill_marked
from instant_ic.util.closing import on_end_signal

STOP_SCHEDULE: Schedule = (
    (signal.SIGINT, 2.5),
    (signal.SIGTERM, 1.2),
    (signal.SIGKILL, 1.0),
)
"""Signals to the process groups at shutdown, with the longest wait after each; under 5 s in total."""

HANG_SCHEDULE: Schedule = ((signal.SIGABRT, 2.0), (signal.SIGKILL, 1.0))
"""Signals to a hung node: the first makes it write the stack of every thread, the second ends it."""

_HURRIED_SCHEDULE: Schedule = ((signal.SIGKILL, 1.0),)
_ROUND_S = 0.25  # also the longest time to react to Ctrl-C; the end of a node is noticed at once
_END_S = 0.01  # usual time from the end of a process's output to its own end
_LAST_LINES_S = 0.5
_LAST_LOG_S = 2.0
_REAPER = Path(__file__).with_name("reaper.py")


class SupervisorOutput(Protocol):
    """Destination of the supervisor's output. Lines come from one thread per node, events from any thread."""

    def node_line(self, node: str, text: str) -> None:
        """Show a line of a node's output."""

    def event(self, text: str, bad: bool = False) -> None:
        """Show an event reported by the supervisor."""

    def refresh(self, processes: Sequence[ManagedProcess], health: HealthMonitor | None, ending: bool) -> None:
        """Show the present state; called several times a second. ``health`` is None until all processes are started."""


class Supervisor:
    """A supervisor that repeatedly brings every process from its actual to its wanted state, until the end.

    Each round compares for each process whether it should run with whether it does, and takes one step: start it, send
    the next signal that ends it, detect that it hangs, or leave it alone. The nodes do not depend on the order of
    starts.

    Args:
        nodes: the nodes to run.
        run_dir: run directory of the stack.
        output: destination of lines and events.
        stop_schedule: signals at shutdown, with the wait after each.
        make_health: function called once all processes are started; None: heartbeats are not watched.
    """

    def __init__(
        self,
        nodes: Sequence[NodeSpec],
        run_dir: Path,
        output: SupervisorOutput,
        stop_schedule: Schedule = STOP_SCHEDULE,
        make_health: Callable[[], HealthMonitor] | None = None,
    ) -> None:
        self._stop_schedule = tuple(stop_schedule)
        self._output = output
        self._mark = uuid.uuid4().hex
        self.processes = [
            ManagedProcess(node, run_dir, self._mark, output.node_line, lambda text: output.event(text, bad=True))
            for node in nodes
        ]
        self._make_health = make_health
        self._health: HealthMonitor | None = None
        self._output_ended = threading.Event()
        self._output_ended.set()  # the first round starts at once
        self._stop = False
        self._hurry = False
        self._status = 0
        self._last_look_s = 0.0

    def request_stop(self, hurry: bool = False) -> None:
        """Request the end, from a signal handler or another thread. ``hurry`` sends SIGKILL at once."""
        self._hurry = self._hurry or hurry
        self._stop = True

    def run(self) -> int:
        """Start all nodes, watch them until the end, and stop those that still run.

        Returns:
            0 if a stop was requested or every node ended normally; 1 if a required node failed, or if all nodes have
            ended and at least one of them failed.
        """
        try:
            # A second signal hurries the end.
            with self._reaper(), on_end_signal(lambda *_: self.request_stop(hurry=self._stop)):
                self._last_look_s = time.monotonic()
                try:
                    while not self._stop:
                        self._step(_ROUND_S)
                        states = {process.state for process in self.processes}
                        if states <= {ProcessState.ENDED, ProcessState.FAILED}:
                            self._status = 1 if ProcessState.FAILED in states else self._status
                            break
                finally:
                    self._stop_all()
        finally:
            until_s = time.monotonic() + _LAST_LOG_S
            if not all(process.finish_output(until_s - time.monotonic()) for process in self.processes):
                self._output.event("the rest of the logs could not be written", bad=True)
            if self._health is not None:
                self._health.close()
        return self._status

    @contextmanager
    def _reaper(self) -> Iterator[None]:
        """Run a helper that kills the remaining processes when this process dies, even by SIGKILL."""
        process = subprocess.Popen(
            (sys.executable, "-I", "-S", str(_REAPER)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        assert process.stdin is not None
        process.stdin.write(self._mark.encode())
        process.stdin.flush()
        try:
            yield
        finally:
            try:
                left, _ = process.communicate(timeout=5)
            except subprocess.TimeoutExpired:
                process.kill()
                left, _ = process.communicate()
                self._output.event("processes that the nodes left behind could not be killed within 5 s", bad=True)
            for line in left.decode(errors="replace").splitlines():
                self._output.event(f"killed a process that a node left behind: {line}", bad=True)

    # -- one round -------------------------------------------------------------------------------

    def _step(self, wait_s: float) -> None:
        """Wait for at most ``wait_s``, then bring every process closer to its wanted state."""
        if self._output_ended.wait(wait_s):
            self._output_ended.clear()
            time.sleep(_END_S)
        if self._health is not None:
            self._health.poll()
        self._reconcile(time.monotonic())
        if self._health is None and self._make_health is not None and not self._stop:
            self._health = self._make_health()  # after the starts, so that they need not wait for it
        self._output.refresh(self.processes, self._health, self._stop)

    def _reconcile(self, now_s: float) -> None:
        since_s, self._last_look_s = now_s - self._last_look_s, now_s
        sent: dict[signal.Signals, list[str]] = {}
        for process in self.processes:
            if process.has_ended():
                self._reap(process)
            runs = process.state is ProcessState.RUNNING
            wanted = (runs or process.state is ProcessState.WAITING) and not self._stop and now_s >= process.start_s
            if wanted and not runs:
                self._start(process)
            elif wanted and not process.ending:
                self._check_heartbeat(process, since_s)
            elif not wanted and runs and not process.ending:
                process.begin_end(_HURRIED_SCHEDULE if self._hurry else self._stop_schedule)
            if runs and (signum := process.press_on(now_s)) is not None:
                sent.setdefault(signum, []).append(process.spec.label)
        for signum, names in sent.items():
            if signum is not signal.SIGINT:
                self._output.event(f"{signum.name} to {', '.join(names)}", bad=True)

    def _check_heartbeat(self, process: ManagedProcess, since_s: float) -> None:
        """End a process that has stopped sending heartbeats."""
        if self._health is None or process.pid is None:
            return
        limit_s, silence = process.spec.hang_timeout_s, process.silence
        silence.look(self._health.beat_s(process.spec, process.pid), process.pid, since_s)
        if silence.beat_s is None or limit_s <= 0 or silence.lasts_s < limit_s:
            return
        if silence.lasts_s < BUSY_FACTOR * limit_s and silence.busy(process.pid):
            if not silence.reported:
                silence.reported = True
                text = f"no heartbeat for {silence.lasts_s:.0f} s, but it is computing"
                self._output.event(
                    f"{process.spec.label}: {text}; it will be killed after {BUSY_FACTOR * limit_s:.0f} s", bad=True
                )
            return
        reason = f"hangs: no heartbeat for {silence.lasts_s:.0f} s"
        self._output.event(f"{process.spec.label} {reason}; its stack is in {process.log_path}", bad=True)
        process.begin_end(HANG_SCHEDULE, reason)

    def _start(self, process: ManagedProcess) -> None:
        try:
            process.start(self._output_ended.set)
        except (OSError, ValueError) as error:  # ValueError: an argument contains a zero byte
            process.state, process.exit_status = ProcessState.FAILED, 127
            self._output.event(f"{process.spec.label} cannot be started: {error}", bad=True)
            self._after_end(process)

    def _reap(self, process: ManagedProcess) -> None:
        process.reap()
        if self._stop:
            return
        # Children in a session of their own, outside the process group, would keep the node's devices and ports open.
        for pid, command in kill_marked(process.mark).items():
            self._output.event(f"killed a process that {process.spec.label} left behind: {pid} {command}", bad=True)
        process.finish_output(_LAST_LINES_S)  # before the event, so that the last lines are shown first
        self._after_end(process)

    def _after_end(self, process: ManagedProcess) -> None:
        """Restart a process, end the stack, or only report that the process has ended."""
        spec, status = process.spec, process.exit_status or 0
        what = f"{spec.label} ended ({process.reason or describe_exit(status)})"
        status = status or (1 if process.reason else 0)
        hint = f", see {process.log_path}" if status else ""
        if status == USAGE_STATUS:
            self._status = 1
            self._output.event(f"{what}: its parameters are wrong, so the stack ends{hint}", bad=True)
            self._stop = True
            return
        if spec.respawn:
            delay_s = process.limit.next_delay_s(time.monotonic())
            if delay_s is not None:
                process.state, process.start_s = ProcessState.WAITING, time.monotonic() + delay_s
                used, most = process.limit.used, process.limit.MAX_STARTS
                self._output.event(f"{what}; restarts in {delay_s:.1f} s ({used} of {most})", bad=True)
                return
            process.state = ProcessState.FAILED
            self._output.event(f"{what}; given up after {process.limit}{hint}", bad=True)
            status = status or 1
        if spec.required:
            self._status = 1 if status else 0
            self._output.event(f"{what}; it is required, so the stack ends{hint}", bad=bool(status))
            self._stop = True
        elif not spec.respawn:
            self._output.event(f"{what}{hint}", bad=bool(status))

    def _stop_all(self) -> None:
        self._stop = True
        running = [process for process in self.processes if process.state is ProcessState.RUNNING]
        if running:
            self._output.event(f"stopping {len(running)} node{'s' if len(running) > 1 else ''}")
        hurried = self._hurry
        while left := [process for process in self.processes if process.state is ProcessState.RUNNING]:
            if self._hurry and not hurried:
                hurried = True
                for process in left:
                    process.begin_end(_HURRIED_SCHEDULE)
            self._step(0.02)
            now_s = time.monotonic()
            if all(process.state is not ProcessState.RUNNING or process.out_of_means(now_s) for process in left):
                stuck = [f"{p.spec.label} (pid {p.pid})" for p in left if p.state is ProcessState.RUNNING]
                if stuck:
                    self._output.event(f"{', '.join(stuck)} cannot be killed: blocked in the kernel", bad=True)
                return
