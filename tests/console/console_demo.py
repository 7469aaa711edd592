"""The page's server with a synthetic robot in a room, for the browser tests, which choose the mode."""

from __future__ import annotations

import math
import threading
import time
from typing import Any

import cv2
import demo_world
import numpy as np
from numpy.typing import NDArray

from instant_ic.console.backend import ConsoleBackend
from instant_ic.console.config import ConsoleServerConfig
from instant_ic.console.gridimage import grid_image
from instant_ic.console.protocol import FrameKind
from instant_ic.console.recording import RecorderError, RecordingDesk
from instant_ic.console.server import ConsoleServer
from instant_ic.console.view import PROBE_HZ, Look, ViewConfig, view_shape
from instant_ic.geometry.poses import pose_matrix, quaternion_from_matrix, wrap_angle

CAMERA_HEIGHT_M = 1.2
STEP_S = 0.05
Pose = NDArray[np.float64]


class DemoRecorder:
    """Answers as a recorder would, and writes nothing."""

    def __init__(self) -> None:
        self.missing = False
        self.state, self.error = "idle", ""
        self.snapshots = 0
        self._began_s = 0.0

    def ask(self, command: str, **arguments: Any) -> Any:
        """Answer a command, as the recorder does for ``RecordingDesk``."""
        if self.missing:
            raise RecorderError("No recorder is running. Launch the station with recorder:=true.")
        path = f"recordings/rec_{time.strftime('%Y%m%d_%H%M%S')}"
        if command == "record":
            self.state, self._began_s = "recording", time.monotonic()
        elif command == "stop":
            self.state = "idle"
        elif command == "snapshot":
            self.snapshots += 1
        seconds = time.monotonic() - self._began_s if self.state != "idle" else 0.0
        recording = {"state": self.state, "path": path, "seconds": round(seconds, 1), "bytes": int(2e6 * seconds)}
        return {
            "path": path,
            "cached_s": 60.0,
            "recording": recording | {"error": self.error, "free_bytes": 50_000_000_000},
        }


class Demo(ConsoleBackend):
    """Backend with a simulated robot, and its server.

    Args:
        server_config: parameters of the server.
        panorama_width: width of the camera's images, pixels.
        view: size and rate of the rendered views.
        page_values: further values for the page.
    """

    def __init__(
        self, server_config: ConsoleServerConfig, panorama_width: int, view: ViewConfig, page_values: dict[str, float]
    ) -> None:
        self._view = view
        page = {"footprint": [0.6, 0.5], "camera": [0.0, 0.0, CAMERA_HEIGHT_M]}
        self.server = ConsoleServer(self, server_config, page | page_values)
        self.commands: list[tuple[float, float]] = []
        self.look = Look()
        self.estop = False
        self.button = False  # e-stop button on the robot
        self.forced_mode = "real"
        self.faults: list[dict[str, str]] = []
        self.images = True
        self.tint = (1.0, 1.0, 1.0)  # gains of the rendered view: red, green, blue
        self.mode = "real"
        self.reason = ""
        self.robot: Pose = np.zeros(3)
        self.vbot: Pose = np.zeros(3)
        self.trajectory: list[list[float]] = []
        self._command = (0.0, 0.0)
        self.placing = threading.Lock()
        self._slow_due = 0.0
        self._panorama_width = panorama_width
        self.panorama, self.panorama_camera = b"", np.zeros((4, 4))  # last panorama (JPEG) and its camera pose
        self.recorder = DemoRecorder()
        self._desk = RecordingDesk(self.recorder.ask, lambda status: self.server.publish("recording", status))
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=run, name=f"console-demo-{run.__name__}", daemon=True)
            for run in (self._move, self._send_images)
        ]

    def on_drive(self, linear: float, angular: float) -> None:
        self.commands.append((linear, angular))
        self._command = (linear, angular)

    def on_estop(self, stop: bool) -> None:
        self.estop = stop

    def on_look(self, look: Look) -> None:
        self.look = look

    def on_recorder(self, command: str, on: bool) -> None:
        if command == "record":
            self._desk.record(on)
        elif command == "snapshot":
            self._desk.snapshot()

    def start(self) -> None:
        """Start the server and the robot."""
        self.server.start()
        grid, origin = demo_world.occupancy()
        for kind, cells in ((FrameKind.MAP, grid), (FrameKind.COSTMAP, demo_world.inflate(grid))):
            image = grid_image(cells, demo_world.RESOLUTION_M, origin)
            assert image is not None
            self.server.send_frame(kind, image.header, image.payload)
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Stop the server and the robot."""
        self._stop.set()
        for thread in self._threads:
            thread.join(timeout=5.0)
        self._desk.stop()
        self.server.stop()

    def _move(self) -> None:
        last = time.monotonic()
        while not self._stop.wait(STEP_S):
            now = time.monotonic()
            with self.placing:
                self._step(min(now - last, 0.2))
            last = now
            self._publish_state()

    def _send_images(self) -> None:
        due = view_due = 0.0
        while not self._stop.wait(0.01):
            now = time.monotonic()
            if now >= due and self.images:
                due = now + 0.25
                self._send_panorama()
            rate_hz = self._view.virtual_rate_hz if self.mode == "virtual" else PROBE_HZ
            if self.images and self.server.needs_views() and now >= view_due:
                view_due = now + 1.0 / rate_hz
                self._send_view()

    def send_layers(self, keyframe: Pose) -> None:
        """Send the layers round a keyframe at this pose (m, rad)."""
        from demo_layers import demo_layers  # takes seconds to import

        self.server.send_layers(demo_layers(1, _camera(keyframe)))

    def place(self, x: float, y: float, yaw: float) -> None:
        """Place both robots at this pose (m, rad)."""
        with self.placing:
            self.robot, self.vbot = np.array([x, y, yaw]), np.array([x, y, yaw])

    def reset(self) -> None:
        """Restore the initial state, with the mode forced to REAL; for tests that share a demo."""
        self.forced_mode, self.faults, self.images = "real", [], True
        self.recorder.missing, self.recorder.error, self.recorder.state = False, "", "idle"
        self.place(0.0, 0.0, 0.0)
        self.commands.clear()

    def _step(self, seconds: float) -> None:
        stopped = self.estop or self.button
        v, w = (0.0, 0.0) if stopped else self._command
        before = self.mode
        if stopped:
            text = "The robot's emergency stop button is pressed. Release it, then release the stop here."
            self.mode, self.reason = (
                "stopped",
                text if self.button else "Emergency stop is pressed. Release it to continue.",
            )
        else:
            self.mode, self.reason = self.forced_mode, ""
        if self.mode == "virtual":
            if before != "virtual":
                self.vbot = self.robot.copy()
            self.vbot = _moved(self.vbot, v, w, seconds)
        elif self.mode == "real":
            self.robot = _moved(self.robot, v, w, seconds)
        shown = self.vbot if self.mode == "virtual" else self.robot
        self.trajectory = _ahead(shown, v, w, 3.0 * abs(v)).round(3).tolist() if v else []

    def _publish_state(self) -> None:
        now = time.monotonic()
        v, w = self._command
        self.server.publish(
            "state",
            {
                "at_ms": self.server.now_ms(),
                "mode": self.mode,
                "shown": "virtual" if self.mode == "virtual" else "real",
                "reason": self.reason,
                "estop": self.estop or self.button,
                "robot": self.robot.round(4).tolist(),
                "vbot": self.vbot.round(4).tolist() if self.mode == "virtual" else None,
                "command": [v, w],
                "twist": [v, w],
            },
        )
        self.server.show(FrameKind.VIEW if self.mode == "virtual" else FrameKind.PANORAMA)
        if now >= self._slow_due:
            self._slow_due = now + 0.5
            self._publish_health()
        self.server.publish("plan", {"trajectory": self.trajectory, "path": [], "subgoal": None})

    def _publish_health(self) -> None:
        vspace = {"state": "ready", "psnr_db": 27.4, "train_seconds": 9.0, "message": ""}
        vspace |= {"expected_psnr_db": 25.6, "unseen_share": 0.03, "radius_m": 2.0}
        battery = {"voltage": 24.6, "percent": 81.0}
        self.server.publish(
            "health", {"vspace": vspace, "battery": battery, "faults": self.faults, "nodes": [], "pace": ""}
        )
        self._desk.poll()

    def _send_panorama(self) -> None:
        captured_ms = self.server.now_ms()
        camera = _camera(self.robot)
        if not np.array_equal(self.panorama_camera, camera):  # a standing robot sees the same image
            self.panorama = _jpeg(demo_world.panorama(camera, self._panorama_width).rgb)
            self.panorama_camera = camera
        header = {"captured_ms": captured_ms, "q": quaternion_from_matrix(camera).tolist(), "p": camera[:3, 3].tolist()}
        self.server.send_frame(FrameKind.PANORAMA, header, self.panorama)

    def _send_view(self) -> None:
        captured_ms = self.server.now_ms()
        look = self.look
        fov_rad, width, height = view_shape(look, self._view)
        camera = _camera(self.vbot if self.mode == "virtual" else self.robot) @ look.rotation()
        image = demo_world.perspective(camera, width, height, fov_rad).rgb
        image = np.clip(image * np.array(self.tint), 0, 255).astype(np.uint8)
        header = {
            "captured_ms": captured_ms,
            "q": quaternion_from_matrix(camera).tolist(),
            "p": camera[:3, 3].tolist(),
            "fov": fov_rad,
        }
        self.server.send_frame(FrameKind.VIEW, header, _jpeg(image))


def _camera(pose: Pose) -> NDArray[np.float64]:
    return pose_matrix(pose[0], pose[1], CAMERA_HEIGHT_M, 0.0, 0.0, pose[2])


def _jpeg(rgb: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()


def _moved(pose: Pose, v: float, w: float, seconds: float) -> Pose:
    middle = pose[2] + w * seconds / 2
    step = np.array([v * math.cos(middle), v * math.sin(middle), w]) * seconds
    moved: Pose = pose + step
    moved[2] = wrap_angle(moved[2])
    return moved


def _ahead(pose: Pose, v: float, w: float, metres: float) -> Pose:
    """Return the path of a command, (N, 2), ``metres`` long."""
    points = []
    for _ in range(40):
        points.append(pose[:2])
        pose = _moved(pose, math.copysign(1.0, v) if v else 0.0, w / abs(v) if v else w, metres / 40)
    return np.array(points)
