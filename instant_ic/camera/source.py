"""What every camera has in common."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self


class CameraError(ConnectionError):
    """The camera gives no pictures; the text says why and what to do. Connecting again may help."""


@dataclass(frozen=True)
class Frame:
    """One equirectangular picture as JPEG.

    Attributes:
        jpeg: encoded bytes, as the camera sent them where it sends JPEG.
        stamp_ns: when the picture was taken, since the epoch: its arrival less the configured latency.
        width: pixels, by the JPEG's header.
        height: pixels.
    """

    jpeg: bytes
    stamp_ns: int
    width: int
    height: int


class Camera(ABC):
    """A source of frames.

    Example:
        >>> with FileCamera(FilesConfig(path="pano.jpg", rate_hz=5.0)) as camera:   # doctest: +SKIP
        ...     frame = camera.read()
    """

    def __init__(self, latency_s: float, now_ns: Callable[[], int] = time.time_ns) -> None:
        """Nothing is opened yet.

        Args:
            latency_s: from the exposure to the arrival here.
            now_ns: clock of the stamps.
        """
        self.bad_frames = 0
        """Pictures dropped because they were cut or damaged, since the object was made."""
        self._latency_ns = round(latency_s * 1e9)
        self._now_ns = now_ns

    @abstractmethod
    def connect(self) -> str:
        """Open the camera; returns what it is, in words.

        Raises:
            CameraError: it cannot be opened.
        """

    @abstractmethod
    def read(self) -> Frame:
        """The next picture.

        Raises:
            CameraError: none came within the camera's time-out, or the connection ended.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the camera; harmless when it is not open."""

    def __enter__(self) -> Self:
        """Connect."""
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()

    def _stamp_ns(self) -> int:
        return self._now_ns() - self._latency_ns
