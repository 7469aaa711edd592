"""Bags that unpack to more than they say, or than a machine holds (19 kB became 617 MB in recover)."""

from __future__ import annotations

import math
import struct
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import lz4.frame
import pytest
import yaml
import zstandard
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC as MAGIC
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from instant_ic.bag import BagError, BagReader, bounded
from instant_ic.bag.mcap_scan import McapScan
from instant_ic.bag.recover import recover
from instant_ic.msg import typestore

MB = 1 << 20
BOMB = 24 * MB
"""What the bombs hold; the limits of these tests are at most 2 MB."""
TEXT = "std_msgs/msg/String"


@contextmanager
def level_memory() -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < 16 * MB
    finally:
        tracemalloc.stop()


@pytest.fixture
def small_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded, "MOST_CHUNK_BYTES", 2 * MB)


def packed(compression: str) -> bytes:
    content = bytes(BOMB)
    return zstandard.compress(content) if compression == "zstd" else lz4.frame.compress(content)


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def bomb(path: Path, compression: str, declared: int) -> Path:
    """An MCAP file of one chunk."""
    data = packed(compression)
    chunk = struct.pack("<QQQI", 0, 1, declared, 0) + text(compression) + struct.pack("<Q", len(data)) + data
    path.write_bytes(
        MAGIC
        + record(Opcode.HEADER, text("ros2") + text(""))
        + record(Opcode.CHUNK, chunk)
        + record(Opcode.DATA_END, bytes(4))
        + record(Opcode.FOOTER, bytes(20))
        + MAGIC
    )
    return path


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("declared", [1000, 1 << 62])
def test_chunk_never_unpacks_to_more_than_it_declares_or_than_the_limit(
    tmp_path: Path, compression: str, declared: int, small_limits: None
) -> None:
    (tmp_path / "bag").mkdir()
    path = bomb(tmp_path / "bag" / "bag_0.mcap", compression, declared)
    with level_memory():
        scan = McapScan(path)
        assert list(scan.messages()) == []
        assert len(scan.damaged) == 1
    with level_memory(), pytest.raises(BagError, match="no message could be recovered"):
        recover(path, tmp_path / "new")
    with level_memory(), pytest.raises(BagError, match="bytes"):
        BagReader(path)


def ros2_bag(mode: CompressionMode, storage: StoragePlugin) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        writer = Writer(folder / "bag", version=9, storage_plugin=storage)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection("/text", TEXT, typestore=typestore())
            writer.write(connection, 1, bytes(BOMB))
        return folder / "bag"

    return write


@pytest.mark.parametrize(
    "write",
    [
        ros2_bag(CompressionMode.MESSAGE, StoragePlugin.SQLITE3),
        ros2_bag(CompressionMode.STORAGE, StoragePlugin.MCAP),
    ],
    ids=["sqlite-message", "mcap"],
)
def test_every_kind_of_bag_is_limited(
    tmp_path: Path, write: Callable[[Path], Path], small_limits: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path)
    with level_memory(), pytest.raises(BagError, match=r"more than|data declare"), BagReader(path) as bag:
        list(bag.messages())
    # Above the limit it is not the bag that is at fault.
    monkeypatch.setattr(bounded, "MOST_CHUNK_BYTES", 2 * BOMB)
    with BagReader(path) as bag:
        assert bag.count == 1
        assert len(next(iter(bag.messages())).payload) >= BOMB - 8


def test_computed_column_of_an_sqlite_bag_is_limited(tmp_path: Path, small_limits: None) -> None:
    import sqlite3

    path = ros2_bag(CompressionMode.NONE, StoragePlugin.SQLITE3)(tmp_path)
    file = next(path.glob("*.db3"))
    with sqlite3.connect(file) as database:
        database.execute("DROP TABLE messages")
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
            f"data BLOB GENERATED ALWAYS AS (zeroblob({BOMB})) VIRTUAL)"
        )
        database.execute("INSERT INTO messages(topic_id, timestamp) VALUES (1, 1)")
    database.close()
    with level_memory(), pytest.raises(BagError, match="too big"), BagReader(path) as bag:
        list(bag.messages())


@pytest.mark.timeout(300)
def test_sqlite_table_that_is_a_view_without_end_is_not_read(tmp_path: Path) -> None:
    import sqlite3

    path = ros2_bag(CompressionMode.NONE, StoragePlugin.SQLITE3)(tmp_path)
    file = next(path.glob("*.db3"))
    with sqlite3.connect(file) as database:
        database.execute("DROP TABLE messages")
        database.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
            "SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n"
        )
        # rosbags counts what the schema calls tables.
        database.execute("PRAGMA writable_schema = ON")
        database.execute("UPDATE sqlite_master SET type = 'table' WHERE name = 'messages'")
    database.close()
    with pytest.raises(BagError, match="cannot be read"):
        BagReader(file)


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_whole_frames_come_whole_and_cut_ones_as_far_as_they_go(compression: str) -> None:
    import random

    content = random.Random(3).randbytes(3 * MB) + bytes(MB)
    pack = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}[compression]
    data = pack(content)
    assert bounded.decompress(data, compression, len(content)) == content
    cut = bounded.decompress(data[: 2 * MB], compression, len(content))
    assert 2 * MB - (1 << 18) < len(cut) < len(content) and content.startswith(cut)  # all complete blocks
    with pytest.raises(ValueError, match="more than"):
        bounded.decompress(data, compression, len(content) - 1)
    with pytest.raises(ValueError):
        bounded.decompress(b"\0" * 100, compression)


@pytest.mark.parametrize("count", [math.inf, None])
def test_a_message_count_that_is_no_number_is_an_error_with_its_topic(tmp_path: Path, count: object) -> None:
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/text", TEXT, typestore=typestore())
        writer.write(connection, 1, b"\x00\x01\x00\x00\x02\x00\x00\x00x\x00")
    file = tmp_path / "bag" / "metadata.yaml"
    content = yaml.safe_load(file.read_text())
    content["rosbag2_bagfile_information"]["topics_with_message_count"][0]["message_count"] = count
    file.write_text(yaml.safe_dump(content))
    with pytest.raises(BagError, match="message_count of /text is"), BagReader(tmp_path / "bag") as bag:
        _ = bag.topics
