"""Publishes 360-degree images: Theta Z1 live preview, a video device or stream, or image files."""

from __future__ import annotations

from instant_ic.bus import ERROR, OK, SENSOR, WARN, Node, NodeError, main
from instant_ic.camera.config import ThetaCameraConfig
from instant_ic.camera.device import open_camera
from instant_ic.camera.files import FileCamera
from instant_ic.camera.liveness import LiveImages
from instant_ic.camera.loop import CameraLoop
from instant_ic.camera.source import CameraError, Frame
from instant_ic.camera.theta import ThetaCamera
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import CompressedImage, compressed_image_message


class ThetaCameraNode(Node[ThetaCameraConfig]):
    name = "theta_camera"
    live_parameters = ("silence_s", "camera_mount")

    def setup(self) -> None:
        config = self.config
        self.loop: CameraLoop | None = None
        self.out = self.publisher("/camera/image/compressed", CompressedImage, qos=SENSOR)
        self.broadcast_mount()
        self.last_ns = self.started_ns = self.clock.steady_ns()
        self.published = self.published_told = 0
        self.images = LiveImages()
        try:
            self.camera = open_camera(config, self.clock.now_ns)
        except CameraError as error:
            raise NodeError(str(error)) from None
        self.diagnose("camera", WARN, f"connecting to {config.url}")
        self.timer(1.0, self.check)
        if isinstance(self.camera, FileCamera):
            self.play_files(self.camera)
            return
        if self.lockstep:
            raise NodeError(f"source {config.source} cannot run in lockstep: use source:=files")
        self.loop = CameraLoop(
            self.camera,
            on_frame=self.on_frame,
            on_event=lambda connected, text: self.call_soon(self.on_event, connected, text),
        )
        if isinstance(self.camera, ThetaCamera):
            client = self.camera.client
            worker = self.background(lambda _: client.health(), self.diagnose_all)
            self.timer(config.health_period_s, lambda: worker.submit(None))
        self.loop.start()

    def broadcast_mount(self) -> None:
        self.transforms.broadcast_static("base_link", self.config.frame_id, pose_matrix(*self.config.camera_mount.pose))

    def reconfigure(self, config: ThetaCameraConfig) -> None:
        super().reconfigure(config)
        self.broadcast_mount()

    def play_files(self, camera: FileCamera) -> None:
        """Play files on the node's timer."""
        try:
            self.on_event(True, camera.connect())
        except CameraError as error:
            raise NodeError(str(error)) from error
        self.timer(1.0 / self.config.files.rate_hz, lambda: self.publish(camera.read()))

    def on_frame(self, frame: Frame) -> None:
        """Publish a device's image on the camera's thread, unless it is a copy or empty. Video files may repeat."""
        if self.camera.recorded or self.images.is_live(frame):
            self.publish(frame)

    def publish(self, frame: Frame) -> None:
        """Publish an image unchanged."""
        self.out.publish(compressed_image_message(frame.jpeg, self.config.frame_id, frame.stamp_ns))
        self.last_ns = self.clock.steady_ns()
        self.published += 1

    def on_event(self, connected: bool, text: str) -> None:
        advice = self.camera.advice if connected else ""
        level = WARN if advice else OK if connected else ERROR
        self.diagnose("camera", level, f"{text}. {advice}" if advice else text)

    def check(self) -> None:
        """Report missing images and the frame rate, each second."""
        silent_s = (self.clock.steady_ns() - self.last_ns) * 1e-9
        values = {
            "images": self.published,
            "rate_hz": self.published - self.published_told,
            "bad_images": self.camera.bad_frames,
            "withheld": self.images.withheld,
        }
        self.published_told = self.published
        if self.images.fault:
            self.diagnose("images", ERROR, self.images.fault, **values)
            return
        if silent_s <= self.config.silence_s:
            if self.published:
                self.diagnose("images", OK, "receiving images", **values)
            return
        level = ERROR if silent_s > 4.0 * self.config.silence_s else WARN
        self.diagnose("images", level, f"no image for {silent_s:.1f} s", **values)

    def teardown(self) -> None:
        loop = getattr(self, "loop", None)
        if loop is not None:
            if loop.is_alive() and not loop.end():
                self.log.warning("the camera's thread is still waiting for %s and is abandoned", self.config.url)
        elif hasattr(self, "camera"):
            self.camera.close()


if __name__ == "__main__":
    main(ThetaCameraNode)
