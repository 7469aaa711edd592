"""The camera that the parameters of the node ``theta_camera`` select."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from instant_ic.camera.config import ThetaCameraConfig
from instant_ic.camera.files import FileCamera
from instant_ic.camera.source import Camera, CameraError
from instant_ic.camera.theta import ThetaCamera, ThetaClient
from instant_ic.camera.video import VideoCamera
from instant_ic.util.private import read_secret

USER_VARIABLE = "INSTANT_IC_THETA_USER"
PASSWORD_VARIABLE = "INSTANT_IC_THETA_PASSWORD"
"""Environment variable for the credentials: parameters are visible in ``ic param`` and in files."""


def open_camera(config: ThetaCameraConfig, now_ns: Callable[[], int]) -> Camera:
    """Return the camera of ``config.source``, not connected yet.

    Args:
        config: parameters of the node.
        now_ns: clock of the images' stamps.

    Raises:
        CameraError: the password file cannot be used.
    """
    user, password = _credentials(config.password_file)
    if config.source == "theta":
        if not config.password_file:
            user, password = os.environ.get(USER_VARIABLE, ""), os.environ.get(PASSWORD_VARIABLE, "")
        return ThetaCamera(ThetaClient(config.url, config.theta, user, password), now_ns)
    if config.source == "video":
        return VideoCamera(config.url, config.video, now_ns, user, password)
    return FileCamera(config.url, now_ns)


def _credentials(file: str) -> tuple[str, str]:
    """Return the user and password in a file; both are empty without a file."""
    if not file:
        return "", ""
    path = Path(file).expanduser()
    try:
        user, colon, password = read_secret(path).partition(":")
    except (OSError, UnicodeDecodeError) as error:
        raise CameraError(f"password_file {path}: {getattr(error, 'strerror', None) or error}") from error
    if not colon:
        raise CameraError(f"password_file {path}: must hold USER:PASSWORD in one line")
    return user, password
