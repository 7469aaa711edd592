#!/usr/bin/env python3
"""Latency from a key press in Chromium to the base, and to the motion shown in the virtual space; prints JSON.

    python benchmarks/latency.py --presses 30 --json latency.json

The nodes are the real ones, each in its own process, at their rates and with their parameters: console, arbiter and
virtual_robot for the path to the base; console, virtual_robot and nerf (source warp) for the path to the image. Their
input from the robot is simulated here: scan, poses, odometry, images, one keyframe, and in the second part the
arbiter's state. In the whole stack SLAM, depth and the simulator load the machine as well: benchmarks/stack.py measures
the path to the base there.

All times start at the browser's time of the key event:

- ``base_ms``: to the command on /cmd_vel.
- ``shown_forward_ms``: to the first frame from a position 2 mm or more in the commanded direction (half a pixel at the
  image's edge, for objects 2 m away); ``shown_first_ms``: 0.5 mm or more.
- ``shown_turn_ms``: to the first frame with another heading (0.05 degrees or more).
- ``pixels_forward_ms``, ``pixels_turn_ms``: to the end of the first frame whose pixels, read back from the canvas,
  differ from those before the key. The CPU has rendered the frame by then; the compositor has not shown it yet.
- ``new_view_ms``: to the frame with the first view of the server rendered from another position (0.5 mm or more); none
  where the page renders the virtual space by itself.

They include the robot's own acceleration: 2 mm take 71 ms at 0.8 m/s2. ``steps_ms`` breaks the time down by step, and
``draws_hz`` is the page's frame rate while the v-bot moved. Reading back delays the frames up to the first one that
differs. ``server_views`` counts the views to be shown that `nerf` rendered meanwhile: none for a page that renders by
itself.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import socket
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from reporting import parser_for, report

from instant_ic.bus import LATCHED, SENSOR
from instant_ic.console.view import PROBE
from instant_ic.experiments.page_renderer import launch_chromium
from instant_ic.experiments.stack import Stack, free_port
from instant_ic.geometry.poses import pose_matrix
from instant_ic.launch.pacing import machine_pace
from instant_ic.msg import (
    ControlState,
    Keyframe,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    VspaceStatus,
    compressed_image_message,
    header,
    image_message,
    matrix_from_pose,
    message_type,
    odometry_message,
    pose_message,
    scan_message,
    to_time,
    transform_message,
    twist_message,
    twist_values,
)
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.worlds import corridor_world

LAUNCH = """launch:
- node:
    exec: console
    param:
    - from: $(config console.yaml)
    - {{name: server.port, value: {port}}}
    - {{name: server.access.simulated, value: true}}
- node: {{exec: virtual_robot, param: [{{from: $(config control.yaml)}}]}}
{more}
"""
ARBITER = "- node: {exec: arbiter, param: [{from: $(config control.yaml)}]}"
NERF = "- node: {exec: nerf, param: [{from: $(config nerf.yaml)}, {name: space.source, value: warp}]}"
CAMERA_Z = 1.2
WATCH = """
const STRIP = 16, DIFFERENT = 0.5; // rows of pixels; grey levels, mean
window.presses = [];
let before = null; // pixels of the last frame at rest
const strip = () => {
    const gl = document.getElementById("view").getContext("webgl2"), {drawingBufferWidth: width} = gl;
    const low = Math.round(0.2 * gl.drawingBufferHeight), pixels = new Uint8Array(4 * width * STRIP);
    gl.readPixels(0, low, width, STRIP, gl.RGBA, gl.UNSIGNED_BYTE, pixels); // waits until all of it is rendered
    return pixels;
};
const apartBy = (a, b) => a.length === b.length
    ? a.reduce((sum, value, i) => sum + Math.abs(value - b[i]), 0) / a.length : 0;
const signs = {KeyW: 1, KeyS: -1};
let last = null;
addEventListener("keydown", (event) => {
    if (event.repeat) return;
    const pressed = performance.timeOrigin + event.timeStamp, sign = signs[event.code] ?? 0;
    const unset = {forward: 0, first: 0, view: 0, turn: 0, pixels: 0};
    presses.push({code: event.code, sign, pressed, from: last, draws: [], ...unset});
}, true);
addEventListener("rendered", ({detail}) => {
    const now = performance.timeOrigin + performance.now(), press = presses.at(-1);
    if (detail.blend > 0.99 && (!press || now - press.pressed > 600)) before = strip();
    else if (before && press && !press.pixels && apartBy(strip(), before) > DIFFERENT)
        press.pixels = performance.timeOrigin + performance.now();
    if (!detail.place || !detail.pose) return;
    if (press?.from && detail.blend > 0.99) {
        const way = [0, 1].map((i) => detail.place[i] - press.from.place[i]), yaw = press.from.yaw;
        const ahead = press.sign * (way[0] * Math.cos(yaw) + way[1] * Math.sin(yaw));
        press.draws.push(now);
        if (!press.forward && ahead >= 0.002) press.forward = now;
        if (!press.first && ahead >= 0.0005) press.first = now;
        const seen = detail.view?.p, origin = press.from.p;
        const apart = seen && origin ? Math.hypot(seen[0] - origin[0], seen[1] - origin[1]) : 0;
        if (!press.view && apart > 0.0005) press.view = now;
        if (!press.turn && Math.abs(detail.pose[2] - yaw) > 0.00087) press.turn = now;
    }
    last = {p: detail.view?.p, place: detail.place, yaw: detail.pose[2]};
});
"""


class Robot:
    """Simulated input of the nodes from a robot in the simulator's corridor; the base follows commands at once."""

    def __init__(self, stack: Stack, virtual: bool) -> None:
        self.stack, self.virtual = stack, virtual
        self.stop, self.error = threading.Event(), ""
        self.marks: dict[str, int] = {}  # step -> time when it was first seen since the last press, ns
        observer = stack.observer
        self.out = {
            topic: observer.publisher(topic, kind, qos=qos)
            for topic, kind, qos in (
                ("/tf", message_type("TFMessage"), SENSOR),
                ("/tf_static", message_type("TFMessage"), LATCHED),
                ("/scan", message_type("LaserScan"), SENSOR),
                ("/wheel/odom", message_type("Odometry"), SENSOR),
                ("/pose", PoseWithCovarianceStamped, SENSOR),
                ("/camera/image/compressed", message_type("CompressedImage"), SENSOR),
                ("/keyframe", Keyframe, LATCHED),
                *([("/ic/state", ControlState, LATCHED)] if virtual else [("/vspace/status", VspaceStatus, LATCHED)]),
            )
        }
        self.vbot = np.eye(4)
        self.mode = -1
        self.views = 0
        self.operator, self.holder = twist_message(), ""  # newest command, and who sent it
        self.requested = np.eye(4)
        observer.subscribe("/cmd_vel", message_type("TwistStamped"), self.on_moving("cmd_vel"), SENSOR)
        observer.subscribe("/operator/cmd_vel", message_type("TwistStamped"), self.on_operator, SENSOR)
        observer.subscribe("/vbot/odom", message_type("Odometry"), self.on_vbot, SENSOR)
        observer.subscribe("/view/request", message_type("ViewRequest"), self.on_request, SENSOR)
        observer.subscribe("/vspace/view", message_type("RenderedView"), self.on_view, SENSOR)
        if not virtual:
            observer.subscribe("/ic/state", ControlState, self.on_state, LATCHED)
        renderer, pose = EquirectRenderer(corridor_world()), pose_matrix(z=CAMERA_Z)
        rgb = renderer.render(pose, 1280, 640).rgb
        self.jpeg = cv2.imencode(".jpg", rgb[..., ::-1])[1].tobytes()
        self.depth_m = renderer.render(pose, 512, 256).depth_m
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def mark(self, step: str) -> None:
        self.marks.setdefault(step, time.time_ns())

    def on_moving(self, step: str) -> Callable[[Any], None]:
        def on_command(message: Any) -> None:
            if any(twist_values(message)):
                self.mark(step)

        return on_command

    def on_operator(self, message: Any) -> None:
        self.on_moving("operator")(message)
        changed = twist_values(message) != twist_values(self.operator)
        self.operator, self.holder = message.twist, f"console/{message.header.frame_id}"
        if self.virtual and changed:
            self.tell_state(time.time_ns())  # as the arbiter does

    def on_vbot(self, message: Any) -> None:
        self.vbot = matrix_from_pose(message)
        if any(twist_values(message)):
            self.mark("vbot")

    def on_request(self, message: Any) -> None:
        pose = matrix_from_pose(message.pose)
        if np.abs(pose - self.requested).max() > 0.0005:
            self.mark("request")
        self.requested = pose

    def on_view(self, message: Any) -> None:
        self.views += message.width > 2 * PROBE[0]  # smaller ones are only judged
        if "request" in self.marks and np.abs(matrix_from_pose(message.pose) - self.requested).max() < 1e-6:
            self.mark("view")

    def on_state(self, message: Any) -> None:
        self.mode = int(message.mode)

    def run(self) -> None:
        try:
            step = 0
            due = time.monotonic()
            while not self.stop.is_set():
                self.stack.observer.spin_once()
                if time.monotonic() >= due:
                    due = max(due + 0.05, time.monotonic() - 0.2)
                    self.tell(step)
                    step += 1
                self.stack.observer.rest(due - time.monotonic())
        except Exception as error:  # noqa: BLE001 - reported in the waiting thread
            self.error = f"{type(error).__name__}: {error}"

    def tell(self, step: int) -> None:
        """Publish the robot's topics, 20 times per second."""
        now, here, send = time.time_ns(), np.eye(4), lambda topic, message: self.out[topic].publish(message)
        tf = message_type("TFMessage")
        if step % 20 == 0:
            mounts = [("camera", CAMERA_Z), ("velodyne", 0.6)]
            send("/tf_static", tf([transform_message(pose_matrix(z=z), "base_link", name, now) for name, z in mounts]))
        send(
            "/tf",
            tf([transform_message(here, "map", "odom", now), transform_message(here, "odom", "base_link", now)]),
        )
        send("/wheel/odom", odometry_message(here, 0.0, 0.0, "odom", "base_link", now))
        if step % 2 == 0:
            angles = 2 * np.pi / 720
            ranges = np.full(720, 6.0, np.float32)  # free in all directions
            send("/scan", scan_message(ranges, -np.pi, angles, 0.4, 100.0, "velodyne", now))
            covariance = PoseWithCovariance(pose=pose_message(here), covariance=np.eye(6).ravel() * 1e-4)
            send("/pose", PoseWithCovarianceStamped(header=header("map", now), pose=covariance))
            send("/camera/image/compressed", compressed_image_message(self.jpeg, "camera", now))
        if self.virtual:
            self.tell_virtual(step, now)
        elif step % 10 == 0:
            send("/vspace/status", vspace_status(now))

    def tell_virtual(self, step: int, now: int) -> None:
        if step == 0:
            self.out["/keyframe"].publish(
                Keyframe(
                    header=header("map", now), id=1, pose=pose_message(pose_matrix(z=CAMERA_Z)),
                    panorama=compressed_image_message(self.jpeg, "camera", now),
                    depth=image_message(self.depth_m, "32FC1", "camera", now),
                    sigma=image_message(np.empty((0, 0), np.uint8), "mono8", "camera", now),
                    source="lidar", scale=1.0, quality=1.0, relative_sigma=0.01, fit=True, message="",
                )
            )  # fmt: skip
        self.tell_state(now)

    def tell_state(self, now: int) -> None:
        self.out["/ic/state"].publish(
            ControlState(
                header=header("map", now), mode=ControlState.VIRTUAL, reason="", estop=False, blocked=False,
                transitions=1, robot_pose=pose_message(self.vbot), vbot_start=pose_message(np.eye(4)),
                vbot_pose=pose_message(self.vbot), operator_command=self.operator, applied_command=twist_message(),
                pose_gap_m=0.0, yaw_gap_rad=0.0, time_to_obstacle_s=float("inf"), shown=ControlState.SHOWN_VIRTUAL,
                vbot_action=ControlState.VBOT_DRIVEN, vbot_target=pose_message(np.eye(4)), robot_twist=twist_message(),
                vbot_limit_m_s=0.5, reason_code=ControlState.REASON_DRIVE_VBOT,
                holder=self.holder,
            )
        )  # fmt: skip


def vspace_status(now: int) -> Any:
    return VspaceStatus(
        header=header("map", now), state=VspaceStatus.EMPTY, keyframe_id=0, keyframe_pose=pose_message(np.eye(4)),
        keyframe_stamp=to_time(0), ready_radius_m=0.0, psnr_db=0.0, train_seconds=0.0, ready_seconds=0.0, iterations=0,
        ms_per_iteration=0.0, render_ms=0.0, render_fps=0.0, device="", message="", expected_psnr_db=0.0,
        unseen_share=0.0,
    )  # fmt: skip


def part(virtual: bool, args: argparse.Namespace) -> dict[str, Any]:
    """Measure one of the two paths, with its own stack and browser."""
    from playwright.sync_api import sync_playwright

    run_dir = Path(tempfile.mkdtemp(prefix="ic-"))
    port = free_port()
    launch = run_dir / "latency.yaml"
    launch.write_text(LAUNCH.format(port=port, more=NERF if virtual else ARBITER))
    try:
        with Stack(str(launch), run_dir, {}) as stack, sync_playwright() as playwright:
            robot = Robot(stack, virtual)
            try:
                wait(
                    robot,
                    lambda: serves(port) if virtual else robot.mode == ControlState.REAL,
                    args.wait,
                    "the nodes",
                )
                browser = launch_chromium(playwright)
                page = browser.new_page(viewport={"width": args.width, "height": args.height})
                page.add_init_script(WATCH)
                page.goto(f"http://127.0.0.1:{port}/")
                shows = f'body[data-driver="you"][data-blend="{int(virtual)}.00"][data-image="live"]'
                page.locator(shows).wait_for(timeout=args.wait * 1000)
                page.wait_for_timeout(2000)
                until_it_renders(page, robot, args.wait)
                rows = press_keys(page, robot, ["KeyW", "KeyA", "KeyS", "KeyD"] if virtual else ["KeyW", "KeyS"], args)
                browser.close()
            finally:
                robot.stop.set()
                robot.thread.join(timeout=5.0)
            return figures(rows, virtual) | ({"server_views": robot.views} if virtual else {})
    finally:
        shutil.rmtree(run_dir, ignore_errors=True)


def serves(port: int) -> bool:
    """Whether the page's server answers."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def wait(robot: Robot, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        robot.stack.check_alive(what)
        if robot.error or time.monotonic() > deadline:
            raise RuntimeError(f"no {what} within {timeout_s:g} s; {robot.error}\n{robot.stack.log_tail()}")
        time.sleep(0.02)


def until_it_renders(page: Any, robot: Robot, timeout_s: float) -> None:
    """Wait until the page needs no more views, because the layers are there; then count views from 0."""
    deadline = time.monotonic() + timeout_s
    robot.views = 1
    while robot.views:
        if time.monotonic() > deadline:
            raise RuntimeError(f"the page does not render by itself within {timeout_s:g} s\n{robot.stack.log_tail()}")
        robot.views = 0
        page.wait_for_timeout(3000)


def press_keys(page: Any, robot: Robot, keys: list[str], args: argparse.Namespace) -> list[dict[str, Any]]:
    rows, jitter = [], random.Random(1)
    for number in range(args.presses * (len(keys) // 2)):
        robot.marks.clear()
        key = keys[number % len(keys)]
        page.keyboard.down(key)
        page.wait_for_timeout(500)
        page.keyboard.up(key)
        page.wait_for_timeout(900 + jitter.uniform(0, 100))  # not in phase with any timer
        row = page.evaluate("presses.at(-1)")
        rows.append(row | {"marks": dict(robot.marks)})
    return rows


def figures(rows: list[dict[str, Any]], virtual: bool) -> dict[str, Any]:
    """Medians and 95th percentiles, ms."""
    straight = [row for row in rows if row["code"] in ("KeyW", "KeyS")]
    turns = [row for row in rows if row["code"] in ("KeyA", "KeyD")]

    def since(chosen: list[dict[str, Any]], end: Callable[[dict[str, Any]], float]) -> dict[str, Any]:
        values = sorted(end(row) - row["pressed"] for row in chosen if end(row))
        if len(values) < 2:
            return {"n": len(values), "missed": len(chosen) - len(values)}
        p95 = statistics.quantiles(values, n=20, method="inclusive")[18]
        return {
            "p50": round(statistics.median(values), 1), "p95": round(p95, 1), "n": len(values),
            "missed": len(chosen) - len(values),
        }  # fmt: skip

    def marked(step: str) -> Callable[[dict[str, Any]], float]:
        return lambda row: row["marks"].get(step, 0) / 1e6

    if not virtual:
        return {
            "base_ms": since(straight, marked("cmd_vel")),
            "steps_ms": {"to_the_bus": since(straight, marked("operator"))},
        }
    steps = ("operator", "vbot", "request", "view")
    return {
        "shown_forward_ms": since(straight, lambda row: row["forward"]),
        "shown_first_ms": since(straight, lambda row: row["first"]),
        "shown_turn_ms": since(turns, lambda row: row["turn"]),
        "pixels_forward_ms": since(straight, lambda row: row["pixels"]),
        "pixels_turn_ms": since(turns, lambda row: row["pixels"]),
        "new_view_ms": since(straight, lambda row: row["view"]),
        "draws_hz": round(statistics.median(draws_hz(row) for row in straight), 1),
        "steps_ms": {step: since(straight, marked(step)) for step in steps},
    }


def draws_hz(row: dict[str, Any]) -> float:
    """Frames per second in the half second of the press."""
    return sum(0 <= at - row["pressed"] < 500 for at in row["draws"]) / 0.5


def main() -> int:
    parser = parser_for(__doc__)
    parser.add_argument("--presses", type=int, default=30, help="for each figure (default 30)")
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--height", type=int, default=600)
    parser.add_argument("--wait", type=float, default=180.0, help="seconds for the nodes to start (default 180)")
    args = parser.parse_args()
    if args.presses < 2:
        parser.error("--presses must be 2 or more")
    result: dict[str, Any] = {
        "cores": os.cpu_count(),
        # 1.0: fast enough for a whole simulated stack in real time. Below it, and under other load, latencies are
        # longer.
        "machine_pace": round(machine_pace(), 2),
        "load_average": round(os.getloadavg()[0], 1),
        "targets_ms": {"base_p50": 40, "shown_p50": 50},
    }
    result |= {"real": part(False, args), "virtual": part(True, args)}
    report(result, args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
