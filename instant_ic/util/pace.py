"""Pace of a simulated stack's time relative to the machine's: slow motion on a machine that is too slow or busy.

All processes of a stack share one pace. The launcher writes it into a file of the run directory, which each process
maps. The nodes' stamps, timers and time-outs follow the pace, and so do the simulated devices. Heartbeats and the
shutdown of processes concern only the machine and do not.

The launcher may change the pace while the stack runs. It writes each change ``LEAD_S`` ahead, so that all processes
change at the same instant. The stack's time therefore does not jump and is the same in all processes.
"""

from __future__ import annotations

import math
import mmap
import os
import struct
import time
import zlib
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from pathlib import Path

from instant_ic.util.files import replacing

FILE = "pace"
SLOWEST, FASTEST = 0.02, 10.0
SLOWEST_CHOSEN = 0.1
"""Slowest pace that the launcher chooses by itself."""
LEAD_S = 0.2
"""Machine seconds from the writing of a change until it takes effect. Waits shorter than this are exact."""

# Fields of eight bytes: number of the record, whether the pace adapts, two stretches, and a CRC of these fields. The
# CRC reveals a record that is being written, in whatever order its fields arrive.
_RECORD = struct.Struct("=QQdqqqdqqqQ")


class PaceError(ValueError):
    """The pace is out of range, or the run directory's pace file cannot be read."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A stretch of the stack's time with a constant factor.

    Attributes:
        factor: seconds of the stack per second of the machine.
        monotonic_ns: start on the machine's steady clock, which all its processes share.
        epoch_ns: start in the stack's time, nanoseconds since the epoch.
        steady_ns: start on the stack's steady clock.
    """

    factor: float
    monotonic_ns: int
    epoch_ns: int
    steady_ns: int

    def since_begin_ns(self, monotonic_ns: int) -> int:
        """Return the stack's nanoseconds from the start to an instant of the machine's steady clock."""
        return round(self.factor * (monotonic_ns - self.monotonic_ns))

    def followed_by(self, factor: float, monotonic_ns: int) -> Stretch:
        """Return the stretch with another factor that continues this one from an instant."""
        ns = self.since_begin_ns(monotonic_ns)
        return Stretch(factor, monotonic_ns, self.epoch_ns + ns, self.steady_ns + ns)


class Pace:
    """The stack's time: the machine's own time, or that of the newest two stretches.

    Args:
        stretch: stretch of a pace that does not change; None for the machine's own time.

    Attributes:
        adapts: whether the launcher adapts the pace to the machine's speed.
    """

    def __init__(self, stretch: Stretch | None = None) -> None:
        self.adapts = False
        self._stretches = None if stretch is None else (stretch, stretch)  # before and after the newest change
        self._record: mmap.mmap | None = None
        self._words = memoryview(bytes(8)).cast("Q")
        self._number = 0  # number of the record in _stretches

    @classmethod
    def from_now(cls, factor: float) -> Pace:
        """Return a pace that starts now and does not change.

        Raises:
            PaceError: the factor is out of range.
        """
        return cls(Stretch(check_factor(factor), time.monotonic_ns(), time.time_ns(), 0))

    @property
    def real(self) -> bool:
        """True if this is the machine's own time, now and later."""
        return self._stretches is None

    @property
    def factor(self) -> float:
        """Present seconds of the stack per second of the machine."""
        return 1.0 if self._stretches is None else self._at(time.monotonic_ns()).factor

    @property
    def text(self) -> str:
        """Text about the pace for the operator; empty in real time."""
        return describe(self.factor, self.adapts)

    def now_ns(self) -> int:
        """Return nanoseconds since the epoch."""
        if self._stretches is None:
            return time.time_ns()
        now_ns = time.monotonic_ns()
        stretch = self._at(now_ns)
        return stretch.epoch_ns + stretch.since_begin_ns(now_ns)

    def steady_ns(self) -> int:
        """Return nanoseconds since an arbitrary origin; only differences are meaningful."""
        now_ns = time.monotonic_ns()
        if self._stretches is None:
            return now_ns
        stretch = self._at(now_ns)
        return stretch.steady_ns + stretch.since_begin_ns(now_ns)

    def steady_s(self) -> float:
        """Return seconds since an arbitrary origin; only differences are meaningful."""
        return self.steady_ns() * 1e-9

    def wait_s(self, seconds: float) -> float:
        """Convert seconds of the stack, from now on, to seconds of the machine.

        A result above ``LEAD_S`` may be wrong, because the pace can change meanwhile: wait, then convert the rest.
        """
        if self._stretches is None:
            return seconds
        now_ns = time.monotonic_ns()
        stretch, newest = self._at(now_ns), self._stretches[1]
        until_change_s = (newest.monotonic_ns - now_ns) * 1e-9
        if 0.0 < until_change_s < seconds / stretch.factor:
            return until_change_s + (seconds - until_change_s * stretch.factor) / newest.factor
        return seconds / stretch.factor

    def timeout_s(self, seconds: float) -> float:
        """Convert a time-out in seconds of the stack to machine seconds that suffice at any later pace."""
        return seconds / (SLOWEST_CHOSEN if self.adapts else self.factor)

    def sleep(self, seconds: float) -> None:
        """Sleep for a number of the stack's seconds."""
        if self._stretches is None:
            time.sleep(seconds)
            return
        until_ns = self.steady_ns() + round(seconds * 1e9)
        while (left_ns := until_ns - self.steady_ns()) > 0:
            time.sleep(min(self.wait_s(left_ns * 1e-9), LEAD_S))

    def stamp_ns(self, machine_ns: int) -> int:
        """Convert a recent stamp of the machine's clock to the stack's time."""
        if self._stretches is None:
            return machine_ns
        then_ns = time.monotonic_ns() - (time.time_ns() - machine_ns)
        stretch = self._at(then_ns)
        return stretch.epoch_ns + stretch.since_begin_ns(then_ns)

    def _at(self, monotonic_ns: int) -> Stretch:
        """Return the stretch at an instant. Read the clock before this call, so that no change can come in between."""
        if self._words[0] != self._number and self._record is not None:
            self._take(self._record[:])
        assert self._stretches is not None
        before, newest = self._stretches
        return newest if monotonic_ns >= newest.monotonic_ns else before

    def _take(self, record: bytes) -> bool:
        """Take over a record. Return False if it is being written."""
        number, adapts, *fields, crc = _RECORD.unpack(record)
        if crc != zlib.crc32(record[:-8]):
            return False
        self._stretches = (Stretch(*fields[:4]), Stretch(*fields[4:]))
        self.adapts, self._number = bool(adapts), number
        return True

    @classmethod
    def _of_record(cls, record: mmap.mmap) -> Pace:
        pace = cls()
        if not pace._take(record[:]):
            raise ValueError("its check sum is wrong")
        assert pace._stretches is not None
        for stretch in pace._stretches:
            check_factor(stretch.factor)
        pace._record, pace._words = record, memoryview(record).cast("Q")
        return pace


class PaceFiles:
    """The pace files in the run directories of a stack, one per group. Only the launcher writes them.

    Args:
        folders: run directories.
        factor: pace at the start.
        adapts: true if :meth:`change` may be called later.

    Raises:
        PaceError: the factor is out of range.
    """

    def __init__(self, folders: Iterable[Path], factor: float, adapts: bool = False) -> None:
        self._newest = Stretch(check_factor(factor), time.monotonic_ns(), time.time_ns(), 0)
        self._adapts = adapts
        self._number = 1
        self._records = [_create(folder / FILE, self._packed(self._newest)) for folder in folders]

    @property
    def factor(self) -> float:
        """The newest factor written."""
        return self._newest.factor

    def change(self, factor: float) -> None:
        """Change the pace in ``LEAD_S`` machine seconds. Do nothing while an earlier change is still ahead.

        Raises:
            PaceError: the factor is out of range.
        """
        before, now_ns = self._newest, time.monotonic_ns()
        if now_ns < before.monotonic_ns:
            return
        self._newest = before.followed_by(check_factor(factor), now_ns + round(LEAD_S * 1e9))
        self._number += 1
        packed = self._packed(before)
        for record in self._records:
            record[:] = packed

    def _packed(self, before: Stretch) -> bytes:
        body = _RECORD.pack(self._number, self._adapts, *astuple(before), *astuple(self._newest), 0)[:-8]
        return body + struct.pack("=Q", zlib.crc32(body))


def check_factor(factor: float) -> float:
    """Return the factor if it is in range.

    Raises:
        PaceError: the factor is out of range.
    """
    if not (math.isfinite(factor) and SLOWEST <= factor <= FASTEST):
        raise PaceError(f"pace must lie in {SLOWEST}..{FASTEST:g} (got {factor:g})")
    return float(factor)


def describe(factor: float, adapts: bool) -> str:
    """Return a text about the pace; empty in real time. An adapting pace is rounded, so the text rarely changes."""
    factor = round(factor, 1) if adapts else factor
    if factor == 1.0:
        return ""
    return f"simulation at {factor:g} of real time{': this machine is busy' if adapts else ''}"


_current = Pace()


def current() -> Pace:
    """Return this process's pace."""
    return _current


def use(pace: Pace) -> None:
    """Set this process's pace. Call this before creating clocks."""
    global _current
    _current = pace


def suspended_ns() -> int:
    """Return the nanoseconds for which this machine was suspended, or less if the process is delayed meanwhile.

    A virtual machine does not notice when it is paused.
    """
    # The order matters: a process delayed between the two readings must not appear suspended.
    since_start_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    return since_start_ns - time.monotonic_ns()


def remove_files(folders: Iterable[Path]) -> None:
    """Remove the pace files, so that processes started from now on run on the machine's own time."""
    for folder in folders:
        (folder / FILE).unlink(missing_ok=True)


def _create(file: Path, content: bytes) -> mmap.mmap:
    """Replace a file and map the new one. Processes that have mapped the old one keep it."""
    with replacing(file, private=True) as stream:
        stream.write(content)
        stream.flush()
        return mmap.mmap(stream.fileno(), len(content))


def read(run_dir: Path) -> Pace:
    """Return the pace of a run directory, which follows the launcher's changes; real time if there is no pace file.

    Raises:
        PaceError: the pace file cannot be read or is damaged.
    """
    file = run_dir / FILE
    try:
        descriptor = os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        return Pace()
    except OSError as error:
        raise PaceError(f"{file}: cannot be read: {error.strerror}") from error
    try:
        if (size := os.fstat(descriptor).st_size) != _RECORD.size:
            raise ValueError(f"{size} bytes instead of {_RECORD.size}")
        return Pace._of_record(mmap.mmap(descriptor, _RECORD.size, prot=mmap.PROT_READ))
    except (ValueError, OSError) as error:
        raise PaceError(f"{file}: not a valid pace ({error}); delete the file, or restart the stack") from error
    finally:
        os.close(descriptor)
