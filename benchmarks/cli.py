#!/usr/bin/env python3
"""Response time of ``ic`` while a node runs, of its completion, and of that node's control channel; prints JSON.

python benchmarks/cli.py                        [--runs N]
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from instant_ic.bus import registry
from instant_ic.bus.control import NodeControl

IC = [sys.executable, "-m", "instant_ic.cli.main"]
NODE = "bag_recorder"


def timed(function: Callable[[], Any], runs: int) -> dict[str, float]:
    """Minimum, median and maximum over some runs, after one warm-up run."""
    function()
    seconds = []
    for _ in range(runs):
        began = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - began)
    figures = {"min_ms": min(seconds), "median_ms": statistics.median(seconds), "max_ms": max(seconds)}
    return {name: round(value * 1e3, 2) for name, value in figures.items()}


def command(*words: str, **environment: str) -> Callable[[], Any]:
    """A call of ``ic`` in its own process."""
    return lambda: subprocess.run([*IC, *words], env={**os.environ, **environment}, capture_output=True, check=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10)
    runs = parser.parse_args().runs
    folder = Path(tempfile.mkdtemp(prefix="ic-"))
    os.environ["INSTANT_IC_RUN_DIR"] = str(folder)
    line = "ic topic echo /dia"
    completion = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line))}
    node = subprocess.Popen([*IC, "run", NODE, "-p", f"path:={folder / 'bag'}"], stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while not any(info.name == NODE and info.subscribes for info in registry.list_nodes(folder)):
            if time.monotonic() > deadline or node.poll() is not None:
                raise SystemExit(f"{NODE} does not come up")
            time.sleep(0.05)
        control = NodeControl(folder, NODE)
        result = {
            "python -c pass": timed(lambda: subprocess.run([sys.executable, "-c", "pass"], check=True), runs),
            "ic --help": timed(command("--help"), runs),
            "ic node list": timed(command("node", "list"), runs),
            "ic topic list": timed(command("topic", "list"), runs),
            "ic param get": timed(command("param", "get", NODE, "duration_s"), runs),
            "TAB": timed(command(_ARGCOMPLETE_STDOUT_FILENAME=os.devnull, **completion), runs),
            "NodeControl.get": timed(control.get, 20 * runs),
            "NodeControl.set": timed(lambda: control.set({"duration_s": time.monotonic() + 1e6}), 5 * runs),
        }
        began = time.monotonic()
        node.send_signal(signal.SIGINT)
        node.wait(30)
        result["Ctrl-C to the end of ic run"] = {"median_ms": round((time.monotonic() - began) * 1e3, 2)}
    finally:
        node.kill()
        node.wait()
    print(json.dumps(result, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
