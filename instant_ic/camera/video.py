"""Video device or network stream read by OpenCV; frames are encoded to JPEG."""

import math
import os
import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from instant_ic.camera.config import VideoConfig
from instant_ic.camera.source import JPEG_QUALITY, Camera, CameraError, Frame
from instant_ic.util.pace import current

_OPEN_S = 10.0
"""Time-out of opening: a USB camera takes seconds until its format is settled."""
_CLOSE_S = 1.0
"""Time-out of closing a device that answers, so that it can be opened again."""
_MOST_HUNG = 2
"""Readers that may hang in a driver at once; no further one is started until one of them returns."""
_LOOK_S = 0.1
"""Period at which a waiting call checks whether it is cancelled."""


class VideoCamera(Camera):
    """Equirectangular video from ``/dev/videoN`` (or just N), ``rtsp://...``, or a video file.

    A Theta over USB appears as a device through v4l2loopback (gst_loopback). A device may open and send nothing, and a
    read in its driver cannot be interrupted. Reads run on a thread of their own, which is abandoned if it hangs.
    """

    def __init__(
        self,
        url: str,
        config: VideoConfig | None = None,
        now_ns: Callable[[], int] = time.time_ns,
        user: str = "",
        password: str = "",
    ) -> None:
        self.url = url
        scheme, separator, rest = url.partition("://")
        user, password = quote(user, safe=""), quote(password, safe="")
        placed = url.replace("{user}", user).replace("{password}", password)
        signed_in = f"{scheme}://{user}:{password}@{rest}" if placed == url else placed
        self._source = signed_in if user and separator else url  # shown nowhere
        self.config = config or VideoConfig()
        super().__init__(self.config.latency_s, now_ns)
        self.recorded = not separator and Path(url).is_file()
        self._reader: _Reader | None = None
        self._hung: list[_Reader] = []

    def connect(self) -> str:
        self.close()
        self._hung = [reader for reader in self._hung if reader.is_alive()]
        if len(self._hung) >= _MOST_HUNG:
            raise CameraError(
                f"{self.url}: {len(self._hung)} reads have not returned: the device's driver hangs. Unplug the camera "
                "and plug it in again; if that does not help, restart the node"
            )
        self._reader = _Reader(self._open, self._stamp_ns)
        self._reader.start()
        return str(self._wait(_OPEN_S, f"cannot be opened within {_OPEN_S:g} s. Check the device or address."))

    def read(self) -> Frame:
        import cv2

        if self._reader is None:
            raise CameraError(f"{self.url}: not connected; call connect() first")
        self._reader.ask()
        timeout_s = self.config.read_timeout_s
        ok, image, stamp_ns = self._wait(
            current().timeout_s(timeout_s),
            f"is open, but sends no image for {timeout_s:g} s. Check that the camera is in live streaming mode and "
            "that the program that feeds the device runs.",
        )
        if not ok:
            self.close()
            raise CameraError(f"{self.url}: no more frames: the stream ended or the device was disconnected")
        encoded, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not encoded:
            raise CameraError(f"{self.url}: a frame {image.shape} {image.dtype} cannot be encoded as JPEG")
        return Frame(jpeg.tobytes(), stamp_ns, int(image.shape[1]), int(image.shape[0]))

    def close(self) -> None:
        reader, self._reader = self._reader, None
        if reader is not None and not reader.end(_CLOSE_S):
            self._hung.append(reader)

    def _wait(self, timeout_s: float, otherwise: str) -> Any:
        """Return the reader's answer. Abandon the reader if it does not answer in time or the camera is cancelled."""
        assert self._reader is not None
        try:
            return self._reader.answer(timeout_s, self.cancelled)
        except TimeoutError:
            self.close()
            raise CameraError(f"{self.url}: {otherwise}") from None
        except BaseException:
            self.close()
            raise

    def _open(self) -> tuple[Any, str]:
        """Open the source, and return its capture and its description; runs on the reader's thread."""
        import cv2

        source: int | str = int(self.url) if self.url.isdigit() else self._source
        if isinstance(source, str) and source.startswith("/dev/") and not os.access(source, os.R_OK | os.W_OK):
            why = "is not readable (join the group video)" if os.path.exists(source) else "does not exist"  # noqa: PTH110
            raise CameraError(f"{source} {why}; 'v4l2-ctl --list-devices' lists the devices")
        timeout_ms = round(self.config.read_timeout_s * 1000.0)
        parameters = []
        if "://" in self.url:
            parameters = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, timeout_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, timeout_ms]
        # OpenCV takes the time-out of devices from here, in whole seconds, once in a process; the default is 10 s.
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(math.ceil(self.config.read_timeout_s)))
        if self._source != self.url:  # OpenCV would log an address that it cannot open, including its password
            cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        capture = cv2.VideoCapture(source, cv2.CAP_ANY, parameters)
        if not capture.isOpened():
            capture.release()
            raise CameraError(f"{self.url}: cannot be opened as video. Check the device or address.")
        if self.config.width and self.config.height:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.config.width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.config.height)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        width, height = (int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        return capture, f"video {self.url}, {width}x{height} by {capture.getBackendName()}"


class _Reader(threading.Thread):
    """Thread that opens a capture, reads an image on each request, and finally releases the capture.

    Args:
        open_capture: function that returns the capture and its description; the description is the first answer.
        stamp_ns: clock of the images.
    """

    def __init__(self, open_capture: Callable[[], tuple[Any, str]], stamp_ns: Callable[[], int]) -> None:
        super().__init__(name="video", daemon=True)
        self._open = open_capture
        self._stamp_ns = stamp_ns
        self._asked: queue.SimpleQueue[bool] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._waiting = 1

    def run(self) -> None:
        capture = None
        try:
            capture, text = self._open()
            self._answers.put(text)
            while self._asked.get():
                self._answers.put((*capture.read(), self._stamp_ns()))
        except Exception as error:  # noqa: BLE001 - the thread that waits raises it
            self._answers.put(error)
        finally:
            if capture is not None:
                capture.release()

    def ask(self) -> None:
        """Begin to read an image."""
        self._waiting += 1
        self._asked.put(True)

    def answer(self, timeout_s: float, cancelled: threading.Event) -> Any:
        """Return the next answer.

        Raises:
            TimeoutError: no answer came in time, or the camera was cancelled.
        """
        until_s = time.monotonic() + timeout_s
        while not cancelled.is_set() and (left_s := until_s - time.monotonic()) > 0.0:
            try:
                found = self._answers.get(timeout=min(_LOOK_S, left_s))
            except queue.Empty:
                continue
            self._waiting -= 1
            if isinstance(found, Exception):
                raise found
            return found
        raise TimeoutError

    def end(self, timeout_s: float) -> bool:
        """Let the thread end; return False if it hangs. Do not wait for a thread that has not answered yet."""
        self._asked.put(False)
        if not self._waiting:
            self.join(timeout_s)
        return not self.is_alive()
