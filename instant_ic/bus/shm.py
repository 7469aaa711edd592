"""Shared memory for large messages: unnamed buffers, owned by one publisher and lent to its readers.

A buffer is a ``memfd`` whose file descriptor goes to a reader over the topic's socket. So no file can be left behind
or be out of reach in another mount namespace, and the kernel frees the memory with the last process that holds it.
The publisher writes a buffer again only after every reader that got it has returned it or is gone: a reader's view
never changes.
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
_F_SEAL_FUTURE_WRITE = 0x10  # not in Python's fcntl; later mappings are read-only


class SharedBuffer:
    """Memory of one message, on the publisher's side.

    Args:
        number: identifies the buffer to readers; unique within a publisher.
        size: bytes of the largest message that must fit.

    Raises:
        OSError: the machine does not have that much free memory.
    """

    def __init__(self, number: int, size: int) -> None:
        self.number = number
        length = -(-(size * 9 // 8 + _PAYLOAD_AT) // _STEP) * _STEP  # some spare space: compressed images vary in size
        self.capacity = length - _PAYLOAD_AT
        self.holders: set[Hashable] = set()
        self.fd = os.memfd_create("instant_ic", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            # Reserve the pages now: without free memory this raises here, instead of SIGBUS in the middle of a copy.
            os.posix_fallocate(self.fd, 0, length)
            self._map = mmap.mmap(self.fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE)
            seals = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW
            fcntl.fcntl(self.fd, fcntl.F_ADD_SEALS, seals)
            try:
                fcntl.fcntl(self.fd, fcntl.F_ADD_SEALS, _F_SEAL_FUTURE_WRITE)
            except OSError as error:
                if error.errno != errno.EINVAL:  # kernels before 5.1 do not support this seal
                    raise
        except BaseException:
            os.close(self.fd)
            raise

    def begin(self, size: int) -> memoryview:
        """Memory for the next message of ``size`` bytes; the previous message becomes invalid."""
        _SEQUENCE.pack_into(self._map, 0, 0)
        return memoryview(self._map)[_PAYLOAD_AT : _PAYLOAD_AT + size]

    def finish(self, sequence: int) -> None:
        """Mark the message as complete."""
        _SEQUENCE.pack_into(self._map, 0, sequence)

    def view(self, size: int) -> memoryview:
        """Read-only view of the message."""
        return memoryview(self._map)[_PAYLOAD_AT : _PAYLOAD_AT + size].toreadonly()

    def close(self) -> None:
        """Release the publisher's share; readers keep theirs."""
        os.close(self.fd)
        with contextlib.suppress(BufferError):  # a view is still being sent; the memory is freed with it
            self._map.close()


class BufferPool:
    """Buffers of one publisher. The most recently used one is reused first, while it is still in the CPU cache.

    Args:
        most_bytes: limit for all buffers together.
    """

    def __init__(self, most_bytes: int = 512 << 20) -> None:
        self.buffers: list[SharedBuffer] = []
        self._most_bytes = most_bytes
        self._next = 0

    def acquire(self, size: int, most: int) -> tuple[SharedBuffer | None, list[SharedBuffer]]:
        """A free buffer for ``size`` bytes, and the buffers that were closed to make room.

        Args:
            size: bytes of the message.
            most: largest number of buffers.

        Returns:
            The buffer, or None when all are in use; and the closed buffers, which must be announced to the readers.

        Raises:
            OSError: there is no memory for another buffer.
        """
        for index, buffer in enumerate(self.buffers):
            if not buffer.holders and buffer.capacity >= size:
                if index:
                    self.buffers.insert(0, self.buffers.pop(index))
                return buffer, []
        free = [buffer for buffer in self.buffers if not buffer.holders]
        for buffer in free:  # too small for the present messages
            self.buffers.remove(buffer)
            buffer.close()
        if len(self.buffers) >= most or sum(b.capacity for b in self.buffers) + size > self._most_bytes:
            return None, free
        self._next += 1
        buffer = SharedBuffer(self._next, size)
        self.buffers.insert(0, buffer)
        return buffer, free

    def close(self) -> None:
        """Release all memory; readers keep what they hold."""
        for buffer in self.buffers:
            buffer.close()
        self.buffers.clear()


class SharedMapping:
    """A publisher's buffer on the reader's side, read-only.

    Args:
        fd: file descriptor received over the socket; closed here.

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
        """Whether the buffer can hold a message of ``size`` bytes."""
        return _PAYLOAD_AT + size <= self.length

    @property
    def sequence(self) -> int:
        """Sequence of the message in the buffer; 0 while one is being written."""
        return int(_SEQUENCE.unpack_from(self.map, 0)[0])

    def view(self, size: int) -> memoryview:
        """Read-only view of the message."""
        return memoryview(self.map)[_PAYLOAD_AT : _PAYLOAD_AT + size]
