#!/usr/bin/env python3
"""CPU of each process of the simulated stack, standing and in the virtual space, without a browser; prints JSON.

Runs slower than real time, so that the machine has time left and the figures do not depend on what runs beside it.
Percent are of one core, per second of the stack's time: what the process would need at pace 1.

    python benchmarks/budget.py --pace 0.4
"""

from __future__ import annotations

import argparse
import asyncio
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from reporting import parser_of, report

from instant_ic.experiments.budget import Usage, cpu_percent, reference_loop, usage
from instant_ic.experiments.drive import DriveRecorder, drive_through_obstacle
from instant_ic.experiments.stack import Stack, free_ports
from instant_ic.msg import ControlState, message_type


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--pace", type=float, default=0.4, help="pace of the stack's time (default 0.4)")
    parser.add_argument("--seconds", type=float, default=20.0, help="time to stand, of the stack's time (default 20)")
    parser.add_argument("--standing", action="store_true", help="do not drive")
    parser.add_argument("--log", type=Path, default=None, help="where the stack's output goes")
    args = parser.parse_args()
    run_dir = Path(tempfile.mkdtemp(prefix="ic-"))
    try:
        with Stack("sim.yaml", run_dir, free_ports(), args.log, pace=args.pace) as stack, reference_loop() as loop:
            result = measure(stack, run_dir, args)
            result["pace"], result["reference_loop_ms"] = args.pace, round(loop.million_ms, 1)
    finally:
        shutil.rmtree(run_dir, ignore_errors=True)
    report(result, args.json)
    return 0


def measure(stack: Stack, run_dir: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Stand, then drive; return CPU by process of both."""
    recorder = DriveRecorder(stack)
    began = time.monotonic()
    stack.wait_for(lambda: recorder.mode == ControlState.REAL and recorder.ready, 240, "virtual space fit to show")
    result: dict[str, Any] = {"start_s": round(time.monotonic() - began, 1)}
    settled = time.monotonic() + 3.0
    stack.wait_for(lambda: time.monotonic() > settled, 60, "rest")
    first, end = usage(run_dir), time.monotonic() + args.seconds / stack.pace
    stack.wait_for(lambda: time.monotonic() > end, args.seconds + 10, "end of the measuring time")
    result["standing"] = table(first, usage(run_dir), stack.pace)
    if args.standing:
        return result

    entered: list[Usage] = []
    left: list[Usage] = []

    def on_state(message: Any) -> None:
        if message.mode == ControlState.VIRTUAL and not entered:
            entered.append(usage(run_dir))
        if message.mode != ControlState.VIRTUAL and entered and not left:
            left.append(usage(run_dir))

    stack.observer.subscribe("/ic/state", message_type("ControlState"), on_state)
    port = stack.arguments["console_port"]
    asyncio.run(drive_through_obstacle(stack, recorder, f"http://127.0.0.1:{port}/", beyond_x_m=5.6))
    result["virtual"] = table(entered[0], left[0], stack.pace)
    result["modes"], result["contact"] = recorder.modes, recorder.contact
    return result


def table(before: Usage, after: Usage, pace: float) -> dict[str, Any]:
    """CPU by process in percent of a core at pace 1, largest first, and their sum."""
    percent = cpu_percent(before, after, (after.monotonic_s - before.monotonic_s) * pace)
    ordered = dict(sorted(percent.items(), key=lambda item: -item[1]))
    return {
        "seconds": round((after.monotonic_s - before.monotonic_s) * pace, 1),
        "sum": round(sum(percent.values()), 1),
        "cpu_percent": ordered,
    }


if __name__ == "__main__":
    sys.exit(main())
