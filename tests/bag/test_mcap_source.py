"""MCAP files of any writer: everything that the format makes optional, and files that contradict themselves."""

from __future__ import annotations

import io
import itertools
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer

from instant_ic.bag import BagError, BagReader
from instant_ic.bag.mcap_source import SCHEMALESS
from instant_ic.bag.mcap_writer import MAGIC
from instant_ic.bag.recover import recover, reindex

BOOL = "std_msgs/msg/Bool"
CHANNELS = {1: "/a", 2: "/b", 3: "/a"}
"""Two channels have one topic and type, as those of two publishers in one file do."""
SENT = [(1 + i % 3, 100 + i, bytes([i]) * (1 + i)) for i in range(12)]
"""Channel, stamp, payload."""


def expected(messages: list[tuple[int, int, bytes]] | None = None) -> list[tuple[str, int, bytes]]:
    found = [(CHANNELS[channel], stamp_ns, payload) for channel, stamp_ns, payload in messages or SENT]
    return sorted(found, key=lambda entry: entry[1])


def read(path: Path, *span: int | None) -> list[tuple[str, int, bytes]]:
    with BagReader(path) as reader:
        found = [(m.topic, m.stamp_ns, m.payload) for m in reader.messages(None, *span)]
        if not span:
            assert reader.count == len(found) == sum(topic.count for topic in reader.topics)
            assert not found or (reader.start_ns, reader.end_ns) == (found[0][1], found[-1][1])
        for topic in {"/a", "/b"}:
            assert [m.payload for m in reader.messages({topic}, *span)] == [p for t, _, p in found if t == topic]
    return found


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def message(channel: int, stamp_ns: int, payload: bytes) -> bytes:
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", channel, 7, stamp_ns, stamp_ns + 3) + payload)


def definitions(encoding: str = "cdr") -> bytes:
    schema = record(Opcode.SCHEMA, struct.pack("<H", 1) + text(BOOL) + text("ros2msg") + text("bool data"))
    channels = [
        record(Opcode.CHANNEL, struct.pack("<HH", channel, 1) + text(topic) + text(encoding) + text(""))
        for channel, topic in CHANNELS.items()
    ]
    return schema + b"".join(channels)


def chunk(content: bytes, compression: str = "", crc: int | None = None, times: tuple[int, int] = (100, 111)) -> bytes:
    pack = {"": bytes, "zstd": zstandard.compress, "lz4": lz4.frame.compress}[compression]
    data = pack(content)
    head = struct.pack("<QQQI", *times, len(content), zlib.crc32(content) if crc is None else crc)
    return record(Opcode.CHUNK, head + text(compression) + struct.pack("<Q", len(data)) + data)


def file_of(path: Path, *data: bytes, summary: bytes = b"", profile: str = "ros2", library: str = "other") -> Path:
    head = MAGIC + record(Opcode.HEADER, text(profile) + text(library))
    body = head + b"".join(data) + record(Opcode.DATA_END, bytes(4))
    footer = struct.pack("<QQI", len(body) if summary else 0, 0, 0)
    path.write_bytes(body + summary + record(Opcode.FOOTER, footer) + MAGIC)
    return path


ALL = b"".join(message(*entry) for entry in SENT)
HALVES = [b"".join(message(*entry) for entry in part) for part in (SENT[:6], SENT[6:])]
UNKNOWN = record(0x42, b"of a later version") + record(0x99, b"private")
ATTACHMENT = record(Opcode.ATTACHMENT, bytes(16) + text("a") + text("b") + struct.pack("<Q", 3) + b"xyz" + bytes(4))
METADATA = record(Opcode.METADATA, text("note") + struct.pack("<I", 10) + text("k") + text("v"))


@pytest.mark.parametrize(
    "data",
    [
        [definitions(), ALL],
        [definitions(), HALVES[1], HALVES[0]],  # not in stamp order
        [chunk(definitions() + ALL, "zstd")],
        [chunk(definitions() + HALVES[0], "lz4"), chunk(HALVES[1], "zstd")],
        [definitions(), chunk(HALVES[1]), chunk(HALVES[0])],
        [definitions(), chunk(HALVES[0]), HALVES[1]],  # messages in chunks and beside them
        [definitions(), HALVES[0], chunk(b"", times=(0, 0)), chunk(HALVES[1], "zstd", crc=0)],
        [UNKNOWN, definitions(), ATTACHMENT, HALVES[0], METADATA, UNKNOWN, chunk(UNKNOWN + HALVES[1]), UNKNOWN],
    ],
    ids=["plain", "unordered", "zstd", "lz4-zstd", "unordered-chunks", "beside", "empty-chunk", "unknown-records"],
)
def test_file_without_summary_is_read(tmp_path: Path, data: list[bytes]) -> None:
    path = file_of(tmp_path / "a.mcap", *data)
    assert read(path) == expected()
    assert read(path, 103, 108) == [entry for entry in expected() if 103 <= entry[1] < 108]


@pytest.mark.parametrize(("profile", "library"), [("", ""), ("ros2", "instant_ic"), ("px4", "my writer")])
def test_profile_and_library_do_not_matter(tmp_path: Path, profile: str, library: str) -> None:
    path = file_of(tmp_path / "a.mcap", definitions(), ALL, profile=profile, library=library)
    assert read(path) == expected()


def test_fields_of_a_later_version_at_the_end_of_a_record_are_ignored(tmp_path: Path) -> None:
    schema = struct.pack("<H", 1) + text(BOOL) + text("ros2msg") + text("bool data") + b"more"
    channel = struct.pack("<HH", 1, 1) + text("/a") + text("cdr") + text("") + b"more"
    data = record(Opcode.SCHEMA, schema) + record(Opcode.CHANNEL, channel) + message(1, 5, b"x")
    assert read(file_of(tmp_path / "a.mcap", data)) == [("/a", 5, b"x")]


def test_channel_without_schema_is_read_and_has_no_type(tmp_path: Path) -> None:
    channel = record(Opcode.CHANNEL, struct.pack("<HH", 1, 0) + text("/a") + text("cdr") + text(""))
    path = file_of(tmp_path / "a.mcap", channel, message(1, 5, b"x"))
    with BagReader(path) as reader:
        assert [(t.topic, t.type_name, t.count) for t in reader.topics] == [("/a", SCHEMALESS, 1)]
        assert [m.payload for m in reader.messages()] == [b"x"]
        with pytest.raises(BagError, match=f"type {SCHEMALESS} is unknown"):
            reader.decoder(reader.topics[0])


def test_schema_in_another_encoding_is_no_obstacle_to_other_topics(tmp_path: Path) -> None:
    other = record(Opcode.SCHEMA, struct.pack("<H", 2) + text("pb.Thing") + text("protobuf") + text("") + b"\xff\xfe")
    other += record(Opcode.CHANNEL, struct.pack("<HH", 9, 2) + text("/pb") + text("protobuf") + text(""))
    path = file_of(tmp_path / "a.mcap", definitions(), other, ALL, message(9, 100, b"\xff"))
    with BagReader(path) as reader:
        assert reader.count == 13
        assert [m.payload for m in reader.messages({"/b"})] == [p for t, _, p in expected() if t == "/b"]
        with pytest.raises(BagError, match="/pb: its messages are 'protobuf', not CDR"):
            list(reader.messages())


def statistics(count: int, chunks: int, by_channel: bool = False) -> bytes:
    counts = b"".join(struct.pack("<HQ", channel, 4) for channel in CHANNELS) if by_channel else b""
    head = struct.pack("<QHIIIIQQ", count, 1, len(CHANNELS), 0, 0, chunks, 100, 111)
    return record(Opcode.STATISTICS, head + struct.pack("<I", len(counts)) + counts)


def chunk_index(path: Path, data: bytes, offsets: bytes = b"", length: int = 0) -> bytes:
    """The index entry of the first chunk in a file that begins as ``file_of`` begins it."""
    at = file_of(path, definitions(), data).read_bytes().index(data)
    size = struct.pack("<QQQQ", 100, 111, at, len(data)) + struct.pack("<I", len(offsets)) + offsets
    return record(Opcode.CHUNK_INDEX, size + struct.pack("<Q", length) + text("") + struct.pack("<QQ", 1, 1))


@pytest.mark.parametrize("by_channel", [False, True])
@pytest.mark.parametrize("counts", [False, True])
def test_chunk_index_without_message_index_gives_all_messages(tmp_path: Path, by_channel: bool, counts: bool) -> None:
    """5 were counted and 0 read, silently."""
    path, data = tmp_path / "a.mcap", chunk(ALL)
    summary = definitions() + chunk_index(path, data) + (statistics(12, 1, by_channel) if counts else b"")
    assert read(file_of(path, definitions(), data, summary=summary)) == expected()
    (tmp_path / "bag").mkdir()
    path.rename(tmp_path / "bag" / "bag_0.mcap")
    assert reindex(tmp_path / "bag") == (1, 12)
    assert read(tmp_path / "bag") == expected()


def test_messages_beside_indexed_chunks_are_read(tmp_path: Path) -> None:
    path, data = tmp_path / "a.mcap", chunk(HALVES[0])
    for count in (statistics(12, 1), b""):
        summary = definitions() + chunk_index(path, data) + count
        assert read(file_of(path, definitions(), data, HALVES[1], summary=summary)) == expected()


def test_message_index_that_lists_a_part_of_its_chunk_is_no_limit(tmp_path: Path) -> None:
    path, data = tmp_path / "a.mcap", chunk(ALL)
    at = file_of(path, definitions(), data).read_bytes().index(data) + len(data)
    index = record(Opcode.MESSAGE_INDEX, struct.pack("<HI", 1, 16) + struct.pack("<QQ", 100, 0))
    entry = chunk_index(path, data, struct.pack("<HQ", 1, at), len(index))
    summary = definitions() + entry + statistics(12, 1)
    assert read(file_of(path, definitions(), data, index, summary=summary)) == expected()


def test_counts_that_differ_from_the_content_are_an_error(tmp_path: Path) -> None:
    path, data = tmp_path / "a.mcap", chunk(ALL)
    with pytest.raises(BagError, match="counts 13 messages and contains 12"):
        BagReader(file_of(path, definitions(), data, summary=definitions() + statistics(13, 1)))
    at = file_of(path, definitions(), data).read_bytes().index(data) + len(data)
    index = record(Opcode.MESSAGE_INDEX, struct.pack("<HI", 1, 16) + struct.pack("<QQ", 100, 0))
    entry = chunk_index(path, data, struct.pack("<HQ", 1, at), len(index))
    summary = definitions() + entry + statistics(1, 1)  # statistics and message index agree on 1 of 12
    with BagReader(file_of(path, definitions(), data, index, summary=summary)) as reader:
        with pytest.raises(BagError, match=r"index counts 1 messages at byte .*, there are 12"):
            list(reader.messages())


def test_fault_an_index_with_other_stamps_gives_messages_out_of_order(tmp_path: Path) -> None:
    path, data = tmp_path / "a.mcap", chunk(ALL)
    at = file_of(path, definitions(), data).read_bytes().index(data) + len(data)
    index = b"".join(record(Opcode.MESSAGE_INDEX, struct.pack("<HI", channel, 64) + bytes(64)) for channel in CHANNELS)
    size = len(index) // len(CHANNELS)
    offsets = b"".join(struct.pack("<HQ", channel, at + size * n) for n, channel in enumerate(CHANNELS))
    entry = bytearray(chunk_index(path, data, offsets, len(index)))
    struct.pack_into("<QQ", entry, 9, 0, 0)  # the writer left the chunk's stamps out
    summary = definitions() + bytes(entry) + statistics(12, 1)
    with BagReader(file_of(path, definitions(), data, index, summary=summary)) as reader:
        with pytest.raises(BagError, match="stamp outside those that its index gives"):
            list(reader.messages())


@pytest.mark.parametrize(
    ("data", "why"),
    [
        ([definitions(), message(8, 1, b"x")], "channel 8, which it does not define"),
        ([definitions(), chunk(ALL[:-3])], "record at byte .* is damaged"),
        ([definitions(), chunk(ALL, crc=5)], "wrong checksum"),
        ([definitions(), record(0, b"x")], "record at byte .* is damaged"),
    ],
)
def test_damage_is_an_error_that_names_recover(tmp_path: Path, data: list[bytes], why: str) -> None:
    with pytest.raises(BagError, match=f"cannot be read: .*{why}.*ic bag recover"):
        BagReader(file_of(tmp_path / "a.mcap", *data))


def test_truncated_file_is_an_error_wherever_it_ends(tmp_path: Path) -> None:
    data = file_of(tmp_path / "a.mcap", definitions(), chunk(HALVES[0], "zstd"), HALVES[1]).read_bytes()
    cut = tmp_path / "cut.mcap"
    for length in range(0, len(data), 7):
        cut.write_bytes(data[:length])
        with pytest.raises(BagError, match="ic bag recover"):
            BagReader(cut)


MIXED = st.lists(st.tuples(st.sampled_from([1, 2, 3]), st.integers(0, 50), st.binary(max_size=40)), max_size=20)


@settings(max_examples=120, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    messages=MIXED,
    chunk_size=st.sampled_from([1, 60, 200, 1 << 20]),
    compression=st.sampled_from(CompressionType),
    index_types=st.sets(st.sampled_from(IndexType)),
    flags=st.fixed_dictionaries(
        {
            name: st.booleans()
            for name in (
                "repeat_channels",
                "repeat_schemas",
                "use_chunking",
                "use_statistics",
                "use_summary_offsets",
                "enable_crcs",
                "enable_data_crcs",
            )
        }
    ),
)
def test_every_option_of_a_writer_gives_every_message(
    tmp_path: Path,
    messages: list[tuple[int, int, bytes]],
    chunk_size: int,
    compression: CompressionType,
    index_types: set[IndexType],
    flags: dict[str, bool],
) -> None:
    stream = io.BytesIO()
    kinds = IndexType.NONE
    for kind in index_types:
        kinds |= kind
    writer = Writer(stream, chunk_size=chunk_size, compression=compression, index_types=kinds, **flags)
    writer.start("", "other")
    schema = writer.register_schema(BOOL, "ros2msg", b"bool data")
    numbers = {channel: writer.register_channel(topic, "cdr", schema) for channel, topic in CHANNELS.items()}
    for number, (channel, stamp_ns, payload) in enumerate(messages):
        writer.add_message(numbers[channel], stamp_ns, payload, stamp_ns)
        if number == 5:
            writer.add_attachment(1, 1, "a", "b", b"xyz")
            writer.add_metadata("note", {"k": "v"})
    writer.finish()
    path = tmp_path / f"{next(NUMBERS)}.mcap"
    path.write_bytes(stream.getvalue())
    found = read(path)
    assert sorted(found) == sorted(expected(messages) if messages else [])
    assert [stamp_ns for _, stamp_ns, _ in found] == sorted(stamp_ns for _, stamp_ns, _ in messages)
    assert sorted(read(path, 10, 30)) == sorted(entry for entry in found if 10 <= entry[1] < 30)
    if messages:
        assert recover(path, path.with_suffix("")).count == len(messages)


NUMBERS: Iterator[int] = itertools.count()
