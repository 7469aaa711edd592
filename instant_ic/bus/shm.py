"""Shared memory for large messages (docs/wire.md): slots of a publisher, leased by readers with a file lock.

A slot is a ``memfd``, opened by readers under ``/proc/PID/fd/FD``: nothing is left behind by a killed process, and its
size is sealed, so no access raises SIGBUS. While a reader uses a message it holds a shared ``flock`` on the slot. The
publisher writes a slot only under the exclusive lock, which it gets when no reader uses it; the kernel releases the
locks of dead processes.

A lock says nothing about a message that a reader has not looked at yet. For that, each subscription announces a page
of memory in which it stores how far it has read (its progress).
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import re
import struct
from pathlib import Path

NAME = "instant_ic"
_SLOT = struct.Struct("<Q8s")  # sequence, publisher
_PAYLOAD_AT = 60  # CDR's body starts 4 bytes later, so its arrays are aligned to 64
_STEP = 1 << 16
_F_SEAL_FUTURE_WRITE = 0x10  # not in Python's fcntl; later mappings are read-only
_ENTRY = struct.Struct("<8sQ")  # publisher, sequence of the newest message looked at
_PAGE = mmap.PAGESIZE
_ENTRIES = _PAGE // _ENTRY.size
_ANNOUNCEMENT = re.compile(rb"!(\d{1,10})/(\d{1,10})/([01])\Z")

LEAST_SLOTS = 4
"""Slots that a publisher makes before it overwrites a message that only newest-only readers still have to look at."""


def _sealed(size: int) -> int:
    """A ``memfd`` of a fixed size.

    Raises:
        OSError: the machine does not have that much free memory.
    """
    fd = os.memfd_create(NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        # Reserve the pages now: without free memory this raises here, instead of SIGBUS in the middle of a copy.
        os.posix_fallocate(fd, 0, size)
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
    except BaseException:
        os.close(fd)
        raise
    return fd


def _open_sealed(pid: int, fd: int, least: int) -> int:
    """Open another process's ``memfd`` for reading.

    Raises:
        FileNotFoundError: there is none of that number, or it is something else.
        OSError: it cannot be opened.
    """
    path = f"/proc/{pid}/fd/{fd}"
    # The number may belong to another file by now, even to a device: look before opening.
    if not str(Path(path).readlink()).startswith(f"/memfd:{NAME}"):
        raise FileNotFoundError(errno.ENOENT, "no shared memory of the bus", path)
    found = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    if fcntl.fcntl(found, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK and os.fstat(found).st_size >= least:
        return found
    os.close(found)
    raise FileNotFoundError(errno.ENOENT, "shared memory of the bus without seal, or too small", path)


class Slot:
    """Memory of one message, on either side; made by :meth:`create` or :meth:`open`, closed when nothing refers to it.

    Args:
        fd: its ``memfd``, which the slot then owns.
        access: ``mmap.PROT_READ``, for the publisher with ``mmap.PROT_WRITE``.

    Attributes:
        number: unique within a publisher.
        capacity: bytes of the largest message.
        held: the message is leased.

    Raises:
        OSError: it cannot be mapped.
    """

    def __init__(self, fd: int, access: int, number: int = 0) -> None:
        try:
            self._map = mmap.mmap(fd, os.fstat(fd).st_size, mmap.MAP_SHARED | mmap.MAP_POPULATE, access)
        except BaseException:
            os.close(fd)
            raise
        self.fd = fd
        self.number = number
        self.capacity = len(self._map) - _PAYLOAD_AT
        self.held = False

    @classmethod
    def create(cls, number: int, size: int, publisher: bytes) -> Slot:
        """A publisher's slot for messages of ``size`` bytes and a little more: compressed images vary in size.

        Raises:
            OSError: the machine does not have that much free memory.
        """
        length = -(-(size * 9 // 8 + _PAYLOAD_AT) // _STEP) * _STEP
        slot = cls(_sealed(length), mmap.PROT_READ | mmap.PROT_WRITE, number)
        try:
            fcntl.fcntl(slot.fd, fcntl.F_ADD_SEALS, _F_SEAL_FUTURE_WRITE)
        except OSError as error:
            if error.errno != errno.EINVAL:  # kernels before 5.1 do not support this seal
                raise
        _SLOT.pack_into(slot._map, 0, 0, publisher)
        return slot

    @classmethod
    def open(cls, pid: int, fd: int, publisher: bytes) -> Slot:
        """Another process's slot, read-only.

        Raises:
            FileNotFoundError: the slot is gone.
            OSError: it cannot be opened or mapped.
        """
        slot = cls(_open_sealed(pid, fd, _PAYLOAD_AT), mmap.PROT_READ)
        if _SLOT.unpack_from(slot._map)[1] != publisher:
            raise FileNotFoundError(errno.ENOENT, "a slot of another publisher")
        return slot

    @property
    def sequence(self) -> int:
        """Sequence of the message in the slot; 0 while one is being written."""
        return int(_SLOT.unpack_from(self._map)[0])

    def lock(self, kind: int = fcntl.LOCK_EX) -> bool:
        """Take the lock; False while another process holds it."""
        try:
            fcntl.flock(self.fd, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def unlock(self) -> None:
        fcntl.flock(self.fd, fcntl.LOCK_UN)

    def begin(self, size: int) -> memoryview:
        """Memory for the next message of ``size`` bytes, under the lock; the previous message becomes invalid."""
        self.finish(0)
        return memoryview(self._map)[_PAYLOAD_AT : _PAYLOAD_AT + size]

    def finish(self, sequence: int) -> None:
        """Mark the message as complete."""
        struct.pack_into("<Q", self._map, 0, sequence)

    def lease(self, sequence: int, size: int) -> bool:
        """Lock the slot for reading; False, and not locked, when it does not hold this message any more."""
        if self.held or size > self.capacity or not self.lock(fcntl.LOCK_SH):
            return False
        self.held = self.sequence == sequence
        if not self.held:
            self.unlock()
        return self.held

    def release(self) -> None:
        """End the lease."""
        self.unlock()
        self.held = False

    def view(self, size: int) -> memoryview:
        """Read-only view of the message."""
        return memoryview(self._map)[_PAYLOAD_AT : _PAYLOAD_AT + size].toreadonly()

    def close(self) -> None:
        """Close the descriptor, and with it the lock; views keep the memory, and other processes their share."""
        fd, self.fd = getattr(self, "fd", -1), -1
        if fd >= 0:
            os.close(fd)

    __del__ = close


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
        """A locked slot for ``size`` bytes; None when all are in use.

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
            if slot is keep or slot.sequence > must or not slot.lock():
                continue
            if slot.capacity < size:  # too small for the present messages
                self.slots.remove(slot)
                slot.close()
            elif slot.sequence <= should or len(self.slots) >= LEAST_SLOTS:
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


class ProgressPage:
    """How far one subscription has read from each publisher.

    Args:
        newest_only: the publisher may overwrite a message before this subscription has looked at it.

    Attributes:
        announcement: the ZeroMQ subscription that announces the page to publishers.

    Raises:
        OSError: there is no memory.
    """

    def __init__(self, newest_only: bool) -> None:
        self._fd = os.memfd_create(f"{NAME}_progress", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.write(self._fd, bytes(_PAGE))
        fcntl.fcntl(self._fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
        self._memory = mmap.mmap(self._fd, _PAGE)
        self._places: dict[bytes, int] = {}
        self.announcement = b"!%d/%d/%d" % (os.getpid(), self._fd, newest_only)

    def close(self) -> None:
        """Release the memory; publishers keep what they have mapped."""
        os.close(self._fd)
        self._memory.close()

    def store(self, publisher: bytes, sequence: int) -> None:
        """Note that the message of this sequence, and all before it, have been looked at."""
        place = self._places.get(publisher)
        if place is None:
            free = set(range(_ENTRIES)) - set(self._places.values())
            if not free:
                return
            place = self._places[publisher] = min(free)
        _ENTRY.pack_into(self._memory, place * _ENTRY.size, publisher, sequence)

    def forget(self, publisher: bytes) -> None:
        """Free the entry of a publisher that is gone."""
        place = self._places.pop(publisher, None)
        if place is not None:
            _ENTRY.pack_into(self._memory, place * _ENTRY.size, bytes(8), 0)


class PeerProgress:
    """A subscription's page, on the side of one publisher.

    Args:
        announcement: what the subscription announced.
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
        self._place = 0
        opened = _open_sealed(pid, fd, _PAGE)
        try:
            self._memory = mmap.mmap(opened, _PAGE, mmap.MAP_SHARED, mmap.PROT_READ)
        finally:
            os.close(opened)

    def sequence(self) -> int:
        """The subscription has looked at all messages up to this one."""
        found, sequence = _ENTRY.unpack_from(self._memory, self._place * _ENTRY.size)
        if found != self._publisher:
            for place, (other, value) in enumerate(_ENTRY.iter_unpack(self._memory)):
                if other == self._publisher:
                    self._place, sequence = place, value
                    break
            else:
                return self._joined
        return max(self._joined, int(sequence))
