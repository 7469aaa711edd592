"""Runs one node's module as a program and leaves at once when the node is done: ``python -m ... MODULE ARGUMENTS``.

An interpreter that has numba's compiler loaded takes 0.7 s of CPU to take itself down, six of them on two cores
several seconds. A node has closed what matters (motors, bag, sockets, registry) before its ``main`` returns; the rest
is memory.
Until the node has signal handlers of its own, a signal ends the process quietly: nothing has been opened yet.
"""

from __future__ import annotations

import logging
import os
import runpy
import signal
import sys
import traceback


def main() -> None:
    """Runs the module named by the first argument; ends the process with its exit status."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
    module = sys.argv[1]
    del sys.argv[1]
    status = 1
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
        status = 0
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):
            status = end.code or 0
        else:
            sys.stderr.write(f"{end.code}\n")
    except BaseException:  # noqa: BLE001 - the process ends here: what the interpreter would print is printed
        traceback.print_exc()
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


if __name__ == "__main__":
    main()
