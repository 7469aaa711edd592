"""Start a program that the kernel kills when its launcher dies; run as a script, never imported.

``python -I -S child.py LAUNCHER_PID PROGRAM ARGUMENTS...``. The death signal survives the exec, so the program itself
needs no support for it. The signal is set here, not between fork and exec, because the launcher has threads. SIGKILL is
safe even for the process that drives the crawler, because the base's own command time-out then stops the tracks.
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
    if os.getppid() != launcher:  # the launcher died before the line above
        raise SystemExit(1)
    os.execvp(program[0], program)


if __name__ == "__main__":
    _start()
