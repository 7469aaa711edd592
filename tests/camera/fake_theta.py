"""A Theta that misbehaves on demand: digest, both boundary forms, 503s, stalls, cut frames, early ends."""

import hashlib
import json
import threading
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2
import numpy as np

from instant_ic.sim.theta_options import OptionError, ThetaOptions

REALM, NONCE = "RICOH THETA", "00f1c8c4"


def jpeg(value: int, width: int = 64, height: int = 32) -> bytes:
    """A small picture; its grey tells which one it is."""
    noise = np.random.default_rng(value).integers(0, 20, (height, width, 3))
    image = np.clip(noise + value, 0, 255).astype(np.uint8)
    return bytes(cv2.imencode(".jpg", image)[1].tobytes())


def part(data: bytes, boundary: str = "---osclivepreview---", length: int | None = None) -> bytes:
    """One part of the preview as the Z1 sends it; ``length`` may lie."""
    size = len(data) if length is None else length
    head = f"{boundary}\r\nContent-type: image/jpeg\r\nContent-Length: {size}\r\n\r\n"
    return head.encode() + data + b"\r\n"


@dataclass
class Behaviour:
    """What the camera does wrong, and what it was asked.

    Attributes:
        previews: pieces of each preview, in the order of the requests; after the last, requests are refused (403).
        stall: after its pieces, a preview keeps silent instead of ending.
        busy: how many of the next requests are answered by 503.
        password: digest authentication is asked for where it is set (user "THETAYL00105307").
        chunked: preview in HTTP chunks, as the camera does it; else until the connection ends.
        firmware: decides which preview formats it offers.
        options: its options, with the rules of the documents.
        reported: options that it reports otherwise; None: not at all.
    """

    previews: list[list[bytes]] = field(default_factory=list)
    stall: bool = False
    busy: int = 0
    password: str = ""
    chunked: bool = True
    state: dict[str, Any] = field(default_factory=lambda: {"batteryLevel": 0.83, "_batteryTemp": 30, "_boardTemp": 41})
    firmware: str = "3.10.2"
    options: ThetaOptions = field(init=False)
    reported: dict[str, Any] = field(default_factory=dict)
    commands: list[str] = field(default_factory=list)
    unauthorised: int = 0

    def __post_init__(self) -> None:
        self.options = ThetaOptions(firmware=self.firmware)


class FakeTheta:
    """Serves a `Behaviour` on a free port."""

    def __init__(self, behaviour: Behaviour | None = None) -> None:
        self.behaviour = behaviour or Behaviour()
        self.released = threading.Event()
        theta = self

        class Handler(_Handler):
            camera = theta

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        self._thread.start()
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"

    def close(self) -> None:
        self.released.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5.0)

    def __enter__(self) -> "FakeTheta":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Handler(BaseHTTPRequestHandler):
    camera: FakeTheta
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        if self._admitted(b""):
            firmware = self.camera.behaviour.firmware
            self._json(200, {"model": "RICOH THETA Z1", "firmwareVersion": firmware, "serialNumber": "YL00105307"})

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if not self._admitted(body):
            return
        behaviour = self.camera.behaviour
        if self.path == "/osc/state":
            self._json(200, {"fingerprint": "F", "state": behaviour.state})
            return
        request = json.loads(body)
        behaviour.commands.append(request["name"])
        try:
            self._execute(request["name"], request)
        except OptionError as error:
            self._error(400, error.code, str(error))

    def _execute(self, name: str, request: dict[str, Any]) -> None:
        behaviour = self.camera.behaviour
        if name == "camera.setOptions":
            behaviour.options.set(request["parameters"]["options"])
            self._json(200, {"name": name, "state": "done"})
        elif name == "camera.getOptions":
            options = behaviour.options.get(request["parameters"]["optionNames"]) | behaviour.reported
            options = {key: value for key, value in options.items() if value is not None}
            self._json(200, {"name": name, "state": "done", "results": {"options": options}})
        elif name == "camera.getLivePreview":
            if behaviour.previews:
                self._preview(behaviour.previews.pop(0))
            else:
                self._error(403, "disabledCommand", "Command is currently disabled.")
        else:
            self._error(400, "unknownCommand", f"Unknown command {name}")

    def _preview(self, pieces: list[bytes]) -> None:
        behaviour = self.camera.behaviour
        self.send_response(200)
        self.send_header("Content-Type", 'multipart/x-mixed-replace; boundary="---osclivepreview---"')
        self.send_header(
            "Transfer-Encoding" if behaviour.chunked else "Connection", "chunked" if behaviour.chunked else "close"
        )
        self.end_headers()
        for piece in pieces:
            self.wfile.write(b"%x\r\n%s\r\n" % (len(piece), piece) if behaviour.chunked else piece)
            self.wfile.flush()
        if behaviour.stall:
            self.camera.released.wait(60.0)
        elif behaviour.chunked:
            self.wfile.write(b"0\r\n\r\n")
        self.close_connection = True

    def _admitted(self, body: bytes) -> bool:
        behaviour = self.camera.behaviour
        if behaviour.password and not self._knows(behaviour.password):
            behaviour.unauthorised += 1
            self.send_response(401)
            self.send_header("WWW-Authenticate", f'Digest realm="{REALM}", nonce="{NONCE}", qop="auth", algorithm=MD5')
            self.send_header("Content-Length", "0")
            self.end_headers()
            return False
        if behaviour.busy:
            behaviour.busy -= 1
            self._error(503, "serviceUnavailable", "busy")
            return False
        return True

    def _knows(self, password: str) -> bool:
        """Check the digest (RFC 7616, MD5, qop auth)."""
        given = self.headers.get("Authorization", "")
        if not given.startswith("Digest "):
            return False
        fields = {}
        for item in given[7:].split(", "):
            key, _, value = item.partition("=")
            fields[key] = value.strip('"')

        def md5(text: str) -> str:
            return hashlib.md5(text.encode()).hexdigest()

        secret = md5(f"{fields['username']}:{REALM}:{password}")
        request = md5(f"{self.command}:{fields['uri']}")
        expected = md5(f"{secret}:{NONCE}:{fields['nc']}:{fields['cnonce']}:{fields['qop']}:{request}")
        return fields["response"] == expected and fields["username"] == "THETAYL00105307"

    def _error(self, status: int, code: str, message: str) -> None:
        self._json(status, {"state": "error", "error": {"code": code, "message": message}})

    def _json(self, status: int, body: dict[str, Any]) -> None:
        data = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json;charset=utf-8")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)
