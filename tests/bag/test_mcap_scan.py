"""The tolerant reader on bytes of any kind: it gives messages that were written, or none, and never fails otherwise."""

import io
import tempfile
from functools import cache
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from instant_ic.bag import BagError, BagWriter
from instant_ic.bag.mcap_scan import McapScan
from instant_ic.bus import LATCHED, SENSOR

BOOL = "std_msgs/msg/Bool"
PAYLOADS = {bytes([i]) * (10 + i) for i in range(12)}


@cache
def good(compressed: bool) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag"
        with BagWriter(path, compressed) as writer:
            writer.set_custom("a", "b")
            for index in range(12):
                writer.write("/x", BOOL, bytes([index]) * (10 + index), 100 + index, SENSOR if index % 2 else LATCHED)
                if index % 4 == 3:
                    writer.flush()
        return (path / "bag.mcap").read_bytes()


def scan(data: bytes) -> tuple[list[bytes], McapScan]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        path.write_bytes(data)
        found = McapScan(path)
        return [message.payload for message in found.messages()], found


@settings(max_examples=150, deadline=None)
@given(
    st.booleans(), st.lists(st.tuples(st.integers(0, 10**9), st.integers(1, 255)), min_size=1, max_size=4), st.data()
)
def test_flipped_bytes_never_give_a_message_that_was_not_written(
    compressed: bool, flips: list[tuple[int, int]], data: st.DataObject
) -> None:
    garbled = bytearray(good(compressed))
    for at, mask in flips:
        garbled[at % len(garbled)] ^= mask
    cut = data.draw(st.integers(0, len(garbled)))
    try:
        payloads, found = scan(bytes(garbled))
        whole_chunks_only = found.stopped_by == ""
    except BagError:
        return
    # The check sums hold for whole chunks; in a chunk whose own length was changed nothing can be checked.
    if whole_chunks_only:
        assert set(payloads) <= PAYLOADS
    try:
        scan(bytes(garbled[:cut]))
    except BagError as error:
        assert "not an MCAP file" in str(error)


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=400))
def test_any_bytes_after_the_magic(data: bytes) -> None:
    scan(good(False)[:8] + data)
    with pytest.raises(BagError, match="not an MCAP file"):
        scan(b"x" + data)


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def test_files_of_the_mcap_package_cut_anywhere(compression: CompressionType) -> None:
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=3000, compression=compression)
    writer.start("ros2", "other")
    schema = writer.register_schema(BOOL, "ros2msg", b"bool data")
    channel = writer.register_channel("/x", "cdr", schema)
    sent = [bytes([i]) * 500 for i in range(30)]
    for index, payload in enumerate(sent):
        writer.add_message(channel, index, payload, index + 7)  # their publish time is no sign of a repetition
    writer.finish()
    data = stream.getvalue()
    assert scan(data)[0] == sent
    most = 0
    for at in range(0, len(data), 211):
        try:
            payloads, _ = scan(data[:at])
        except BagError:
            assert at < 8
            continue
        assert payloads == sent[: len(payloads)] and len(payloads) >= most
        most = len(payloads)
    assert most == 30


def test_file_without_chunks() -> None:
    stream = io.BytesIO()
    writer = Writer(stream, use_chunking=False)
    writer.start("ros2", "other")
    channel = writer.register_channel("/x", "cdr", writer.register_schema(BOOL, "ros2msg", b"bool data"))
    for index in range(5):
        writer.add_message(channel, index, bytes([index]), index)
    writer.finish()
    assert scan(stream.getvalue())[0] == [bytes([i]) for i in range(5)]
    assert len(scan(stream.getvalue()[:-400])[0]) >= 1
