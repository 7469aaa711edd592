"""Shared memory for large messages (docs/wire.md): slots of a publisher, leased by readers with a file lock.

A slot is a ``memfd``, which readers open as ``/proc/PID/fd/FD``. A killed process therefore leaves nothing behind. The
slot's size is sealed, so that no access raises SIGBUS. A reader holds a shared ``flock`` on the slot while it uses the
message. The publisher writes a slot only under the exclusive lock, which it gets when no reader uses the slot. The
kernel releases the locks of dead processes.

The lock does not protect a message that a reader has not looked at yet. Each subscription therefore announces a page
of memory in which it stores the newest sequence that it has looked at (its progress).
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
_PAYLOAD_AT = 60  # the CDR body starts 4 bytes later, so its arrays are aligned to 64
_STEP = 1 << 16
_F_SEAL_FUTURE_WRITE = 0x10  # makes later mappings read-only; missing in Python's fcntl
_ENTRY = struct.Struct("<8sQ")  # publisher, and sequence of its newest message looked at
_PAGE = mmap.PAGESIZE
_ANNOUNCEMENT = re.compile(rb"!(\d{1,10})/(\d{1,10})/([01])\Z")

LEAST_SLOTS = 4
"""Number of slots from which a publisher overwrites messages that only newest-only readers have not looked at yet."""


class Memory:
    """A sealed ``memfd`` and its mapping, of a publisher or a reader. It closes when nothing refers to it any more.

    Args:
        fd: file descriptor, owned by this object from now on.
        access: ``mmap.PROT_READ``; the creator adds ``mmap.PROT_WRITE``.

    Raises:
        OSError: the memory cannot be mapped.
    """

    def __init__(self, fd: int, access: int = mmap.PROT_READ) -> None:
        self.fd = fd  # set first, so that it is closed even if the next line fails
        self.map = mmap.mmap(fd, os.fstat(fd).st_size, mmap.MAP_SHARED | mmap.MAP_POPULATE, access)

    @classmethod
    def make(cls, size: int) -> Self:
        """Create memory.

        Raises:
            OSError: the machine lacks the free memory.
        """
        memory = cls.__new__(cls)
        memory.fd = os.memfd_create(NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        # Reserve the pages now. Without free memory this call raises, instead of a SIGBUS in the middle of a copy.
        os.posix_fallocate(memory.fd, 0, size)
        fcntl.fcntl(memory.fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
        memory.__init__(memory.fd, mmap.PROT_READ | mmap.PROT_WRITE)  # type: ignore[misc]
        return memory

    @classmethod
    def open(cls, pid: int, fd: int, publisher: bytes | None = None) -> Self:
        """Map another process's memory for reading.

        Args:
            pid: id of the process.
            fd: descriptor of the memory in that process.
            publisher: owner that the slot must have; None if the memory is not a slot.

        Raises:
            FileNotFoundError: no memory has this number, or it is not the expected memory.
            OSError: the memory cannot be opened or mapped.
        """
        path = f"/proc/{pid}/fd/{fd}"
        # The number may already belong to another file, even to a device. Check it before opening.
        if not str(Path(path).readlink()).startswith(f"/memfd:{NAME}"):
            raise FileNotFoundError(errno.ENOENT, "not shared memory of the bus", path)
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
        """Close the descriptor and so release the lock. Views and other processes keep the memory."""
        fd, self.fd = getattr(self, "fd", -1), -1
        if fd >= 0:
            os.close(fd)

    __del__ = close


class Slot(Memory):
    """Memory of one message. :meth:`create` makes a slot, :meth:`open` maps one of another process.

    Attributes:
        number: number of the slot, unique within a publisher.
        held: true while the message is leased.
        written: sequence of the last message written by the publisher; 0 while it writes one.
    """

    number = 0
    held = False
    written = 0

    def __init__(self, fd: int, access: int = mmap.PROT_READ) -> None:
        super().__init__(fd, access)
        self.capacity = len(self.map) - _PAYLOAD_AT  # bytes of the largest message

    @classmethod
    def create(cls, number: int, size: int, publisher: bytes) -> Slot:
        """Create a slot for messages of a little more than ``size`` bytes, because compressed images vary in size.

        Raises:
            OSError: the machine lacks the free memory.
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
        """Take the lock. Return False if another process holds it."""
        try:
            fcntl.flock(self.fd, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def unlock(self) -> None:
        self.held = False  # first, because once unlocked, the publisher may fill it and another thread lease it
        fcntl.flock(self.fd, fcntl.LOCK_UN)

    def begin(self, size: int) -> memoryview:
        """Return memory for the next message of ``size`` bytes, under the lock. The previous one becomes invalid."""
        self.finish(0)
        return memoryview(self.map)[_PAYLOAD_AT : _PAYLOAD_AT + size]

    def finish(self, sequence: int) -> None:
        """Mark the message as complete."""
        _SEQUENCE.pack_into(self.map, 0, sequence)
        self.written = sequence

    def lease(self, sequence: int, size: int) -> bool:
        """Lock the slot for reading until :meth:`unlock`. Return False if it no longer holds this message."""
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
    """Slots of one publisher. The slot with the oldest message is written next.

    Args:
        publisher: 8 bytes that identify the publisher.
        most_bytes: limit for the sum of all slots.
    """

    def __init__(self, publisher: bytes, most_bytes: int = 512 << 20) -> None:
        self.slots: list[Slot] = []  # the oldest message first
        self._publisher = publisher
        self._most_bytes = most_bytes
        self._next = 0

    @property
    def oldest(self) -> int:
        """Smallest slot number in use. Readers drop smaller ones."""
        return min((slot.number for slot in self.slots), default=0)

    def acquire(self, size: int, most: int, must: int, should: int, keep: Slot | None = None) -> Slot | None:
        """Return a locked slot for ``size`` bytes, or None if all are in use.

        Args:
            size: size of the message in bytes.
            most: largest number of slots.
            must: newest sequence that every lossless reader has looked at; newer messages are never overwritten.
            should: newest sequence that every reader has looked at; newer messages are overwritten only if
                ``LEAST_SLOTS`` slots exist.
            keep: slot whose message the publisher itself still needs.

        Raises:
            OSError: there is no memory for another slot.
        """
        for slot in list(self.slots):
            if slot is keep or slot.written > must or not slot.lock():
                continue
            if slot.capacity < size:  # too small for today's messages
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
        """Release all memory. Readers keep what they have mapped."""
        for slot in self.slots:
            slot.close()
        self.slots.clear()


def progress_page(newest_only: bool) -> tuple[Memory, bytes]:
    """Return a subscription's progress page and the ZeroMQ subscription that announces it.

    Args:
        newest_only: allow a publisher to overwrite a message before this subscription has looked at it.

    Raises:
        OSError: there is no memory for the page.
    """
    page = Memory.make(_PAGE)
    return page, b"!%d/%d/%d" % (os.getpid(), page.fd, newest_only)


def store_progress(page: Memory, place: int, publisher: bytes, sequence: int) -> None:
    """Store the newest sequence looked at of a publisher, whose index on the page is ``place``."""
    if place * _ENTRY.size < _PAGE:  # a publisher beyond the page sees no progress, and so keeps its messages longer
        _ENTRY.pack_into(page.map, place * _ENTRY.size, publisher, sequence)


class PeerProgress:
    """Progress of one subscription, as a publisher reads it.

    Args:
        announcement: ZeroMQ subscription that announces the page.
        publisher: 8 bytes that identify this publisher.
        joined: sequence of the newest message that was sent before the subscription.

    Raises:
        ValueError: ``announcement`` does not announce a page.
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
        """Return the sequence of the newest message that the subscription has looked at."""
        at = self._map.find(self._publisher)
        if at < 0 or at % _ENTRY.size:
            return self._joined
        return max(self._joined, int(_ENTRY.unpack_from(self._map, at)[1]))
