"""Web API of the Ricoh Theta Z1 (OSC 2) over HTTP: state, options and live preview."""

import json
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from instant_ic.camera.config import FORMATS_FIRMWARE, PREVIEW_FORMATS
from instant_ic.config.ranges import PositiveInt, Range, check_ranges
from instant_ic.sim.theta_options import NEVER, OptionError, ThetaOptions
from instant_ic.util.limits import load_image
from instant_ic.util.pace import current

log = logging.getLogger(__name__)

BOUNDARY = "---osclivepreview---"
#: Largest delay of an image in seconds at which the stack works as with a punctual camera.
ACCEPTABLE_DELAY_S = 0.06
JPEG_QUALITY = 92
#: Standard deviation of the sensor's noise, out of 255, so that no two images are equal. It makes a JPEG 2 % larger.
NOISE = 1.0
_NOISE_STEP = 389
"""Number of columns by which the noise moves per image; a prime, so that it repeats only after the whole width."""
#: Time after setting options during which the preview is not ready, seconds.
SETTLE_S = 0.8


@dataclass(frozen=True)
class SimThetaConfig:
    """Parameters of the simulated camera.

    Attributes:
        enabled: whether the camera is simulated.
        host, port: address of its Web API; port 0 selects a free one.
        width, height: preview format until a driver sets another one.
        rate: largest frame rate, even if the format allows more.
        latency_s: time from the exposure of an image to its delivery.
    """

    enabled: bool = True
    host: str = "127.0.0.1"
    port: Annotated[int, Range(0, 65535)] = 8089
    width: PositiveInt = 1024
    height: PositiveInt = 512
    rate: Annotated[float, Range(above=0, high=30)] = 5.0
    latency_s: Annotated[float, Range(0, below=2)] = 0.20

    def __post_init__(self) -> None:
        if (self.width, self.height) not in {f[:2] for f in PREVIEW_FORMATS}:
            formats = ", ".join(sorted({f"{w}x{h}" for w, h, _ in PREVIEW_FORMATS}))
            raise ValueError(f"width and height must be one of {formats} (got {self.width}x{self.height})")
        check_ranges(self)


#: Function that returns the camera's view for a width and height: panorama (H, W, 3), sRGB, without sensor noise.
ImageSource = Callable[[int, int], npt.NDArray[np.uint8]]


def panorama_file(path: str | Path) -> ImageSource:
    """Return a source that always gives the panorama of a file, area-averaged to the requested size.

    Raises:
        ValueError: the file cannot be decoded as an image.
    """
    import cv2

    image = load_image(path, cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"panorama {path} cannot be decoded as an image")
    rgb = np.ascontiguousarray(image[..., ::-1])
    sized: dict[tuple[int, int], npt.NDArray[np.uint8]] = {}

    def source(width: int, height: int) -> npt.NDArray[np.uint8]:
        if (width, height) not in sized:
            sized[width, height] = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        return sized[width, height]

    return source


class ThetaServer:
    """A camera with its Web API, which renders images only while a client reads the preview.

    The image source is called on the camera's thread. ``seed`` is that of the noise in each image.

    Raises:
        OSError: the port is in use.

    Attributes:
        port: listening port.
        rate_hz: recent frame rate; 0 without a viewer and for the first four frames.
        frames: number of delivered images.
        stopping: True while the camera is closing.
        late_s: recent delay of the images behind schedule, in the stack's seconds; 0 without a viewer.
    """

    def __init__(self, config: SimThetaConfig, source: ImageSource, seed: int = 0) -> None:
        self.config = config
        self._rng = np.random.default_rng([67, seed])
        self._noise: npt.NDArray[np.int8] = np.empty((0, 0, 3), np.int8)
        self._noise_first = 0
        self.source = source
        self.rate_hz = 0.0
        self.frames = 0
        self.late_s = 0.0
        self._options = ThetaOptions(next(f for f in PREVIEW_FORMATS if f[:2] == (config.width, config.height)))
        # A camera that stays on keeps the options of the driver's last run.
        self._options.set({"sleepDelay": NEVER, "offDelay": NEVER})
        self._options_set_s = -1e9
        self._frame: bytes | None = None
        self._number = 0
        self._viewers = 0
        self._changed = threading.Condition()
        self.stopping = False
        server = self

        class Handler(_Handler):
            camera = server

        try:
            self._http = ThreadingHTTPServer((config.host, config.port), Handler)
        except OSError as error:
            raise OSError(
                f"the camera's Web API cannot listen on {config.host}:{config.port} ({error.strerror}). Stop the "
                "program that uses the port, or set camera.port."
            ) from error
        self._http.daemon_threads = True
        self.port = int(self._http.server_address[1])
        self._threads = [
            threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.05}, name="theta-http"),
            threading.Thread(target=self._make_frames, name="theta-camera"),
        ]
        for thread in self._threads:
            thread.daemon = True
            thread.start()

    @property
    def watched(self) -> bool:
        """True while a client reads the preview."""
        return self._viewers > 0

    def close(self) -> None:
        """End the streams and the server."""
        with self._changed:
            self.stopping = True
            self._changed.notify_all()
        self._http.shutdown()
        self._http.server_close()
        for thread in self._threads:
            # An image in progress on a busy machine is not waited for: no client needs it, and the thread is a daemon.
            thread.join(0.3)

    # --- images -------------------------------------------------------------------------------------

    def _jpeg(self, rgb: npt.NDArray[np.uint8]) -> bytes:
        import cv2

        height, width = rgb.shape[:2]
        if self._noise.shape[:2] != (height, 2 * width):
            self._noise = np.rint(self._rng.normal(0.0, NOISE, (height, 2 * width, 3))).astype(np.int8)
        # The offsets take turns. Random offsets would soon repeat, and two images of a standing robot would be equal.
        self._noise_first = (self._noise_first + _NOISE_STEP) % width
        first = self._noise_first
        noisy = cv2.add(rgb, self._noise[:, first : first + width], dtype=cv2.CV_8U)
        bgr = cv2.cvtColor(noisy, cv2.COLOR_RGB2BGR)
        ok, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not ok:
            raise RuntimeError(f"OpenCV could not encode an image of {rgb.shape[1]}x{rgb.shape[0]}")
        return encoded.tobytes()

    def _make_frames(self) -> None:
        due = current().steady_s()
        made, period_s = 0, 0.0
        while True:
            with self._changed:
                while self._viewers == 0 and not self.stopping:
                    self.rate_hz, self.late_s, made = 0.0, 0.0, 0
                    self._changed.wait(1.0)
                    due = current().steady_s()
                if self.stopping:
                    return
                width, height, promised = self._options.preview
            began = current().steady_s()
            jpeg = self._jpeg(self.source(width, height))
            self._sleep(began + self.config.latency_s)
            late_s = current().steady_s() - began - self.config.latency_s
            with self._changed:
                self._frame = jpeg
                self._number += 1
                self.frames += 1
                self._changed.notify_all()
            period = 1.0 / min(self.config.rate, promised)
            # If rendering takes too long, the camera delivers fewer images, but never old ones.
            due += period
            late_s = min(
                max(late_s, current().steady_s() - due, 0.0), period
            )  # because a single late image does not mean a slow machine
            self.late_s = 0.5 * self.late_s + 0.5 * late_s
            due = max(due, current().steady_s())
            self._sleep(due)
            took = current().steady_s() - began
            made += 1
            period_s = took if made == 1 else 0.8 * period_s + 0.2 * took
            # The first images are always late, so the rate is reported only after them.
            if made >= 5:
                self.rate_hz = 1 / period_s

    def _sleep(self, until: float) -> None:
        """Sleep until a time on the stack's steady clock."""
        with self._changed:
            while not self.stopping and (left := until - current().steady_s()) > 0:
                self._changed.wait(current().wait_s(left))

    def next_frame(self, after: int, timeout_s: float) -> tuple[int, bytes] | None:
        """Return the number and JPEG of the newest image after image ``after``; None on a time-out or at shutdown."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while (self._number <= after or self._frame is None) and not self.stopping:
                left = deadline - time.monotonic()
                if left <= 0:
                    return None
                self._changed.wait(left)
            if self.stopping or self._frame is None:
                return None
            return self._number, self._frame

    # --- Web API ------------------------------------------------------------------------------------

    def info(self) -> dict[str, Any]:
        """Reply to GET /osc/info."""
        return {
            "manufacturer": "RICOH",
            "model": "RICOH THETA Z1",
            "serialNumber": "YN10000000",
            "firmwareVersion": FORMATS_FIRMWARE,
            "apiLevel": [2],
        }

    def state(self) -> dict[str, Any]:
        """Reply to POST /osc/state."""
        return {"state": {"batteryLevel": 0.8, "_batteryTemp": 31, "_boardTemp": 44, "_cameraError": []}}

    def execute(self, name: str, parameters: Any) -> dict[str, Any]:
        """Reply to a command other than the live preview.

        Raises:
            OptionError: the command is refused.
        """
        if not isinstance(parameters, dict):
            raise OptionError("invalidParameterValue", "parameters must be an object")
        if name == "camera.setOptions":
            with self._changed:
                self._options.set(parameters.get("options"))
                self._options_set_s = time.monotonic()
            return {"name": name, "state": "done"}
        if name == "camera.getOptions":
            wanted = parameters.get("optionNames")
            if not isinstance(wanted, list):
                raise OptionError("missingParameter", "optionNames is missing")
            return {"name": name, "state": "done", "results": {"options": self._options.get(wanted)}}
        raise OptionError("unknownCommand", f"command {name} is not known")

    def open_preview(self) -> int:
        """Add a viewer and return the number of the newest image; the viewer gets the images after it.

        Raises:
            OptionError: the camera is not ready yet after a change of options.
        """
        if time.monotonic() - self._options_set_s < SETTLE_S:
            raise OptionError("serviceUnavailable", "the camera is changing its settings", 503)
        with self._changed:
            self._viewers += 1
            self._changed.notify_all()
            return self._number

    def close_preview(self) -> None:
        """Remove a viewer."""
        with self._changed:
            self._viewers -= 1


class _Handler(BaseHTTPRequestHandler):
    """A connection to the camera."""

    camera: ThetaServer
    protocol_version = "HTTP/1.1"
    # Seconds after which a client that stops reading is disconnected.
    timeout = 30.0

    def log_message(self, format: str, *args: Any) -> None:
        """Write requests to the debug log."""
        log.debug("theta: " + format, *args)

    def do_GET(self) -> None:
        if self.path == "/osc/info":
            self._reply(200, self.camera.info())
        else:
            self._refuse(OptionError("invalidParameterValue", f"{self.path} does not exist", 404))

    def do_POST(self) -> None:
        """Reply to POST requests: state and commands."""
        length = int(self.headers.get("Content-Length") or 0)
        body = self.rfile.read(length) if 0 <= length < 1_000_000 else b""
        name = ""
        try:
            if self.path == "/osc/state":
                self._reply(200, self.camera.state())
                return
            if self.path != "/osc/commands/execute":
                raise OptionError("invalidParameterValue", f"{self.path} does not exist", 404)
            request = json.loads(body)
            if not isinstance(request, dict) or not isinstance(request.get("name"), str):
                raise OptionError("missingParameter", "name is missing")
            name = request["name"]
            if name == "camera.getLivePreview":
                self._preview()
            else:
                self._reply(200, self.camera.execute(name, request.get("parameters", {})))
        except OptionError as error:
            self._refuse(error, name)
        except ValueError:
            self._refuse(OptionError("invalidParameterValue", "the body is not JSON"))

    def _refuse(self, error: OptionError, name: str = "") -> None:
        value = {"name": name, "state": "error", "error": {"code": error.code, "message": str(error)}}
        self._reply(error.status, value)

    def _reply(self, status: int, value: Any) -> None:
        body = json.dumps(value).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json;charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _preview(self) -> None:
        number = self.camera.open_preview()
        self.close_connection = True
        try:
            self.send_response(200)
            self.send_header("Content-Type", f'multipart/x-mixed-replace; boundary="{BOUNDARY}"')
            self.send_header("Transfer-Encoding", "chunked")
            self.end_headers()
            while not self.camera.stopping:
                frame = self.camera.next_frame(number, 5.0)
                if frame is None:
                    continue
                number, jpeg = frame
                # The camera sends its boundary without the two leading dashes of RFC 2046.
                head = f"{BOUNDARY}\r\nContent-type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode()
                part = head + jpeg + b"\r\n"
                self.wfile.write(f"{len(part):x}\r\n".encode() + part + b"\r\n")
            self.wfile.write(b"0\r\n\r\n")
        except (BrokenPipeError, ConnectionResetError, TimeoutError):
            log.debug("theta: a viewer left the preview")
        finally:
            self.camera.close_preview()
