"""Starts a program that the kernel kills when its launcher is gone; run as a script, never imported.

``python -I -S child.py LAUNCHER_PID PROGRAM ARGUMENTS...``. The death signal survives the exec, so the program needs
to know nothing of it. It is set here and not in the launcher's fork because the launcher has threads. SIGKILL is
right: who is killed while it holds the crawler leaves its tracks to the base's own command time-out.
"""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def _start() -> None:
    launcher, program = int(sys.argv[1]), sys.argv[2:]
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != launcher:  # it died before the line above
        raise SystemExit(1)
    os.execvp(program[0], program)


if __name__ == "__main__":
    _start()
