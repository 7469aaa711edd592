"""Feeds parsers with mutated samples: no other error than the parser's own, no hang, no growth of memory.

Input ``index`` of a target depends on the target and the index alone, so that each can be made again.
"""

from __future__ import annotations

import random
import re
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

MOST_INPUT_BYTES = 1 << 16
DEADLINE_S = 5.0
"""CPU time of one input, which no other job on the machine changes."""
WALL_DEADLINE_S = 120.0
"""For a parser that waits instead of working."""
MOST_GROWTH_KB = 256 << 10
"""Most by which one input may raise the process's peak of resident memory."""
_DIGIT = re.compile(rb"[0-9]")
_NUMBERS = (0, 1, 2, 3, 7, 8, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 1 << 24, 0x7FFFFFFF)
_LARGE = (0x80000000, 0xFFFFFFFF, 1 << 32, (1 << 40) + 3, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)


@dataclass(frozen=True)
class Target:
    """A parser and what it may do.

    Attributes:
        samples: valid inputs.
        parse: parses one input.
        allowed: the parser's own errors.
        words: what its format's inputs are made of.
        fix: repairs what would keep mutations out, such as a check sum.
    """

    samples: list[bytes]
    parse: Callable[[bytes], object]
    allowed: tuple[type[BaseException], ...] = ()
    words: tuple[bytes, ...] = ()
    fix: Callable[[bytes], bytes] | None = None

    def input(self, name: str, index: int) -> bytes:
        """Input number ``index``; the first ones are the samples as they are."""
        if index < len(self.samples):
            return self.samples[index]
        rng = random.Random(f"{name} {index}")
        data = bytearray(rng.choice(self.samples))
        for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 5, 9))):
            _mutate(data, rng, self)
            del data[MOST_INPUT_BYTES:]
        return self.fix(bytes(data)) if self.fix is not None and rng.random() < 0.7 else bytes(data)


class Hang(BaseException):
    """An input took too long; no parser's ``except Exception`` may take it for its own."""


def run(name: str, target: Target, count: int) -> None:
    """Parse the first ``count`` inputs; what goes wrong is raised with the input's number and bytes."""
    peak_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with _alarms():
        for index in range(count):
            data = target.input(name, index)
            signal.setitimer(signal.ITIMER_PROF, DEADLINE_S)
            signal.setitimer(signal.ITIMER_REAL, WALL_DEADLINE_S)
            try:
                target.parse(data)
            except target.allowed:
                pass
            except BaseException as error:
                error.add_note(f"input {index} of {name}: {data[:2000]!r}")
                raise
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
                signal.setitimer(signal.ITIMER_REAL, 0)
            before_kb, peak_kb = peak_kb, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            assert peak_kb - before_kb < MOST_GROWTH_KB, f"input {index} of {name}: {data[:2000]!r}"


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


def _mutate(data: bytearray, rng: random.Random, target: Target) -> None:
    """Change the data in place."""
    at, length = rng.randrange(len(data) + 1), rng.randint(1, 64)
    kind = rng.choice(
        ("flip", "byte", "number", "number", "end", "delete", "repeat", "word", "splice", "digit", "nest")
    )
    if kind == "flip" and at < len(data):
        data[at] ^= 1 << rng.randrange(8)
    elif kind == "byte" and at < len(data):
        data[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
    elif kind == "number" and len(data) >= 8:
        size, at = rng.choice((2, 4, 8)), rng.randrange(len(data) - 7)
        value = rng.choice((*_NUMBERS, *_LARGE, len(data), len(data) - 1, rng.getrandbits(64)))
        data[at : at + size] = (value % (1 << 8 * size)).to_bytes(size, rng.choice(("little", "big")))
    elif kind == "end":
        del data[at:]
    elif kind == "delete":
        del data[at : at + length]
    elif kind == "repeat":
        data[at:at] = data[at : at + length] * rng.choice((1, 1, 2, 10, 300))
    elif kind == "word":
        word = rng.choice(target.words or (rng.randbytes(length),))
        data[at : at + rng.choice((0, len(word)))] = word
    elif kind == "splice":
        other = rng.choice(target.samples)
        data[at:] = other[rng.randrange(len(other) + 1) :]
    elif kind == "digit" and (places := [found.start() for found in _DIGIT.finditer(data, 0, 4096)]):
        at = rng.choice(places)
        texts = (b"-1", b"0", b"1e999", b"1" * 5000, b"NaN", b"0x7f", b"99999999999999999999", b"1.5", b"010")
        data[at : at + 1] = rng.choice(texts)
    elif kind == "nest":
        data[at:at] = rng.choice((b"[", b"{", b'{"a":', b"(", b"- ", b"$(")) * rng.choice((1, 3, 100, 3000))
