#!/usr/bin/env python3
"""Three simulated robots and a station through a Zenoh router, on this machine: CPU, memory, delays; prints JSON.

python benchmarks/fleet.py --json fleet.json
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from instant_ic.bus import RELIABLE, SENSOR, Node
from instant_ic.bus.registry import list_topics
from instant_ic.bus.transport import Received
from instant_ic.experiments.stack import Observer, Stack, free_port, free_ports, observer

ROBOTS = ("robot1", "robot2", "robot3")
DELAYS = ("/scan", "/pose", "/map", "/camera/image/compressed", "/lidar/points", "/robot2/pose", "/robot3/pose")


def usage(launcher: int) -> dict[str, tuple[float, float]]:
    """CPU seconds used and resident MB of every process of the fleet, as GROUP/NODE."""
    found = {}
    for process in psutil.Process(launcher).children(recursive=True):
        try:
            words = process.cmdline()
            if "--name" not in words:
                continue
            group = Path(process.environ().get("INSTANT_IC_RUN_DIR", "")).name
            times = process.cpu_times()
            name = f"{group if group in (*ROBOTS, 'station') else 'fleet'}/{words[words.index('--name') + 1]}"
            found[name] = (times.user + times.system, process.memory_info().rss / 1e6)
        except psutil.NoSuchProcess:
            continue
    return found


def percentiles(values: list[float]) -> dict[str, float]:
    """p50 and p99 in ms, and the number of values."""
    p50, p99 = np.percentile(values, [50, 99])
    return {"p50_ms": round(float(p50), 2), "p99_ms": round(float(p99), 2), "messages": len(values)}


def measure(seconds: float, vspace: bool) -> dict[str, Any]:
    """Run the fleet and measure for some seconds once the station sees every robot."""
    run_dir = Path(tempfile.mkdtemp(prefix="ic-"))
    arguments = {**free_ports(), "router_port": free_port(), "headless": True, "vspace": vspace}
    started = time.monotonic()
    try:
        with Stack("fleet.yaml", run_dir, arguments) as stack, observer(run_dir / "station") as station:
            assert stack.process is not None
            wanted = {f"/{robot}/ic/state" for robot in ROBOTS} | {"/map", "/lidar/points", "/camera/image/compressed"}
            stack.wait_for(
                lambda: wanted <= {info.topic for info in list_topics(run_dir / "station")},
                180,
                "all robots at the station",
            )
            seen_s = time.monotonic() - started
            delays_ms = listen(station)
            settle(stack, station, 5.0)
            for values in delays_ms.values():
                values.clear()
            before, at = usage(stack.process.pid), time.monotonic()
            settle(stack, station, seconds)
            after, took_s = usage(stack.process.pid), time.monotonic() - at
            ended = time.monotonic()
            status = stack.stop()
            cpu = {name: 100 * (after[name][0] - before[name][0]) / took_s for name in after if name in before}
            return {
                "seconds": round(took_s, 1),
                "cores": os.cpu_count(),
                "load_1min": os.getloadavg()[0],
                "seen_at_station_s": round(seen_s, 1),
                "exit_status": status,
                "end_s": round(time.monotonic() - ended, 2),
                "cpu_percent": {name: round(value, 1) for name, value in sorted(cpu.items())},
                "cpu_percent_by_node": by_node(cpu),
                "cpu_percent_all": round(sum(cpu.values()), 1),
                "rss_mb_all": round(sum(memory for _, memory in after.values()), 0),
                "delay_to_station": {topic: percentiles(v) for topic, v in sorted(delays_ms.items()) if v},
            }
    finally:
        shutil.rmtree(run_dir, ignore_errors=True)


def by_node(cpu: dict[str, float]) -> dict[str, float]:
    """CPU of each kind of node, averaged over the robots that have one."""
    values = defaultdict(list)
    for name, percent in cpu.items():
        group, _, node = name.partition("/")
        values[node if group in ROBOTS else name].append(percent)
    return {node: round(float(np.mean(found)), 1) for node, found in sorted(values.items())}


def listen(station: Observer) -> dict[str, list[float]]:
    """Times from publication on the robot to arrival on the station's bus, in ms; one clock, one machine."""
    delays: dict[str, list[float]] = {topic: [] for topic in DELAYS}

    def heard(topic: str) -> Callable[[Received], None]:
        return lambda received: delays[topic].append((received.received_ns - received.publish_ns) / 1e6)

    for topic in DELAYS:
        station.subscribe_received(topic, heard(topic), RELIABLE if topic == "/map" else SENSOR)
    return delays


def settle(stack: Stack, node: Node[Any], seconds: float) -> None:
    """Run the observer's callbacks for some time."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        node.spin_once()
        stack.check_alive("measuring")
        time.sleep(0.005)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="how long to look (default: %(default)s)")
    parser.add_argument("--vspace", action="store_true", help="with depth and the virtual space at the station")
    parser.add_argument("--json", type=Path, help="where to write the figures, beside printing them")
    args = parser.parse_args()
    text = json.dumps(measure(args.seconds, args.vspace), indent=2)
    print(text)
    if args.json:
        args.json.write_text(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
