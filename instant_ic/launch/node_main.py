"""Runs a node's file as a program and leaves at once when the node is done: ``node_main.py FILE ARGUMENTS``.

Run as a script, never imported, so that nothing of the launcher is loaded into each node.

An interpreter that has numba's compiler loaded takes 0.7 s of CPU to take itself down, six of them on two cores
several seconds. A node has closed what matters (motors, bag, sockets, registry) before its ``main`` returns; the rest
is memory.
Until the node has signal handlers of its own, a signal ends the process quietly: nothing has been opened yet.
"""

from __future__ import annotations

import os
import signal
import sys

for _number in (signal.SIGINT, signal.SIGTERM):  # before the other imports: they take their time
    signal.signal(_number, lambda *_: os._exit(0))

import logging  # noqa: E402
import runpy  # noqa: E402
import traceback  # noqa: E402
from pathlib import Path  # noqa: E402

_here = Path(__file__).resolve().parent
if sys.path and Path(sys.path[0]) == _here:  # beside this file lie modules that no node should find by accident
    sys.path[0] = str(_here.parents[1])


def main() -> None:
    """Runs the file named by the first argument; ends the process with its exit status."""
    del sys.argv[0]
    status = 1
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
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
