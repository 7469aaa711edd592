"""Kill the processes that are left when the launcher has ended; run as the script ``python -I -S reaper.py``.

The launcher holds the other end of the reaper's standard input and writes MARK first. When the launcher has ended for
any reason, the reaper kills every process that carries MARK in its environment: the nodes, their children, and
processes that have left a node's process group for a session of their own, which neither group signals nor parent-death
signals reach. It writes ``PID COMMAND`` for each of them, and exits.
"""

import os
import signal
import time
from pathlib import Path

VARIABLE = "INSTANT_IC_STACK"
"""Environment variable with the marks of the stacks that a process belongs to: ``MARK/NODE``, separated by ``:``."""

_LONGEST_S = 3.0


def marked(mark: str) -> "list[int]":
    """Return the processes that carry a mark. Those of other users are unreadable, and cannot belong to the stack."""
    wanted = mark.encode()
    found = []
    for name in os.listdir("/proc"):  # noqa: PTH208 - pathlib would stat each of them
        if name.isdigit() and int(name) != os.getpid() and wanted in _marks(int(name)):
            found.append(int(name))
    return found


def _marks(pid: int) -> bytes:
    try:
        environment = Path(f"/proc/{pid}/environ").read_bytes()
    except OSError:  # the process has ended, or belongs to another user
        return b""
    start = (b"\0" + environment).find(b"\0" + VARIABLE.encode() + b"=")
    return environment[start:].split(b"\0", 1)[0] if start >= 0 else b""


def kill_marked(mark: str) -> "dict[int, str]":
    """Kill every process that carries a mark, until none is left; return their command lines by process id."""
    killed: dict[int, str] = {}
    deadline = time.monotonic() + _LONGEST_S
    while time.monotonic() < deadline:
        pids = marked(mark)
        if not pids:
            break
        for pid in pids:
            try:
                descriptor = os.pidfd_open(pid)
            except OSError:
                continue
            try:
                if mark.encode() in _marks(pid):  # still the same process: its id has not been reused
                    command = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
                    signal.pidfd_send_signal(descriptor, signal.SIGKILL)
                    killed.setdefault(pid, command.strip())
            except OSError:
                continue
            finally:
                os.close(descriptor)
        time.sleep(0.01)
    return killed


def main() -> None:
    """Wait for the launcher's end, then kill the marked processes."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the reaper must outlive the launcher
    received = b""
    while piece := os.read(0, 4096):
        received += piece
    mark = received.decode().strip()
    killed = kill_marked(mark) if mark else {}
    try:
        for pid, command in killed.items():
            os.write(1, f"{pid} {command}\n".encode())
    except OSError:  # the reader of standard output is gone
        pass


if __name__ == "__main__":
    main()
