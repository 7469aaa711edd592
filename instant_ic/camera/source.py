"""Base class of all cameras."""

import threading
import time
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

from instant_ic.util.closing import Closing

JPEG_QUALITY = 90
"""JPEG quality, 1 to 100, of images that the camera does not deliver as JPEG."""


class CameraError(ConnectionError):
    """The camera delivers no images; the text says why and what to do. Reconnecting may help."""


@dataclass(frozen=True)
class Frame:
    """One equirectangular image as JPEG.

    Attributes:
        jpeg: encoded bytes; unchanged if the camera sends JPEG.
        stamp_ns: time of exposure since the epoch: time of arrival minus the configured latency.
        width: pixels, from the JPEG header.
        height: pixels, from the JPEG header.
    """

    jpeg: bytes
    stamp_ns: int
    width: int
    height: int


class Camera(Closing):
    """A source of frames.

    Example:
        >>> with FileCamera("pano.jpg") as camera:      # doctest: +SKIP
        ...     frame = camera.read()
    """

    def __init__(self, latency_s: float, now_ns: Callable[[], int] = time.time_ns) -> None:
        """Create the camera without opening it.

        Args:
            latency_s: time from the exposure to the arrival.
            now_ns: clock of the stamps.
        """
        self.bad_frames = 0
        """Images dropped because they were truncated or damaged, since the object was created."""
        self.cancelled = threading.Event()
        """Set by another thread: a call that waits for the device then ends soon, with an error."""
        self.advice = ""
        """Advice to the operator while images arrive; empty if there is none."""
        self.recorded = False
        """True for a video file, whose images may be played again."""
        self._latency_ns = round(latency_s * 1e9)
        self._now_ns = now_ns

    @abstractmethod
    def connect(self) -> str:
        """Open the camera and return its description.

        Raises:
            CameraError: the camera cannot be opened.
        """

    @abstractmethod
    def read(self) -> Frame:
        """Return the next image.

        Raises:
            CameraError: no image arrived within the camera's time-out, or the connection ended.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the camera; has no effect if it is not open."""

    def __enter__(self) -> Self:
        self.connect()
        return self

    def _stamp_ns(self) -> int:
        return self._now_ns() - self._latency_ns
