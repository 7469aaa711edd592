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
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from instant_ic.console import ConsoleServer, Look, ServerConfig
from instant_ic.console.drive import DriveConfig
from instant_ic.experiments.teleop_stack import CAMERA_HEIGHT_M, STEP_S, SimulatedStack, StackConfig, _Page
from instant_ic.experiments.teleop_worlds import make_course
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import ControlState
from instant_ic.vspace import State

CHROMIUM_FLAGS = [
    "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-quic",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip
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
        import cv2

        x, y, yaw = self.stack._newest[False].pose
        frame = self.stack.simulation.renderer.render(pose_matrix(x, y, CAMERA_HEIGHT_M, yaw=yaw), 1280, 640)
        return bytes(cv2.imencode(".jpg", frame.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())


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

    def on_estop(self, stop: bool) -> None:
        raise RuntimeError("the emergency stop is not used in this video")

    def on_record(self, on: bool) -> None:
        raise RuntimeError("recording is not used in this video")

    def on_snapshot(self) -> None:
        raise RuntimeError("snapshots are not used in this video")

    def on_bookmark(self, name: str) -> None:
        raise RuntimeError("bookmarks are not used in this video")

    def export_map(self) -> dict[str, bytes]:
        return {}


def film(args: argparse.Namespace) -> list[bytes]:
    """PNG screenshots of the page, ``args.fps`` per second of simulated time."""
    from playwright.sync_api import sync_playwright

    course = make_course(args.world, args.seed, 0)
    words = ("console.view.width:=480", "console.view.height:=270", "console.map_rate_hz:=2.0")
    config = StackConfig(depth=args.depth, seed=args.seed, whole_views=True, overrides=words)
    with SimulatedStack(course.world, config) as stack:
        operator = Operator(stack)
        patient = DriveConfig(watchdog_s=60.0, lease_timeout_s=600.0, max_command_age_s=60.0, beat_timeout_s=60.0)
        page_values = {"footprint": [0.6, 0.5], "camera": [0.0, 0.0, CAMERA_HEIGHT_M]}
        server = ConsoleServer(operator, ServerConfig(port=0, drive=patient), page_values)
        stack.page = stack.nodes["console"].feed.server = page_in = Page(stack, server)
        stack.nodes["console"].feed_layers(True)
        server.start()
        try:
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=CHROMIUM_FLAGS)
                context = browser.new_context(viewport={"width": args.width, "height": args.height})
                context.add_init_script(CLOCK)
                page = context.new_page()
                page.goto(f"{server.url}?quality=full")
                frames = drive(stack, page, page_in, operator, args)
                browser.close()
        finally:
            server.stop()
    return frames


def drive(stack: SimulatedStack, page: Any, told: Page, operator: Operator, args: argparse.Namespace) -> list[bytes]:
    """Wait until the virtual space is ready, hold W through the obstacle, release it behind the obstacle."""
    frames: list[bytes] = []
    steps = round(1.0 / args.fps / STEP_S)
    ready_s = pressed_s = back_s = None
    was_virtual = False
    while True:
        for _ in range(steps):
            stack.step(lambda: operator.command)
        page.wait_for_timeout(args.settle_ms)  # images arrive over a real socket and are decoded
        for part in (0.5, 1.0):
            page.evaluate("(ms) => film(ms)", 1e3 * (stack.time_s - (1 - part) / args.fps))
        now, state = stack.time_s, stack.state
        if now > LONGEST_S:
            raise RuntimeError(f"the drive has not finished after {LONGEST_S:g} s: {state and state.reason}")
        if ready_s is None:
            ready = state is not None and int(state.mode) == ControlState.REAL and vspace_ready(stack)
            drives = page.locator('body[data-driver="you"][data-image="live"]').count() > 0
            ready_s = now if ready and drives else None
            continue
        frames.append(page.screenshot(type="png"))
        print(f"\r{len(frames)} frames, {now - ready_s:.1f} s, {told.mode}   ", end="", file=sys.stderr)
        if pressed_s is None and now > ready_s + 0.8:
            pressed_s = now
            page.keyboard.down("w")
        was_virtual |= told.virtual
        if was_virtual and not told.virtual and back_s is None:
            back_s = now
        if back_s is not None and now > back_s + args.after_s:
            page.keyboard.up("w")
        if back_s is not None and now > back_s + args.after_s + 0.8:
            print(file=sys.stderr)
            return frames


def vspace_ready(stack: SimulatedStack) -> bool:
    return stack.nodes["nerf"].schedule.state == State.READY


def write(frames: list[bytes], args: argparse.Namespace) -> None:
    """Write an animated WebP, which GitHub shows in a README."""
    from PIL import Image

    kept = frames[round(args.skip_s * args.fps) :: args.every]
    pictures = [Image.open(io.BytesIO(frame)).convert("RGB") for frame in kept]
    if args.frames:
        args.frames.mkdir(parents=True, exist_ok=True)
        for number, frame in enumerate(frames):
            (args.frames / f"{number:04d}.png").write_bytes(frame)
    small = [picture.resize((args.out_width, round(args.out_width * picture.height / picture.width)), Image.LANCZOS)
             for picture in pictures]  # fmt: skip
    small[0].save(
        args.out, save_all=True, append_images=small[1:], duration=round(1000 * args.every / args.fps / args.speed),
        loop=0, quality=args.quality, method=2,
    )  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="animated WebP to write")
    parser.add_argument("--world", default="corridor", help="as for `ic evaluate teleop` (default corridor)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--depth", default="fused", choices=("fused", "lidar"))
    parser.add_argument("--fps", type=int, default=10, help="frames per second; must divide 60 (default 10)")
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--height", type=int, default=600)
    parser.add_argument("--out-width", type=int, default=704)
    parser.add_argument("--quality", type=int, default=50)
    parser.add_argument("--every", type=int, default=2, help="keep every Nth frame (default 2)")
    parser.add_argument("--skip-s", type=float, default=4.4, help="seconds to skip at the start (default 4.4)")
    parser.add_argument("--speed", type=float, default=1.5, help="playback speed (default 1.5)")
    parser.add_argument(
        "--after-s", type=float, default=1.5, help="seconds to keep driving after the switch back (default 1.5)"
    )
    parser.add_argument("--settle-ms", type=int, default=120, help="real time to wait for each frame (default 120)")
    parser.add_argument("--frames", type=Path, metavar="DIR", help="also write all frames to this folder")
    args = parser.parse_args()
    if round(1 / STEP_S) % args.fps:
        parser.error(f"--fps must divide {round(1 / STEP_S)}")
    began = time.monotonic()
    frames = film(args)
    write(frames, args)
    megabytes = args.out.stat().st_size / 1e6
    seconds = (len(frames) / args.fps - args.skip_s) / args.speed
    print(f"{args.out}: {seconds:.1f} s, {megabytes:.2f} MB, made in {time.monotonic() - began:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
