"""HTTP session with a camera that may not be the expected device: no redirects, limits on size and time of a reply."""

from __future__ import annotations

import io
import math
import socket
import time
from typing import Any

import requests
import urllib3
from requests.adapters import HTTPAdapter
from requests.auth import HTTPDigestAuth

from instant_ic.camera.source import CameraError

MOST_REPLY_BYTES = 256 << 10
"""Largest reply other than the preview; the camera's longest reply has a few thousand bytes."""


class _DeadlineSocket(socket.socket):
    """Socket whose reads end at its session's deadline; a plain time-out restarts with each byte."""

    session: DeviceSession

    def recv_into(self, *arguments: Any) -> int:
        left_s = self.session.deadline_s - time.monotonic()
        if left_s <= 0.0:
            raise TimeoutError("the reply took too long")
        self.settimeout(left_s)
        return super().recv_into(*arguments)


class DeviceSession(requests.Session):
    """Session with one device over plain HTTP.

    Args:
        user: for digest authentication; empty: none.
        password: for digest authentication.

    Attributes:
        deadline_s: monotonic time at which reading a reply ends, however slowly its bytes arrive.
    """

    def __init__(self, user: str, password: str) -> None:
        super().__init__()
        self.deadline_s = math.inf
        # Proxies and .netrc from the environment do not apply to a camera on the local network.
        self.trust_env = False
        self.auth = HTTPDigestAuth(user, password) if user else None
        self.headers["Accept-Encoding"] = "identity"
        self.headers["Content-Type"] = "application/json;charset=utf-8"
        self.adapters.clear()
        self.mount("http://", _Adapter(self))

    def get_redirect_target(self, resp: requests.Response) -> None:
        """Return None: redirects are neither followed nor read."""


class _Adapter(HTTPAdapter):
    """Adapter that reads every reply except the preview, within the limits, before authentication sees it."""

    def __init__(self, session: DeviceSession) -> None:
        super().__init__()

        class DeadlineConnection(urllib3.connection.HTTPConnection):
            def _new_conn(self) -> socket.socket:
                bound = _DeadlineSocket(fileno=super()._new_conn().detach())
                bound.session = session
                return bound

        class DeadlinePool(urllib3.HTTPConnectionPool):
            ConnectionCls = DeadlineConnection

        self.poolmanager.pool_classes_by_scheme = {"http": DeadlinePool}

    def send(self, request: requests.PreparedRequest, *arguments: Any, **keywords: Any) -> requests.Response:
        """Send a request; raise CameraError if the reply is encoded or too long."""
        response = super().send(request, *arguments, **keywords)
        if response.status_code == 200 and is_multipart(response):
            return response
        try:
            body = response.raw.read(MOST_REPLY_BYTES + 1)
        except (urllib3.exceptions.HTTPError, OSError) as error:
            response.close()
            raise requests.ConnectionError(error, request=request) from error
        encoding = response.headers.get("Content-Encoding")
        if encoding or len(body) > MOST_REPLY_BYTES:
            response.close()
            limit = f"longer than {MOST_REPLY_BYTES >> 10} kB, the limit for a Theta"
            what = f"encoded ({encoding[:40]}), which a Theta never does" if encoding else limit
            raise CameraError(f"{request.url}: the reply is {what}")
        response.raw.release_conn()
        response.raw = io.BytesIO(body)
        return response


def is_multipart(response: requests.Response) -> bool:
    """Return whether a reply is the preview."""
    return response.headers.get("Content-Type", "").lower().startswith("multipart/")
