"""Bounded decompression, for our readers and for those of `rosbags`: 19 kB of zstd can expand to 617 MB."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import TYPE_CHECKING, BinaryIO

import yaml

from instant_ic.bag.errors import BagError
from instant_ic.config.yaml_text import compose_yaml

if TYPE_CHECKING:
    import apsw

MOST_CHUNK_BYTES = 256 << 20
"""Largest decompressed chunk or message. Recorders close chunks at about 1 MB, but a single message may be larger."""
MOST_FILE_BYTES = 64 << 30
"""Largest decompressed size of a file that was compressed as a whole."""
_FREE_BYTES = 2 << 30
"""Space that must stay free on the disk such a file is unpacked to."""
_PIECE = 1 << 20


def decompress(data: bytes | memoryview, compression: str, declared_bytes: int | None = None) -> bytes:
    """Decompress one frame. A truncated frame yields the content of its complete blocks.

    Args:
        data: compressed bytes.
        compression: ``zstd`` or ``lz4``; empty for none.
        declared_bytes: decompressed size that the frame declares; `MOST_CHUNK_BYTES` is the limit in any case.

    Raises:
        ValueError: the data are damaged or larger than declared or allowed, or the compression is unknown.
    """
    most_bytes = MOST_CHUNK_BYTES if declared_bytes is None else declared_bytes
    if most_bytes > MOST_CHUNK_BYTES:
        raise ValueError(f"it declares {most_bytes} bytes; the limit is {MOST_CHUNK_BYTES}")
    if compression == "":
        return bytes(data)
    pieces = _PIECES.get(compression)
    if pieces is None:
        raise ValueError(f"unknown compression {compression[:40]!r}")
    out: list[bytes] = []
    size = 0
    try:
        for piece in pieces(bytes(data)):
            size += len(piece)
            if size > most_bytes:
                raise ValueError(f"it decompresses to more than {most_bytes} bytes, its declared or maximum size")
            out.append(piece)
    except (RuntimeError, EOFError) as error:  # raised by lz4
        raise ValueError(str(error)) from None
    return b"".join(out)


def guard_rosbags() -> None:
    """Add size limits to `rosbags`, which has none: MCAP chunks, messages, whole files, SQLite values, YAML.

    This replaces the decompressor tables and YAML readers of `rosbags`; a test checks that `rosbags` uses the
    replacements.
    """
    import apsw
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap, storage_sqlite3

    from instant_ic.bag.metadata import profiles_of

    ros2.YAML = _BoundedYaml  # type: ignore[assignment,misc]
    for module in (ros2, storage_mcap, storage_sqlite3):
        module.parse_qos = profiles_of  # type: ignore[attr-defined]

    storage_mcap.DECOMPRESSORS["lz4"] = lambda data, size: decompress(data, "lz4", size)
    storage_mcap.DECOMPRESSORS["zstd"] = lambda data, size: decompress(data, "zstd", size)
    ros2.zstd = SimpleNamespace(  # type: ignore[assignment]
        decompress=lambda data: decompress(data, "zstd"), open=_open_zstd
    )
    if _limit_schema not in apsw.connection_hooks:
        apsw.connection_hooks.append(_limit_schema)


class _BoundedYaml:
    """Reads ``metadata.yaml`` in the YAML version of `rosbags`, unless its aliases stand for too many values."""

    def __init__(self, typ: str) -> None:
        from ruamel.yaml import YAML

        self._yaml = YAML(typ=typ)

    def load(self, text: str) -> object:
        """Return the value of a document.

        Raises:
            BagError: it has too many values, or is not YAML.
        """
        if "*" in text:  # no alias without it
            try:
                compose_yaml(text)
            except yaml.YAMLError as error:
                raise BagError(f"metadata.yaml: {error}") from None
        return self._yaml.load(text)


def _limit_schema(connection: apsw.Connection) -> None:
    """Limit what the schema of a database may compute, since it comes with the file."""
    import apsw

    # A column may be computed: the 20 bytes of zeroblob(1000000000) yield a gigabyte.
    connection.limit(apsw.SQLITE_LIMIT_LENGTH, MOST_CHUNK_BYTES)
    # A view may have rows without end.
    connection.config(apsw.SQLITE_DBCONFIG_ENABLE_VIEW, 0)


@contextmanager
def _open_zstd(stream: BinaryIO, _mode: str) -> Iterator[_FileLimit]:
    import zstandard

    with zstandard.ZstdDecompressor().stream_reader(stream, read_across_frames=True, closefd=False) as reader:
        yield _FileLimit(reader)


class _FileLimit:
    """A stream that raises at the file size limit, or before the disk for temporary files is full."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._left = min(MOST_FILE_BYTES, shutil.disk_usage(tempfile.gettempdir()).free - _FREE_BYTES)

    def read(self, size: int = _PIECE) -> bytes:
        """Return the next piece.

        Raises:
            BagError: the limit is reached.
        """
        piece = self._stream.read(size)
        self._left -= len(piece)
        if piece and self._left < 0:
            raise BagError(
                f"a compressed file of the bag unpacks to more than {MOST_FILE_BYTES >> 30} GB, or to more than "
                f"{tempfile.gettempdir()} has room for; set TMPDIR to a larger disk"
            )
        return piece


def _zstd(data: bytes) -> Iterator[bytes]:
    import zstandard

    reader = zstandard.ZstdDecompressor().stream_reader(data)
    try:
        while piece := reader.read(_PIECE):
            yield piece
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from None


def _lz4(data: bytes) -> Iterator[bytes]:
    import lz4.frame

    decompressor = lz4.frame.LZ4FrameDecompressor()
    piece = decompressor.decompress(data, _PIECE)
    while piece:
        yield piece
        if decompressor.eof or decompressor.needs_input:
            return
        piece = decompressor.decompress(b"", _PIECE)


_PIECES: dict[str, Callable[[bytes], Iterator[bytes]]] = {"zstd": _zstd, "lz4": _lz4}
