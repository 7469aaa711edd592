"""Shared memory for large messages: buffers without a name, owned by one publisher, lent to its readers.

A buffer is a ``memfd``: its file descriptor goes to a reader over the topic's socket, so there is nothing in the file
system to be left behind, to be swept, or to be out of reach in another mount namespace, and the kernel takes the
memory back with the last process that has it. A buffer is written again only after every reader that it was sent to
has said that it is done with it, or is gone: a reader's view cannot change under it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import struct
from collections.abc import Hashable

_SEQUENCE = struct.Struct("<Q")
_PAYLOAD_AT = 60  # CDR's body starts 4 bytes later, so its arrays are aligned to 64
_STEP = 1 << 16
_F_SEAL_FUTURE_WRITE = 0x10  # not in Python's fcntl: mappings made from now on are read-only


class SharedBuffer:
    """Memory of one message, on the publisher's side.

    Args:
        number: how readers call it; unique within a publisher.
        size: bytes of the largest message that must fit.

    Raises:
        OSError: the machine has not that much memory to give.
    """

    def __init__(self, number: int, size: int) -> None:
        self.number = number
        length = -(-(size * 9 // 8 + _PAYLOAD_AT) // _STEP) * _STEP  # a little more: compressed pictures vary
        self.capacity = length - _PAYLOAD_AT
        self.holders: set[Hashable] = set()
        self.fd = os.memfd_create("instant_ic", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            # Pages are reserved now: a machine without memory says so here, not with SIGBUS in the midst of a copy.
            os.posix_fallocate(self.fd, 0, length)
            self._map = mmap.mmap(self.fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE)
            seals = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW
            fcntl.fcntl(self.fd, fcntl.F_ADD_SEALS, seals)
            try:
                fcntl.fcntl(self.fd, fcntl.F_ADD_SEALS, _F_SEAL_FUTURE_WRITE)
            except OSError as error:
                if error.errno != errno.EINVAL:  # a kernel before 5.1 does not know it
                    raise
        except BaseException:
            os.close(self.fd)
            raise

    def begin(self, size: int) -> memoryview:
        """Where the next message of ``size`` bytes is written; what was there is no longer valid."""
        _SEQUENCE.pack_into(self._map, 0, 0)
        return memoryview(self._map)[_PAYLOAD_AT : _PAYLOAD_AT + size]

    def finish(self, sequence: int) -> None:
        """The message is whole."""
        _SEQUENCE.pack_into(self._map, 0, sequence)

    def view(self, size: int) -> memoryview:
        """The message in the buffer, read-only."""
        return memoryview(self._map)[_PAYLOAD_AT : _PAYLOAD_AT + size].toreadonly()

    def close(self) -> None:
        """Gives the publisher's share back; readers keep theirs."""
        os.close(self.fd)
        with contextlib.suppress(BufferError):  # a view of it is still on its way out; the memory goes with it
            self._map.close()


class BufferPool:
    """Buffers of one publisher; the one that was used last is used first, while the CPU still has it in its cache.

    Args:
        most_bytes: limit of all buffers together.
    """

    def __init__(self, most_bytes: int = 512 << 20) -> None:
        self.buffers: list[SharedBuffer] = []
        self._most_bytes = most_bytes
        self._next = 0

    def acquire(self, size: int, most: int) -> tuple[SharedBuffer | None, list[SharedBuffer]]:
        """A free buffer for ``size`` bytes, and buffers given up for it.

        Args:
            size: bytes of the message.
            most: how many buffers there may be.

        Returns:
            The buffer, None when all are in use, and the closed ones, of which readers must be told.

        Raises:
            OSError: the machine has no memory for one more.
        """
        for index, buffer in enumerate(self.buffers):
            if not buffer.holders and buffer.capacity >= size:
                if index:
                    self.buffers.insert(0, self.buffers.pop(index))
                return buffer, []
        free = [buffer for buffer in self.buffers if not buffer.holders]
        for buffer in free:  # too small for what is sent now
            self.buffers.remove(buffer)
            buffer.close()
        if len(self.buffers) >= most or sum(b.capacity for b in self.buffers) + size > self._most_bytes:
            return None, free
        self._next += 1
        buffer = SharedBuffer(self._next, size)
        self.buffers.insert(0, buffer)
        return buffer, free

    def close(self) -> None:
        """Gives all memory back; readers keep what they hold."""
        for buffer in self.buffers:
            buffer.close()
        self.buffers.clear()


class SharedMapping:
    """A publisher's buffer on a reader's side, read-only.

    Args:
        fd: as it came over the socket; closed here.

    Raises:
        OSError: it cannot be mapped.
    """

    def __init__(self, fd: int) -> None:
        try:
            self.length = os.fstat(fd).st_size
            self.map = mmap.mmap(fd, self.length, mmap.MAP_SHARED | mmap.MAP_POPULATE, mmap.PROT_READ)
        finally:
            os.close(fd)

    def fits(self, size: int) -> bool:
        """Whether a message of ``size`` bytes can be in it."""
        return _PAYLOAD_AT + size <= self.length

    @property
    def sequence(self) -> int:
        """Which message is in it; 0 while one is being written."""
        return int(_SEQUENCE.unpack_from(self.map, 0)[0])

    def view(self, size: int) -> memoryview:
        """The message, read-only."""
        return memoryview(self.map)[_PAYLOAD_AT : _PAYLOAD_AT + size]
