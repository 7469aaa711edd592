"""What a reader does with bytes from its socket, whole, in pieces and wrong; the buffers behind them."""

import json
import os
import socket
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from local_bus import BYTES, LARGE, Bus, number, numbered, wait_for, whole

from instant_ic.bus import RELIABLE, SENSOR
from instant_ic.bus.frame import DATA, GREETING, HEADER, HELLO, MAGIC, VERSION, FrameError, Hello, type_digest
from instant_ic.bus.local_subscription import RECEIVE_BYTES, Inlet
from instant_ic.bus.shm import BufferPool, SharedBuffer, SharedMapping

HELLO_FRAME = Hello("sender", "/x", BYTES, type_digest(BYTES), "00" * 8).pack()


class Listener:
    """A publisher of which every byte is the test's; keeps what the reader takes."""

    shared = True
    qos = RELIABLE
    topic = "/x"

    def __init__(self, folder: Path) -> None:
        self.taken: list[tuple[int, int, int, bytes]] = []
        self.hello: Hello | None = None
        path = folder / f"{os.urandom(4).hex()}.sock"
        server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        server.bind(str(path))
        server.listen()
        self.inlet = Inlet(self, str(path))
        self.socket, _ = server.accept()
        server.close()
        assert self.socket.recv(GREETING.size) == GREETING.pack(MAGIC, VERSION, True, RELIABLE.depth)
        self.socket.setblocking(False)  # both ends are this thread's

    def met(self, inlet: Inlet) -> None:
        self.hello = inlet.hello

    def deliver(self, _: Inlet, sequence: int, skipped: int, publish_ns: int, payload: bytes) -> None:
        self.taken.append((sequence, skipped, publish_ns, bytes(payload)))

    def tell_torn(self, _: Inlet) -> None:
        raise AssertionError("nothing shared here")

    def close(self) -> None:
        self.inlet.close()
        self.socket.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("f")


messages = st.lists(
    st.tuples(st.integers(0, 2**31), st.integers(-(2**62), 2**62), st.integers(0, 3000) | st.integers(60_000, 400_000)),
    max_size=6,
)


@settings(max_examples=60, deadline=None)
@given(messages=messages, cuts=st.lists(st.integers(1, 300_000), min_size=1, max_size=30))
def test_frames_cut_anywhere_come_whole_and_in_order(folder: Path, messages, cuts) -> None:
    wanted = [(i, skipped, stamp, bytes([i]) * size) for i, (skipped, stamp, size) in enumerate(messages, start=1)]
    data = HELLO_FRAME + b"".join(HEADER.pack(DATA, k, len(body), i, t) + body for i, k, t, body in wanted)
    listener = Listener(folder)
    try:
        at = turn = 0
        while at < len(data):
            end = min(len(data), at + cuts[turn % len(cuts)])
            turn += 1
            at += listener.socket.send(data[at:end])
            assert listener.inlet.read()
        assert listener.taken == wanted
        assert listener.hello == Hello("sender", "/x", BYTES, type_digest(BYTES), "00" * 8)
        listener.socket.close()
        assert not listener.inlet.read()
    finally:
        listener.close()


kinds = st.sampled_from([HELLO, DATA, HELLO + (1 << 40), DATA + (2 << 40), DATA - 1]) | st.integers(0, 2**64 - 1)
frames = st.builds(
    lambda kind, size, body: HEADER.pack(kind, 0, size, 1, 0) + body, kinds, st.integers(0, 60), st.binary(max_size=60)
)


@settings(max_examples=200, deadline=None)
@given(data=st.lists(frames | st.binary(max_size=200), max_size=5).map(b"".join))
def test_foreign_bytes_are_refused_in_words_or_wait_for_more(folder: Path, data: bytes) -> None:
    listener = Listener(folder)
    try:
        listener.socket.sendall(data)
        try:
            while listener.inlet.read() and len(data) > RECEIVE_BYTES:
                pass
        except FrameError as error:
            assert str(error)
        listener.socket.close()
        try:
            assert listener.inlet.read() in (True, False)
        except FrameError as error:
            assert str(error)
    finally:
        listener.close()


def test_frame_of_another_version_says_so(folder: Path) -> None:
    listener = Listener(folder)
    other = int.from_bytes(MAGIC + bytes([VERSION + 1, 2, 0, 0]), "little")
    try:
        listener.socket.sendall(HEADER.pack(other, 0, 0, 1, 0))
        with pytest.raises(FrameError, match=f"not a frame of version {VERSION} .*version {VERSION + 1}"):
            listener.inlet.read()
    finally:
        listener.close()


NO_TEXT = json.dumps({"node": 1, "topic": 2, "type_name": 3, "digest": 4, "publisher": 5}).encode()


@pytest.mark.parametrize("body", [b"", b"[]", b"{}", b"\xff", NO_TEXT])
def test_greeting_that_cannot_be_read(body: bytes) -> None:
    with pytest.raises(FrameError, match="greeting"):
        Hello.unpack(body)


def test_stranger_at_a_publishers_socket_is_refused_and_others_are_served(bus: Bus, caplog) -> None:
    out, reader = bus.publisher(), bus.reader()
    wait_for(lambda: out.subscriber_count == 1)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stranger:
        stranger.settimeout(30)
        stranger.connect(str(out._path))
        stranger.send(b"GET / HTTP/1.1\r\n\r\n")
        assert stranger.recv(100) == b""  # hung up
    assert "refused a reader of another bus version (expected 2, it sent b'GET '" in caplog.text
    out.send(numbered(1))
    wait_for(lambda: reader.numbers() == [1])


def test_payload_in_parts_and_of_any_buffer_is_one_message(bus: Bus) -> None:
    out, reader = bus.publisher(), bus.reader()
    wait_for(lambda: out.subscriber_count == 1)
    for size in (1000, LARGE):
        want = numbered(3, size)
        words = np.frombuffer(want, np.int64)
        for payload in (want, bytearray(want), memoryview(words), [want[:7], memoryview(want)[7:]], [want]):
            out.send(payload)
            assert wait_for(reader.poll).pop().payload == want


def test_buffer_is_refilled_only_when_nobody_holds_it() -> None:
    pool = BufferPool()
    first, _ = pool.acquire(LARGE, most=2)
    first.holders.add("a")
    second, _ = pool.acquire(LARGE, most=2)
    second.holders.add("b")
    assert first is not second
    assert pool.acquire(LARGE, most=2) == (None, [])
    first.holders.clear()
    assert pool.acquire(LARGE, most=2) == (first, [])
    pool.close()


def test_larger_message_takes_a_new_buffer_and_tells_of_the_old() -> None:
    pool = BufferPool(most_bytes=10_000_000)
    small, _ = pool.acquire(LARGE, most=3)
    large, retired = pool.acquire(5_000_000, most=3)
    assert retired == [small] and pool.buffers == [large]
    large.holders.add("a")
    assert pool.acquire(5_000_000, most=3) == (None, [])  # over the limit of all together
    pool.close()


def test_mapping_is_read_only_and_checks_the_size() -> None:
    buffer = SharedBuffer(1, LARGE)
    with buffer.begin(LARGE) as target:
        target[:] = numbered(5, LARGE)
    buffer.finish(5)
    mapping = SharedMapping(os.dup(buffer.fd))
    assert mapping.sequence == 5
    assert mapping.view(LARGE) == numbered(5, LARGE)
    assert mapping.view(LARGE).readonly
    assert mapping.fits(buffer.capacity) and not mapping.fits(buffer.capacity + 1)
    body = np.frombuffer(mapping.view(LARGE), np.uint8, offset=4)
    assert body.ctypes.data % 64 == 0  # arrays of a CDR message start aligned
    with pytest.raises(OSError):  # sealed: a reader cannot take the memory away under the publisher
        os.truncate(buffer.fd, 10)
    with pytest.raises(OSError):
        import mmap

        mmap.mmap(buffer.fd, 4096, mmap.MAP_SHARED, mmap.PROT_WRITE)
    buffer.close()
    assert mapping.view(LARGE) == numbered(5, LARGE)  # the reader's share stays


def test_larger_and_larger_messages_reach_the_reader(bus: Bus) -> None:
    out, reader = bus.publisher(qos=SENSOR), bus.reader(qos=SENSOR)
    wait_for(lambda: out.subscriber_count == 1)
    for i, size in enumerate((70_000, 200_000, 3_000_000, 100_000, 6_000_000), start=1):
        out.send(numbered(i, size))
        message = wait_for(reader.poll).pop()
        assert struct.unpack_from("<q", message.payload)[0] == i and whole(message) and len(message.payload) == size
        del message  # gives the buffer back
    assert len(out._pool.buffers) == 1
    assert len(next(iter(reader.raw._inlets.values()))[1]._mappings) == 1  # it let go of what was retired


def test_descriptor_waits_with_its_frame_until_the_socket_has_room(bus: Bus) -> None:
    """The socket is full just when a buffer goes out for the first time."""
    out, reader = bus.publisher(), bus.reader()
    wait_for(lambda: out.subscriber_count == 1)
    (peer,) = out._readers.values()
    sent = 0
    with reader.transport._read_lock:
        while peer.prompt:  # until a small message no longer goes out whole
            sent += 1
            out.send(numbered(sent, 5000))
        with out._lock:
            peer.flush()
            assert peer._part is not None
            peer._part = None  # as if the last byte that fits had been this one
            sent -= 1
            out._sequence -= 1
            peer._queue.clear()
        out.send(numbered(sent + 1, LARGE))
        assert peer._part_fd is not None
    wait_for(lambda: reader.poll() and number(reader.received[-1]) == sent + 1)
    assert whole(reader.received[-1])
