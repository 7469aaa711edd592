#!/usr/bin/env python3
"""The newcomer's first drive: the whole simulated stack and a browser on this machine; prints JSON.

Holds W on the page in a real Chromium (software WebGL): up to the white box, through it in the virtual space, and
back to the real robot.

    python benchmarks/stack.py --repeat 10 --json stack.json --screenshots images/

Each drive has `completed`, `mode_changes` (4 without a stop), `camera_hz`, `page_fps` (frames drawn a second in
VIRTUAL), `pace` (the stack's seconds per second), `stopped_s` (time in STOPPED from the first key on), the time from
a key to the first command, and CPU by process in percent of a core. Rates and times are the machine's.
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
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
from cpu_usage import Usage, cpu_percent, reference_loop, usage
from reporting import note, parser_for, report

from instant_ic.bus import LATCHED, RELIABLE
from instant_ic.experiments.drive import DriveRecorder
from instant_ic.experiments.page_renderer import launch_chromium
from instant_ic.experiments.stack import Stack, StackError, free_ports, processes_of
from instant_ic.msg import ControlState, message_type, twist_values

PASSAGE = [ControlState.REAL, ControlState.ENTERING, ControlState.VIRTUAL, ControlState.RETURNING, ControlState.REAL]
BEYOND_X_M = 5.6
"""Map x behind the box where the key is released."""
POLL_MS = 60
"""Between two looks at the stack while the browser runs; each look costs CPU too."""
# Counts what the page renders: several draw calls of one animation frame count as one.
WATCH_PAGE = """
window.__keys = [];
window.addEventListener('keydown', e => {
  if (!e.repeat) window.__keys.push([e.code, performance.timeOrigin + performance.now()]);
}, true);
window.__frames = 0;
let drawn = false;
for (const kind of [window.WebGLRenderingContext, window.WebGL2RenderingContext]) {
  for (const name of ['drawArrays', 'drawElements']) {
    const draw = kind.prototype[name];
    kind.prototype[name] = function (...values) {
      if (!drawn) {
        drawn = true;
        window.__frames += 1;
        requestAnimationFrame(() => { drawn = false; });
      }
      return draw.apply(this, values);
    };
  }
}
"""


class Watch:
    """Modes, camera images and pace of the stack, by the machine's clock."""

    def __init__(self, stack: Stack) -> None:
        self.modes: list[tuple[float, int]] = []
        self.images = 0
        observer = stack.observer
        observer.subscribe("/ic/state", message_type("ControlState"), self._on_state, LATCHED)
        observer.subscribe("/camera/image/compressed", message_type("CompressedImage"), self._on_image)

    def _on_state(self, message: Any) -> None:
        if not self.modes or self.modes[-1][1] != message.mode:
            self.modes.append((time.monotonic(), message.mode))

    def _on_image(self, message: Any) -> None:
        self.images += 1

    def since(self, began_s: float) -> list[int]:
        """The mode at a moment and each change after it."""
        before = [mode for at, mode in self.modes if at <= began_s]
        return before[-1:] + [mode for at, mode in self.modes if at > began_s]

    def stopped_s(self, began_s: float, ended_s: float) -> float:
        """Seconds in STOPPED between two moments."""
        ends = [at for at, _ in self.modes[1:]] + [ended_s]
        spans = [
            (max(at, began_s), min(end, ended_s))
            for (at, mode), end in zip(self.modes, ends, strict=True)
            if mode == ControlState.STOPPED
        ]
        return sum(max(0.0, end - start) for start, end in spans)


def main() -> int:
    parser = parser_for(__doc__)
    parser.add_argument("--repeat", type=int, default=1, help="number of drives, each with a new stack (default 1)")
    parser.add_argument("--pace", type=float, default=None, help="fixed pace (default: what the machine can do)")
    parser.add_argument("--screenshots", type=Path, metavar="DIR", help="screenshots of the page in each mode")
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=720)
    parser.add_argument("--full-quality", action="store_true", help="the page draws at full resolution (screenshots)")
    parser.add_argument("--log", type=Path, default=None, help="where the output of the last stack goes")
    args = parser.parse_args()
    if args.repeat < 1:
        parser.error(f"--repeat must be at least 1 (got {args.repeat})")
    drives = []
    for number in range(args.repeat):
        note(f"drive {number + 1} of {args.repeat}")
        drives.append(one_drive(args))
        note(json.dumps({key: drives[-1].get(key) for key in SHOWN}))
        result = {
            "cores": os.cpu_count(),
            "completed": f"{sum(drive['completed'] for drive in drives)} of {len(drives)}",
            "drives": drives,
        }
        report(result, args.json)
    return 0 if all(drive["completed"] for drive in drives) else 1


SHOWN = ("completed", "error", "ready_s", "mode_changes", "stopped_s", "camera_hz", "page_fps", "pace")


def one_drive(args: argparse.Namespace) -> dict[str, Any]:
    """Start a stack and a browser, drive, stop; what went wrong is part of the result."""
    run_dir = Path(tempfile.mkdtemp(prefix="ic-"))
    ports = free_ports()
    result: dict[str, Any] = {"completed": False}
    try:
        arguments = {**ports, "recordings": run_dir / "recordings"}
        with Stack("sim.yaml", run_dir, arguments, args.log, pace=args.pace) as stack, reference_loop() as loop:
            try:
                drive(stack, run_dir, f"http://127.0.0.1:{ports['console_port']}/", args, result)
            except StackError as error:
                result["error"] = str(error).splitlines()[0]
            result["reference_loop_ms"] = round(loop.million_ms, 1)
            began = time.monotonic()
            result["exit_status"] = stack.stop()
            result["stop_s"] = round(time.monotonic() - began, 2)
            result["processes_left"] = len(processes_of(run_dir))
    finally:
        shutil.rmtree(run_dir, ignore_errors=True)
    return result


def drive(stack: Stack, run_dir: Path, url: str, args: argparse.Namespace, result: dict[str, Any]) -> None:
    """Drive into the box, through the virtual space and back, and fill in the figures."""
    from playwright.sync_api import sync_playwright

    began = time.monotonic()
    recorder, watch = DriveRecorder(stack), Watch(stack)
    stack.wait_for(lambda: recorder.mode == ControlState.REAL and recorder.ready, 240, "virtual space fit to show")
    result["ready_s"] = round(time.monotonic() - began, 1)
    with sync_playwright() as playwright:
        browser = launch_chromium(playwright)
        page = browser.new_page(viewport={"width": args.width, "height": args.height})
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.add_init_script(WATCH_PAGE)
        page.goto(url + "?quality=full" if args.full_quality else url)
        page.wait_for_timeout(5000)
        shot(page, args, "real")
        result["standing"] = load(stack, page, run_dir, watch, 15.0)
        latencies = [press_latency(stack, page, "KeyW" if i % 2 else "KeyS") for i in range(8)]
        result["key_to_cmd_vel_ms"] = {
            "median": round(statistics.median(latencies), 1),
            "max": round(max(latencies), 1),
        }

        def hold(condition: Callable[[], bool], timeout_s: float, what: str) -> None:
            """Hold W until the condition is true; release it at a stop and press it again after it."""
            end = time.monotonic() + timeout_s
            while not condition():
                page.keyboard.down("KeyW")
                left = max(1.0, end - time.monotonic())
                wait(stack, page, lambda: condition() or recorder.mode == ControlState.STOPPED, left, what)
                if recorder.mode == ControlState.STOPPED:
                    page.keyboard.up("KeyW")
                    wait(stack, page, lambda: recorder.mode != ControlState.STOPPED, 60, "end of the stop")

        started, images = time.monotonic(), watch.images
        paces: list[float] = []
        try:

            def inside() -> bool:
                paces.append(stack.pace)
                return recorder.mode == ControlState.VIRTUAL

            hold(inside, 120, "VIRTUAL")
            before = sample(page, run_dir, watch)
            shots = 0

            def past() -> bool:
                nonlocal shots
                paces.append(stack.pace)
                x = 0.0 if recorder.vbot_pose is None else float(recorder.vbot_pose[0])
                if shots < 3 and x > (2.6, 3.3, 4.9)[shots]:
                    shots += 1
                    shot(page, args, f"virtual{shots}")
                return x > BEYOND_X_M

            hold(past, 120, "v-bot behind the box")
            page.keyboard.up("KeyW")
            result["virtual"] = between(before, sample(page, run_dir, watch))
            wait(stack, page, lambda: recorder.mode == ControlState.REAL, 180, "REAL behind the box")
            page.wait_for_timeout(1500)
            shot(page, args, "back")
            result["completed"] = is_passage(watch.since(started)) and not recorder.contact and not errors
        finally:
            ended = time.monotonic()
            result["mode_changes"] = len(watch.since(started)) - 1
            result["modes"] = watch.since(started)
            result["stopped_s"] = round(watch.stopped_s(started, ended), 2)
            result["camera_hz"] = round((watch.images - images) / (ended - started), 2)
            result["page_fps"] = result.get("virtual", {}).get("page_fps")
            result["pace"] = {"mean": round(statistics.mean(paces), 2), "min": round(min(paces), 2)} if paces else None
            result["contact"], result["page_errors"] = recorder.contact, errors
            result["keyframe_to_ready_s"] = [round(seconds, 2) for seconds in recorder.ready_seconds]
            result["render_ms"] = round(statistics.median(recorder.render_ms), 1) if recorder.render_ms else None
            browser.close()


def is_passage(modes: list[int]) -> bool:
    """Whether the modes are those of one drive through a box; stops in between count apart."""
    return [mode for mode in modes if mode != ControlState.STOPPED] == PASSAGE


Sample = tuple[Usage, float, int, int]
"""Usage of the stack, CPU seconds of the browser, camera images, frames rendered by the page."""


def sample(page: Any, run_dir: Path, watch: Watch) -> Sample:
    """Everything that is counted, now."""
    return usage(run_dir), browser_cpu_s(), watch.images, int(page.evaluate("window.__frames"))


def browser_cpu_s() -> float:
    """CPU seconds of all Chromium processes that this program started."""
    total = 0.0
    for process in psutil.Process().children(recursive=True):
        try:
            if "chrom" in process.name():
                times = process.cpu_times()
                total += times.user + times.system
        except psutil.NoSuchProcess:
            continue
    return total


def between(before: Sample, after: Sample) -> dict[str, Any]:
    """Rates and load between two samples."""
    seconds = after[0].monotonic_s - before[0].monotonic_s
    percent = cpu_percent(before[0], after[0], seconds)
    return {
        "seconds": round(seconds, 1),
        "camera_hz": round((after[2] - before[2]) / seconds, 2),
        "page_fps": round((after[3] - before[3]) / seconds, 1),
        "cpu_percent": {
            "stack": round(sum(percent.values()), 1),
            "browser": round(100 * (after[1] - before[1]) / seconds, 1),
            **dict(sorted(percent.items(), key=lambda item: -item[1])),
        },
        "rss_mb": round(sum(after[0].rss_mb.values())),
    }


def load(stack: Stack, page: Any, run_dir: Path, watch: Watch, seconds: float) -> dict[str, Any]:
    """Rates and load over a period in which nobody does anything."""
    before, end = sample(page, run_dir, watch), time.monotonic() + seconds
    wait(stack, page, lambda: time.monotonic() > end, seconds + 5, "end of the measuring time")
    return between(before, sample(page, run_dir, watch))


def wait(stack: Stack, page: Any, condition: Callable[[], Any], timeout_s: float, what: str) -> None:
    """Like Stack.wait_for, but also processes the browser's events."""

    def both() -> bool:
        page.wait_for_timeout(POLL_MS)
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


if __name__ == "__main__":
    sys.exit(main())
