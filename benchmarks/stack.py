#!/usr/bin/env python3
"""The whole simulated stack on this machine: rates, CPU and memory of each process, latencies; prints JSON.

Drives with the keyboard of a real browser into the white obstacle, through the virtual space, and back.

    python benchmarks/stack.py --json stack.json --screenshots pictures/
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from instant_ic.bus import RELIABLE
from instant_ic.experiments.drive import DriveRecorder
from instant_ic.experiments.stack import Stack, free_ports, processes_of
from instant_ic.msg import message_type, twist_values

CHROMIUM_FLAGS = [
    "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-quic",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip
KEY_TIMES = """
window.__keys = [];
window.addEventListener('keydown', e => {
  if (!e.repeat) window.__keys.push([e.code, performance.timeOrigin + performance.now()]);
}, true);
"""


class Probe:
    """Collects the rates published in heartbeats."""

    def __init__(self, stack: Stack) -> None:
        self.rates: dict[str, list[float]] = defaultdict(list)
        self.collecting = False
        stack.observer.subscribe("/heartbeat", message_type("NodeStatus"), self.on_status, RELIABLE)

    def on_status(self, message: Any) -> None:
        if self.collecting:
            for topic, rate in zip(message.outputs, message.output_rates_hz, strict=True):
                self.rates[f"{topic} ({message.node})"].append(float(rate))


def usage(run_dir: Path) -> dict[str, tuple[float, float]]:
    """CPU seconds used and resident MB of each process, by node name."""
    found = {}
    for process in processes_of(run_dir):
        words = process.cmdline()
        name = words[words.index("--name") + 1] if "--name" in words else Path(words[-1]).name
        if "launch" in words:
            name = "launcher"
        times = process.cpu_times()
        found[name] = (times.user + times.system, process.memory_info().rss / 1e6)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="OUT", help="also write the result here")
    parser.add_argument("--screenshots", type=Path, metavar="DIR", help="pictures of the page in each mode")
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=720)
    parser.add_argument("--full-quality", action="store_true", help="the page draws at full resolution (screenshots)")
    parser.add_argument("--log", type=Path, default=None, help="where the stack's output goes")
    args = parser.parse_args()
    run_dir = Path(tempfile.mkdtemp(prefix="ic-"))
    ports = free_ports()
    try:
        with Stack("sim.yaml", run_dir, ports, args.log) as stack:
            result = measure(stack, run_dir, f"http://127.0.0.1:{ports['console_port']}/", args)
            started = time.monotonic()
            result["exit_status"] = stack.stop()
            result["seconds_from_ctrl_c_to_end"] = round(time.monotonic() - started, 2)
            result["processes_left"] = len(processes_of(run_dir))
    finally:
        shutil.rmtree(run_dir, ignore_errors=True)
    text = json.dumps(result, indent=2)
    if args.json:
        args.json.write_text(text + "\n")
    print(text)
    return 0


def measure(stack: Stack, run_dir: Path, url: str, args: argparse.Namespace) -> dict[str, Any]:
    """Run the drive and return the figures."""
    from playwright.sync_api import sync_playwright

    control = message_type("ControlState")
    recorder, probe = DriveRecorder(stack), Probe(stack)
    started = time.monotonic()
    stack.wait_for(lambda: recorder.mode == control.REAL and recorder.ready, 240, "virtual space fit to show")
    start_s = time.monotonic() - started
    note("virtual space ready; idle figures for 15 s")
    idle = window(stack, probe, run_dir, 15.0)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=CHROMIUM_FLAGS)
        page = browser.new_page(viewport={"width": args.width, "height": args.height})
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.add_init_script(KEY_TIMES)
        page.goto(url + "?quality=full" if args.full_quality else url)
        page.wait_for_timeout(3000)
        shot(page, args, "real")
        latencies = [press_latency(stack, page, "KeyW" if i % 2 else "KeyS") for i in range(8)]

        def hold(condition: Callable[[], bool], timeout_s: float, what: str) -> None:
            """Hold W until the condition is true; release and press again after a stop by late sensor data."""
            end = time.monotonic() + timeout_s
            while not condition():
                page.keyboard.down("KeyW")
                left = max(1.0, end - time.monotonic())
                wait(stack, page, lambda: condition() or recorder.mode == control.STOPPED, left, what)
                if recorder.mode == control.STOPPED:
                    page.keyboard.up("KeyW")
                    wait(stack, page, lambda: recorder.mode != control.STOPPED, 30, "end of the stop")

        note("driving into the obstacle")
        hold(lambda: recorder.mode == control.VIRTUAL, 90, "passage into the virtual space")
        before = usage(run_dir), time.monotonic()
        probe.rates.clear()
        probe.collecting = True
        views = len(recorder.record.view_stamps_ns)
        shots = 0

        def past() -> bool:
            nonlocal shots
            x = recorder.vbot_pose[0]
            if shots < 3 and x > (2.6, 3.3, 4.9)[shots]:
                shots += 1
                shot(page, args, f"virtual{shots}")
            return bool(x > 5.6)

        hold(past, 90, "v-bot past the obstacle")
        page.keyboard.up("KeyW")
        after = usage(run_dir), time.monotonic()
        probe.collecting = False
        stamps = recorder.record.view_stamps_ns[views:]
        virtual = {"rates_hz": mean_rates(probe), "processes": cpu_between(before, after)}
        wait(stack, page, lambda: recorder.mode == control.REAL, 120, "passage back")
        page.wait_for_timeout(1500)
        shot(page, args, "back")
        browser.close()
    record = recorder.record
    seconds = (stamps[-1] - stamps[0]) / 1e9 if len(stamps) > 1 else 0.0
    return {
        "cores": os.cpu_count(),
        "seconds_from_start_to_ready": round(start_s, 1),
        "modes": record.modes,
        "contact": record.contact,
        "page_errors": errors,
        "key_to_cmd_vel_ms": {
            "median": round(statistics.median(latencies), 1),
            "max": round(max(latencies), 1),
            "all": [round(v, 1) for v in latencies],
        },
        "keyframe_to_ready_s": [round(v, 2) for v in record.ready_seconds],
        "rendered_views": {
            "size": record.view_size,
            "rate_hz_while_virtual": round((len(stamps) - 1) / seconds, 2) if seconds else 0.0,
            "render_ms_median": round(statistics.median(record.render_ms), 1) if record.render_ms else None,
            "jpeg_bytes_median": int(statistics.median(record.view_bytes)) if record.view_bytes else None,
        },
        "idle_real_mode": idle,
        "driving_virtual_mode": virtual,
    }


def window(stack: Stack, probe: Probe, run_dir: Path, seconds: float) -> dict[str, Any]:
    """Rates and load over a period without any requests to the stack."""
    before = usage(run_dir), time.monotonic()
    probe.rates.clear()
    probe.collecting = True
    end = time.monotonic() + seconds
    stack.wait_for(lambda: time.monotonic() > end, seconds + 5, "end of the measuring time")
    probe.collecting = False
    after = usage(run_dir), time.monotonic()
    return {"rates_hz": mean_rates(probe), "processes": cpu_between(before, after)}


def mean_rates(probe: Probe) -> dict[str, float]:
    """Mean of the rates published in heartbeats."""
    return {topic: round(statistics.mean(values), 2) for topic, values in sorted(probe.rates.items())}


def cpu_between(before: Any, after: Any) -> dict[str, dict[str, float]]:
    """CPU in percent of one core, and memory, of each process between two samples."""
    (used0, t0), (used1, t1) = before, after
    return {
        name: {
            "cpu_percent": round(100 * (seconds - used0.get(name, (0.0, 0.0))[0]) / (t1 - t0), 1),
            "rss_mb": round(memory, 0),
        }
        for name, (seconds, memory) in sorted(used1.items())
    }


def wait(stack: Stack, page: Any, condition: Any, timeout_s: float, what: str) -> None:
    """Like Stack.wait_for, but also processes the browser's events."""

    def both() -> bool:
        page.wait_for_timeout(20)
        return bool(condition())

    stack.wait_for(both, timeout_s, what)


def press_latency(stack: Stack, page: Any, key: str) -> float:
    """Milliseconds from a key's event in the page to the first /cmd_vel that moves the robot."""
    moving: list[int] = []

    def on_command(message: Any) -> None:
        if abs(twist_values(message)[0]) > 1e-3:
            moving.append(time.time_ns())

    subscription = stack.observer.subscribe("/cmd_vel", message_type("TwistStamped"), on_command, RELIABLE)
    settle = time.monotonic() + 1.0
    stack.wait_for(lambda: time.monotonic() > settle, 5, "a still robot")
    moving.clear()
    page.keyboard.down(key)
    stack.wait_for(lambda: moving, 10, f"/cmd_vel after {key}")
    page.keyboard.up(key)
    pressed_ms = page.evaluate("window.__keys.at(-1)[1]")
    stack.observer.subscriptions.remove(subscription)
    subscription.close()
    return moving[0] / 1e6 - float(pressed_ms)


def shot(page: Any, args: argparse.Namespace, name: str) -> None:
    """Save a screenshot of the page."""
    if args.screenshots:
        args.screenshots.mkdir(parents=True, exist_ok=True)
        page.screenshot(path=str(args.screenshots / f"{name}.png"))


def note(text: str) -> None:
    """Print the progress."""
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
