"""Parameters of the cameras."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from instant_ic.config.ranges import Checked, NotNegativeInt, Plausible, PositiveInt, check_ranges
from instant_ic.config.robot import CAMERA_MOUNT, Mount
from instant_ic.util.safe_text import holds_password

PREVIEW_FORMATS = ((1920, 960, 8), (1024, 512, 30), (1024, 512, 8), (640, 320, 30), (640, 320, 8))
"""(width, height, frames/s) that the Theta Z1 offers, with firmware `FORMATS_FIRMWARE`."""
FORMATS_FIRMWARE = "2.21.1"
OLD_PREVIEW_FORMATS = ((1024, 512, 8), (1920, 960, 8))
"""Formats that every firmware of the Theta Z1 offers."""


@dataclass(frozen=True)
class ThetaConfig:
    """Theta Z1 over its Web API.

    Attributes:
        width: preview width, pixels; width, height and rate_hz together must be one of the camera's formats.
        height: preview height, pixels.
        rate_hz: preview frame rate.
        latency_s: time from the exposure to the arrival of an image.
        read_timeout_s: time without data after which the preview is closed.
        connect_timeout_s: time-out of commands and of opening a connection.
        settle_s: wait between setting options and starting the preview; the camera needs 1 s.
        busy_retries: repeats of a command while the camera is busy (503).
        busy_wait_s: first wait before such a repeat; doubled each time.
    """

    width: PositiveInt = 1024
    height: PositiveInt = 512
    rate_hz: PositiveInt = 30
    latency_s: Annotated[float, Plausible(0, 2)] = 0.20
    read_timeout_s: Annotated[float, Plausible(0.1, 60)] = 2.0
    connect_timeout_s: Annotated[float, Plausible(0.1, 60)] = 5.0
    settle_s: Annotated[float, Plausible(0, 10)] = 1.0
    busy_retries: Annotated[int, Plausible(0, 50)] = 5
    busy_wait_s: Annotated[float, Plausible(0.001, 10)] = 0.25

    def __post_init__(self) -> None:
        wanted = (self.width, self.height, self.rate_hz)
        if wanted not in PREVIEW_FORMATS:
            known = ", ".join(f"{w}x{h}@{r}" for w, h, r in PREVIEW_FORMATS)
            raise ValueError(f"width, height, rate_hz must be one of {known} (got {wanted})")
        check_ranges(self)


@dataclass(frozen=True)
class VideoConfig(Checked):
    """A video device or a network stream, read by OpenCV.

    Attributes:
        latency_s: time from the exposure to the arrival of an image (about 0.25 s over USB).
        read_timeout_s: time without data after which the stream is closed.
        width: width requested from a device, pixels; 0 keeps the device's setting.
        height: height requested from a device, pixels; 0 keeps the device's setting.
    """

    latency_s: Annotated[float, Plausible(0, 2)] = 0.25
    read_timeout_s: Annotated[float, Plausible(0.1, 60)] = 2.0
    width: NotNegativeInt = 0
    height: NotNegativeInt = 0


@dataclass(frozen=True)
class FilesConfig(Checked):
    """Equirectangular images from files.

    Attributes:
        rate_hz: images per second.
    """

    rate_hz: Annotated[float, Plausible(0.01, 200)] = 5.0


@dataclass(frozen=True)
class ThetaCameraConfig:
    """Parameters of the node ``theta_camera``.

    Attributes:
        source: ``theta`` (Web API), ``video`` (device, RTSP address or video file), ``files``.
        url: address of the Theta; device, address or path for the other sources. It must not hold a password.
        password_file: file with USER:PASSWORD of the Theta or the stream, mode 0600. Empty: none for a stream, and
            INSTANT_IC_THETA_USER and INSTANT_IC_THETA_PASSWORD for the Theta. User and password replace ``{user}``
            and ``{password}`` in the stream's address, or are put before its host.
        frame_id: the camera's frame.
        camera_mount: the camera's pose on base_link.
        silence_s: seconds without an image that cause a warning; four times as many cause an error.
        health_period_s: seconds between requests for the Theta's battery and temperature.
        theta: live preview.
        video: stream through OpenCV.
        files: images from files.
    """

    source: Literal["theta", "video", "files"] = "theta"
    url: str = "http://192.168.1.1"
    password_file: str = ""
    frame_id: str = "camera"
    camera_mount: Mount = CAMERA_MOUNT
    silence_s: Annotated[float, Plausible(0.1, 60)] = 2.0
    health_period_s: Annotated[float, Plausible(0.05, 600)] = 10.0
    theta: ThetaConfig = field(default_factory=ThetaConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    files: FilesConfig = field(default_factory=FilesConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.url:
            raise ValueError("url must not be empty")
        if holds_password(self.url):
            raise ValueError(
                "url must not hold a password, which ps, logs, parameters and bags would show: write USER:PASSWORD "
                "into a file, run chmod 600 on it, and set password_file"
            )
        if "{password}" in self.url and not self.password_file:
            raise ValueError("url contains {password}, but password_file is empty: set password_file")
