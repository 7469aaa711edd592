"""One supervised process: start, its output, its end, its new starts."""

from __future__ import annotations

import enum
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO

from instant_ic.launch.description import NodeSpec

MAX_LINE_BYTES = 1 << 16
"""A longer line of output is broken here."""

USAGE_STATUS = 2
"""Exit status of a node whose parameters or arguments are wrong: starting it again cannot help."""

_CHILD = Path(__file__).with_name("child.py")


class State(enum.Enum):
    """What a supervised process is doing."""

    RUNNING = "running"
    WAITING = "waiting to start again"
    ENDED = "ended"
    FAILED = "failed"


class RespawnLimit:
    """How often a process may be started again: a wait that doubles, and a number of starts in a window.

    Args:
        delay_s: wait before the first new start.
        max_delay_s: the wait grows no longer than this.
        window_s: only the starts within it count.
        max_starts: more of them in the window than this, and it is given up.
    """

    def __init__(self, delay_s: float, max_delay_s: float = 15.0, window_s: float = 60.0, max_starts: int = 5) -> None:
        self.delay_s, self.max_delay_s = delay_s, max_delay_s
        self.window_s, self.max_starts = window_s, max_starts
        self._starts: deque[float] = deque()

    @property
    def used(self) -> int:
        """New starts within the window, up to the last question."""
        return len(self._starts)

    def next_delay_s(self, now_s: float) -> float | None:
        """Counts one more start; seconds to wait before it, or None when there were too many."""
        while self._starts and now_s - self._starts[0] > self.window_s:
            self._starts.popleft()
        if len(self._starts) >= self.max_starts:
            return None
        delay_s = min(self.delay_s * 2 ** len(self._starts), self.max_delay_s)
        self._starts.append(now_s)
        return delay_s


class ManagedProcess:
    """A node's process in a session of its own, with its log file."""

    def __init__(self, spec: NodeSpec, run_dir: Path, limit: RespawnLimit | None = None) -> None:
        self.spec = spec
        self.limit = limit or RespawnLimit(spec.respawn_delay_s)
        self.state = State.ENDED
        self.exit_status: int | None = None
        self.start_again_s = 0.0
        self.output_closed = False
        self.log_path = run_dir / "log" / (spec.name.strip("/").replace("/", ".") + ".log")
        self._run_dir = run_dir
        self._popen: subprocess.Popen[bytes] | None = None
        self._partial = b""
        if self.log_path.exists():
            self.log_path.replace(self.log_path.with_suffix(".log.1"))
        self._log: IO[bytes] = self.log_path.open("ab", buffering=0)

    @property
    def pid(self) -> int | None:
        """Process id, also its process group's, while it runs."""
        return self._popen.pid if self._popen is not None else None

    @property
    def output(self) -> IO[bytes] | None:
        """The pipe with its output, non-blocking, while it runs."""
        return self._popen.stdout if self._popen is not None else None

    def start(self) -> None:
        """Starts the process."""
        guard = (sys.executable, "-I", "-S", str(_CHILD), str(os.getpid()))
        environment = {
            **os.environ,
            "PYTHONUNBUFFERED": "1",
            "INSTANT_IC_RUN_DIR": str(self._run_dir),
            **self.spec.env,
        }
        self._popen = subprocess.Popen(
            (*guard, *self.spec.command),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
        assert self._popen.stdout is not None
        os.set_blocking(self._popen.stdout.fileno(), False)
        self.state, self.exit_status = State.RUNNING, None
        self.output_closed = False

    def send(self, signum: signal.Signals) -> None:
        """Sends a signal to the whole process group."""
        if self._popen is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._popen.pid, signum)

    def read_lines(self) -> Iterator[str]:
        """What it has written since, line by line; all of it goes into the log file."""
        while self._popen is not None and self._popen.stdout is not None:
            try:
                data = os.read(self._popen.stdout.fileno(), MAX_LINE_BYTES)
            except BlockingIOError:
                return
            if not data:
                self.output_closed = True
                return
            self._log.write(data)
            *lines, self._partial = (self._partial + data).split(b"\n")
            if len(self._partial) >= MAX_LINE_BYTES:
                lines, self._partial = [*lines, self._partial], b""
            yield from (line.decode(errors="replace").rstrip("\r") for line in lines)

    def has_ended(self) -> bool:
        """Whether its own process has ended; it stays unreaped, so that its group's number cannot be taken."""
        if self._popen is None:
            return False
        return os.waitid(os.P_PID, self._popen.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def reap(self) -> Iterator[str]:
        """After ``has_ended``: kills what is left of its group, sets ``exit_status``, gives the last lines."""
        assert self._popen is not None
        self.send(signal.SIGKILL)
        yield from self.read_lines()
        if self._partial:
            yield self._partial.decode(errors="replace")
            self._partial = b""
        self.exit_status = self._popen.wait()
        if self._popen.stdout is not None:
            self._popen.stdout.close()
        self._popen = None
        self.state = State.ENDED if self.exit_status == 0 else State.FAILED

    def close(self) -> None:
        """Closes the log file."""
        self._log.close()


def describe_exit(status: int) -> str:
    """``exit status 1``, or ``killed by SIGSEGV``."""
    if status >= 0:
        return f"exit status {status}"
    try:
        return f"killed by {signal.Signals(-status).name}"
    except ValueError:
        return f"killed by signal {-status}"
