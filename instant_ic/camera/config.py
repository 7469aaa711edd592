"""Parameters of the cameras."""

from dataclasses import dataclass

PREVIEW_FORMATS = ((1920, 960, 8), (1024, 512, 30), (1024, 512, 8), (640, 320, 30), (640, 320, 8))
"""(width, height, frames/s) that the Theta Z1 offers."""


def _positive(key: str, value: float) -> None:
    if not value > 0.0:
        raise ValueError(f"{key} must be > 0 (got {value})")


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
    latency_s: float = 0.20
    read_timeout_s: float = 2.0
    connect_timeout_s: float = 5.0
    settle_s: float = 1.0
    busy_retries: int = 5
    busy_wait_s: float = 0.25

    def __post_init__(self) -> None:
        """Check the values."""
        wanted = (self.width, self.height, self.rate_hz)
        if wanted not in PREVIEW_FORMATS:
            known = ", ".join(f"{w}x{h}@{r}" for w, h, r in PREVIEW_FORMATS)
            raise ValueError(f"width, height, rate_hz must be one of {known} (got {wanted})")
        if self.latency_s < 0.0:
            raise ValueError(f"latency_s must be >= 0 (got {self.latency_s})")
        for key in ("read_timeout_s", "connect_timeout_s", "busy_wait_s"):
            _positive(key, getattr(self, key))
        if self.settle_s < 0.0:
            raise ValueError(f"settle_s must be >= 0 (got {self.settle_s})")
        if self.busy_retries < 0:
            raise ValueError(f"busy_retries must be >= 0 (got {self.busy_retries})")


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

    latency_s: float = 0.25
    read_timeout_s: float = 2.0
    quality: int = 90
    width: int = 0
    height: int = 0

    def __post_init__(self) -> None:
        """Check the values."""
        if self.latency_s < 0.0:
            raise ValueError(f"latency_s must be >= 0 (got {self.latency_s})")
        _positive("read_timeout_s", self.read_timeout_s)
        if not 1 <= self.quality <= 100:
            raise ValueError(f"quality must be in 1..100 (got {self.quality})")
        if self.width < 0 or self.height < 0:
            raise ValueError(f"width and height must be >= 0 (got {self.width}, {self.height})")


@dataclass(frozen=True)
class FilesConfig:
    """Equirectangular pictures from files.

    Attributes:
        rate_hz: pictures a second.
        loop: start again after the last one; else it is repeated.
        quality: of the JPEGs made of files that are none, 1-100.
        latency_s: taken off the stamps.
    """

    rate_hz: float = 5.0
    loop: bool = True
    quality: int = 90
    latency_s: float = 0.0

    def __post_init__(self) -> None:
        """Check the values."""
        _positive("rate_hz", self.rate_hz)
        if not 1 <= self.quality <= 100:
            raise ValueError(f"quality must be in 1..100 (got {self.quality})")
        if self.latency_s < 0.0:
            raise ValueError(f"latency_s must be >= 0 (got {self.latency_s})")
