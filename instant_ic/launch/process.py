"""One supervised process: start, its output, its end, its new starts."""

from __future__ import annotations

import enum
import fcntl
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

from instant_ic.launch.description import NodeSpec
from instant_ic.launch.outlet import LogFile, Outlet
from instant_ic.launch.reaper import VARIABLE

MAX_LINE_BYTES = 1 << 16
"""A longer line of output is broken here."""

OUTPUT_BYTES_PER_S = 1 << 20
"""A node that writes more than this is cut short, after a burst of four seconds' worth."""

USAGE_STATUS = 2
"""Exit status of a node whose parameters or arguments are wrong: starting it again cannot help."""

Schedule = Sequence[tuple[signal.Signals, float]]
"""Signals to end a process, and how long to wait after each."""

_CHILD = Path(__file__).with_name("child.py")
_BURST_BYTES = 4.0 * OUTPUT_BYTES_PER_S
_PIPE_BYTES = 1 << 20  # a launcher that is held up for a moment must not hold up the nodes


def dies_with_us() -> tuple[str, ...]:
    """What goes before a command so that the kernel kills its process when this thread is gone, however it went."""
    return sys.executable, "-I", "-S", str(_CHILD), str(os.getpid())


class State(enum.Enum):
    """What a supervised process is doing."""

    RUNNING = "running"
    WAITING = "waiting to start"
    ENDED = "ended"
    FAILED = "failed"


class RespawnLimit:
    """How often a process may be started again: a wait that doubles, and a number of starts in a window.

    Args:
        delay_s: wait before the first new start.
        max_delay_s: the wait grows no longer than this.
        window_s: only the starts within it count.
        max_starts: more of them in the window than this, and it is given up.
        max_retries: more of them in all than this, and it is given up; -1: no limit.
    """

    def __init__(
        self,
        delay_s: float,
        max_delay_s: float = 15.0,
        window_s: float = 60.0,
        max_starts: int = 5,
        max_retries: int = -1,
    ) -> None:
        self.delay_s, self.max_delay_s = delay_s, max_delay_s
        self.window_s, self.max_starts, self.max_retries = window_s, max_starts, max_retries
        self.retries = 0
        """New starts in all."""
        self._starts: deque[float] = deque()

    @property
    def used(self) -> int:
        """New starts within the window, up to the last question."""
        return len(self._starts)

    def next_delay_s(self, now_s: float) -> float | None:
        """Counts one more start; seconds to wait before it, or None when there were too many."""
        while self._starts and now_s - self._starts[0] > self.window_s:
            self._starts.popleft()
        if len(self._starts) >= self.max_starts or 0 <= self.max_retries <= self.retries:
            return None
        delay_s = min(self.delay_s * 2 ** len(self._starts), self.max_delay_s)
        self._starts.append(now_s)
        self.retries += 1
        return delay_s

    def __str__(self) -> str:
        """The limit that was reached, in words."""
        if 0 <= self.max_retries <= self.retries:
            return f"{self.max_retries} new starts"
        return f"{self.max_starts} new starts within {self.window_s:.0f} s"


class ManagedProcess:
    """A process in a session of its own, with its log file.

    Args:
        spec: what to start.
        run_dir: run directory of the stack.
        mark: what the process and all that it starts carry in their environment.
        disk: where the log is written from.
        tell: for words about the log.
        limit: of its new starts.
    """

    def __init__(
        self,
        spec: NodeSpec,
        run_dir: Path,
        mark: str,
        disk: Outlet,
        tell: Callable[[str], None],
        limit: RespawnLimit | None = None,
    ) -> None:
        self.spec = spec
        self.limit = limit or RespawnLimit(spec.respawn_delay_s, max_retries=spec.respawn_max_retries)
        self.mark = f"{mark}/{spec.label}."  # the point, so that no name is the beginning of another
        self.state = State.WAITING
        self.exit_status: int | None = None
        self.reason = ""
        """Why the launcher ends it, in words; empty when it ends by itself or with the stack."""
        self.start_s = 0.0
        """Monotonic time from which on it is to run."""
        self.started_s = 0.0
        """Monotonic time of its last start."""
        self.output_closed = False
        self.log_path = (spec.run_dir or run_dir) / "log" / f"{spec.name}.log"
        self._run_dir = spec.run_dir or run_dir
        self._popen: subprocess.Popen[bytes] | None = None
        self._partial = b""
        self._ending: deque[tuple[signal.Signals, float]] | None = None
        self._next_signal_s = 0.0
        self._disk = disk
        self._log = LogFile(self.log_path, tell)
        self._budget = _BURST_BYTES
        self._budget_s = time.monotonic()
        self._left_out = 0

    @property
    def pid(self) -> int | None:
        """Process id, also its process group's, while it runs."""
        return self._popen.pid if self._popen is not None else None

    @property
    def output(self) -> IO[bytes] | None:
        """The pipe with its output, non-blocking, while it runs."""
        return self._popen.stdout if self._popen is not None else None

    @property
    def flooding(self) -> bool:
        """Whether it has been cut short for now."""
        return self._left_out > 0

    @property
    def ending(self) -> bool:
        """Whether signals to end it are on their way."""
        return self._ending is not None

    def start(self) -> None:
        """Starts the process.

        Raises:
            OSError: the kernel does not let it.
        """
        guard = dies_with_us()
        # A stack inside a node of another stack carries both marks, so that it goes with the outer one.
        marks = [mark for mark in (os.environ.get(VARIABLE), self.mark) if mark]
        environment: dict[str, str | None] = {
            **os.environ,
            "PYTHONUNBUFFERED": "1",
            "PYTHONFAULTHANDLER": "1",  # a crash, and the SIGABRT to one that hangs, leave the stack of every thread
            **self.spec.env,
            "INSTANT_IC_RUN_DIR": str(self._run_dir),
            VARIABLE: ":".join(marks),
        }
        self.exit_status, self.reason, self._ending = None, "", None
        self._popen = subprocess.Popen(
            (*guard, *self.spec.command),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={key: value for key, value in environment.items() if value is not None},
            cwd=self.spec.cwd,
            start_new_session=True,
        )
        assert self._popen.stdout is not None
        os.set_blocking(self._popen.stdout.fileno(), False)
        with suppress(OSError):  # the user's share of pipe memory is used up: the usual 64 kB then
            fcntl.fcntl(self._popen.stdout.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self.state, self.output_closed = State.RUNNING, False
        self.started_s = time.monotonic()

    def send(self, signum: signal.Signals) -> None:
        """Sends a signal to the whole process group; SIGABRT to the process alone, whose stack it is to show."""
        if self._popen is not None:
            with suppress(ProcessLookupError):
                if signum is signal.SIGABRT:
                    os.kill(self._popen.pid, signum)
                else:
                    os.killpg(self._popen.pid, signum)
                # Who has been stopped sees nothing but SIGKILL before he goes on.
                os.killpg(self._popen.pid, signal.SIGCONT)

    def begin_end(self, schedule: Schedule, reason: str = "") -> None:
        """From now on :meth:`press_on` sends these signals."""
        self._ending = deque(schedule)
        self._next_signal_s = 0.0
        self.reason = self.reason or reason

    def press_on(self, now_s: float) -> signal.Signals | None:
        """Sends the next signal of its end when it is due; the signal that was sent."""
        if self._ending is None or now_s < self._next_signal_s or not self._ending:
            return None
        signum, wait_s = self._ending.popleft()
        self._next_signal_s = now_s + wait_s
        self.send(signum)
        return signum

    def out_of_means(self, now_s: float) -> bool:
        """Whether all signals have been sent, and their waits are over."""
        return self._ending is not None and not self._ending and now_s >= self._next_signal_s

    def read_lines(self, now_s: float) -> Iterator[str]:
        """What it has written since, line by line; all of it goes into the log file.

        At most four pieces a call, so that one that writes without end cannot keep the launcher from the others; and
        no more than ``OUTPUT_BYTES_PER_S``.
        """
        self._budget = min(self._budget + (now_s - self._budget_s) * OUTPUT_BYTES_PER_S, _BURST_BYTES)
        self._budget_s = now_s
        for _ in range(4):
            if self._popen is None or self._popen.stdout is None:
                return
            try:
                data = os.read(self._popen.stdout.fileno(), MAX_LINE_BYTES)
            except BlockingIOError:
                return
            if not data:
                self.output_closed = True
                return
            # Once cut short, it has to save up a second's worth: one note a second, not one a piece.
            if self._budget < (OUTPUT_BYTES_PER_S if self._left_out else 0):
                self._left_out += len(data)
                continue
            self._budget -= len(data)
            if self._left_out:
                data, self._left_out = self._note() + data, 0
            if not self._disk.put(self._log.write, data, size=len(data)):
                self._left_out += len(data)  # the disk does not keep up
            *lines, self._partial = (self._partial + data).split(b"\n")
            if len(self._partial) >= MAX_LINE_BYTES:
                lines, self._partial = [*lines, self._partial], b""
            yield from (line.decode(errors="replace").rstrip("\r") for line in lines)

    def _note(self) -> bytes:
        return f"\n[launch: {self._left_out} bytes left out: more than {OUTPUT_BYTES_PER_S} a second]\n".encode()

    def has_ended(self) -> bool:
        """Whether its own process has ended; it stays unreaped, so that its group's number cannot be taken."""
        if self._popen is None:
            return False
        return os.waitid(os.P_PID, self._popen.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def reap(self) -> Iterator[str]:
        """After ``has_ended``: kills what is left of its group, sets ``exit_status``, gives the last lines."""
        assert self._popen is not None
        self.send(signal.SIGKILL)
        now_s = time.monotonic()
        for _ in range(8):
            yield from self.read_lines(now_s)
        if self._left_out:
            self._disk.put(self._log.write, self._note())
            self._left_out = 0
        if self._partial:
            yield self._partial.decode(errors="replace")
            self._partial = b""
        self.exit_status = self._popen.wait()
        if self._popen.stdout is not None:
            self._popen.stdout.close()
        self._popen, self._ending = None, None
        self.state = State.ENDED if self.exit_status == 0 and not self.reason else State.FAILED

    def close(self) -> None:
        """Closes the log file, after what waits to be written."""
        self._disk.put(self._log.close, always=True)


def describe_exit(status: int) -> str:
    """``exit status 1``, or ``killed by SIGSEGV``."""
    if status >= 0:
        return f"exit status {status}"
    try:
        return f"killed by {signal.Signals(-status).name}"
    except ValueError:
        return f"killed by signal {-status}"
