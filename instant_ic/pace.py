"""Pace of a simulated stack's time relative to the machine's: slow motion for a machine that is too slow.

All processes of a stack share one pace. The launcher writes it into the run directory (``ic launch sim --pace 0.5``),
and each process reads it at start-up. Stamps, timers and time-outs of the nodes follow it, and so do the simulated
devices. Functions that concern only the machine (heartbeats, shutdown of processes) do not.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path

FILE = "pace.json"
SLOWEST, FASTEST = 0.02, 10.0


class PaceError(ValueError):
    """The pace is out of range, or the run directory's pace file cannot be read."""


@dataclass(frozen=True)
class Pace:
    """A pace, with the moment at which its time equalled the machine's.

    Attributes:
        factor: seconds of the stack per second of the machine.
        epoch_ns: nanoseconds since the epoch at that moment.
        monotonic_ns: the machine's steady clock at that moment; all processes of a machine share it.
    """

    factor: float = 1.0
    epoch_ns: int = 0
    monotonic_ns: int = 0

    @classmethod
    def from_now(cls, factor: float) -> Pace:
        """A pace that starts now.

        Raises:
            PaceError: the factor is out of range.
        """
        if not (math.isfinite(factor) and SLOWEST <= factor <= FASTEST):
            raise PaceError(f"pace must lie in {SLOWEST}..{FASTEST:g} (got {factor:g})")
        return cls(float(factor), time.time_ns(), time.monotonic_ns())

    @property
    def real(self) -> bool:
        """Whether this is the machine's own time."""
        return self.factor == 1.0

    def now_ns(self) -> int:
        """Nanoseconds since the epoch."""
        if self.real:
            return time.time_ns()
        return self.epoch_ns + round(self.factor * (time.monotonic_ns() - self.monotonic_ns))

    def steady_ns(self) -> int:
        """Nanoseconds since an arbitrary origin; only differences are meaningful."""
        return time.monotonic_ns() if self.real else round(self.factor * (time.monotonic_ns() - self.monotonic_ns))

    def steady_s(self) -> float:
        """Seconds since an arbitrary origin; only differences are meaningful."""
        return self.steady_ns() * 1e-9

    def wait_s(self, seconds: float) -> float:
        """Convert seconds of the stack to seconds of the machine."""
        return seconds / self.factor

    def sleep(self, seconds: float) -> None:
        """Sleep for a number of the stack's seconds."""
        time.sleep(self.wait_s(seconds))

    def stamp_ns(self, machine_ns: int) -> int:
        """Convert a recent stamp of the machine's clock to the stack's time."""
        return machine_ns if self.real else self.now_ns() - round(self.factor * (time.time_ns() - machine_ns))


_current = Pace()


def current() -> Pace:
    """This process's pace."""
    return _current


def use(pace: Pace) -> None:
    """Set this process's pace; call it before the clocks are used."""
    global _current
    _current = pace


def write(run_dir: Path, pace: Pace) -> None:
    """Write the pace into a run directory; the machine's own pace leaves no file."""
    file = run_dir / FILE
    if pace.real:
        file.unlink(missing_ok=True)
        return
    part = file.with_suffix(".part")
    part.write_text(json.dumps(asdict(pace)), encoding="utf-8")
    part.replace(file)


def read(run_dir: Path) -> Pace:
    """Read the pace of a run directory.

    Raises:
        PaceError: its file is damaged.
    """
    file = run_dir / FILE
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError:
        return Pace()
    except OSError as error:
        raise PaceError(f"{file}: cannot be read: {error.strerror}") from error
    try:
        fields = json.loads(text)
        pace = Pace(float(fields["factor"]), int(fields["epoch_ns"]), int(fields["monotonic_ns"]))
    except (ValueError, KeyError, TypeError) as error:
        raise PaceError(f"{file}: not a valid pace ({error}); delete the file, or restart the stack") from error
    if not (math.isfinite(pace.factor) and SLOWEST <= pace.factor <= FASTEST):
        raise PaceError(f"{file}: pace must lie in {SLOWEST}..{FASTEST:g} (got {pace.factor:g})")
    return pace
