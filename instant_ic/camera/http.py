"""HTTP client for a device that may not be the expected one: no redirects or encodings, limits on size and time."""

from __future__ import annotations

import io
import math
import socket
import time
from collections.abc import Mapping
from typing import Any

import requests
import urllib3
from requests.adapters import HTTPAdapter
from requests.auth import HTTPDigestAuth

from instant_ic.camera.source import CameraError

MOST_REPLY_BYTES = 256 << 10
"""Size limit of a reply other than the preview; the camera's longest has a few thousand bytes."""
_CHUNK = 16 << 10


class Deadline:
    """Time limit for reading a reply, independent of how slowly the bytes arrive.

    Attributes:
        at_s: monotonic time, seconds.
    """

    def __init__(self) -> None:
        self.at_s = math.inf

    def start(self, seconds: float) -> None:
        """Set the limit to ``seconds`` from now."""
        self.at_s = time.monotonic() + seconds


class _Socket(socket.socket):
    """Socket whose reads end at a deadline; the socket's own time-out restarts with each byte."""

    deadline: Deadline

    def recv_into(self, buffer: Any, nbytes: int = 0, flags: int = 0) -> int:
        """As the base class.

        Raises:
            TimeoutError: also after the deadline.
        """
        left_s = self.deadline.at_s - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("the reply took too long")
        before = self.gettimeout()
        self.settimeout(min(left_s, math.inf if before is None else before) if left_s < math.inf else before)
        try:
            return super().recv_into(buffer, nbytes, flags)
        finally:
            self.settimeout(before)


class _Adapter(HTTPAdapter):
    """Reads every reply except the preview, so that authentication also sees only replies within the limits."""

    def __init__(self, deadline: Deadline) -> None:
        self._deadline = deadline
        super().__init__()

    def init_poolmanager(self, *arguments: Any, **keywords: Any) -> None:
        """As the base class, with sockets that end at the deadline."""
        super().init_poolmanager(*arguments, **keywords)
        deadline = self._deadline

        class Connection(urllib3.connection.HTTPConnection):
            def _new_conn(self) -> socket.socket:
                plain = super()._new_conn()
                timeout = plain.gettimeout()
                bound = _Socket(fileno=plain.detach())
                bound.deadline = deadline
                bound.settimeout(timeout)
                return bound

        class Pool(urllib3.HTTPConnectionPool):
            ConnectionCls = Connection

        self.poolmanager.pool_classes_by_scheme = {"http": Pool}

    def send(self, request: requests.PreparedRequest, *arguments: Any, **keywords: Any) -> requests.Response:
        """As the base class.

        Raises:
            CameraError: the reply is encoded or too long.
        """
        response = super().send(request, *arguments, **keywords)
        try:
            encoding = response.headers.get("Content-Encoding", "identity").strip().lower()
            if encoding != "identity":
                raise CameraError(f"{request.url}: the reply is encoded ({encoding[:40]}), which a Theta never does")
            if response.status_code != 200 or not is_multipart(response):
                response.raw = _whole(response, str(request.url))
        except BaseException:
            response.close()
            raise
        return response


class _Digest(HTTPDigestAuth):
    """Digest authentication that validates the challenge."""

    def build_digest_header(self, method: str, url: str) -> str:
        """As the base class.

        Raises:
            CameraError: the challenge cannot be answered.
        """
        try:
            answer = super().build_digest_header(method, url)
        except (KeyError, ValueError, AttributeError) as error:
            raise CameraError(f"{url}: the camera's digest challenge is incomplete ({error!r})") from error
        if answer is None:
            raise CameraError(f"{url}: the camera's digest challenge has an unknown algorithm or quality")
        # Text of the challenge goes into a header and must not inject another header line.
        if not answer.isprintable():
            raise CameraError(f"{url}: the camera's digest challenge has control characters")
        return answer


class Session(requests.Session):
    """Session with one device over plain HTTP; set ``deadline`` before each request."""

    def __init__(self, user: str, password: str) -> None:
        super().__init__()
        self.deadline = Deadline()
        # Proxies and .netrc from the environment do not apply to a camera on the local network.
        self.trust_env = False
        if user:
            self.auth = _Digest(user, password)
        self.headers["Accept-Encoding"] = "identity"
        self.headers["Content-Type"] = "application/json;charset=utf-8"
        self.adapters.clear()
        self.mount("http://", _Adapter(self.deadline))

    def get_redirect_target(self, resp: requests.Response) -> None:
        """Return None: redirects are neither followed nor read."""

    def ask(self, method: str, url: str, body: Mapping[str, Any] | None, timeout_s: float) -> requests.Response:
        """Send one request and read its reply; the parts of a multipart reply are left for streaming.

        Args:
            method: HTTP method.
            url: complete address.
            body: sent as JSON.
            timeout_s: time-out of the connection and of the whole reply.

        Raises:
            requests.RequestException: no reply in time.
            CameraError: the reply cannot come from a camera.
        """
        self.deadline.start(timeout_s)
        try:
            return self.request(method, url, json=body, timeout=timeout_s, stream=True, allow_redirects=False)
        finally:
            self.deadline.at_s = math.inf


def is_multipart(response: requests.Response) -> bool:
    """Whether a reply is the preview."""
    return response.headers.get("Content-Type", "").lower().startswith("multipart/")


def _whole(response: requests.Response, url: str) -> urllib3.HTTPResponse:
    """Read the body to its end."""
    body = bytearray()
    raw = response.raw
    try:
        while data := raw.read1(_CHUNK):
            body += data
            if len(body) > MOST_REPLY_BYTES:
                raise CameraError(f"{url}: the reply is longer than {MOST_REPLY_BYTES >> 10} kB, the limit for a Theta")
    except (urllib3.exceptions.HTTPError, OSError) as error:
        raise requests.ConnectionError(error, request=response.request) from error
    raw.release_conn()
    return urllib3.HTTPResponse(
        io.BytesIO(bytes(body)), headers=raw.headers, status=raw.status, preload_content=False, decode_content=False
    )
