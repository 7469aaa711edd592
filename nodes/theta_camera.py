"""Publishes 360-degree images: Theta Z1 live preview, a video device or stream, or image files."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Literal

from instant_ic.bus import ERROR, OK, SENSOR, WARN, Node, NodeError, main
from instant_ic.camera.config import FilesConfig, ThetaConfig, VideoConfig
from instant_ic.camera.files import FileCamera
from instant_ic.camera.loop import CameraLoop, ReconnectConfig
from instant_ic.camera.source import Camera, CameraError, Frame
from instant_ic.camera.theta import ThetaCamera, ThetaClient, ThetaState
from instant_ic.camera.video import VideoCamera
from instant_ic.config.ranges import Positive, check_ranges
from instant_ic.config.robot import CAMERA_MOUNT, Mount
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import CompressedImage, compressed_image_message

USER_VARIABLE = "INSTANT_IC_THETA_USER"
PASSWORD_VARIABLE = "INSTANT_IC_THETA_PASSWORD"
"""Environment variable for the credentials: parameters are visible in ``ic param`` and in files."""

_BATTERY_LOW = 0.2  # share of the charge
_BOARD_HOT_C = 70.0


@dataclass(frozen=True)
class ThetaCameraConfig:
    """Parameters.

    Attributes:
        source: ``theta`` (Web API), ``video`` (device, RTSP address or video file), ``files``.
        url: address of the Theta; device, address or path for the other sources.
        frame_id: the camera's frame.
        camera_mount: the camera's pose on base_link.
        silence_s: seconds without an image that cause a warning; four times as long is an error.
        health_period_s: seconds between requests for the Theta's battery and temperature.
        theta: live preview.
        video: stream through OpenCV.
        files: images from files.
        reconnect: delays between connection attempts.
    """

    source: Literal["theta", "video", "files"] = "theta"
    url: str = "http://192.168.1.1"
    frame_id: str = "camera"
    camera_mount: Mount = CAMERA_MOUNT
    silence_s: Positive = 2.0
    health_period_s: Positive = 10.0
    theta: ThetaConfig = field(default_factory=ThetaConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    files: FilesConfig = field(default_factory=FilesConfig)
    reconnect: ReconnectConfig = field(default_factory=ReconnectConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.url:
            raise ValueError("url must not be empty")


class ThetaCameraNode(Node[ThetaCameraConfig]):
    name = "theta_camera"
    live_parameters = ("silence_s", "camera_mount")

    def setup(self) -> None:
        """Create the topics, the mount and the loop that reads the camera."""
        config = self.config
        self.loop: CameraLoop | None = None
        self.out = self.publisher("/camera/image/compressed", CompressedImage, qos=SENSOR)
        self.broadcast_mount()
        self.last_ns = self.started_ns = self.clock.steady_ns()
        self.published = self.published_told = 0
        self.camera = self.make_camera()
        self.diagnose("camera", WARN, f"connecting to {config.url}")
        self.timer(1.0, self.check)
        if self.lockstep:
            self.play_in_lockstep()
            return
        self.loop = CameraLoop(
            self.camera,
            on_frame=self.publish,
            on_event=lambda connected, text: self.call_soon(self.on_event, connected, text),
            reconnect=config.reconnect,
        )
        if isinstance(self.camera, ThetaCamera):
            self.health = self.background(ask_state, self.on_health)
            client = self.camera.client
            self.timer(config.health_period_s, lambda: self.health.submit(client))
        self.loop.start()

    def broadcast_mount(self) -> None:
        """Broadcast the camera's mount on the robot."""
        self.tf_broadcast_static("base_link", self.config.frame_id, pose_matrix(*self.config.camera_mount.pose))

    def reconfigure(self, config: ThetaCameraConfig) -> None:
        super().reconfigure(config)
        self.broadcast_mount()

    def make_camera(self) -> Camera:
        """The camera that the parameters select."""
        config, now_ns = self.config, self.clock.now_ns
        if config.source == "theta":
            user, password = os.environ.get(USER_VARIABLE, ""), os.environ.get(PASSWORD_VARIABLE, "")
            return ThetaCamera(config.url, config.theta, user, password, now_ns)
        if config.source == "video":
            return VideoCamera(config.url, config.video, now_ns)
        return FileCamera(config.url, config.files, now_ns)

    def play_in_lockstep(self) -> None:
        """Play files on the node's own timer; devices have their own time and cannot be stepped."""
        camera = self.camera
        if not isinstance(camera, FileCamera):
            raise NodeError(f"source {self.config.source} cannot run in lockstep: use source:=files")
        try:
            self.on_event(True, camera.connect())
        except CameraError as error:
            raise NodeError(str(error)) from error
        self.timer(1.0 / self.config.files.rate_hz, lambda: self.publish(camera.next_frame()))

    def publish(self, frame: Frame) -> None:
        """Publish an image unchanged; runs on the camera's thread."""
        self.out.publish(compressed_image_message(frame.jpeg, self.config.frame_id, frame.stamp_ns))
        self.last_ns = self.clock.steady_ns()
        self.published += 1

    def on_event(self, connected: bool, text: str) -> None:
        """Report a connection or its loss."""
        self.diagnose("camera", OK if connected else ERROR, text)

    def check(self) -> None:
        """Report silence and the frame rate; each second."""
        silent_s = (self.clock.steady_ns() - self.last_ns) * 1e-9
        values = {
            "images": self.published,
            "rate_hz": self.published - self.published_told,
            "bad_images": self.camera.bad_frames,
        }
        self.published_told = self.published
        if silent_s <= self.config.silence_s:
            if self.published:
                self.diagnose("images", OK, "receiving images", **values)
            return
        level = ERROR if silent_s > 4.0 * self.config.silence_s else WARN
        self.diagnose("images", level, f"no image for {silent_s:.1f} s", **values)

    def on_health(self, health: ThetaState | str) -> None:
        """Report battery, temperature and errors of the Theta."""
        if isinstance(health, str):
            self.diagnose("health", WARN, health)
            return
        low = health.battery is not None and health.battery < _BATTERY_LOW
        hot = health.board_temperature_c is not None and health.board_temperature_c >= _BOARD_HOT_C
        text = [
            *(["battery is low: charge it"] if low else []),
            *(["it is getting hot"] if hot else []),
            *health.errors,
        ]
        self.diagnose(
            "health",
            ERROR if health.errors else WARN if low or hot else OK,
            ", ".join(text) or "no faults",
            battery=health.battery,
            battery_temperature_c=health.battery_temperature_c,
            board_temperature_c=health.board_temperature_c,
        )

    def teardown(self) -> None:
        loop = getattr(self, "loop", None)
        if loop is not None:
            if loop.is_alive() and not loop.end():
                self.log.warning("the camera's thread is still waiting for %s and is abandoned", self.config.url)
        elif hasattr(self, "camera"):
            self.camera.close()


def ask_state(client: ThetaClient) -> ThetaState | str:
    """State of the camera, or the reason why it is unknown; for a worker thread."""
    try:
        return client.state()
    except CameraError as error:
        return str(error)


if __name__ == "__main__":
    main(ThetaCameraNode)
