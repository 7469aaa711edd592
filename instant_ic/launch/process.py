"""One supervised process: start, output, end and restarts."""

from __future__ import annotations

import enum
import fcntl
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

from instant_ic.launch.description import NodeSpec
from instant_ic.launch.hang import HeartbeatSilence
from instant_ic.launch.node_log import NodeLog
from instant_ic.launch.reaper import VARIABLE

MAX_LINE_BYTES = 1 << 16
"""Longer lines of output are split at this length."""

OUTPUT_BYTES_PER_S = 1 << 20
"""Output limit of a node, on average over four seconds; the excess is dropped."""

USAGE_STATUS = 2
"""Exit status of a node with wrong parameters or arguments; restarting it cannot help."""

Schedule = Sequence[tuple[signal.Signals, float]]
"""Signals that end a process, with the wait after each."""

_CHILD = Path(__file__).with_name("child.py")
_FLOOD_PAUSE_S = 0.005  # between two reads of output that is dropped: leaves the CPU to the others
_PIPE_BYTES = 1 << 20  # a short delay of the launcher or its disk must not block the nodes


def dies_with_us() -> tuple[str, ...]:
    """Return the command prefix that makes the kernel kill the process when this thread dies, for whatever reason."""
    return sys.executable, "-I", "-S", str(_CHILD), str(os.getpid())


class ProcessState(enum.Enum):
    """State of a supervised process."""

    RUNNING = "running"
    WAITING = "waiting to start"
    ENDED = "ended"
    FAILED = "failed"


class RespawnLimit:
    """Limit on restarts of a process: a delay that doubles, and a number of restarts within a window.

    Args:
        delay_s: wait before the first restart.
    """

    MAX_DELAY_S = 15.0
    WINDOW_S = 60.0
    MAX_STARTS = 5
    """The process is given up after more restarts than this within the window."""

    def __init__(self, delay_s: float) -> None:
        self.delay_s = delay_s
        self.retries = 0
        """Total number of restarts."""
        self._starts: deque[float] = deque()

    @property
    def used(self) -> int:
        """Restarts within the window, as of the last call of :meth:`next_delay_s`."""
        return len(self._starts)

    def next_delay_s(self, now_s: float) -> float | None:
        """Count one more restart; return the seconds to wait before it, or None if there were too many."""
        while self._starts and now_s - self._starts[0] > self.WINDOW_S:
            self._starts.popleft()
        if len(self._starts) >= self.MAX_STARTS:
            return None
        delay_s = min(self.delay_s * 2 ** len(self._starts), self.MAX_DELAY_S)
        self._starts.append(now_s)
        self.retries += 1
        return delay_s

    def __str__(self) -> str:
        """Return the limit as text."""
        return f"{self.MAX_STARTS} restarts within {self.WINDOW_S:.0f} s"


class OutputLimit:
    """Passes on ``OUTPUT_BYTES_PER_S`` for each period of a node's output; a note stands for what is dropped."""

    PERIOD_S = 4.0

    def __init__(self) -> None:
        self._left_bytes = 0.0
        self._period_ends_s = -math.inf
        self._dropped_bytes = 0

    def pass_on(self, data: bytes) -> bytes:
        """Return the data, after a note if some was dropped before; empty if it is dropped."""
        now_s = time.monotonic()
        if now_s >= self._period_ends_s:
            self._left_bytes, self._period_ends_s = self.PERIOD_S * OUTPUT_BYTES_PER_S, now_s + self.PERIOD_S
        if self._left_bytes < 0:
            self._dropped_bytes += len(data)
            return b""
        self._left_bytes -= len(data)
        return self.note() + data

    def note(self) -> bytes:
        """Return a line about dropped output, if there is some, and forget it."""
        dropped, self._dropped_bytes = self._dropped_bytes, 0
        text = f"\n[launch: {dropped} bytes dropped: more than {OUTPUT_BYTES_PER_S} a second]\n"
        return text.encode() if dropped else b""


class ManagedProcess:
    """A process in a session of its own, with its log file and a thread that forwards its output.

    Args:
        spec: the node to run.
        run_dir: run directory of the stack.
        mark: text that the process and everything it starts carry in their environment.
        show_line: called with each line of its output, on the forwarding thread.
        report: called with texts about the log, on any thread.
    """

    def __init__(
        self,
        spec: NodeSpec,
        run_dir: Path,
        mark: str,
        show_line: Callable[[str, str], None],
        report: Callable[[str], None],
    ) -> None:
        self.spec = spec
        self.limit = RespawnLimit(spec.respawn_delay_s)
        self.mark = f"{mark}/{spec.label}."  # ends with a dot, so that no mark is a prefix of another
        self.state = ProcessState.WAITING
        self.exit_status: int | None = None
        self.reason = ""
        """Why the launcher ends it; empty when it ends by itself or with the stack."""
        self.start_s = 0.0
        """Monotonic time from which it should run."""
        self.started_s = 0.0
        """Monotonic time of its last start."""
        self.silence = HeartbeatSilence()
        self._run_dir = spec.run_dir or run_dir
        self.log_path = self._run_dir / "log" / f"{spec.name}.log"
        self._log = NodeLog(self.log_path, report)
        self._show_line = show_line
        self._popen: subprocess.Popen[bytes] | None = None
        self._forwarder: threading.Thread | None = None
        self._ending: deque[tuple[signal.Signals, float]] | None = None
        self._next_signal_s = 0.0

    @property
    def pid(self) -> int | None:
        """Process id, which is also the id of its process group, while it runs."""
        return self._popen.pid if self._popen is not None else None

    @property
    def ending(self) -> bool:
        """True while it is being ended."""
        return self._ending is not None

    def start(self, on_output_end: Callable[[], None]) -> None:
        """Start the process.

        Args:
            on_output_end: called on another thread when its output ends, which is soon before its own end.

        Raises:
            OSError: the kernel refuses it.
            ValueError: an argument contains a zero byte.
        """
        # A stack started by a node of another stack carries both marks, so that it ends with the outer one.
        marks = [mark for mark in (os.environ.get(VARIABLE), self.mark) if mark]
        environment = {
            **os.environ,
            "PYTHONUNBUFFERED": "1",
            "PYTHONFAULTHANDLER": "1",  # a crash, or the SIGABRT sent to a hung node, prints the stack of every thread
            **self.spec.env,
            "INSTANT_IC_RUN_DIR": str(self._run_dir),
            VARIABLE: ":".join(marks),
        }
        self.exit_status, self.reason, self._ending = None, "", None
        self.silence = HeartbeatSilence()
        self._popen = subprocess.Popen(
            (*dies_with_us(), *self.spec.command),
            bufsize=0,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
        output = self._popen.stdout
        assert output is not None
        with suppress(OSError):  # the user's pipe memory is used up: keep the usual 64 kB
            fcntl.fcntl(output.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self.state, self.started_s = ProcessState.RUNNING, time.monotonic()
        self._forwarder = threading.Thread(
            target=self._forward, args=(output, on_output_end), name=f"output of {self.spec.label}", daemon=True
        )
        self._forwarder.start()

    def _forward(self, output: IO[bytes], on_end: Callable[[], None]) -> None:
        """Forward output to log and screen until all processes that hold the pipe have ended."""
        limit, partial = OutputLimit(), b""
        with output:
            while data := output.read(MAX_LINE_BYTES):
                passed = limit.pass_on(data)
                if not passed:
                    time.sleep(_FLOOD_PAUSE_S)
                    continue
                self._log.write(passed)
                *lines, partial = (partial + passed).split(b"\n")
                if len(partial) >= MAX_LINE_BYTES:
                    lines, partial = [*lines, partial], b""
                for line in lines:
                    self._show_line(self.spec.label, line.decode(errors="replace").rstrip("\r"))
        if note := limit.note():
            self._log.write(note)
        if partial:
            self._show_line(self.spec.label, partial.decode(errors="replace"))
        self._log.close()
        on_end()

    def send(self, signum: signal.Signals) -> None:
        """Send a signal to the whole process group; SIGABRT only to the process itself, which then prints its stack."""
        if self._popen is not None:
            with suppress(ProcessLookupError):
                if signum is signal.SIGABRT:
                    os.kill(self._popen.pid, signum)
                else:
                    os.killpg(self._popen.pid, signum)
                # A stopped process handles no signal except SIGKILL until it continues.
                os.killpg(self._popen.pid, signal.SIGCONT)

    def begin_end(self, schedule: Schedule, reason: str = "") -> None:
        """Begin to end the process; :meth:`press_on` then sends these signals."""
        self._ending = deque(schedule)
        self._next_signal_s = 0.0
        self.reason = self.reason or reason

    def press_on(self, now_s: float) -> signal.Signals | None:
        """Send the next ending signal when it is due; return the signal sent."""
        if self._ending is None or now_s < self._next_signal_s or not self._ending:
            return None
        signum, wait_s = self._ending.popleft()
        self._next_signal_s = now_s + wait_s
        self.send(signum)
        return signum

    def out_of_means(self, now_s: float) -> bool:
        """Return whether all signals have been sent and their waits are over."""
        return self._ending is not None and not self._ending and now_s >= self._next_signal_s

    def has_ended(self) -> bool:
        """Return whether its own process has ended. It stays unreaped, so that its group id cannot be reused."""
        if self._popen is None:
            return False
        return os.waitid(os.P_PID, self._popen.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def reap(self) -> None:
        """After ``has_ended``: kill the rest of its group, and set ``exit_status``."""
        assert self._popen is not None
        self.send(signal.SIGKILL)
        self.exit_status = self._popen.wait()
        self._popen, self._ending = None, None
        self.state = ProcessState.ENDED if self.exit_status == 0 and not self.reason else ProcessState.FAILED

    def finish_output(self, timeout_s: float) -> bool:
        """Wait until the output of the ended process has been forwarded; return whether all of it has."""
        if self._forwarder is None:
            return True
        self._forwarder.join(max(0.0, timeout_s))
        return not self._forwarder.is_alive()


def describe_exit(status: int) -> str:
    """Return ``exit status 1``, or ``killed by SIGSEGV``."""
    if status >= 0:
        return f"exit status {status}"
    try:
        return f"killed by {signal.Signals(-status).name}"
    except ValueError:
        return f"killed by signal {-status}"
