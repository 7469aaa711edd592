"""One MCAP file, held against the independent `mcap` package; and a disk that gets full under it."""

import errno
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import NonSeekingReader, make_reader

from instant_ic.bag.mcap_writer import CHUNK_BYTES, McapWriter, Schema

BOOL = Schema("std_msgs/msg/Bool", "ros2msg", "bool data\n", "RIHS01_1")


def fill(file: McapWriter, sizes: list[int]) -> list[tuple[int, bytes]]:
    channel = file.add_channel("/a", file.add_schema(BOOL), {"offered_qos_profiles": "x"})
    sent = [(1000 + i, bytes([i % 256]) * size) for i, size in enumerate(sizes)]
    for stamp_ns, payload in sent:
        file.write(channel, stamp_ns, memoryview(payload), stamp_ns - 1)
    return sent


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("sizes", [[0, 1, 5, 300], [CHUNK_BYTES, CHUNK_BYTES - 100, 7], [3_000_000] * 3, [40] * 5000])
def test_mcap_package_reads_it_with_check_sums(tmp_path: Path, sizes: list[int], compressed: bool) -> None:
    file = McapWriter(tmp_path / "a.mcap", compressed)
    sent = fill(file, sizes)
    file.add_metadata("notes", {"key": "wörds"})
    assert file.finish() is None and file.count == len(sizes)
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
        assert [(m.log_time, m.data) for _, _, m in reader.iter_messages()] == sent
        assert [m.publish_time for _, _, m in reader.iter_messages()] == [stamp_ns - 1 for stamp_ns, _ in sent]
        assert [(m.name, m.metadata) for m in reader.iter_metadata()] == [("notes", {"key": "wörds"})]
    assert summary is not None and summary.statistics is not None
    told = summary.statistics
    assert (told.message_count, told.channel_message_counts) == (len(sizes), {1: len(sizes)})
    assert (told.message_start_time, told.message_end_time) == (1000, 999 + len(sizes))
    assert (told.schema_count, told.channel_count, told.metadata_count) == (1, 1, 1)
    assert summary.schemas[1].name == BOOL.name and summary.channels[1].metadata == {"offered_qos_profiles": "x"}
    assert told.chunk_count == len(summary.chunk_indexes)
    if sizes[0] == 3_000_000:
        assert told.chunk_count == 3  # a message larger than a chunk closes its own


def test_span_of_time_is_found_by_the_index(tmp_path: Path) -> None:
    file = McapWriter(tmp_path / "a.mcap")
    sent = fill(file, [500_000] * 10)
    file.finish()
    with (tmp_path / "a.mcap").open("rb") as stream:
        found = [m.log_time for _, _, m in make_reader(stream).iter_messages(starting_at=1003, ending_before=1006)]
    assert found == [1003, 1004, 1005] and len(sent) == 10


def test_nothing_is_copied_of_a_large_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    payload = b"x" * 5_000_000
    given: list[memoryview] = []
    writev = os.writev
    monkeypatch.setattr(os, "writev", lambda fd, parts: given.extend(parts) or writev(fd, parts))
    file = McapWriter(tmp_path / "a.mcap")
    channel = file.add_channel("/a", file.add_schema(BOOL), {})
    file.write(channel, 1, payload)
    file.finish()
    assert any(part.obj is payload for part in given)


class FullDisk:
    """Takes so many bytes in all, the last piece only in part, as a disk does; ``limit`` may be raised."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, limit: int, error: int = errno.ENOSPC) -> None:
        self.limit, self.error = limit, error
        self._writev, self._truncate = os.writev, os.ftruncate
        self._sizes: dict[int, int] = {}
        monkeypatch.setattr(os, "writev", self.writev)
        monkeypatch.setattr(os, "ftruncate", self.ftruncate)

    def writev(self, fd: int, parts: list[memoryview]) -> int:
        room = self.limit - sum(self._sizes.values())
        if room <= 0:
            raise OSError(self.error, os.strerror(self.error))
        cut: list[memoryview] = []
        for part in parts:
            cut.append(part[:room])
            room -= len(cut[-1])
            if room == 0:
                break
        written = self._writev(fd, cut)
        self._sizes[fd] = self._sizes.get(fd, 0) + written
        return written

    def ftruncate(self, fd: int, size: int) -> None:
        self._truncate(fd, size)
        self._sizes[fd] = size


def whole_messages(path: Path) -> list[bytes]:
    with path.open("rb") as stream:
        return [m.data for _, _, m in make_reader(stream, validate_crcs=True).iter_messages()]


@pytest.mark.parametrize("limit", [10_000, 100_000, 1_000_000, 2_345_678])
def test_full_disk_leaves_a_whole_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int) -> None:
    FullDisk(monkeypatch, limit)
    file = McapWriter(tmp_path / "a.mcap")
    channel = file.add_channel("/a", file.add_schema(BOOL), {})
    sent, failed = [], False
    for index in range(300):
        sent.append(bytes([index % 256]) * 10_000)
        try:
            file.write(channel, index, sent[-1])
            if index % 5 == 4:
                file.flush()
        except OSError as error:
            assert error.errno == errno.ENOSPC
            failed = True
            break
    assert failed
    file.finish()
    got = whole_messages(tmp_path / "a.mcap")
    assert got == sent[: len(got)] and file.count == len(got)
    # All but the chunk that did not fit, and those that made room for the index: at most two of 5 messages.
    assert len(got) >= min(len(sent), limit // 10_100) - 11
    assert (tmp_path / "a.mcap").stat().st_size <= limit


def test_other_errors_of_the_disk_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = FullDisk(monkeypatch, 50_000, errno.EIO)
    file = McapWriter(tmp_path / "a.mcap")
    fill(file, [10_000] * 3)
    file.flush()
    disk.limit = 0
    with pytest.raises(OSError, match="Input/output error"):
        file.finish()
    with (tmp_path / "a.mcap").open("rb") as stream, pytest.raises(Exception, match=r"."):  # no index, so no reader ...
        make_reader(stream).get_summary()
    with (tmp_path / "a.mcap").open("rb") as stream:  # ... but what was flushed is there
        messages = NonSeekingReader(stream).iter_messages(log_time_order=False)
        assert [next(messages)[2].data[0] for _ in range(3)] == [0, 1, 2]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A real file system of 3 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", folder], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"a tmpfs cannot be mounted here: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_real_full_disk(small_disk: Path) -> None:
    file = McapWriter(small_disk / "a.mcap")
    channel = file.add_channel("/a", file.add_schema(BOOL), {})
    with pytest.raises(OSError) as caught:
        for index in range(100):
            file.write(channel, index, bytes([index]) * 100_000)
    assert caught.value.errno == errno.ENOSPC
    file.finish()
    got = whole_messages(small_disk / "a.mcap")
    assert len(got) >= 11 and [data[0] for data in got] == list(range(len(got)))
