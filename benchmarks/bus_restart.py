#!/usr/bin/env python3
"""Reconnection time of a killed publisher or subscriber after its new process is up; prints JSON.

    python benchmarks/bus_restart.py

A publisher sends 200 times per second. The time counts from when the new process has created its topic (starting Python
takes longer than everything after it) to the first message that arrives.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

from instant_ic.bus import RELIABLE
from instant_ic.bus.local_transport import LocalTransport

TYPE = "std_msgs/msg/UInt8MultiArray"
REPEATS = 10

PUBLISHER = f"""
import sys, time
from pathlib import Path
from instant_ic.bus import RELIABLE
from instant_ic.bus.local_transport import LocalTransport
out = LocalTransport(Path(sys.argv[1]), "sender", time.time_ns).advertise("/x", "{TYPE}", RELIABLE)
print(time.monotonic_ns(), flush=True)
while True:
    out.send(bytes(100))
    time.sleep(0.005)
"""
SUBSCRIBER = f"""
import sys, threading, time
from pathlib import Path
from instant_ic.bus import RELIABLE
from instant_ic.bus.frame import type_digest
from instant_ic.bus.local_transport import LocalTransport
type_digest("{TYPE}")  # the message types are loaded, as in a node by then
came = threading.Event()
transport = LocalTransport(Path(sys.argv[1]), "reader", time.time_ns)
start = time.monotonic_ns()
transport.subscribe("/x", "{TYPE}", RELIABLE, came.set)
if not came.wait(20.0):
    sys.exit("nothing came")
print(start, time.monotonic_ns(), flush=True)
came.clear()
threading.Event().wait(60)
"""


def killed_and_restarted(code: str, run_dir: str, measure: Callable[[list[int]], float]) -> list[float]:
    """Reconnection time in milliseconds for each kill and restart of the process."""
    away = []
    for _ in range(REPEATS + 1):
        process = subprocess.Popen([sys.executable, "-c", code, run_dir], stdout=subprocess.PIPE, text=True)
        try:
            assert process.stdout is not None
            away.append(measure([int(word) for word in process.stdout.readline().split()]))
        finally:
            process.kill()
            process.wait(10)
    return away[1:]  # the first is a start, not a restart


def main() -> int:
    with tempfile.TemporaryDirectory(prefix="ic") as run_dir:
        transport = LocalTransport(Path(run_dir), "observer", time.time_ns)
        came: list[int] = []
        event = threading.Event()

        def ready() -> None:
            came.extend(message.steady_ns for message in heard.take())
            event.set()

        heard = transport.subscribe("/x", TYPE, RELIABLE, ready)

        def until_heard(words: list[int]) -> float:
            deadline = time.monotonic() + 20.0
            while not (later := [ns for ns in list(came) if ns > words[0]]):
                if time.monotonic() > deadline:
                    raise TimeoutError("the restarted publisher is not heard")
                event.wait(0.01)
                event.clear()
            return (later[0] - words[0]) / 1e6

        publisher = killed_and_restarted(PUBLISHER, run_dir, until_heard)
        feeder = subprocess.Popen([sys.executable, "-c", PUBLISHER, run_dir], stdout=subprocess.PIPE, text=True)
        try:
            subscriber = killed_and_restarted(SUBSCRIBER, run_dir, lambda words: (words[1] - words[0]) / 1e6)
        finally:
            feeder.kill()
            feeder.wait(10)
        transport.close()
    result = {
        f"{name}_away_ms": {"median": round(statistics.median(values), 1), "max": round(max(values), 1)}
        for name, values in (("publisher", publisher), ("subscriber", subscriber))
    }
    print(json.dumps({"repeats": REPEATS, **result}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
