#!/usr/bin/env python3
"""Start and stop of a stack: seconds until all nodes are RUNNING and until "ready", CPU of both; prints JSON.

python benchmarks/launch.py                     launch/sim.yaml without the page
python benchmarks/launch.py headless:=false     with the page
python benchmarks/launch.py --file replay bag:=drive
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from instant_ic.bus import RELIABLE
from instant_ic.experiments.stack import Stack, free_ports, processes_of
from instant_ic.msg import message_type

RUNNING = 1


def check_s(file: str, words: list[str], cache: Path) -> float:
    """Seconds of ``ic launch FILE --check``."""
    started = time.monotonic()
    command = [sys.executable, "-m", "instant_ic.cli.main", "launch", file, "--check", *words]
    subprocess.run(command, env={**os.environ, "XDG_CACHE_HOME": str(cache)}, check=True, stdout=subprocess.DEVNULL)
    return round(time.monotonic() - started, 2)


def cpu_s(process: Any) -> float:
    """CPU seconds used by a process."""
    times = process.cpu_times()
    return float(times.user + times.system)


def measure(file: str, arguments: dict[str, str], steady_s: float) -> dict[str, Any]:
    """Measure one stack from its start to its end."""
    import psutil

    from instant_ic.launch import find_launch_file, read_launch_file

    run_dir = Path(tempfile.mkdtemp(prefix="ic-"))
    nodes = {node.name for node in read_launch_file(find_launch_file(file), arguments, run_dir).nodes}
    up: dict[str, dict[str, float]] = {}
    began = time.monotonic()

    def on_status(message: Any) -> None:
        if message.state == RUNNING and message.node not in up:
            up[message.node] = {
                "running_s": round(time.monotonic() - began, 2),
                "cpu_s": round(cpu_s(psutil.Process(message.pid)), 2),
            }

    try:
        with Stack(file, run_dir, arguments) as stack:
            stack.observer.subscribe("/heartbeat", message_type("NodeStatus"), on_status, RELIABLE)
            stack.wait_for(lambda: nodes <= set(up), 180, f"RUNNING of {', '.join(sorted(nodes))}")
            result: dict[str, Any] = {}
            if file == "sim":
                stack.wait_for(lambda: "ready after" in stack.log_path.read_text(errors="replace"), 180, "ready")
                result["ready_s"] = round(time.monotonic() - began, 2)
                result["cpu_s_to_ready"] = round(sum(cpu_s(process) for process in processes_of(run_dir)), 2)
            assert stack.process is not None
            launcher = psutil.Process(stack.process.pid)
            before, since = cpu_s(launcher), time.monotonic()
            stack.wait_for(lambda: time.monotonic() > since + steady_s, steady_s + 30, "end of the steady time")
            result |= {
                "all_running_s": max(times["running_s"] for times in up.values()),
                "cpu_s_to_running": round(sum(times["cpu_s"] for times in up.values()), 2),
                "nodes": dict(sorted(up.items())),
                "launcher_cpu_percent": round(100 * (cpu_s(launcher) - before) / (time.monotonic() - since), 2),
                "launcher_rss_mb": round(launcher.memory_info().rss / 1e6, 1),
            }
            asked = time.monotonic()
            result["exit_status"] = stack.stop()
            result["stop_s"] = round(time.monotonic() - asked, 2)
            result["processes_left"] = len(processes_of(run_dir))
        return result
    finally:
        shutil.rmtree(run_dir, ignore_errors=True)


def killed(file: str, arguments: dict[str, str]) -> dict[str, float]:
    """Seconds from the launcher's SIGKILL until the last process of the stack is gone."""
    run_dir = Path(tempfile.mkdtemp(prefix="ic-"))
    try:
        with Stack(file, run_dir, arguments) as stack:
            stack.wait_for(lambda: len(processes_of(run_dir)) > 3, 60, "the first processes")
            assert stack.process is not None
            os.kill(stack.process.pid, signal.SIGKILL)
            asked = time.monotonic()
            while processes_of(run_dir) and time.monotonic() < asked + 30:
                time.sleep(0.01)
            return {"last_gone_s": round(time.monotonic() - asked, 2), "left": float(len(processes_of(run_dir)))}
    finally:
        shutil.rmtree(run_dir, ignore_errors=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--file", default="sim", help="launch file (default: %(default)s)")
    parser.add_argument("--steady", type=float, default=10.0, metavar="SECONDS", help="time over which CPU is taken")
    parser.add_argument("--json", type=Path, metavar="OUT", help="also write the result here")
    parser.add_argument("arguments", nargs="*", metavar="KEY:=VALUE", help="arguments of the launch file")
    args = parser.parse_args()
    given: dict[str, str] = dict(word.split(":=", 1) for word in args.arguments)
    if args.file == "sim":
        given = {"headless": "true", **{key: str(port) for key, port in free_ports().items()}, **given}
    words = [f"{key}:={value}" for key, value in given.items()]
    cache = Path(tempfile.mkdtemp())
    try:
        checks = {"check_first_s": check_s(args.file, words, cache), "check_again_s": check_s(args.file, words, cache)}
    finally:
        shutil.rmtree(cache, ignore_errors=True)
    result = {
        "file": args.file,
        "cpus": os.cpu_count(),
        "load_before": os.getloadavg()[0],
        **checks,
        **measure(args.file, given, args.steady),
        "launcher_killed": killed(args.file, given),
    }
    text = json.dumps(result, indent=2)
    print(text)
    if args.json:
        args.json.write_text(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
