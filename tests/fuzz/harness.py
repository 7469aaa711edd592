"""Feeds parsers with mutated samples and reports what they must not do: other errors, hangs, growth of memory.

Input ``index`` of a target depends on the seed, the target and the index alone, so that each can be made again.
"""

from __future__ import annotations

import hashlib
import random
import re
import resource
import signal
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import FrameType
from typing import Any

MOST_INPUT_BYTES = 1 << 16
DEADLINE_S = 5.0
"""CPU time of one input, which no other job on the machine changes."""
WALL_DEADLINE_S = 120.0
"""For a parser that waits instead of working."""
MOST_GROWTH_KB = 256 << 10
"""Most by which one input may raise the process's peak of resident memory."""

_QUICK_S = 0.01
_peak_kb = [0]
"""Peak of resident memory when it was last read."""
_DIGIT = re.compile(rb"[0-9]")
_INTERESTING = (0, 1, 2, 3, 7, 8, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 1 << 24, 0x7FFFFFFF)
_LARGE = (0x80000000, 0xFFFFFFFF, 1 << 32, (1 << 40) + 3, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)


@dataclass(frozen=True)
class Target:
    """A parser and what it may do.

    Attributes:
        name: of the parser.
        samples: makes valid inputs.
        make: makes the function that parses one input; called once a process, as it may need files or tables.
        allowed: the parser's own errors.
        dictionary: what its format's inputs are made of.
        fix: repairs what would keep mutations out, such as a check sum; gets the input and a random generator.
        share: inputs of the test that runs with all others.
    """

    name: str
    samples: Callable[[], list[bytes]]
    make: Callable[[], Callable[[bytes], object]]
    allowed: tuple[type[BaseException], ...] = ()
    dictionary: tuple[bytes, ...] = ()
    fix: Callable[[bytes, random.Random], bytes] | None = None
    share: int = 1000

    @cached_property
    def corpus(self) -> list[bytes]:
        """The samples, made once."""
        return self.samples()

    def input(self, seed: int, index: int) -> bytes:
        """Input number ``index``; the first ones are the samples as they are."""
        if index < len(self.corpus):
            return self.corpus[index]
        rng = random.Random(f"{seed} {self.name} {index}")
        if rng.random() < 0.02:
            return rng.randbytes(rng.randrange(200))
        data = bytearray(rng.choice(self.corpus))
        for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 5, 9))):
            rng.choice(_MUTATIONS)(data, rng, self)
            del data[MOST_INPUT_BYTES:]
        if self.fix is not None and rng.random() < 0.7:
            return self.fix(bytes(data), rng)
        return bytes(data)


@dataclass(frozen=True)
class Finding:
    """What a parser must not do."""

    target: str
    seed: int
    index: int
    what: str
    where: str
    trace: str = field(compare=False)
    data: bytes = field(repr=False, compare=False)

    @property
    def key(self) -> tuple[str, str]:
        """Findings with the same are one."""
        return self.what.split(":")[0], self.where

    def save(self, folder: Path) -> Path:
        """Write input and report; returns the input's file."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.target}-{hashlib.sha256(self.data).hexdigest()[:12]}.bin"
        path.write_bytes(self.data)
        path.with_suffix(".txt").write_text(
            f"target {self.target}, seed {self.seed}, input {self.index}\n{self.what}\n{self.where}\n\n{self.trace}"
        )
        return path


class Hang(BaseException):
    """An input took too long; no parser's ``except Exception`` may take it for its own."""


def run(target: Target, parse: Callable[[bytes], object], seed: int, start: int, count: int) -> list[Finding]:
    """Parse inputs ``start`` to ``start + count``; returns one finding of each kind."""
    found: dict[tuple[str, str], Finding] = {}
    _peak_kb[0] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with _alarms():
        for index in range(start, start + count):
            finding = check(target, parse, seed, index, target.input(seed, index))
            if finding is not None:
                found.setdefault(finding.key, finding)
    return list(found.values())


def check(target: Target, parse: Callable[[bytes], object], seed: int, index: int, data: bytes) -> Finding | None:
    """Parse one input; the finding, if it is one. Call it within `run` for its deadlines."""
    began_s = time.perf_counter()
    signal.setitimer(signal.ITIMER_PROF, DEADLINE_S)
    signal.setitimer(signal.ITIMER_REAL, WALL_DEADLINE_S)
    try:
        parse(data)
    except target.allowed:
        pass
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # noqa: BLE001 - whatever it is, it is a finding
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in frames if "instant_ic" in frame.filename] or list(frames)
        where = f"{Path(own[-1].filename).name}:{own[-1].lineno} in {own[-1].name}"
        text = f"{type(error).__name__}: {error}"[:300]
        trace = "".join(traceback.format_exception(error, limit=30))[-8000:]
        return Finding(target.name, seed, index, text, where, trace, data)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
    # To touch that much memory takes longer than this; asking the kernel costs as much as a small input.
    if time.perf_counter() - began_s < _QUICK_S:
        return None
    before_kb, _peak_kb[0] = _peak_kb[0], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    grown_kb = _peak_kb[0] - before_kb
    if grown_kb > MOST_GROWTH_KB:
        return Finding(target.name, seed, index, f"memory: grew by {grown_kb >> 10} MB", "memory", "", data)
    return None


@contextmanager
def _alarms() -> Iterator[None]:
    def ring(number: int, _: FrameType | None) -> None:
        raise Hang("no end within the deadline")

    before = {number: signal.signal(number, ring) for number in (signal.SIGPROF, signal.SIGALRM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# -- mutations: each changes the data in place -------------------------------------------------------------------------


def _span(data: bytearray, rng: random.Random, most: int = 64) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    return start, min(len(data), start + rng.randint(1, most))


def _flip(data: bytearray, rng: random.Random, _: Target) -> None:
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _set_byte(data: bytearray, rng: random.Random, _: Target) -> None:
    if data:
        data[rng.randrange(len(data))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))


def _set_number(data: bytearray, rng: random.Random, _: Target) -> None:
    size = rng.choice((2, 4, 8))
    if len(data) >= size:
        value = rng.choice((*_INTERESTING, *_LARGE, len(data), len(data) - 1, rng.getrandbits(64)))
        at = rng.randrange(len(data) - size + 1)
        data[at : at + size] = (value % (1 << 8 * size)).to_bytes(size, rng.choice(("little", "big")))


def _truncate(data: bytearray, rng: random.Random, _: Target) -> None:
    del data[rng.randrange(len(data) + 1) :]


def _delete(data: bytearray, rng: random.Random, _: Target) -> None:
    start, end = _span(data, rng)
    del data[start:end]


def _repeat(data: bytearray, rng: random.Random, _: Target) -> None:
    start, end = _span(data, rng)
    data[end:end] = data[start:end] * rng.choice((1, 1, 2, 10, 300))


def _insert(data: bytearray, rng: random.Random, _: Target) -> None:
    at = rng.randrange(len(data) + 1)
    data[at:at] = rng.randbytes(rng.randint(1, 16))


def _word(data: bytearray, rng: random.Random, target: Target) -> None:
    if target.dictionary:
        word = rng.choice(target.dictionary)
        at = rng.randrange(len(data) + 1)
        data[at : at + rng.choice((0, len(word)))] = word


def _splice(data: bytearray, rng: random.Random, target: Target) -> None:
    other = rng.choice(target.corpus)
    data[rng.randrange(len(data) + 1) :] = other[rng.randrange(len(other) + 1) :]


def _swap(data: bytearray, rng: random.Random, _: Target) -> None:
    start, end = _span(data, rng)
    moved = data[start:end]
    del data[start:end]
    at = rng.randrange(len(data) + 1)
    data[at:at] = moved


def _digits(data: bytearray, rng: random.Random, _: Target) -> None:
    """Another number where one stands as text."""
    places = [found.start() for found in _DIGIT.finditer(data, 0, 4096)]
    if places:
        at = rng.choice(places)
        text = rng.choice(
            (b"-1", b"0", b"1e999", b"1" * 5000, b"NaN", b"0x7f", b"99999999999999999999", b"1.5", b"010")
        )
        data[at : at + 1] = text


def _nest(data: bytearray, rng: random.Random, _: Target) -> None:
    at = rng.randrange(len(data) + 1)
    data[at:at] = rng.choice((b"[", b"{", b'{"a":', b"(", b"- ", b"$(")) * rng.choice((1, 3, 100, 3000))


_MUTATIONS: tuple[Callable[[bytearray, random.Random, Target], Any], ...] = (
    _flip,
    _flip,
    _set_byte,
    _set_number,
    _set_number,
    _truncate,
    _delete,
    _repeat,
    _insert,
    _word,
    _word,
    _splice,
    _swap,
    _digits,
    _nest,
)
