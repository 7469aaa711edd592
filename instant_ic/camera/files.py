"""Equirectangular images from a file or a folder, at a fixed rate."""

import time
from collections.abc import Callable
from pathlib import Path

from instant_ic.camera.config import FilesConfig
from instant_ic.camera.source import JPEG_QUALITY, Camera, CameraError, Frame
from instant_ic.util.jpeg import JpegError, check_whole, jpeg_size
from instant_ic.util.limits import load_image

JPEG_SUFFIXES = (".jpg", ".jpeg")
SUFFIXES = (*JPEG_SUFFIXES, ".png", ".bmp", ".tif", ".tiff", ".webp")


class FileCamera(Camera):
    """Images of a file or folder, in the order of their names. JPEG files are passed through unchanged."""

    def __init__(
        self,
        path: str | Path,
        config: FilesConfig | None = None,
        now_ns: Callable[[], int] = time.time_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Create the camera for an image or a folder of images without reading a file."""
        self.path = Path(path)
        self.config = config or FilesConfig()
        super().__init__(0.0, now_ns)
        self.recorded = True
        self._sleep = sleep
        self._paths: list[Path] = []
        self._loaded: dict[Path, tuple[bytes, int, int]] = {}
        self._index = 0
        self._due_ns: int | None = None

    def connect(self) -> str:
        """Find the images and read the first."""
        self.close()
        if self.path.is_dir():
            self._paths = sorted(p for p in self.path.iterdir() if p.suffix.lower() in SUFFIXES)
        elif self.path.is_file():
            self._paths = [self.path]
        if not self._paths:
            raise CameraError(f"{self.path}: no image found ({', '.join(SUFFIXES)})")
        _, width, height = self._load(self._paths[0])
        return f"{len(self._paths)} images from {self.path}, {width}x{height} at {self.config.rate_hz} Hz"

    def read(self) -> Frame:
        """Wait until the next image is due and return it."""
        period_ns = round(1e9 / self.config.rate_hz)
        now_ns = self._now_ns()
        if self._due_ns is None or self._due_ns > now_ns + period_ns:  # the first, or the clock was set back
            self._due_ns = now_ns
        if now_ns < self._due_ns:
            self._sleep((self._due_ns - now_ns) * 1e-9)
        # A late image does not make the following ones come faster.
        self._due_ns = max(self._due_ns, now_ns - period_ns) + period_ns
        return self.next_frame()

    def next_frame(self) -> Frame:
        """Return the next image immediately, stamped with the current time.

        Raises:
            CameraError: not connected, or the file cannot be read.
        """
        if not self._paths:
            raise CameraError(f"{self.path}: not connected; call connect() first")
        jpeg, width, height = self._load(self._paths[self._index])
        self._index = (self._index + 1) % len(self._paths)
        return Frame(jpeg, self._stamp_ns(), width, height)

    def close(self) -> None:
        """Forget the images."""
        self._paths = []
        self._loaded.clear()
        self._index = 0
        self._due_ns = None

    def _load(self, path: Path) -> tuple[bytes, int, int]:
        if path not in self._loaded:
            try:
                data = path.read_bytes()
                if path.suffix.lower() in JPEG_SUFFIXES:
                    check_whole(data)
                else:
                    data = self._encode(path)
                self._loaded[path] = (data, *jpeg_size(data))
            except (OSError, JpegError) as error:
                self.bad_frames += 1
                raise CameraError(f"{path}: {error}") from error
        return self._loaded[path]

    def _encode(self, path: Path) -> bytes:
        import cv2

        image = load_image(path, cv2.IMREAD_COLOR)
        if image is None:
            raise JpegError("cannot be decoded as an image")
        return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())
