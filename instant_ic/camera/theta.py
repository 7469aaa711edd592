"""Ricoh Theta Z1 over its Web API (Open Spherical Camera API, level 2, with Ricoh's options)."""

import contextlib
import json
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import requests
import urllib3

from instant_ic.camera.config import FORMATS_FIRMWARE, OLD_PREVIEW_FORMATS, ThetaConfig
from instant_ic.camera.http import DeviceSession, is_multipart
from instant_ic.camera.preview import PreviewParser
from instant_ic.camera.source import Camera, CameraError, Frame
from instant_ic.util.diagnosis import Diagnosis, Level
from instant_ic.util.jpeg import JpegError, jpeg_size
from instant_ic.util.limits import MOST_PIXELS
from instant_ic.util.pace import current

NEVER = 65535
"""Value of sleepDelay and offDelay that keeps the camera from sleeping or switching itself off."""
_NEVER_READ = (0, NEVER)
"""Values that the camera reports after `NEVER` was set."""

Format = tuple[int, int, int]
"""Width, height and frame rate of the preview."""

_BATTERY_LOW = 0.2  # share of the charge
_BOARD_HOT_C = 70.0
_CHUNK = 64 << 10
_MOST_TEXT = 200
"""Characters of a text from the camera that go into logs and diagnostics."""
_OLD_FIRMWARE = (
    "The camera refused {}, which needs firmware {} or later; it has {}. Update it with Ricoh's app for computers."
)


class ThetaError(CameraError):
    """The camera refused a command.

    Attributes:
        code: error code of the API, such as ``disabledCommand``; ``http`` and the status if the reply has none.
    """

    def __init__(self, text: str, code: str) -> None:
        super().__init__(text)
        self.code = code


class ThetaClient:
    """Commands to the camera over one persistent connection; safe to use from several threads.

    Its methods raise `CameraError` if the camera does not answer, and `ThetaError` if it refuses a command.

    Example:
        >>> client = ThetaClient("http://192.168.1.1", ThetaConfig())       # doctest: +SKIP
        >>> client.info()["model"]                                          # doctest: +SKIP
        'RICOH THETA Z1'
    """

    def __init__(
        self,
        url: str,
        config: ThetaConfig,
        user: str = "",
        password: str = "",
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Create the client without sending anything.

        Args:
            url: such as http://192.168.1.1 (the camera's own network), or the camera's address in your network.
            config: time-outs and retries.
            user: for digest authentication, which the camera requires in client mode; its serial number.
            password: the digits of the serial number, unless changed.
            sleep: waits between repeats.
        """
        self.url = url.rstrip("/")
        self.config = config
        self._user = user
        self._password = password
        self.sleep = sleep
        self._lock = threading.Lock()
        self._session = DeviceSession(user, password)

    def close(self) -> None:
        """Close the connection."""
        self._session.close()

    def info(self) -> dict[str, Any]:
        """Return model, serial number and firmware (``GET /osc/info``)."""
        return self._call("GET", "/osc/info", None)

    def health(self) -> Diagnosis:
        """Ask for battery, temperatures and errors (``POST /osc/state``), which may take seconds."""
        try:
            state = self._call("POST", "/osc/state", {}).get("state")
        except CameraError as error:
            return Diagnosis("health", Level.WARN, str(error))
        state = state if isinstance(state, dict) else {}
        battery, board_c = _number(state, "batteryLevel"), _number(state, "_boardTemp")
        errors = state.get("_cameraError")
        errors = errors if isinstance(errors, list) else [errors] if errors else []
        low, hot = battery is not None and battery < _BATTERY_LOW, board_c is not None and board_c >= _BOARD_HOT_C
        text = [
            *(["battery is low: charge it"] if low else []),
            *(["the camera is hot: switch it off to cool down"] if hot else []),
            *(str(error)[:_MOST_TEXT] for error in errors[:20]),
        ]
        values = {
            "battery": battery,
            "battery_temperature_c": _number(state, "_batteryTemp"),
            "board_temperature_c": board_c,
        }
        level = Level.ERROR if errors else Level.WARN if low or hot else Level.OK
        return Diagnosis("health", level, ", ".join(text) or "no faults", values)

    def execute(self, name: str, parameters: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Run a command and return its results."""
        reply = self._call("POST", "/osc/commands/execute", {"name": name, "parameters": dict(parameters or {})})
        results = reply.get("results", {})
        return results if isinstance(results, dict) else {}

    def options(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the values of options (``camera.getOptions``); empty if the camera refuses the command."""
        try:
            options = self.execute("camera.getOptions", {"optionNames": list(names)}).get("options")
        except ThetaError:
            return {}
        return options if isinstance(options, dict) else {}

    def set_options(self, options: Mapping[str, Any]) -> None:
        """Set options (``camera.setOptions``); the camera refuses an unknown option or value."""
        self.execute("camera.setOptions", {"options": dict(options)})

    def open_preview(self) -> tuple[DeviceSession, requests.Response]:
        """Start ``camera.getLivePreview`` on its own connection; the caller must close both."""
        session = DeviceSession(self._user, self._password)
        try:
            body, timeout_s = {"name": "camera.getLivePreview"}, current().timeout_s(self.config.read_timeout_s)
            response = self._request(session, "POST", "/osc/commands/execute", body, timeout_s)
            if not is_multipart(response):
                kind = response.headers.get("Content-Type", "")[:_MOST_TEXT]
                raise CameraError(f"{self.url}: the preview is {kind or 'of no type'} instead of multipart")
        except CameraError:
            session.close()
            raise
        return session, response

    def _call(self, method: str, path: str, body: Mapping[str, Any] | None) -> dict[str, Any]:
        with self._lock:
            response = self._request(self._session, method, path, body, self.config.connect_timeout_s)
        reply = _json(response)
        if reply is None:
            found = "a multipart stream" if is_multipart(response) else repr(response.content[:80])
            response.close()
            raise CameraError(f"{self.url}{path}: the reply is not a JSON object ({found})")
        if reply.get("state") == "error":
            raise _refusal(self.url + path, body, response.status_code, reply)
        return reply

    def _request(
        self, session: DeviceSession, method: str, path: str, body: Mapping[str, Any] | None, timeout_s: float
    ) -> requests.Response:
        """Send one request; repeat it with growing waits while the camera is busy."""
        wait_s, url = self.config.busy_wait_s, self.url + path
        for attempt in range(self.config.busy_retries + 1):
            session.deadline_s = time.monotonic() + timeout_s
            try:
                response = session.request(
                    method, url, json=body, timeout=timeout_s, stream=True, allow_redirects=False
                )
            except requests.RequestException as error:
                raise CameraError(
                    f"{url}: no answer ({_cause(error)}). Check that the camera is on, in the same network, "
                    "and in the expected wireless mode."
                ) from error
            except (AttributeError, KeyError, ValueError) as error:  # raised by the digest of requests
                raise CameraError(f"{url}: the camera's digest challenge cannot be answered ({error!r})") from error
            if response.status_code != 503:
                break
            if attempt < self.config.busy_retries:
                response.close()
                self.sleep(wait_s)
                wait_s *= 2.0
        if response.status_code == 200:
            return response
        refusal = _refusal(url, body, response.status_code, _json(response) or {})
        response.close()
        raise refusal


class ThetaCamera(Camera):
    """Live preview of a Theta Z1."""

    def __init__(self, client: ThetaClient, now_ns: Callable[[], int] = time.time_ns) -> None:
        self.config = client.config
        super().__init__(self.config.latency_s, now_ns)
        self.client = client
        self._refused: set[tuple[str, Format]] = set()
        """Firmware and the preview formats that it refused."""
        self._session: DeviceSession | None = None
        self._response: requests.Response | None = None
        self._parser = PreviewParser()

    def connect(self) -> str:
        """Set the camera up if needed, start its preview, and return a text with model, firmware and format."""
        self._end_preview()
        info = self.client.info()
        model, firmware = (str(info.get(key, "unknown"))[:_MOST_TEXT] for key in ("model", "firmwareVersion"))
        width, height, rate_hz = chosen = self._set_up(firmware)
        wanted = (self.config.width, self.config.height, self.config.rate_hz)
        self.advice = "" if chosen == wanted else _OLD_FIRMWARE.format(_named(wanted), FORMATS_FIRMWARE, firmware)
        self._session, self._response = self.client.open_preview()
        found = re.search(r"boundary=\"?([^\";]+)", self._response.headers.get("Content-Type", ""))
        self._parser = PreviewParser(found.group(1) if found else "")
        return f"{model} (firmware {firmware}) at {self.client.url}, preview {width}x{height} at {rate_hz} Hz"

    def _set_up(self, firmware: str) -> Format:
        """Set the options that are not set already, and return the preview format.

        A format that the firmware has refused is not requested again, because each setting delays the preview.
        """
        config = self.config
        wanted = (config.width, config.height, config.rate_hz)
        choices = dict.fromkeys([wanted, (config.width, config.height, 8), *OLD_PREVIEW_FORMATS])
        formats = [choice for choice in choices if (firmware, choice) not in self._refused]
        found = self.client.options(["sleepDelay", "offDelay", "previewFormat"])
        awake = all(found.get(name) in _NEVER_READ for name in ("sleepDelay", "offDelay"))
        # Some cameras report no format, or zeros: the option is set then.
        if awake and found.get("previewFormat") == _option(formats[0]):
            return formats[0]
        for choice in formats:
            try:
                self.client.set_options({"sleepDelay": NEVER, "offDelay": NEVER, "previewFormat": _option(choice)})
            except ThetaError as error:
                if error.code != "invalidParameterValue" or choice == formats[-1]:
                    raise
                self._refused.add((firmware, choice))
            else:
                break
        # A preview that is started sooner has the previous format or stops at once.
        self.client.sleep(config.settle_s)
        return choice

    def read(self) -> Frame:
        """Return the newest complete image. The camera ends the preview when it shoots or changes its mode."""
        response, session = self._response, self._session
        if response is None or session is None:
            raise CameraError(f"{self.client.url}: not connected; call connect() first")
        session.deadline_s = time.monotonic() + current().timeout_s(self.config.read_timeout_s)
        while True:
            try:
                # read1 returns the available data instead of waiting until the buffer is full.
                data = response.raw.read1(_CHUNK)
            except (urllib3.exceptions.HTTPError, OSError) as error:
                fault = f" ({self._parser.last_fault})" if self._parser.last_fault else ""
                raise self._ended(f"{_cause(error)}{fault}") from error
            if not data:
                raise self._ended("the camera ended it (button, shooting or change of mode)")
            bad_before = self._parser.bad_frames
            frames = self._parser.feed(data)
            self.bad_frames += self._parser.bad_frames - bad_before
            stamp_ns = self._stamp_ns()
            for jpeg in reversed(frames):
                with contextlib.suppress(JpegError):
                    width, height = jpeg_size(jpeg)
                    if width * height <= MOST_PIXELS:  # 60 kB can declare 65535 x 65535
                        return Frame(jpeg, stamp_ns, width, height)
                self.bad_frames += 1

    def close(self) -> None:
        self._end_preview()
        self.client.close()

    def _end_preview(self) -> None:
        ended, self._response, self._session = (self._response, self._session), None, None
        for each in ended:
            if each is not None:
                each.close()

    def _ended(self, reason: str) -> CameraError:
        self._end_preview()
        return CameraError(f"{self.client.url}: preview ended: {reason}")


def _option(choice: Format) -> dict[str, int]:
    return dict(zip(("width", "height", "framerate"), choice, strict=True))


def _named(choice: Format) -> str:
    return "{}x{} at {} Hz".format(*choice)


def _number(state: Mapping[str, Any], key: str) -> float | None:
    value = state.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e6:
        return None
    return float(value)


def _json(response: requests.Response) -> dict[str, Any] | None:
    if is_multipart(response):
        return None
    try:
        reply = json.loads(response.content)
    except (ValueError, RecursionError):
        return None
    return reply if isinstance(reply, dict) else None


def _refusal(where: str, body: Mapping[str, Any] | None, status: int, reply: Mapping[str, Any]) -> ThetaError:
    error = reply.get("error")
    error = error if isinstance(error, dict) else {}
    code = str(error.get("code", f"http {status}"))[:_MOST_TEXT]
    text = str(error.get("message", ""))[:_MOST_TEXT]
    command = f" {body['name']}" if body and "name" in body else ""
    hint = ""
    if status == 401:
        hint = ". Set password_file, or INSTANT_IC_THETA_USER and INSTANT_IC_THETA_PASSWORD (serial number, digits)."
    elif 300 <= status < 400:
        hint = ". The reply redirects, which a Theta never does: check the address."
    elif status == 503:
        hint = ". The camera stayed busy: switch it off and on again."
    return ThetaError(f"{where}:{command} refused: {code} {text}".rstrip() + hint, code)


def _cause(error: BaseException) -> str:
    """Return the text of the innermost exception, which names the cause; the outer ones only repeat addresses."""
    seen = {id(error)}
    while True:
        inner = error.__cause__ or error.__context__ or getattr(error, "reason", None)
        if not isinstance(inner, BaseException) or id(inner) in seen:
            return f"{type(error).__name__}: {error}"
        seen.add(id(inner))
        error = inner
