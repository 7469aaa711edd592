"""A supervised process: start, output, end and restarts."""

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
_FLOOD_PAUSE_S = 0.005  # pause between two reads of dropped output, which leaves the CPU to other threads
_PIPE_BYTES = 1 << 20  # large enough that a short delay of the launcher or its disk does not block the nodes


def dies_with_us() -> tuple[str, ...]:
    """Return the command prefix by which the kernel kills the process when this thread dies for any reason."""
    return sys.executable, "-I", "-S", str(_CHILD), str(os.getpid())


class ProcessState(enum.Enum):
    """State of a supervised process."""

    RUNNING = "running"
    WAITING = "waiting to start"
    ENDED = "ended"
    FAILED = "failed"


class RespawnLimit:
    """A limit on the restarts of a process: a delay that doubles, and a number of restarts within a window.

    Args:
        delay_s: wait before the first restart.
    """

    MAX_DELAY_S = 15.0
    WINDOW_S = 60.0
    MAX_STARTS = 5
    """Largest number of restarts within the window; after more, the process is given up."""

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
        """Count a restart; return the seconds to wait before it, or None if there were too many."""
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
    """A limit of ``OUTPUT_BYTES_PER_S`` on a node's output in each period. A note replaces dropped output."""

    PERIOD_S = 4.0

    def __init__(self) -> None:
        self._left_bytes = 0.0
        self._period_ends_s = -math.inf
        self._dropped_bytes = 0

    def pass_on(self, data: bytes) -> bytes:
        """Return the data, preceded by a note if output was dropped before; empty if the data is dropped."""
        now_s = time.monotonic()
        if now_s >= self._period_ends_s:
            self._left_bytes, self._period_ends_s = self.PERIOD_S * OUTPUT_BYTES_PER_S, now_s + self.PERIOD_S
        if self._left_bytes < 0:
            self._dropped_bytes += len(data)
            return b""
        self._left_bytes -= len(data)
        return self.note() + data

    def note(self) -> bytes:
        """Return a line about the dropped output, if any, and reset its count."""
        dropped, self._dropped_bytes = self._dropped_bytes, 0
        text = f"\n[launch: {dropped} bytes dropped: more than {OUTPUT_BYTES_PER_S} a second]\n"
        return text.encode() if dropped else b""


class ManagedProcess:
    """A process in a session of its own, with its log file and a thread that forwards its output.

    Args:
        spec: the node to run.
        run_dir: run directory of the stack.
        mark: text that the process and all its descendants carry in their environment.
        show_line: function called with the node and each line of its output, on the forwarding thread.
        report: function called with texts about the log, on any thread.
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
        """Reason why the launcher ends the process; empty if it ends by itself or with the stack."""
        self.start_s = 0.0
        """Monotonic time of the next start."""
        self.started_s = 0.0
        """Monotonic time of the last start."""
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
        """Id of the process and of its process group; None while it does not run."""
        return self._popen.pid if self._popen is not None else None

    @property
    def ending(self) -> bool:
        """True while the launcher ends the process."""
        return self._ending is not None

    def start(self, on_output_end: Callable[[], None]) -> None:
        """Start the process.

        Args:
            on_output_end: function called on another thread when the output ends, shortly before the process ends.

        Raises:
            OSError: the kernel refuses to start it.
            ValueError: an argument contains a zero byte.
        """
        # A stack that a node of another stack has started carries both marks, so that it ends with the outer stack.
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
        with suppress(OSError):  # the user's pipe memory is used up: the pipe keeps its usual 64 kB
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
        """Send a signal to the whole process group. SIGABRT goes only to the process itself, which prints its stack."""
        if self._popen is not None:
            with suppress(ProcessLookupError):
                if signum is signal.SIGABRT:
                    os.kill(self._popen.pid, signum)
                else:
                    os.killpg(self._popen.pid, signum)
                # A stopped process handles no signal but SIGKILL until it continues.
                os.killpg(self._popen.pid, signal.SIGCONT)

    def begin_end(self, schedule: Schedule, reason: str = "") -> None:
        """Begin to end the process. :meth:`press_on` then sends the signals of ``schedule``."""
        self._ending = deque(schedule)
        self._next_signal_s = 0.0
        self.reason = self.reason or reason

    def press_on(self, now_s: float) -> signal.Signals | None:
        """Send the next signal of the schedule if it is due; return the signal sent, or None."""
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
        """Return whether the process itself has ended. It is not reaped yet, so that its group id cannot be reused."""
        if self._popen is None:
            return False
        return os.waitid(os.P_PID, self._popen.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def reap(self) -> None:
        """Kill the rest of the process group and set ``exit_status``; call this after ``has_ended``."""
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
    """Return an exit status as text, such as ``exit status 1`` or ``killed by SIGSEGV``."""
    if status >= 0:
        return f"exit status {status}"
    try:
        return f"killed by {signal.Signals(-status).name}"
    except ValueError:
        return f"killed by signal {-status}"
