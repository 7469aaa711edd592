"""One MCAP file, held against the independent `mcap` package; and a disk that gets full under it."""

import errno
import os
from pathlib import Path

import pytest
from mcap.reader import make_reader

from instant_ic.bag import Schema
from instant_ic.bag.mcap_scan import McapScan
from instant_ic.bag.mcap_writer import CHUNK_BYTES, McapWriter
from instant_ic.bus import LATCHED

BOOL = Schema("std_msgs/msg/Bool", "ros2msg", "bool data\n", "RIHS01_1")
TOPIC = ("/a", BOOL.name)
TOPICS = {TOPIC: (LATCHED, BOOL)}


def fill(file: McapWriter, sizes: list[int]) -> list[tuple[int, bytes]]:
    sent = [(1000 + i, bytes([i % 256]) * size) for i, size in enumerate(sizes)]
    for stamp_ns, payload in sent:
        file.write(TOPIC, stamp_ns, memoryview(payload))
    return sent


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("sizes", [[0, 1, CHUNK_BYTES, 7], [3_000_000] * 3])
def test_mcap_package_reads_it_with_check_sums(tmp_path: Path, sizes: list[int], compressed: bool) -> None:
    file = McapWriter(tmp_path / "a.mcap", TOPICS, compressed)
    sent = fill(file, sizes)
    file.add_metadata("notes", {"key": "wörds"})
    assert file.finish() is None and file.counts.total() == len(sizes)
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
        assert [(m.log_time, m.data) for _, _, m in reader.iter_messages()] == sent
        assert [(m.name, m.metadata) for m in reader.iter_metadata()] == [("notes", {"key": "wörds"})]
    assert summary is not None and summary.statistics is not None
    stated = summary.statistics
    assert (stated.message_count, stated.channel_message_counts) == (len(sizes), {1: len(sizes)})
    assert (stated.message_start_time, stated.message_end_time) == (1000, 999 + len(sizes))
    assert (stated.schema_count, stated.channel_count, stated.metadata_count) == (1, 1, 1)
    assert summary.schemas[1].name == BOOL.name
    assert "transient_local" in summary.channels[1].metadata["offered_qos_profiles"]
    assert stated.chunk_count == len(summary.chunk_indexes)
    if sizes[0] == 3_000_000:
        assert stated.chunk_count == 3  # a message larger than a chunk closes its own


def full_disk(monkeypatch: pytest.MonkeyPatch, limit: int, error: int = errno.ENOSPC) -> None:
    """Make each file take ``limit`` bytes, the last write only in part."""
    write = os.write

    def limited(fd: int, data: memoryview) -> int:
        room = limit - os.lseek(fd, 0, os.SEEK_CUR)
        if room <= 0:
            raise OSError(error, os.strerror(error))
        return write(fd, data[:room])

    monkeypatch.setattr(os, "write", limited)


def scanned(path: Path) -> list[bytes]:
    return [message.payload for message in McapScan(path).messages()]


@pytest.mark.parametrize("limit", [10_000, 1_000_000])
def test_full_disk_leaves_all_complete_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int) -> None:
    full_disk(monkeypatch, limit)
    file = McapWriter(tmp_path / "a.mcap", TOPICS)
    sent = []
    with pytest.raises(OSError, match="No space left"):
        for index in range(300):
            sent.append(bytes([index % 256]) * 10_000)
            file.write(TOPIC, index, sent[-1])
            if index % 5 == 4:
                file.flush()
    got = scanned(tmp_path / "a.mcap")
    assert len(got) + file.lost["/a"] == len(sent) > len(got)
    assert got == sent[: len(got)] and file.counts.total() == len(got)
    assert len(got) >= min(len(sent), limit // 10_100) - 6  # all but the chunk that did not fit
    assert not got or file.span_ns == (0, len(got) - 1)


def test_without_room_for_the_index_all_messages_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = McapWriter(tmp_path / "a.mcap", TOPICS)
    sent = fill(file, [10_000] * 3)
    file.flush()
    full_disk(monkeypatch, 0, errno.EIO)
    with pytest.raises(OSError, match="Input/output"):
        file.finish()
    assert scanned(tmp_path / "a.mcap") == [payload for _, payload in sent] and not file.lost
