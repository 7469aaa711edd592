"""Parameters of the cameras."""

from dataclasses import dataclass

from instant_ic.config.ranges import NotNegative, NotNegativeInt, Percent, Positive, check_ranges

PREVIEW_FORMATS = ((1920, 960, 8), (1024, 512, 30), (1024, 512, 8), (640, 320, 30), (640, 320, 8))
"""(width, height, frames/s) that the Theta Z1 offers."""


@dataclass(frozen=True)
class ThetaConfig:
    """Theta Z1 by its Web API.

    Attributes:
        width: of the preview, pixels; with height and rate_hz one of the camera's formats.
        height: of the preview, pixels.
        rate_hz: of the preview.
        latency_s: from the exposure to the arrival of a picture.
        read_timeout_s: silence after which the preview is given up.
        connect_timeout_s: for commands, and for opening a connection.
        settle_s: between setting options and starting the preview; the camera needs 1 s.
        busy_retries: how often a command is repeated while the camera is busy (503).
        busy_wait_s: first wait before such a repeat; doubled each time.
    """

    width: int = 1024
    height: int = 512
    rate_hz: int = 30
    latency_s: NotNegative = 0.20
    read_timeout_s: Positive = 2.0
    connect_timeout_s: Positive = 5.0
    settle_s: NotNegative = 1.0
    busy_retries: NotNegativeInt = 5
    busy_wait_s: Positive = 0.25

    def __post_init__(self) -> None:
        """Check the values."""
        wanted = (self.width, self.height, self.rate_hz)
        if wanted not in PREVIEW_FORMATS:
            known = ", ".join(f"{w}x{h}@{r}" for w, h, r in PREVIEW_FORMATS)
            raise ValueError(f"width, height, rate_hz must be one of {known} (got {wanted})")
        check_ranges(self)


@dataclass(frozen=True)
class VideoConfig:
    """A video device or a network stream, read by OpenCV.

    Attributes:
        latency_s: from the exposure to the arrival of a picture (about 0.25 s over USB).
        read_timeout_s: silence after which the stream is given up.
        quality: of the JPEGs made here, 1-100.
        width: wanted from a device, pixels; 0 leaves it as it is.
        height: wanted from a device, pixels; 0 leaves it as it is.
    """

    latency_s: NotNegative = 0.25
    read_timeout_s: Positive = 2.0
    quality: Percent = 90
    width: NotNegativeInt = 0
    height: NotNegativeInt = 0

    def __post_init__(self) -> None:
        """Check the values."""
        check_ranges(self)


@dataclass(frozen=True)
class FilesConfig:
    """Equirectangular pictures from files.

    Attributes:
        rate_hz: pictures a second.
        loop: start again after the last one; else it is repeated.
        quality: of the JPEGs made of files that are none, 1-100.
        latency_s: taken off the stamps.
    """

    rate_hz: Positive = 5.0
    loop: bool = True
    quality: Percent = 90
    latency_s: NotNegative = 0.0

    def __post_init__(self) -> None:
        """Check the values."""
        check_ranges(self)
