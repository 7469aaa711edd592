"""Starts the nodes of a launch description, watches them, stops them."""

from __future__ import annotations

import selectors
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Protocol

from instant_ic.launch.description import NodeSpec
from instant_ic.launch.process import USAGE_STATUS, ManagedProcess, RespawnLimit, State, describe_exit

STOP_SCHEDULE: tuple[tuple[signal.Signals, float], ...] = (
    (signal.SIGINT, 2.5),
    (signal.SIGTERM, 1.2),
    (signal.SIGKILL, 1.0),
)
"""What is sent to the process groups at the end, and the longest wait after each; under 5 s in all."""


class Output(Protocol):
    """Where the supervisor's words go."""

    def node_line(self, node: str, text: str) -> None:
        """A line that a node has written."""

    def event(self, text: str, bad: bool = False) -> None:
        """Something that the supervisor has done or seen."""

    def refresh(self, processes: Sequence[ManagedProcess]) -> None:
        """Called several times a second."""

    def stopping(self) -> None:
        """Called once, when the end begins."""


class Supervisor:
    """Runs a list of nodes as processes until they end, one that is required ends, or a stop is asked for.

    Args:
        nodes: what to start.
        run_dir: prepared run directory.
        output: where lines and events go.
        make_limit: the respawn limit of a node; for tests.
        stop_schedule: signals of the end and the wait after each.
    """

    def __init__(
        self,
        nodes: Sequence[NodeSpec],
        run_dir: Path,
        output: Output,
        make_limit: Callable[[NodeSpec], RespawnLimit] = lambda spec: RespawnLimit(spec.respawn_delay_s),
        stop_schedule: Sequence[tuple[signal.Signals, float]] = STOP_SCHEDULE,
    ) -> None:
        self._stop_schedule = tuple(stop_schedule)
        self.processes = [ManagedProcess(node, run_dir, make_limit(node)) for node in nodes]
        self._output = output
        self._selector = selectors.DefaultSelector()
        self._stop = False
        self._hurry = False
        self._status = 0

    def request_stop(self, hurry: bool = False) -> None:
        """Asks for the end, from a signal handler or another thread; ``hurry`` goes straight to SIGKILL."""
        self._hurry = self._hurry or hurry
        self._stop = True

    def run(self) -> int:
        """Starts everything, watches it to the end and stops what is left.

        Returns:
            0 when a stop was asked for or every node ended well; 1 when a required node failed, or when all have
            ended and one of them badly.
        """
        try:
            with self._signals():
                try:
                    for process in self.processes:
                        self._start(process)
                    while not self._stop:
                        self._step(0.1)
                        if all(process.state in (State.ENDED, State.FAILED) for process in self.processes):
                            failed = [p for p in self.processes if p.state is State.FAILED]
                            self._status = 1 if failed else self._status
                            break
                finally:
                    self._stop_all()
        finally:
            self._selector.close()
            for process in self.processes:
                process.close()
        return self._status

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """SIGINT, SIGTERM and SIGHUP ask for the end; a second one hurries it."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def on_signal(signum: int, frame: FrameType | None) -> None:
            self.request_stop(hurry=self._stop)

        watched = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        before = [(signum, signal.signal(signum, on_signal)) for signum in watched]
        try:
            yield
        finally:
            for signum, handler in before:
                signal.signal(signum, handler)

    def _start(self, process: ManagedProcess) -> None:
        try:
            process.start()
        except OSError as error:
            process.state, process.exit_status = State.FAILED, 127
            self._output.event(f"{process.spec.name} cannot be started: {error}", bad=True)
            self._after_end(process)
            return
        assert process.output is not None
        self._selector.register(process.output, selectors.EVENT_READ, process)

    def _step(self, wait_s: float) -> None:
        """Passes on what the nodes write, sees who has ended, starts who is due."""
        if self._selector.get_map():
            ready = self._selector.select(wait_s)
        else:
            time.sleep(wait_s)
            ready = []
        for key, _ in ready:
            self._pass_on(key.data)
        for process in self.processes:
            if process.has_ended():
                self._reap(process)
            elif process.state is State.WAITING and not self._stop and time.monotonic() >= process.start_again_s:
                self._start(process)
        self._output.refresh(self.processes)

    def _pass_on(self, process: ManagedProcess) -> None:
        for line in process.read_lines():
            self._output.node_line(process.spec.name, line)
        if process.output_closed:
            self._forget_output(process)

    def _forget_output(self, process: ManagedProcess) -> None:
        watched = {key.fileobj for key in self._selector.get_map().values()}
        if process.output is not None and process.output in watched:
            self._selector.unregister(process.output)

    def _reap(self, process: ManagedProcess) -> None:
        self._forget_output(process)
        for line in process.reap():
            self._output.node_line(process.spec.name, line)
        if not self._stop:
            self._after_end(process)

    def _after_end(self, process: ManagedProcess) -> None:
        """Starts a node again, ends the stack, or only says that the node has ended."""
        spec, status = process.spec, process.exit_status or 0
        what = f"{spec.name} ended ({describe_exit(status)})"
        hint = f", see {process.log_path}" if status else ""
        if status == USAGE_STATUS:
            self._status = 1
            self._output.event(f"{what}: its parameters are wrong, so the stack ends{hint}", bad=True)
            self._stop = True
            return
        if spec.respawn:
            delay_s = process.limit.next_delay_s(time.monotonic())
            if delay_s is not None:
                process.state, process.start_again_s = State.WAITING, time.monotonic() + delay_s
                used, most = process.limit.used, process.limit.max_starts
                self._output.event(f"{what}; starts again in {delay_s:.1f} s ({used} of {most})", bad=True)
                return
            process.state = State.FAILED
            self._output.event(
                f"{what}, {process.limit.max_starts} new starts within {process.limit.window_s:.0f} s did not "
                f"help: given up{hint}",
                bad=True,
            )
            status = status or 1
        if spec.required:
            self._status = 1 if status else 0
            self._output.event(f"{what}; it is required, so the stack ends{hint}", bad=bool(status))
            self._stop = True
        elif not spec.respawn:
            self._output.event(f"{what}{hint}", bad=bool(status))

    def _stop_all(self) -> None:
        self._stop = True
        self._output.stopping()
        running = [process for process in self.processes if process.state is State.RUNNING]
        if running:
            self._output.event(f"stopping {len(running)} node{'s' if len(running) > 1 else ''}")
        for signum, wait_s in self._stop_schedule:
            if self._hurry and signum is not signal.SIGKILL:
                continue
            left = [process for process in self.processes if process.state is State.RUNNING]
            if not left:
                return
            if signum is not signal.SIGINT:
                names = ", ".join(process.spec.name for process in left)
                self._output.event(f"{signum.name} to {names}", bad=True)
            for process in left:
                process.send(signum)
            deadline_s = time.monotonic() + wait_s
            hurried = self._hurry
            while time.monotonic() < deadline_s and self._hurry == hurried:
                self._step(0.02)
                if all(process.state is not State.RUNNING for process in left):
                    break
