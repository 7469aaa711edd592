"""Run a node's file as a program, and exit at once when the node ends: ``node_main.py FILE ARGUMENTS``.

This file is run as a script and never imported, so that nodes load nothing of the launcher.

Interpreter shutdown with numba's compiler loaded takes 0.7 s of CPU, several seconds for six nodes on two cores. It can
be skipped, because a node closes its motors, bag, sockets and registry before its ``main`` returns. Until the node has
installed its own signal handlers, a signal ends the process quietly: nothing is open yet.
"""

from __future__ import annotations

import os
import signal
import sys

for _number in (signal.SIGINT, signal.SIGTERM):  # before the other imports, which take long
    signal.signal(_number, lambda *_: os._exit(0))

import logging  # noqa: E402
import runpy  # noqa: E402
import traceback  # noqa: E402
from pathlib import Path  # noqa: E402

_here = Path(__file__).resolve().parent
if sys.path and Path(sys.path[0]) == _here:  # modules beside this file must not shadow a node's imports
    sys.path[0] = str(_here.parents[1])


def main() -> None:
    """Run the file named by the first argument, and exit with its status."""
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
    except BaseException:  # noqa: BLE001 - the process ends here, so print the traceback as the interpreter would
        traceback.print_exc()
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


if __name__ == "__main__":
    main()
