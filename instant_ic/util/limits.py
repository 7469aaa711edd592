"""Limits for decoding files and messages, because a few kilobytes can declare an image or an array of gigabytes."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.util.jpeg import JpegError, jpeg_size

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MOST_PIXELS = 32 << 20
"""Most pixels of an image from a network or a bag. The Theta's largest photo (6720x3360) has 22.6 million."""
MOST_FILE_PIXELS = 160 << 20
"""Most pixels of an image file that an operator names; panoramas of 16384x8192 fit."""
MOST_ARRAY_BYTES = 4 << 30
"""Most bytes of all arrays of an ``.npz`` file together, decompressed."""

_MOST_CHUNKS = 20_000
_PNG = b"\x89PNG\r\n\x1a\n"


def limit_opencv() -> None:
    """Make OpenCV refuse images of larger declared size. OpenCV reads this setting once, before its first image."""
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_FILE_PIXELS))


def decode_image(data: bytes | bytearray | NDArray[np.uint8], flags: int) -> NDArray[Any] | None:
    """Decode a JPEG or PNG of at most `MOST_PIXELS` from an untrusted source; return None if that fails.

    ``flags`` are those of ``cv2.imdecode``.
    """
    import cv2
    import numpy as np

    content = data if isinstance(data, bytes | bytearray) else data.tobytes()
    if content.startswith(_PNG):
        if not _chunks_fit(content):
            return None
        width, height = int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")
    else:
        try:
            width, height = jpeg_size(content)
        except JpegError:
            return None
    if not 0 < width * height <= MOST_PIXELS:
        return None
    try:
        return cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        return None


def decode_rgb(
    data: bytes | bytearray | NDArray[np.uint8], width: int = MOST_PIXELS, height: int = MOST_PIXELS
) -> NDArray[np.uint8]:
    """Decode to (H, W, 3) uint8 RGB of at least ``width`` x ``height``, or of the image's own size if it is smaller.

    The decoder shrinks the image 2, 4 or 8 times if the result is still large enough, which saves most of the inverse
    cosine transform. The reduced size is rounded up.

    Raises:
        JpegError: the data cannot be decoded.
    """
    import cv2
    import numpy as np

    flag = cv2.IMREAD_COLOR
    try:
        full_width, full_height = jpeg_size(bytes(data[:65536]))
    except JpegError:  # the image may be a PNG
        full_width, full_height = 0, 0
    for n, reduced in (
        (2, cv2.IMREAD_REDUCED_COLOR_2),
        (4, cv2.IMREAD_REDUCED_COLOR_4),
        (8, cv2.IMREAD_REDUCED_COLOR_8),
    ):
        if full_width >= n * width and full_height >= n * height:
            flag = reduced
    bgr = decode_image(data, flag)
    if bgr is None:
        raise JpegError(f"cannot be decoded as JPEG or PNG of at most {MOST_PIXELS} pixels")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def load_image(path: str | Path, flags: int) -> NDArray[Any] | None:
    """Read an image file of at most `MOST_FILE_PIXELS` in any format of OpenCV; return None if that fails.

    ``flags`` are those of ``cv2.imread``.
    """
    import cv2

    try:
        with Path(path).open("rb") as file:
            is_png = file.read(len(_PNG)) == _PNG
        if is_png and not _chunks_fit(Path(path).read_bytes()):
            return None
        return cv2.imread(str(path), flags)
    except OSError:
        return None
    except cv2.error:  # larger than the limit
        return None


def _chunks_fit(data: bytes | bytearray) -> bool:
    """Return whether a PNG contains its chunks in full. OpenCV allocates the declared size, 1 GB for 40 bytes."""
    view, at = memoryview(data), len(_PNG)
    for _ in range(_MOST_CHUNKS):
        kind = bytes(view[at + 4 : at + 8])
        at += 12 + int.from_bytes(view[at : at + 4], "big")
        if at > len(view):
            return False
        if kind == b"IEND":
            return True
    return False


def check_arrays(path: str | Path) -> None:
    """Check that an ``.npz`` file does not unpack to more than `MOST_ARRAY_BYTES`.

    Raises:
        ValueError: the file unpacks to more, or is damaged.
        OSError: the file cannot be read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
    except zipfile.BadZipFile as error:
        raise ValueError(str(error)) from None
    if size > MOST_ARRAY_BYTES:
        raise ValueError(f"its arrays unpack to {size >> 20} MB; at most {MOST_ARRAY_BYTES >> 20} MB are read")
