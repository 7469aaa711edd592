#!/usr/bin/env python3
"""Record the operator's page during a drive through an obstacle: docs/images/console.webp of the README.

    python scripts/make_video.py docs/images/console.webp

The real page runs in Chromium and is driven by its W key. Its content comes from the real nodes (SLAM, depth, virtual
space, arbiter, virtual robot, navigator, console) and a simulated robot, in one process and in simulated time as in
`ic evaluate teleop`. The page uses the simulation's clock, so the video plays at the right speed on a slow machine too.
"""

from __future__ import annotations

import argparse
import io
import sys
import time
from pathlib import Path
from typing import Any

from instant_ic.console import ConsoleServer, Look, ServerConfig
from instant_ic.console.access import AccessConfig
from instant_ic.console.drive import DriveConfig
from instant_ic.experiments.page_renderer import launch_chromium
from instant_ic.experiments.plots import jpeg
from instant_ic.experiments.teleop_stack import CAMERA_HEIGHT_M, STEP_S, SimulatedStack, StackConfig, _Page
from instant_ic.experiments.teleop_worlds import make_course
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import ControlState
from instant_ic.vspace import State

WORLD, SEED = "corridor", 1
FPS, EVERY = 10, 2
"""Frames per simulated second; every second one is kept."""
SIZE, OUT_WIDTH, QUALITY = (960, 600), 704, 50
SKIP_S, SPEED, AFTER_S = 4.4, 1.5, 1.5
"""Seconds to skip at the start, playback speed, and seconds to keep driving after the switch back."""
SETTLE_MS = 120
"""Real time to wait for each frame: images arrive over a real socket and are decoded."""
CLOCK = """
// The page uses the video's time and renders only when the video steps.
window.filmMs = 1;
const waiting = [];
performance.now = () => window.filmMs;
window.requestAnimationFrame = (callback) => waiting.push(callback);
window.film = (ms) => {
    window.filmMs = ms;
    for (const callback of waiting.splice(0)) callback(ms);
};
"""
LONGEST_S = 120.0


class Page(_Page):
    """Also forwards the console's messages to a real page, in simulated time."""

    def __init__(self, stack: SimulatedStack, server: ConsoleServer) -> None:
        super().__init__(stack)
        self.stack, self.server = stack, server
        self.mode = ""
        server.now_ms = self.now_ms  # type: ignore[method-assign]

    def now_ms(self) -> float:
        return 1e3 * self.stack.time_s

    def publish(self, kind: str, message: dict[str, Any]) -> None:
        super().publish(kind, message)
        self.mode = message.get("mode", self.mode)
        self.server.publish(kind, message)

    def send_frame(self, kind: Any, header: dict[str, Any], payload: bytes) -> None:
        super().send_frame(kind, header, payload)
        self.server.send_frame(kind, header, self.photo() if kind.name == "PANORAMA" else payload)

    def send_layers(self, layers: Any) -> None:
        self.server.send_layers(layers)

    def drawn_ms(self) -> float | None:
        return self.server.drawn_ms()

    def needs_views(self) -> bool:
        return self.server.needs_views()

    def show(self, *kinds: Any) -> None:
        self.server.show(*kinds)

    def photo(self) -> bytes:
        """Render the camera image, which the simulated stack leaves empty."""
        x, y, yaw = self.stack._newest[False].pose
        frame = self.stack.simulation.renderer.render(pose_matrix(x, y, CAMERA_HEIGHT_M, yaw=yaw), 1280, 640)
        return jpeg(frame.rgb, 90)


class Operator:
    """Receives the page's input; keeps the newest drive command."""

    def __init__(self, stack: SimulatedStack) -> None:
        self.stack = stack
        self.command = (0.0, 0.0)

    def on_drive(self, linear: float, angular: float) -> None:
        self.command = (linear, angular)

    def on_operator(self, there: bool) -> None:
        """Ignore the page's heartbeats: they are not in simulated time, and the page is always connected."""

    def on_look(self, look: Look) -> None:
        self.stack.nodes["console"].on_look(look)

    def unused(self, *_: Any) -> None:
        raise RuntimeError("only driving and looking are used in this video")

    on_estop = on_record = on_snapshot = on_bookmark = unused

    def export_map(self) -> dict[str, bytes]:
        return {}


def film() -> list[bytes]:
    """PNG screenshots of the page, ``FPS`` per second of simulated time."""
    from playwright.sync_api import sync_playwright

    course = make_course(WORLD, SEED, 0)
    words = ("console.view.width:=480", "console.view.height:=270", "console.map_rate_hz:=2.0")
    config = StackConfig(seed=SEED, whole_views=True, overrides=words)
    with SimulatedStack(course.world, config) as stack:
        operator = Operator(stack)
        patient = DriveConfig(watchdog_s=60.0, lease_timeout_s=600.0, max_command_age_s=60.0, beat_timeout_s=60.0)
        page_values = {"footprint": [0.6, 0.5], "camera": [0.0, 0.0, CAMERA_HEIGHT_M]}
        server = ConsoleServer(
            operator, ServerConfig(port=0, drive=patient, access=AccessConfig(simulated=True)), page_values
        )
        stack.page = stack.nodes["console"].feed.server = page_in = Page(stack, server)
        stack.nodes["console"].feed_layers(True)
        server.start()
        try:
            with sync_playwright() as playwright:
                browser = launch_chromium(playwright)
                context = browser.new_context(viewport=dict(zip(("width", "height"), SIZE, strict=True)))
                context.add_init_script(CLOCK)
                page = context.new_page()
                page.goto(f"{server.url}?quality=full")
                frames = drive(stack, page, page_in, operator)
                browser.close()
        finally:
            server.stop()
    return frames


def drive(stack: SimulatedStack, page: Any, shown: Page, operator: Operator) -> list[bytes]:
    """Wait until the virtual space is ready, hold W through the obstacle, release it behind the obstacle."""
    frames: list[bytes] = []
    steps = round(1.0 / FPS / STEP_S)
    ready_s = pressed_s = back_s = None
    was_virtual = False
    while True:
        for _ in range(steps):
            stack.step(lambda: operator.command)
        page.wait_for_timeout(SETTLE_MS)
        for part in (0.5, 1.0):
            page.evaluate("(ms) => film(ms)", 1e3 * (stack.time_s - (1 - part) / FPS))
        now, state = stack.time_s, stack.state
        if now > LONGEST_S:
            raise RuntimeError(f"the drive has not finished after {LONGEST_S:g} s: {state and state.reason}")
        if ready_s is None:
            ready = state is not None and int(state.mode) == ControlState.REAL and vspace_ready(stack)
            drives = page.locator('body[data-driver="you"][data-image="live"]').count() > 0
            ready_s = now if ready and drives else None
            continue
        frames.append(page.screenshot(type="png"))
        print(f"\r{len(frames)} frames, {now - ready_s:.1f} s, {shown.mode}   ", end="", file=sys.stderr)
        if pressed_s is None and now > ready_s + 0.8:
            pressed_s = now
            page.keyboard.down("w")
        was_virtual |= shown.virtual
        if was_virtual and not shown.virtual and back_s is None:
            back_s = now
        if back_s is not None and now > back_s + AFTER_S:
            page.keyboard.up("w")
        if back_s is not None and now > back_s + AFTER_S + 0.8:
            print(file=sys.stderr)
            return frames


def vspace_ready(stack: SimulatedStack) -> bool:
    return stack.nodes["nerf"].schedule.state == State.READY


def write(frames: list[bytes], out: Path) -> None:
    """Write an animated WebP, which GitHub shows in a README."""
    from PIL import Image

    size = OUT_WIDTH, round(OUT_WIDTH * SIZE[1] / SIZE[0])
    kept = frames[round(SKIP_S * FPS) :: EVERY]
    small = [Image.open(io.BytesIO(frame)).convert("RGB").resize(size, Image.LANCZOS) for frame in kept]
    small[0].save(
        out, save_all=True, append_images=small[1:], duration=round(1000 * EVERY / FPS / SPEED), loop=0,
        quality=QUALITY, method=2,
    )  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="animated WebP to write")
    out = parser.parse_args().out
    began = time.monotonic()
    frames = film()
    write(frames, out)
    seconds = (len(frames) / FPS - SKIP_S) / SPEED
    print(f"{out}: {seconds:.1f} s, {out.stat().st_size / 1e6:.2f} MB, made in {time.monotonic() - began:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
