"""Shared memory for large messages (docs/wire.md): slots of a publisher, leased by readers with a file lock.

A slot is a ``memfd``, opened by readers under ``/proc/PID/fd/FD``: nothing is left behind by a killed process, and its
size is sealed, so no access raises SIGBUS. While a reader uses a message it holds a shared ``flock`` on the slot. The
publisher writes a slot only under the exclusive lock, which it gets when no reader uses it; the kernel releases the
locks of dead processes.

A lock says nothing about a message that a reader has not looked at yet. For that, each subscription announces a page
of memory in which it stores how far it has read (its progress).
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import re
import struct
from pathlib import Path
from typing import Self

NAME = "instant_ic"
_SLOT = struct.Struct("<Q8s")  # sequence, publisher
_SEQUENCE = struct.Struct("<Q")
_PAYLOAD_AT = 60  # CDR's body starts 4 bytes later, so its arrays are aligned to 64
_STEP = 1 << 16
_F_SEAL_FUTURE_WRITE = 0x10  # not in Python's fcntl; later mappings are read-only
_ENTRY = struct.Struct("<8sQ")  # publisher, sequence of the newest message looked at
_PAGE = mmap.PAGESIZE
_ANNOUNCEMENT = re.compile(rb"!(\d{1,10})/(\d{1,10})/([01])\Z")

LEAST_SLOTS = 4
"""Slots that a publisher makes before it overwrites a message that only newest-only readers still have to look at."""


class Memory:
    """A sealed ``memfd`` and its mapping, on either side; closed when nothing refers to it.

    Args:
        fd: its descriptor, which this object then owns.
        access: ``mmap.PROT_READ``, for its owner with ``mmap.PROT_WRITE``.

    Raises:
        OSError: it cannot be mapped.
    """

    def __init__(self, fd: int, access: int = mmap.PROT_READ) -> None:
        self.fd = fd  # closed with this object, also if the next line fails
        self.map = mmap.mmap(fd, os.fstat(fd).st_size, mmap.MAP_SHARED | mmap.MAP_POPULATE, access)

    @classmethod
    def make(cls, size: int) -> Self:
        """Create memory.

        Raises:
            OSError: the machine does not have that much free memory.
        """
        memory = cls.__new__(cls)
        memory.fd = os.memfd_create(NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        # Reserve the pages now: without free memory this raises here, instead of SIGBUS in the middle of a copy.
        os.posix_fallocate(memory.fd, 0, size)
        fcntl.fcntl(memory.fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
        memory.__init__(memory.fd, mmap.PROT_READ | mmap.PROT_WRITE)  # type: ignore[misc]
        return memory

    @classmethod
    def open(cls, pid: int, fd: int, publisher: bytes | None = None) -> Self:
        """Map another process's memory for reading; ``publisher`` is whose slot it must be.

        Raises:
            FileNotFoundError: there is none of that number, or it is something else.
            OSError: it cannot be opened or mapped.
        """
        path = f"/proc/{pid}/fd/{fd}"
        # The number may belong to another file by now, even to a device: look before opening.
        if not str(Path(path).readlink()).startswith(f"/memfd:{NAME}"):
            raise FileNotFoundError(errno.ENOENT, "no shared memory of the bus", path)
        found = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        sealed = fcntl.fcntl(found, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK
        if not sealed or os.fstat(found).st_size < _PAGE:
            os.close(found)
            raise FileNotFoundError(errno.ENOENT, "shared memory of the bus without seal, or too small", path)
        memory = cls(found)
        if publisher is not None and _SLOT.unpack_from(memory.map)[1] != publisher:
            raise FileNotFoundError(errno.ENOENT, "a slot of another publisher", path)
        return memory

    def close(self) -> None:
        """Close the descriptor, and with it the lock; views keep the memory, and other processes their share."""
        fd, self.fd = getattr(self, "fd", -1), -1
        if fd >= 0:
            os.close(fd)

    __del__ = close


class Slot(Memory):
    """Memory of one message; made by :meth:`create` or :meth:`open`.

    Attributes:
        number: unique within a publisher.
        held: the message is leased.
        written: sequence of the message that its publisher has written last; 0 while it writes one.
    """

    number = 0
    held = False
    written = 0

    def __init__(self, fd: int, access: int = mmap.PROT_READ) -> None:
        super().__init__(fd, access)
        self.capacity = len(self.map) - _PAYLOAD_AT  # bytes of the largest message

    @classmethod
    def create(cls, number: int, size: int, publisher: bytes) -> Slot:
        """Create a slot for messages of ``size`` bytes and a little more: compressed images vary in size.

        Raises:
            OSError: the machine does not have that much free memory.
        """
        slot = cls.make(-(-(size * 9 // 8 + _PAYLOAD_AT) // _STEP) * _STEP)
        slot.number = number
        with contextlib.suppress(OSError):  # kernels before 5.1 do not support this seal
            fcntl.fcntl(slot.fd, fcntl.F_ADD_SEALS, _F_SEAL_FUTURE_WRITE)
        _SLOT.pack_into(slot.map, 0, 0, publisher)
        return slot

    @property
    def sequence(self) -> int:
        """Sequence of the message in the slot; 0 while one is being written."""
        return int(_SEQUENCE.unpack_from(self.map)[0])

    def lock(self, kind: int = fcntl.LOCK_EX) -> bool:
        """Take the lock; False while another process holds it."""
        try:
            fcntl.flock(self.fd, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def unlock(self) -> None:
        self.held = False  # first: as soon as it is unlocked, the publisher may fill it and another thread lease it
        fcntl.flock(self.fd, fcntl.LOCK_UN)

    def begin(self, size: int) -> memoryview:
        """Return memory for the next message of ``size`` bytes, under the lock; the previous one becomes invalid."""
        self.finish(0)
        return memoryview(self.map)[_PAYLOAD_AT : _PAYLOAD_AT + size]

    def finish(self, sequence: int) -> None:
        """Mark the message as complete."""
        _SEQUENCE.pack_into(self.map, 0, sequence)
        self.written = sequence

    def lease(self, sequence: int, size: int) -> bool:
        """Lock the slot for reading until :meth:`unlock`; False when it does not hold this message any more."""
        if self.held or size > self.capacity or not self.lock(fcntl.LOCK_SH):
            return False
        self.held = self.sequence == sequence
        if not self.held:
            self.unlock()
        return self.held

    def view(self, size: int) -> memoryview:
        """Return a read-only view of the message."""
        return memoryview(self.map)[_PAYLOAD_AT : _PAYLOAD_AT + size].toreadonly()


class SlotPool:
    """Slots of one publisher; the oldest is written first.

    Args:
        publisher: 8 bytes that identify the publisher.
        most_bytes: limit for all slots together.
    """

    def __init__(self, publisher: bytes, most_bytes: int = 512 << 20) -> None:
        self.slots: list[Slot] = []  # the oldest message first
        self._publisher = publisher
        self._most_bytes = most_bytes
        self._next = 0

    @property
    def oldest(self) -> int:
        """Smallest number of a slot; readers forget smaller ones."""
        return min((slot.number for slot in self.slots), default=0)

    def acquire(self, size: int, most: int, must: int, should: int, keep: Slot | None = None) -> Slot | None:
        """Return a locked slot for ``size`` bytes; None when all are in use.

        Args:
            size: bytes of the message.
            most: largest number of slots.
            must: every reader that wants all messages has looked at those up to this sequence.
            should: every reader has looked at those up to this sequence.
            keep: a slot whose message is still needed here.

        Raises:
            OSError: there is no memory for another slot.
        """
        for slot in list(self.slots):
            if slot is keep or slot.written > must or not slot.lock():
                continue
            if slot.capacity < size:  # too small for the present messages
                self.slots.remove(slot)
                slot.close()
            elif slot.written <= should or len(self.slots) >= LEAST_SLOTS:
                self.slots.remove(slot)
                self.slots.append(slot)
                return slot
            else:
                slot.unlock()
        if len(self.slots) >= most or sum(slot.capacity for slot in self.slots) + size > self._most_bytes:
            return None
        self._next += 1
        slot = Slot.create(self._next, size, self._publisher)
        slot.lock()
        self.slots.append(slot)
        return slot

    def close(self) -> None:
        """Release all memory; readers keep what they have mapped."""
        for slot in self.slots:
            slot.close()
        self.slots.clear()


def progress_page(newest_only: bool) -> tuple[Memory, bytes]:
    """Return a subscription's progress page, and the ZeroMQ subscription that announces it.

    Args:
        newest_only: a publisher may overwrite a message before this subscription has looked at it.

    Raises:
        OSError: there is no memory.
    """
    page = Memory.make(_PAGE)
    return page, b"!%d/%d/%d" % (os.getpid(), page.fd, newest_only)


def store_progress(page: Memory, place: int, publisher: bytes, sequence: int) -> None:
    """Note that a publisher's messages up to this one have been looked at; ``place`` is the publisher's on the page."""
    if place * _ENTRY.size < _PAGE:  # further publishers wait for messages that nobody has looked at
        _ENTRY.pack_into(page.map, place * _ENTRY.size, publisher, sequence)


class PeerProgress:
    """A subscription's page, on the side of one publisher.

    Args:
        announcement: ZeroMQ subscription that announces the page.
        publisher: 8 bytes that identify this publisher.
        joined: sequence of the newest message that was sent before it subscribed.

    Raises:
        ValueError: the announcement is not one.
        OSError: the page cannot be mapped.
    """

    def __init__(self, announcement: bytes, publisher: bytes, joined: int) -> None:
        match = _ANNOUNCEMENT.match(announcement)
        if match is None:
            raise ValueError(f"{announcement[:40]!r} announces no page")
        pid, fd, newest_only = map(int, match.groups())
        self.newest_only = bool(newest_only)
        self._publisher = publisher
        self._joined = joined
        page = Memory.open(pid, fd)
        page.close()  # the mapping stays
        self._map = page.map

    def sequence(self) -> int:
        """Return the number of the last message that the subscription has looked at."""
        at = self._map.find(self._publisher)
        if at < 0 or at % _ENTRY.size:
            return self._joined
        return max(self._joined, int(_ENTRY.unpack_from(self._map, at)[1]))
