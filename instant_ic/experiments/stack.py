"""Runs a whole stack from a program: starts it from a launch file, observes the bus, stops it as Ctrl-C does."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from instant_ic.bus import SENSOR, Node, QoS
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.launch.process import dies_with_us
from instant_ic.util.pace import read as read_pace

T = TypeVar("T")


class StackError(RuntimeError):
    """The stack did not start, exited early, or did not reach an awaited condition in time."""


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """Return a free port of 127.0.0.1."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def free_ports() -> dict[str, int]:
    """Return free ports by argument name of ``launch/sim.yaml``, so that several stacks can run in parallel."""
    return {
        "camera_port": free_port(),
        "lidar_port": free_port(socket.SOCK_DGRAM),
        "lidar_position_port": free_port(socket.SOCK_DGRAM),
        "console_port": free_port(),
    }


@dataclass(frozen=True)
class _NoParameters:
    """No parameters."""


class StackObserver(Node[_NoParameters]):
    """Node inside the controlling program; its callbacks run while the program waits in :meth:`Stack.wait_for`."""

    name = "observer"

    def rest(self, timeout_s: float) -> None:
        """Sleep until a message or timer is due; for a program that calls :meth:`spin_once` itself."""
        if (timer_ns := self.timers.next_ns()) is not None:
            timeout_s = min(timeout_s, (timer_ns - self.clock.steady_ns()) / 1e9)
        self._transport.wait(max(0.0, timeout_s))
        self._transport.clear()


def _observer(run_dir: Path) -> StackObserver:
    clock = SystemClock()
    return StackObserver(_NoParameters(), LocalTransport(run_dir, StackObserver.name, clock.now_ns), clock)


def observer(run_dir: Path) -> contextlib.AbstractContextManager[StackObserver]:
    """Observe another run directory, such as that of a fleet's robot."""
    return contextlib.closing(_observer(run_dir))


class Stack:
    """Starts a launch file in its own run directory.

    Args:
        launch_file: name or path, as for ``ic launch``.
        run_dir: its path must be short (sockets).
        log_path: file for the launcher's output (default: ``RUN_DIR/launch.log``).
        prefix: command that starts the launcher, such as ``ip netns exec NAME``.
        pace: pace of the stack's time, see :mod:`instant_ic.util.pace`; None: as fast as the machine can.

    Example::

        with Stack("sim.yaml", run_dir, free_ports()) as stack:
            pose = stack.observer.latest("/pose", PoseWithCovarianceStamped, max_age_s=1.0)
            stack.wait_for(lambda: pose.message is not None, 60, "a pose")
    """

    def __init__(
        self,
        launch_file: str,
        run_dir: Path,
        arguments: dict[str, Any],
        log_path: Path | None = None,
        prefix: Sequence[str] = (),
        pace: float | None = 1.0,
    ) -> None:
        self.launch_file = launch_file
        self.run_dir = run_dir
        self.arguments = dict(arguments)
        self.log_path = log_path or run_dir / "launch.log"
        self.prefix = list(prefix)
        self._pace = pace
        self.process: subprocess.Popen[bytes] | None = None
        self.observer: StackObserver

    @property
    def pace(self) -> float:
        """Seconds of the stack per second of the machine, at present."""
        return read_pace(self.run_dir).factor if self._pace is None else self._pace

    def __enter__(self) -> Self:
        """Start the launcher and the observer."""
        self.run_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        words = [f"{key}:={_word(value)}" for key, value in self.arguments.items()]
        launch = [self.launch_file, *words, "--verbose", f"--pace={self._pace or 'auto'}"]
        environment = {**os.environ, "INSTANT_IC_RUN_DIR": str(self.run_dir)}
        with self.log_path.open("wb") as log:
            self.process = subprocess.Popen(
                [*dies_with_us(), *self.prefix, sys.executable, "-m", "instant_ic.cli.main", "launch", *launch],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self.observer = _observer(self.run_dir)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop everything, also after an error."""
        try:
            self.stop()
        finally:
            self.observer.close()

    def collect(self, topic: str, message_class: Any, qos: QoS = SENSOR) -> list[Any]:
        """Return a list that collects the topic's messages while the program waits."""
        messages: list[Any] = []
        self.observer.subscribe(topic, message_class, messages.append, qos)
        return messages

    def wait_for(self, condition: Callable[[], T], timeout_s: float, what: str) -> T:
        """Run the observer's callbacks until the condition is true, and return its value.

        Args:
            condition: returns a true value when met.
            timeout_s: seconds of the stack's time, as a slow machine needs longer.
            what: description of the condition, for the error.

        Raises:
            StackError: timeout, or the launcher exited.
        """
        left_s, looked_s = timeout_s, time.monotonic()
        while True:
            self.observer.spin_once()
            if value := condition():
                return value
            self.check_alive(what)
            left_s, looked_s = left_s - (time.monotonic() - looked_s) * self.pace, time.monotonic()
            if left_s < 0:
                raise StackError(f"no {what} within {timeout_s:g} s; the stack's output ends with:\n{self.log_tail()}")
            time.sleep(0.005)

    def check_alive(self, while_waiting_for: str) -> None:
        """Raise StackError if the launcher has exited."""
        assert self.process is not None
        status = self.process.poll()
        if status is not None:
            raise StackError(
                f"the stack ended with status {status} while waiting for {while_waiting_for}:\n{self.log_tail()}"
            )

    def stop(self, timeout_s: float = 15.0) -> int:
        """Stop the stack as Ctrl-C does and return the launcher's exit status.

        Raises:
            StackError: it did not stop in time and was killed.
        """
        assert self.process is not None
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            # The nodes die with their launcher (PR_SET_PDEATHSIG).
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait(10)
            raise StackError(
                f"the stack did not end within {timeout_s:g} s of SIGINT and was killed:\n{self.log_tail()}"
            ) from None

    def log_tail(self) -> str:
        """Return the last lines of the launcher's output."""
        return "\n".join(self.log_path.read_text(errors="replace").splitlines()[-40:])


def processes_of(run_dir: Path) -> Sequence[Any]:
    """Return the psutil processes that were started with this run directory in their environment."""
    import psutil

    wanted = str(run_dir)
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get("INSTANT_IC_RUN_DIR") == wanted and process.pid != os.getpid():
                found.append(process)
        except (psutil.NoSuchProcess, psutil.AccessDenied, psutil.ZombieProcess):
            continue
    return found


def _word(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
