#!/usr/bin/env python3
"""The newcomer's first drive: the whole simulated stack and a browser on this machine; prints JSON.

Holds W on the page in a real Chromium (software WebGL): up to the white box, through it in the virtual space, and
back to the real robot.

    python benchmarks/stack.py --repeat 10 --json stack.json

Each drive has `completed`, `mode_changes` (4 without a stop), `camera_hz`, `page_fps` (frames rendered a second in
VIRTUAL), `pace` (the stack's seconds per second), `stopped_s` (time in STOPPED from the first key on), the time from
a key to the first command, and CPU by process in percent of a core. Rates and times are in seconds of the machine.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from browser import launch_chromium
from cpu_usage import ReferenceLoop, Usage, cpu_percent, usage
from drive import DriveRecorder
from reporting import note, parser_for, report

from instant_ic.bus import RELIABLE
from instant_ic.experiments.stack import Stack, StackError, free_ports, processes_of
from instant_ic.msg import ControlState, message_type, twist_values

PASSAGE = [ControlState.REAL, ControlState.ENTERING, ControlState.VIRTUAL, ControlState.RETURNING, ControlState.REAL]
BEYOND_X_M = 5.6
"""Map x behind the box where the key is released."""
POLL_MS = 60
"""Time between two looks at the stack while the browser runs; each look costs CPU too."""
SHOWN = ("completed", "error", "ready_s", "mode_changes", "stopped_s", "camera_hz", "page_fps", "pace")
"""Figures of the progress line."""
# Counts what the page renders: several draw calls of one animation frame count as one.
WATCH_PAGE = """
window.__keys = [];
window.addEventListener('keydown', e => {
  if (!e.repeat) window.__keys.push([e.code, performance.timeOrigin + performance.now()]);
}, true);
window.__frames = 0;
let drawn = false;
for (const name of ['drawArrays', 'drawElements']) {
  const draw = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...values) {
    if (!drawn) {
      drawn = true;
      window.__frames += 1;
      requestAnimationFrame(() => { drawn = false; });
    }
    return draw.apply(this, values);
  };
}
"""


@dataclass(frozen=True)
class LoadSample:
    """Counters of stack, browser, camera and page at one moment."""

    stack: Usage
    browser_s: float
    images: int
    frames: int

    def until(self, later: LoadSample) -> dict[str, Any]:
        """Return rates and load between this sample and a later one."""
        seconds = later.stack.monotonic_s - self.stack.monotonic_s
        percent = cpu_percent(self.stack, later.stack, seconds)
        return {
            "seconds": round(seconds, 1),
            "camera_hz": round((later.images - self.images) / seconds, 2),
            "page_fps": round((later.frames - self.frames) / seconds, 1),
            "cpu_percent": {
                "stack": round(sum(percent.values()), 1),
                "browser": round(100 * (later.browser_s - self.browser_s) / seconds, 1),
                **dict(sorted(percent.items(), key=lambda item: -item[1])),
            },
            "rss_mb": round(sum(later.stack.rss_mb.values())),
        }


class PageDrive:
    """A drive on the page through the box, and its figures."""

    def __init__(self, stack: Stack, run_dir: Path) -> None:
        self.result: dict[str, Any] = {"completed": False}
        self._stack, self._run_dir = stack, run_dir
        self._recorder = DriveRecorder(stack)
        self._images = 0
        stack.observer.subscribe("/camera/image/compressed", message_type("CompressedImage"), self._on_image)
        self._paces: list[float] = []
        self._page: Any = None

    def run(self, url: str) -> None:
        """Wait for the stack, open the page, drive, and fill in the figures.

        Raises:
            StackError: the stack did not reach a step of the drive in time.
        """
        from playwright.sync_api import sync_playwright

        began = time.monotonic()
        recorder = self._recorder
        self._stack.wait_for(lambda: recorder.mode == ControlState.REAL and recorder.ready, 240, "a virtual space")
        self.result["ready_s"] = round(time.monotonic() - began, 1)
        with sync_playwright() as playwright:
            browser = launch_chromium(playwright)
            self._page = browser.new_page(viewport={"width": 1280, "height": 720})
            errors: list[str] = []
            self._page.on("pageerror", lambda error: errors.append(str(error)))
            self._page.add_init_script(WATCH_PAGE)
            self._page.goto(url)
            self._page.wait_for_timeout(5000)
            self.result["standing"] = self._standing(15.0)
            latencies = [self._press_latency("KeyW" if i % 2 else "KeyS") for i in range(8)]
            self.result["key_to_cmd_vel_ms"] = {
                "median": round(statistics.median(latencies), 1),
                "max": round(max(latencies), 1),
            }
            self._through_the_box(errors)
            browser.close()

    def _through_the_box(self, errors: list[str]) -> None:
        started, images, first = time.monotonic(), self._images, len(self._recorder.modes) - 1
        try:
            self._hold(lambda: self._recorder.mode == ControlState.VIRTUAL, "VIRTUAL")
            before = self._sample()
            self._hold(self._is_beyond, "v-bot behind the box")
            self._page.keyboard.up("KeyW")
            self.result["virtual"] = before.until(self._sample())
            self._wait(lambda: self._recorder.mode == ControlState.REAL, 180, "REAL behind the box")
            self._page.wait_for_timeout(1500)
            modes = [mode for mode in self._recorder.modes[first:] if mode != ControlState.STOPPED]
            self.result["completed"] = modes == PASSAGE and not self._recorder.contact and not errors
        finally:
            self.result |= self._figures(started, images, first) | {"page_errors": errors}

    def _on_image(self, message: Any) -> None:
        self._images += 1

    def _figures(self, started: float, images: int, first: int) -> dict[str, Any]:
        ended, recorder, paces = time.monotonic(), self._recorder, self._paces
        modes, ends_s = recorder.modes[first:], [*recorder.mode_times_s[first + 1 :], ended]
        spans = zip(modes, recorder.mode_times_s[first:], ends_s, strict=True)
        return {
            "mode_changes": len(modes) - 1,
            "modes": modes,
            "stopped_s": round(
                sum(end - max(at, started) for mode, at, end in spans if mode == ControlState.STOPPED), 2
            ),
            "camera_hz": round((self._images - images) / (ended - started), 2),
            "page_fps": self.result.get("virtual", {}).get("page_fps"),
            "pace": {"mean": round(statistics.mean(paces), 2), "min": round(min(paces), 2)} if paces else None,
            "contact": recorder.contact,
            "keyframe_to_ready_s": [round(seconds, 2) for seconds in recorder.ready_seconds],
        }

    def _is_beyond(self) -> bool:
        pose = self._recorder.vbot_pose
        return pose is not None and float(pose[0]) > BEYOND_X_M

    def _hold(self, reached: Callable[[], bool], what: str) -> None:
        """Hold W until the condition is true. At a stop, release W and press it again afterwards."""
        end = time.monotonic() + 120

        def over() -> bool:
            self._paces.append(self._stack.pace)
            return reached() or self._recorder.mode == ControlState.STOPPED

        while not reached():
            self._page.keyboard.down("KeyW")
            self._wait(over, max(1.0, end - time.monotonic()), what)
            if self._recorder.mode == ControlState.STOPPED:
                self._page.keyboard.up("KeyW")
                self._wait(lambda: self._recorder.mode != ControlState.STOPPED, 60, "end of the stop")

    def _wait(self, condition: Callable[[], Any], timeout_s: float, what: str) -> None:
        """Wait like ``Stack.wait_for``, but also process the browser's events."""

        def both() -> bool:
            self._page.wait_for_timeout(POLL_MS)
            return bool(condition())

        self._stack.wait_for(both, timeout_s, what)

    def _sample(self) -> LoadSample:
        frames = int(self._page.evaluate("window.__frames"))
        return LoadSample(usage(self._run_dir), browser_cpu_s(), self._images, frames)

    def _standing(self, seconds: float) -> dict[str, Any]:
        before, end = self._sample(), time.monotonic() + seconds
        self._wait(lambda: time.monotonic() > end, seconds + 5, "end of the measuring time")
        return before.until(self._sample())

    def _press_latency(self, key: str) -> float:
        """Return the milliseconds from a key's event in the page to the first /cmd_vel that moves the robot."""
        moving: list[int] = []

        def on_command(message: Any) -> None:
            if abs(twist_values(message)[0]) > 1e-3:
                moving.append(time.time_ns())

        observer = self._stack.observer
        subscription = observer.subscribe("/cmd_vel", message_type("TwistStamped"), on_command, RELIABLE)
        settle = time.monotonic() + 1.0
        self._stack.wait_for(lambda: time.monotonic() > settle, 5, "a still robot")
        moving.clear()
        self._page.keyboard.down(key)
        self._stack.wait_for(lambda: moving, 10, f"/cmd_vel after {key}")
        self._page.keyboard.up(key)
        pressed_ms = self._page.evaluate("window.__keys.at(-1)[1]")
        observer.subscriptions.remove(subscription)
        subscription.raw.close()
        return moving[0] / 1e6 - float(pressed_ms)


def browser_cpu_s() -> float:
    """Return the CPU seconds of all Chromium processes that this program started."""
    total = 0.0
    for process in psutil.Process().children(recursive=True):
        try:
            if "chrom" in process.name():
                times = process.cpu_times()
                total += times.user + times.system
        except psutil.NoSuchProcess:
            continue
    return total


def one_drive(pace: float | None, log: Path | None) -> dict[str, Any]:
    """Start a stack and a browser, drive, stop; an error is part of the result."""
    ports = free_ports()
    with tempfile.TemporaryDirectory(prefix="ic-", ignore_cleanup_errors=True) as folder:
        run_dir = Path(folder)
        arguments = {**ports, "recordings": run_dir / "recordings"}
        with Stack("sim.yaml", run_dir, arguments, log, pace=pace) as stack, ReferenceLoop() as loop:
            drive = PageDrive(stack, run_dir)
            try:
                drive.run(f"http://127.0.0.1:{ports['console_port']}/")
            except StackError as error:
                drive.result["error"] = str(error).splitlines()[0]
            result = drive.result | {"reference_loop_ms": round(loop.million_ms, 1)}
            began = time.monotonic()
            result["exit_status"] = stack.stop()
            result["stop_s"] = round(time.monotonic() - began, 2)
            result["processes_left"] = len(processes_of(run_dir))
    return result


def main() -> int:
    parser = parser_for(__doc__)
    parser.add_argument("--repeat", type=int, default=1, help="number of drives, each with a new stack (default 1)")
    parser.add_argument("--pace", type=float, default=None, help="fixed pace (default: what the machine can do)")
    parser.add_argument("--log", type=Path, default=None, help="file for the output of the last stack")
    args = parser.parse_args()
    if args.repeat < 1:
        parser.error(f"--repeat must be at least 1 (got {args.repeat})")
    drives: list[dict[str, Any]] = []
    for number in range(args.repeat):
        note(f"drive {number + 1} of {args.repeat}")
        drives.append(one_drive(args.pace, args.log))
        note(json.dumps({key: drives[-1].get(key) for key in SHOWN}))
        completed = f"{sum(drive['completed'] for drive in drives)} of {len(drives)}"
        report({"cores": os.cpu_count(), "completed": completed, "drives": drives}, args.json)
    return 0 if all(drive["completed"] for drive in drives) else 1


if __name__ == "__main__":
    sys.exit(main())
