"""How fast the time of a simulated stack goes beside the machine's: slow motion for a machine that is too slow.

A stack has one pace for all its processes. It stands in the run directory, where the launcher writes it
(``ic launch sim --pace 0.5``) and each process reads it as it starts. Stamps, timers and time-outs of the nodes follow
it, and so do the simulated devices; what concerns the machine alone (heartbeats, the end of processes) does not.
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
    """No pace: a number out of range, or a file of a run directory that cannot be read."""


@dataclass(frozen=True)
class Pace:
    """A pace, and the moment at which its time was the machine's.

    Attributes:
        factor: seconds of the stack in a second of the machine.
        epoch_ns: nanoseconds since the epoch at that moment.
        monotonic_ns: the machine's steady clock at that moment; one for all processes of a machine.
    """

    factor: float = 1.0
    epoch_ns: int = 0
    monotonic_ns: int = 0

    @classmethod
    def from_now(cls, factor: float) -> Pace:
        """A pace that begins now.

        Raises:
            PaceError: the factor is out of range.
        """
        if not (math.isfinite(factor) and SLOWEST <= factor <= FASTEST):
            raise PaceError(f"pace must lie in {SLOWEST}..{FASTEST:g} (got {factor:g})")
        return cls(float(factor), time.time_ns(), time.monotonic_ns())

    @property
    def real(self) -> bool:
        """Whether it is the machine's own time."""
        return self.factor == 1.0

    def now_ns(self) -> int:
        """Nanoseconds since the epoch."""
        if self.real:
            return time.time_ns()
        return self.epoch_ns + round(self.factor * (time.monotonic_ns() - self.monotonic_ns))

    def steady_ns(self) -> int:
        """Nanoseconds since some moment; only differences mean something."""
        return time.monotonic_ns() if self.real else round(self.factor * (time.monotonic_ns() - self.monotonic_ns))

    def steady_s(self) -> float:
        """The same in seconds."""
        return self.steady_ns() * 1e-9

    def wait_s(self, seconds: float) -> float:
        """How long the machine waits for so many seconds of the stack."""
        return seconds / self.factor

    def sleep(self, seconds: float) -> None:
        """Sleeps for so many seconds of the stack."""
        time.sleep(self.wait_s(seconds))

    def stamp_ns(self, machine_ns: int) -> int:
        """The stack's time at a recent moment that the machine's clock has stamped."""
        return machine_ns if self.real else self.now_ns() - round(self.factor * (time.time_ns() - machine_ns))


_current = Pace()


def current() -> Pace:
    """This process's pace."""
    return _current


def use(pace: Pace) -> None:
    """Makes it this process's; before its clocks are used."""
    global _current
    _current = pace


def write(run_dir: Path, pace: Pace) -> None:
    """Makes it the pace of a run directory; the machine's own leaves no file."""
    file = run_dir / FILE
    if pace.real:
        file.unlink(missing_ok=True)
        return
    part = file.with_suffix(".part")
    part.write_text(json.dumps(asdict(pace)), encoding="utf-8")
    part.replace(file)


def read(run_dir: Path) -> Pace:
    """The pace of a run directory.

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
        raise PaceError(f"{file}: no pace ({error}); delete it, or start the stack again") from error
    if not (math.isfinite(pace.factor) and SLOWEST <= pace.factor <= FASTEST):
        raise PaceError(f"{file}: pace must lie in {SLOWEST}..{FASTEST:g} (got {pace.factor:g})")
    return pace
