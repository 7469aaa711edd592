"""A camera's address may be anybody's: redirects, bombs, drips and challenges that no Theta sends."""

from __future__ import annotations

import gzip
import json
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any, Self

import pytest
from fake_theta import Behaviour, FakeTheta, jpeg, part

from instant_ic.camera.config import ThetaConfig
from instant_ic.camera.http import MOST_REPLY_BYTES
from instant_ic.camera.preview import PreviewParser
from instant_ic.camera.source import CameraError
from instant_ic.camera.theta import ThetaCamera, ThetaClient

QUICK = ThetaConfig(connect_timeout_s=0.4, read_timeout_s=0.4, settle_s=0.0, busy_retries=0)
PATIENT = ThetaConfig(connect_timeout_s=60.0, read_timeout_s=60.0, settle_s=0.0, busy_retries=0)


class Stranger:
    """Answers each request with the same pieces of bytes; ``sent`` counts those that went out."""

    def __init__(self, pieces: Callable[[], Iterator[bytes]], pause_s: float = 0.0) -> None:
        self.requests: list[bytes] = []
        self.sent = 0
        self._pieces, self._pause_s = pieces, pause_s
        self._ended = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:  # closed
                return
            with connection:
                connection.settimeout(30.0)
                try:
                    while b"\r\n\r\n" not in (head := connection.recv(65536)) and head:
                        pass
                    self.requests.append(head)
                    for piece in self._pieces():
                        if self._ended.wait(self._pause_s):
                            return
                        connection.sendall(piece)
                        self.sent += 1
                except OSError:  # the client has had enough
                    continue

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(10.0)


def reply(body: bytes, *headers: str, status: str = "200 OK") -> Callable[[], Iterator[bytes]]:
    head = "\r\n".join((f"HTTP/1.1 {status}", f"Content-Length: {len(body)}", "Connection: close", *headers))
    return lambda: iter((head.encode() + b"\r\n\r\n" + body,))


def test_redirect_to_another_host_is_refused() -> None:
    with Stranger(reply(b"{}")) as other:
        found = reply(b"", f"Location: {other.url}/osc/info", status="302 Found")
        with Stranger(found) as camera, pytest.raises(CameraError, match="redirects"):
            ThetaClient(camera.url, PATIENT, "user", "password").info()
        assert other.requests == []


def test_encoded_reply_is_refused_and_none_is_asked_for() -> None:
    bomb = gzip.compress(b"{" + b" " * (1 << 20) + b"}")
    with Stranger(reply(bomb, "Content-Encoding: gzip")) as camera:
        with pytest.raises(CameraError, match="encoded"):
            ThetaClient(camera.url, PATIENT).info()
        assert b"Accept-Encoding: identity\r\n" in camera.requests[0]


@pytest.mark.parametrize("status", ["200 OK", "401 Unauthorized"])
def test_endless_reply_is_cut_off(status: str) -> None:
    def endless() -> Iterator[bytes]:
        yield f'HTTP/1.1 {status}\r\nWWW-Authenticate: Digest realm="a", nonce="b"\r\nLocation: /\r\n\r\n'.encode()
        while True:
            yield b" " * 65536

    with Stranger(endless) as camera, pytest.raises(CameraError, match="longer than 256 kB"):
        ThetaClient(camera.url, PATIENT, "user", "password").info()
    assert MOST_REPLY_BYTES == 256 << 10


@pytest.mark.parametrize("head", [b"HTTP/1.1 200 OK\r\nX: ", b"HTTP/1.1 200 OK\r\n\r\n"])
def test_reply_that_drips_ends_by_the_deadline(head: bytes) -> None:
    """Each byte comes well within the time-out of one reception; all of them would take hours."""

    def drip() -> Iterator[bytes]:
        yield head
        for _ in range(100_000):
            yield b"x"

    with Stranger(drip, pause_s=0.05) as camera:
        with pytest.raises(CameraError, match="no answer"):
            ThetaClient(camera.url, QUICK).info()
        assert camera.sent < 100_000


def test_preview_whose_chunk_head_drips_ends_by_the_deadline() -> None:
    def drip() -> Iterator[bytes]:
        yield b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace\r\nTransfer-Encoding: chunked\r\n\r\n"
        for _ in range(100_000):
            yield b"0"

    with Stranger(drip, pause_s=0.05) as stranger:
        camera = ThetaCamera(ThetaClient(stranger.url, QUICK))
        camera.client.info = dict  # type: ignore[method-assign, assignment]
        camera.client.set_options = camera.client.options = lambda _: {}  # type: ignore[method-assign, assignment]
        camera.connect()
        with pytest.raises(CameraError, match="preview ended"):
            camera.read()
        camera.close()
        assert stranger.sent < 100_000


@pytest.mark.parametrize(
    "challenge",
    ["Digest", 'Digest realm="a", nonce="b", algorithm=ROT13'],
)
def test_digest_challenge_that_cannot_be_answered_is_an_error(challenge: str) -> None:
    with (
        Stranger(reply(b"", f"WWW-Authenticate: {challenge}", status="401 Unauthorized")) as camera,
        pytest.raises(CameraError, match=r"digest challenge|refused: http 401"),
    ):
        ThetaClient(camera.url, PATIENT, "user", "password").info()


@pytest.mark.parametrize("body", [b"[" * 100_000, b"[]", b"\xff\xfe"])
def test_reply_that_is_no_object_is_an_error(body: bytes) -> None:
    with Stranger(reply(body)) as camera, pytest.raises(CameraError, match="not a JSON object"):
        ThetaClient(camera.url, PATIENT).info()


@pytest.mark.parametrize(
    "state",
    [5, {"_cameraError": 5}, {"batteryLevel": 10**400}, {"_boardTemp": "hot"}],
)
def test_state_of_another_shape_is_unknown(state: Any) -> None:
    with Stranger(reply(json.dumps({"state": state}).encode())) as camera:
        found = ThetaClient(camera.url, PATIENT).health().values
    assert (found["battery"], found["board_temperature_c"]) == (None, None)


def test_image_that_declares_more_pixels_than_a_camera_has_is_dropped() -> None:
    good = jpeg(80)
    at = good.index(b"\xff\xc0")
    bomb = good[: at + 5] + b"\xff\xff\xff\xff" + good[at + 9 :]
    with FakeTheta(Behaviour(previews=[[part(bomb)]])) as theta:
        camera = ThetaCamera(ThetaClient(theta.url, PATIENT))
        camera.connect()
        with pytest.raises(CameraError, match="the camera ended it"):
            camera.read()
        assert camera.bad_frames == 1
        camera.close()


def test_many_empty_part_headers_in_one_piece_are_dropped() -> None:
    parser = PreviewParser()
    assert parser.feed(b"osclivepreview\r\n\r\n" * 3000 + part(jpeg(90))) == [jpeg(90)]
    assert parser.bad_frames == 3000


def test_length_of_thousands_of_digits_is_dropped() -> None:
    parser = PreviewParser()
    assert parser.feed(b"osclivepreview\r\nContent-Length: " + b"9" * 5000 + b"\r\n\r\n" + part(jpeg(90))) == [jpeg(90)]


def test_part_above_the_limit_is_not_collected() -> None:
    parser = PreviewParser(max_frame_bytes=1000)
    for _ in range(100):
        assert parser.feed(b"osclivepreview\r\nContent-Length: 1001\r\n\r\n" + b"x" * 1001) == []
    assert parser.waiting < 10_000
