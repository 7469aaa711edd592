"""Video device or network stream read by OpenCV; frames are encoded to JPEG."""

import os
import time
from collections.abc import Callable
from typing import Any

from instant_ic.camera.config import VideoConfig
from instant_ic.camera.source import Camera, CameraError, Frame


class VideoCamera(Camera):
    """Equirectangular video from ``/dev/videoN`` (or just N), ``rtsp://...``, or a video file.

    A Theta over USB appears as a device through v4l2loopback (gst_loopback).
    """

    def __init__(self, url: str, config: VideoConfig | None = None, now_ns: Callable[[], int] = time.time_ns) -> None:
        self.url = url
        self.config = config or VideoConfig()
        super().__init__(self.config.latency_s, now_ns)
        self._capture: Any = None

    def connect(self) -> str:
        import cv2

        self.close()
        source: int | str = int(self.url) if self.url.isdigit() else self.url
        if isinstance(source, str) and source.startswith("/dev/") and not os.access(source, os.R_OK | os.W_OK):
            why = "is not readable (join the group video)" if os.path.exists(source) else "does not exist"  # noqa: PTH110
            raise CameraError(f"{source} {why}; 'v4l2-ctl --list-devices' lists the devices")
        timeout_ms = round(self.config.read_timeout_s * 1000.0)
        parameters = []
        if "://" in self.url:
            parameters = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, timeout_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, timeout_ms]
        capture = cv2.VideoCapture(source, cv2.CAP_ANY, parameters)
        if not capture.isOpened():
            capture.release()
            raise CameraError(f"{self.url}: cannot be opened as video. Check the device or address.")
        if self.config.width and self.config.height:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.config.width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.config.height)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._capture = capture
        width, height = (int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        return f"video {self.url}, {width}x{height} by {capture.getBackendName()}"

    def read(self) -> Frame:
        import cv2

        if self._capture is None:
            raise CameraError(f"{self.url}: not connected; call connect() first")
        ok, image = self._capture.read()
        stamp_ns = self._stamp_ns()
        if not ok:
            self.close()
            raise CameraError(f"{self.url}: no more frames: the stream ended or the device was disconnected")
        encoded, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.config.quality])
        if not encoded:
            raise CameraError(f"{self.url}: a frame {image.shape} {image.dtype} cannot be encoded as JPEG")
        return Frame(jpeg.tobytes(), stamp_ns, int(image.shape[1]), int(image.shape[0]))

    def close(self) -> None:
        capture, self._capture = self._capture, None
        if capture is not None:
            capture.release()
