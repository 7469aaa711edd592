"""Equirectangular images from a file or a folder."""

import time
from collections.abc import Callable
from pathlib import Path

from instant_ic.camera.source import JPEG_QUALITY, Camera, CameraError, Frame
from instant_ic.util.jpeg import JpegError, check_whole, jpeg_size
from instant_ic.util.limits import load_image

JPEG_SUFFIXES = (".jpg", ".jpeg")
SUFFIXES = (*JPEG_SUFFIXES, ".png", ".bmp", ".tif", ".tiff", ".webp")


class FileCamera(Camera):
    """Images of a file or folder, in the order of their names. JPEG files are passed through unchanged."""

    def __init__(self, path: str | Path, now_ns: Callable[[], int] = time.time_ns) -> None:
        """Create the camera for an image or a folder of images without reading a file."""
        self.path = Path(path)
        super().__init__(0.0, now_ns)
        self._paths: list[Path] = []
        self._loaded: dict[Path, tuple[bytes, int, int]] = {}
        self._index = 0

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
        return f"{len(self._paths)} images from {self.path}, {width}x{height}"

    def read(self) -> Frame:
        """Return the next image immediately, stamped with the current time; after the last, the first follows."""
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
