"""Bounded decompression for our readers and those of `rosbags`, because 19 kB of zstd can expand to 617 MB."""

from __future__ import annotations

from io import BytesIO
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NoReturn

import lz4.frame
import yaml
import zstandard

from instant_ic.bag.message import BagError
from instant_ic.config.yaml_text import compose_yaml

if TYPE_CHECKING:
    import apsw

MOST_CHUNK_BYTES = 256 << 20
"""Largest decompressed chunk or message. Recorders close chunks at about 1 MB, but a single message may be larger."""
_PIECE = 1 << 20


def decompress(data: bytes | memoryview, compression: str, declared_bytes: int | None = None) -> bytes:
    """Decompress one frame. A truncated frame yields the content of its complete blocks.

    Args:
        data: compressed bytes.
        compression: ``zstd`` or ``lz4``; empty for none.
        declared_bytes: decompressed size that the frame declares; None if unknown. `MOST_CHUNK_BYTES` always limits it.

    Raises:
        ValueError: the data are damaged or larger than declared or allowed, or the compression is unknown.
    """
    most_bytes = MOST_CHUNK_BYTES if declared_bytes is None else declared_bytes
    if most_bytes > MOST_CHUNK_BYTES:
        raise ValueError(f"data declare {most_bytes} bytes; the limit is {MOST_CHUNK_BYTES}")
    if compression == "":
        return bytes(data)
    out: list[bytes] = []
    size = 0
    try:
        with _opened(data, compression) as stream:
            while piece := stream.read1(_PIECE):  # read() would lose what comes before the end of a truncated frame
                size += len(piece)
                if size > most_bytes:
                    raise ValueError(f"data decompress to more than {most_bytes} bytes, the declared or maximum size")
                out.append(piece)
    except EOFError:  # a truncated frame
        pass
    except (RuntimeError, zstandard.ZstdError) as error:  # RuntimeError is raised by lz4
        raise ValueError(str(error)) from None
    return b"".join(out)


def _opened(data: bytes | memoryview, compression: str) -> Any:
    if compression == "zstd":
        return zstandard.open(BytesIO(data), "rb")
    if compression == "lz4":
        return lz4.frame.open(BytesIO(data), "rb")
    raise ValueError(f"unknown compression {compression[:40]!r}")


def guard_rosbags() -> None:
    """Add size limits to `rosbags`, which has none: MCAP chunks, messages, SQLite values, YAML.

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
        decompress=lambda data: decompress(data, "zstd"), open=_refuse_file
    )
    if _limit_schema not in apsw.connection_hooks:
        apsw.connection_hooks.append(_limit_schema)


class _BoundedYaml:
    """Reader of ``metadata.yaml`` as `rosbags` uses it; refuses text whose aliases expand to too many values."""

    def __init__(self, typ: str) -> None:
        from ruamel.yaml import YAML

        self._yaml = YAML(typ=typ)

    def load(self, text: str) -> object:
        """Return the value of a document.

        Raises:
            BagError: the document has too many values, or is not YAML.
        """
        if "*" in text:  # every alias begins with it
            try:
                compose_yaml(text)
            except yaml.YAMLError as error:
                raise BagError(f"metadata.yaml: {error}") from None
        return self._yaml.load(text)


def _limit_schema(connection: apsw.Connection) -> None:
    """Limit what the schema of a database may compute, because the schema comes with the file."""
    import apsw

    # A column may be computed: the 20 bytes of zeroblob(1000000000) yield a gigabyte.
    connection.limit(apsw.SQLITE_LIMIT_LENGTH, MOST_CHUNK_BYTES)
    # A view may yield infinitely many rows.
    connection.config(apsw.SQLITE_DBCONFIG_ENABLE_VIEW, 0)


def _refuse_file(stream: object, _mode: str) -> NoReturn:
    name = getattr(stream, "name", "a file")
    raise BagError(f"{name} is compressed as a whole; convert its bag first: rosbags-convert --src BAG --dst NEW")
