#!/usr/bin/env python3
"""Latency from a key press in Chromium to the motion shown in the virtual space; prints JSON.

    python benchmarks/latency.py --presses 30 --json latency.json

The nodes are the real ones, each in its own process, at their rates and with their parameters: console, virtual_robot
and nerf (source warp). Their input from the robot is simulated here: poses, odometry, images, one keyframe and the
arbiter's state. benchmarks/stack.py measures the path from a key to the base in the whole stack.

All times start at the browser's time of the key event:

- ``shown_forward_ms``: to the first frame from a position 2 mm or more in the commanded direction (half a pixel at the
  image's edge, for objects 2 m away); ``shown_first_ms``: 0.5 mm or more.
- ``shown_turn_ms``: to the first frame with another heading (0.05 degrees or more).
- ``pixels_forward_ms``, ``pixels_turn_ms``: to the end of the first frame whose pixels, read back from the canvas,
  differ from those before the key. The CPU has rendered the frame by then; the compositor has not shown it yet.

All of them include the robot's own acceleration: 2 mm take 71 ms at 0.8 m/s2. Reading back delays the frames up to the
first one that differs.
"""

from __future__ import annotations

import contextlib
import os
import random
import socket
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from browser import launch_chromium
from reporting import parser_for, report

from instant_ic.bus import LATCHED, SENSOR
from instant_ic.console.view import PROBE
from instant_ic.experiments.stack import Stack, free_port
from instant_ic.geometry.poses import pose_matrix
from instant_ic.launch.pacing import machine_pace
from instant_ic.msg import (
    ControlState,
    Keyframe,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    TFMessage,
    compressed_image_message,
    header,
    image_message,
    matrix_from_pose,
    message_type,
    odometry_message,
    pose_message,
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
- node: {{exec: nerf, param: [{{from: $(config nerf.yaml)}}, {{name: space.source, value: warp}}]}}
"""
CAMERA_Z = 1.2
START_S = 180.0
"""Longest time for the nodes to start, and for the page to show them."""
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
    const unset = {forward: 0, first: 0, turn: 0, pixels: 0};
    presses.push({code: event.code, sign, pressed, from: last, ...unset});
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
        if (!press.forward && ahead >= 0.002) press.forward = now;
        if (!press.first && ahead >= 0.0005) press.first = now;
        if (!press.turn && Math.abs(detail.pose[2] - yaw) > 0.00087) press.turn = now;
    }
    last = {place: detail.place, yaw: detail.pose[2]};
});
"""


class SimulatedInput:
    """Input of the nodes from a robot at rest in the simulator's corridor while its virtual robot drives."""

    def __init__(self, stack: Stack) -> None:
        self.stack = stack
        self.error = ""
        self.views = 0
        """Views rendered by the server, without those that only measure readiness."""
        self._vbot = np.eye(4)
        self._operator, self._holder = twist_message(), ""  # newest command, and its sender
        self._stop = threading.Event()
        observer = stack.observer
        self._publishers = {
            topic: observer.publisher(topic, message_type(kind), qos=qos)
            for topic, kind, qos in (
                ("/tf", "TFMessage", SENSOR),
                ("/tf_static", "TFMessage", LATCHED),
                ("/wheel/odom", "Odometry", SENSOR),
                ("/pose", "PoseWithCovarianceStamped", SENSOR),
                ("/camera/image/compressed", "CompressedImage", SENSOR),
                ("/keyframe", "Keyframe", LATCHED),
                ("/ic/state", "ControlState", LATCHED),
            )
        }
        observer.subscribe("/operator/cmd_vel", message_type("TwistStamped"), self._on_operator, SENSOR)
        observer.subscribe("/vbot/odom", message_type("Odometry"), self._on_vbot, SENSOR)
        observer.subscribe("/vspace/view", message_type("RenderedView"), self._on_view, SENSOR)
        renderer, pose = EquirectRenderer(corridor_world()), pose_matrix(z=CAMERA_Z)
        rgb = renderer.render(pose, 1280, 640).rgb
        self._jpeg = cv2.imencode(".jpg", rgb[..., ::-1])[1].tobytes()
        self._depth_m = renderer.render(pose, 512, 256).depth_m
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the robot's thread."""
        self._stop.set()
        self._thread.join(timeout=5.0)

    def _on_operator(self, message: Any) -> None:
        changed = twist_values(message) != twist_values(self._operator)
        self._operator, self._holder = message.twist, f"console/{message.header.frame_id}"
        if changed:
            self._publish_state(time.time_ns())  # as the arbiter does

    def _on_vbot(self, message: Any) -> None:
        self._vbot = matrix_from_pose(message)

    def _on_view(self, message: Any) -> None:
        self.views += message.width > 2 * PROBE[0]

    def _run(self) -> None:
        try:
            step, due = 0, time.monotonic()
            while not self._stop.is_set():
                self.stack.observer.spin_once()
                if time.monotonic() >= due:
                    due = max(due + 0.05, time.monotonic() - 0.2)
                    self._publish(step)
                    step += 1
                self.stack.observer.rest(due - time.monotonic())
        except Exception as error:  # noqa: BLE001 - reported in the waiting thread
            self.error = f"{type(error).__name__}: {error}"

    def _publish(self, step: int) -> None:
        """Publish the robot's topics, 20 times per second."""
        now, here = time.time_ns(), np.eye(4)
        frames = [transform_message(here, "map", "odom", now), transform_message(here, "odom", "base_link", now)]
        self._send("/tf", TFMessage(frames))
        self._send("/wheel/odom", odometry_message(here, 0.0, 0.0, "odom", "base_link", now))
        self._publish_state(now)
        if step % 20 == 0:
            mounts = [("camera", CAMERA_Z), ("velodyne", 0.6)]
            mounts = [transform_message(pose_matrix(z=z), "base_link", name, now) for name, z in mounts]
            self._send("/tf_static", TFMessage(mounts))
        if step % 2 == 0:
            covariance = PoseWithCovariance(pose=pose_message(here), covariance=np.eye(6).ravel() * 1e-4)
            self._send("/pose", PoseWithCovarianceStamped(header=header("map", now), pose=covariance))
            self._send("/camera/image/compressed", compressed_image_message(self._jpeg, "camera", now))
        if step == 0:
            self._send("/keyframe", self._keyframe(now))

    def _send(self, topic: str, message: Any) -> None:
        self._publishers[topic].publish(message)

    def _keyframe(self, now: int) -> Any:
        return Keyframe(
            header=header("map", now), id=1, pose=pose_message(pose_matrix(z=CAMERA_Z)),
            panorama=compressed_image_message(self._jpeg, "camera", now),
            depth=image_message(self._depth_m, "32FC1", "camera", now),
            sigma=image_message(np.empty((0, 0), np.uint8), "mono8", "camera", now),
            source="lidar", scale=1.0, quality=1.0, relative_sigma=0.01, fit=True, message="",
        )  # fmt: skip

    def _publish_state(self, now: int) -> None:
        state = ControlState(
            header=header("map", now), mode=ControlState.VIRTUAL, reason="", estop=False, blocked=False,
            transitions=1, robot_pose=pose_message(self._vbot), vbot_start=pose_message(np.eye(4)),
            vbot_pose=pose_message(self._vbot), operator_command=self._operator, applied_command=twist_message(),
            pose_gap_m=0.0, yaw_gap_rad=0.0, time_to_obstacle_s=float("inf"), shown=ControlState.SHOWN_VIRTUAL,
            vbot_action=ControlState.VBOT_DRIVEN, vbot_target=pose_message(np.eye(4)), robot_twist=twist_message(),
            vbot_limit_m_s=0.5, reason_code=ControlState.REASON_DRIVE_VBOT, holder=self._holder,
        )  # fmt: skip
        self._send("/ic/state", state)


def measure(presses: int) -> dict[str, Any]:
    """Start the nodes and a browser, press keys, and return the figures."""
    from playwright.sync_api import sync_playwright

    port = free_port()
    with contextlib.ExitStack() as ends:
        run_dir = Path(ends.enter_context(tempfile.TemporaryDirectory(prefix="ic-", ignore_cleanup_errors=True)))
        launch = run_dir / "latency.yaml"
        launch.write_text(LAUNCH.format(port=port))
        stack = ends.enter_context(Stack(str(launch), run_dir, {}))
        robot = ends.enter_context(contextlib.closing(SimulatedInput(stack)))
        browser = launch_chromium(ends.enter_context(sync_playwright()))
        wait(robot, lambda: serves(port), "the nodes")
        page = browser.new_page(viewport={"width": 960, "height": 600})
        page.add_init_script(WATCH)
        page.goto(f"http://127.0.0.1:{port}/")
        page.locator('body[data-driver="you"][data-blend="1.00"][data-image="live"]').wait_for(timeout=START_S * 1000)
        page.wait_for_timeout(2000)
        wait_for_layers(page, robot)
        rows = press_keys(page, presses)
        browser.close()
    return figures(rows)


def serves(port: int) -> bool:
    """Return whether the page's server answers."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def wait(robot: SimulatedInput, condition: Callable[[], bool], what: str) -> None:
    """Wait until a condition of the stack is true.

    Raises:
        RuntimeError: it is not within ``START_S``, or the simulated robot failed.
    """
    deadline = time.monotonic() + START_S
    while not condition():
        robot.stack.check_alive(what)
        if robot.error or time.monotonic() > deadline:
            raise RuntimeError(f"no {what} within {START_S:g} s; {robot.error}\n{robot.stack.log_tail()}")
        time.sleep(0.02)


def wait_for_layers(page: Any, robot: SimulatedInput) -> None:
    """Wait until the page has the layers and therefore needs no view of the server for 3 s."""
    deadline = time.monotonic() + START_S
    robot.views = 1
    while robot.views:
        if time.monotonic() > deadline:
            raise RuntimeError(f"the page does not render by itself within {START_S:g} s\n{robot.stack.log_tail()}")
        robot.views = 0
        page.wait_for_timeout(3000)


def press_keys(page: Any, presses: int) -> list[dict[str, Any]]:
    """Press the keys in turn; return what the page saw of each press."""
    rows, jitter = [], random.Random(1)
    for number in range(2 * presses):
        key = ("KeyW", "KeyA", "KeyS", "KeyD")[number % 4]
        page.keyboard.down(key)
        page.wait_for_timeout(500)
        page.keyboard.up(key)
        page.wait_for_timeout(900 + jitter.uniform(0, 100))  # not in phase with any timer
        rows.append(page.evaluate("presses.at(-1)"))
    return rows


def figures(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return medians and 95th percentiles in milliseconds."""
    straight = [row for row in rows if row["code"] in ("KeyW", "KeyS")]
    turns = [row for row in rows if row["code"] in ("KeyA", "KeyD")]

    def since(chosen: list[dict[str, Any]], ends: Iterable[float]) -> dict[str, Any]:
        values = [end - row["pressed"] for row, end in zip(chosen, ends, strict=True) if end]
        found: dict[str, Any] = {"n": len(values), "missed": len(chosen) - len(values)}
        if len(values) >= 2:
            found["p50"] = round(statistics.median(values), 1)
            found["p95"] = round(statistics.quantiles(values, n=20, method="inclusive")[18], 1)
        return found

    def rendered(chosen: list[dict[str, Any]], event: str) -> dict[str, Any]:
        return since(chosen, (row[event] for row in chosen))

    return {
        "shown_forward_ms": rendered(straight, "forward"),
        "shown_first_ms": rendered(straight, "first"),
        "shown_turn_ms": rendered(turns, "turn"),
        "pixels_forward_ms": rendered(straight, "pixels"),
        "pixels_turn_ms": rendered(turns, "pixels"),
    }


def main() -> int:
    parser = parser_for(__doc__)
    parser.add_argument("--presses", type=int, default=30, help="presses for each figure (default 30)")
    args = parser.parse_args()
    if args.presses < 2:
        parser.error("--presses must be 2 or more")
    result: dict[str, Any] = {
        "cores": os.cpu_count(),
        # At 1.0 the machine runs a whole simulated stack in real time. Below 1.0, latencies are longer.
        "machine_pace": round(machine_pace(), 2),
        "load_average": round(os.getloadavg()[0], 1),
        "targets_ms": {"shown_p50": 50},
        **measure(args.presses),
    }
    report(result, args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
