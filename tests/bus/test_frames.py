"""What a reader does with messages from outside, whole and wrong; the slots behind large ones."""

import fcntl
import mmap
import os
import socket

import numpy as np
import pytest
import zmq
from hypothesis import given, settings
from hypothesis import strategies as st
from local_bus import BYTES, LARGE, Bus, numbered, wait_for

from instant_ic.bus.frame import (
    HEADER,
    INLINE,
    MAGIC,
    MARK,
    REFERENCE,
    SHARED,
    VERSION,
    FrameError,
    type_digest,
    unpack_header,
)
from instant_ic.bus.shm import PeerProgress, Slot, SlotPool, progress_page, store_progress

ID = b"publishr"


class Stranger:
    """A publisher of which every part is the test's, beside a good one; both on /x."""

    def __init__(self, bus: Bus) -> None:
        self.out, self.reader = bus.publisher(), bus.reader()
        wait_for(lambda: self.out.subscriber_count == 1)
        raw = self.reader.raw
        with self.reader.transport.read_lock:
            self._socket = raw._host.context.socket(zmq.PUB)
            self._socket.bind("inproc://stranger")
            raw.socket.connect("inproc://stranger")
            raw.read()

    def send(self, *parts: bytes) -> None:
        with self.reader.transport.read_lock:
            self._socket.send_multipart(parts)
            self.reader.raw.read()

    def close(self) -> None:
        self._socket.close(0)


@pytest.fixture
def stranger(bus: Bus):
    stranger = Stranger(bus)
    yield stranger
    stranger.close()


def good(stranger: Stranger) -> bytes:
    """A header as the good publisher would send it."""
    return HEADER.pack(INLINE, MARK, 1, 5, stranger.out.identity, type_digest(BYTES), 3)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=60) | st.builds(lambda rest: b"\0" + MAGIC + bytes([VERSION]) + rest, st.binary(max_size=60)))
def test_foreign_bytes_are_a_header_or_an_error(data: bytes) -> None:
    try:
        assert len(unpack_header(data)) == 7
    except FrameError as error:
        assert str(error)


def test_frame_of_another_version_says_so() -> None:
    with pytest.raises(FrameError, match=f"not a frame of version {VERSION} .version {VERSION + 1}"):
        unpack_header(b"/x\0" + MAGIC + bytes([VERSION + 1]) + bytes(43))


def test_garbage_is_counted_told_and_followed_by_good_messages(stranger: Stranger, caplog) -> None:
    header, reader = good(stranger), stranger.reader
    bad = [
        [b"/x"],
        [b"/x", b"no header"],
        [b"/x" + header],
        [b"/x" + header, b"four"],
        [b"/x" + HEADER.pack(SHARED, MARK, 1, 5, stranger.out.identity, type_digest(BYTES), 3), b"abc"],
        [b"/x" + HEADER.pack(INLINE, MARK, 1, 5, b"nobody..", type_digest(BYTES), 3), b"abc"],
        [b"/xyz", b"", b"", b"", b""],
    ]
    for count, parts in enumerate(bad, start=1):
        stranger.send(*parts)
        assert reader.stats.rejected >= count, parts
    assert "not a frame of version 4" in caplog.text
    assert "message of 4 bytes, 3 announced" in caplog.text
    assert "not in the registry (identity 6e6f626f64792e2e)" in caplog.text
    assert reader.poll() == []
    stranger.out.send(numbered(1))
    wait_for(lambda: reader.numbers() == [1])
    assert reader.stats.lost == 0


def test_reference_to_something_else_is_not_opened(stranger: Stranger, caplog) -> None:
    """A descriptor that is no memory of the bus, here a pipe nobody writes to: opening it would block."""
    pipe = os.pipe()
    header = HEADER.pack(SHARED, MARK, 1, 5, stranger.out.identity, type_digest(BYTES), 3)
    stranger.send(b"/x" + header, REFERENCE.pack(os.getpid(), pipe[0], 1, 1))
    assert "shared memory of sender cannot be used (not shared memory of the bus)" in caplog.text
    assert stranger.reader.poll() == []
    for end in pipe:
        os.close(end)


def test_stranger_at_a_publishers_socket_disturbs_nobody(bus: Bus) -> None:
    out, reader = bus.publisher(), bus.reader()
    wait_for(lambda: out.subscriber_count == 1)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
        other.connect(str(out.path))
        other.send(b"GET / HTTP/1.1\r\n\r\n" * 10)
        out.send(numbered(1))
        wait_for(lambda: reader.numbers() == [1])
    wait_for(lambda: out.subscriber_count == 1)


def test_payload_of_any_buffer_is_one_message(bus: Bus) -> None:
    out, reader = bus.publisher(), bus.reader()
    wait_for(lambda: out.subscriber_count == 1)
    for size in (1000, LARGE):
        want = numbered(3, size)
        words = np.frombuffer(want, np.int64)
        for payload in (want, bytearray(want), memoryview(words)):
            out.send(payload)
            assert wait_for(reader.poll).pop().payload == want


def written(pool: SlotPool, sequence: int, size: int = LARGE, must: int = 99, should: int = 99) -> Slot | None:
    slot = pool.acquire(size, 6, must, should)
    if slot is not None:
        slot.begin(size).release()
        slot.finish(sequence)
        slot.unlock()
    return slot


def test_slot_is_refilled_only_when_nobody_uses_or_still_wants_it() -> None:
    pool = SlotPool(ID)
    first = written(pool, 1)
    reader = Slot.open(os.getpid(), first.fd, ID)
    assert reader.lease(1, LARGE)
    second = written(pool, 2)
    assert second is not first  # in use
    third = written(pool, 3, must=1)
    assert third not in (first, second)  # a reliable reader has not looked at it
    reader.unlock()
    assert written(pool, 4) is first  # the oldest
    assert written(pool, 5, should=0) not in (first, second, third)  # newest-only readers: not before there are four
    assert written(pool, 6, should=0) is second
    assert not reader.lease(1, LARGE)  # another message by now
    pool.close()


def test_larger_message_takes_a_new_slot_and_drops_the_small() -> None:
    pool = SlotPool(ID, most_bytes=10_000_000)
    small = written(pool, 1)
    large = written(pool, 2, 5_000_000)
    assert small not in pool.slots and pool.oldest == large.number
    assert written(pool, 3, 5_000_000, must=1) is None  # over the limit of all together
    pool.close()


def test_mapping_is_read_only_sealed_and_checks_the_size() -> None:
    slot = Slot.create(1, LARGE, ID)
    with slot.begin(LARGE) as target:
        target[:] = numbered(5, LARGE)
    slot.finish(5)
    mapping = Slot.open(os.getpid(), slot.fd, ID)
    assert mapping.lease(5, slot.capacity)
    mapping.unlock()
    assert not mapping.lease(5, slot.capacity + 1) and not mapping.lease(4, LARGE)
    assert mapping.view(LARGE) == numbered(5, LARGE)
    assert mapping.view(LARGE).readonly
    body = np.frombuffer(mapping.view(LARGE), np.uint8, offset=4)
    assert body.ctypes.data % 64 == 0  # arrays of a CDR message start aligned
    with pytest.raises(OSError):  # sealed: nobody can take the memory away under the others
        os.truncate(slot.fd, 10)
    with pytest.raises(OSError):
        mmap.mmap(slot.fd, 4096, mmap.MAP_SHARED, mmap.PROT_WRITE)
    with pytest.raises(FileNotFoundError):
        Slot.open(os.getpid(), slot.fd, b"somebody")
    assert mapping.lease(5, LARGE)
    slot.close()
    assert mapping.view(LARGE) == numbered(5, LARGE)  # the reader's share stays


def test_writer_killed_in_a_slot_leaves_no_message_in_it() -> None:
    slot = Slot.create(1, LARGE, ID)
    slot.finish(5)
    mapping = Slot.open(os.getpid(), slot.fd, ID)
    assert slot.lock()
    slot.begin(LARGE).release()
    assert not mapping.lease(5, LARGE)  # being written
    slot.close()  # as at a kill: the kernel releases the lock
    assert not mapping.lease(5, LARGE) and mapping.sequence == 0


def test_a_slot_can_be_leased_again_as_soon_as_it_is_unlocked(monkeypatch) -> None:
    """A node's thread unlocks it; before that call returns, the next message is in it and the bus thread reads it."""
    slot = Slot.create(1, LARGE, ID)
    slot.finish(1)
    reader = Slot.open(os.getpid(), slot.fd, ID)
    assert reader.lease(1, LARGE)
    flock, leased = fcntl.flock, []

    def refill(fd: int, kind: int) -> None:
        flock(fd, kind)
        monkeypatch.undo()
        assert slot.lock()
        slot.finish(2)
        slot.unlock()
        leased.append(reader.lease(2, LARGE))

    monkeypatch.setattr("instant_ic.bus.shm.fcntl.flock", refill)
    reader.unlock()
    assert leased == [True] and reader.held and not slot.lock()


def test_progress_is_seen_by_the_publisher() -> None:
    page, announcement = progress_page(newest_only=False)
    peer = PeerProgress(announcement, ID, joined=3)
    assert peer.sequence() == 3 and not peer.newest_only
    store_progress(page, 0, b"another!", 9)
    store_progress(page, 1, ID, 7)
    assert peer.sequence() == 7
    store_progress(page, 1, b"the next", 8)  # in the place of a publisher that is gone
    assert peer.sequence() == 3
    store_progress(page, 256, ID, 9)  # the page is full
    assert peer.sequence() == 3
    for wrong in (b"!1/2/3/0", b"!x", b"!99999999999/1/0", b"!%d/0/0" % os.getpid()):
        with pytest.raises((OSError, ValueError)):
            PeerProgress(wrong, ID, 0)
    page.close()
