"""Comparison of two bags by topic, message and field, with optional tolerances."""

from __future__ import annotations

import dataclasses
import fnmatch
import functools
import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.bag.files import BagReader
from instant_ic.bag.message import BagError, BagMessage


@dataclass(frozen=True)
class Tolerance:
    """Allowed differences between two bags.

    Attributes:
        atol: allowed absolute difference of numbers.
        fields: pattern → absolute tolerance of the fields that match it.
        ignore: patterns of fields that are not compared.
        stamp_s: largest difference of stamps, in seconds, at which two messages of a topic form a pair; None pairs
            messages by order and requires equal stamps.

    A pattern matches a field and everything inside it (``header.stamp``, ``pose.*.position``). A topic name before it
    limits it to that topic (``/scan:ranges``). List entries are written ``transforms[].header``.
    """

    atol: float = 0.0
    fields: dict[str, float] = field(default_factory=dict)
    ignore: tuple[str, ...] = ()
    stamp_s: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("atol", self.atol), ("stamp_s", self.stamp_s or 0.0)):
            if not value >= 0:
                raise ValueError(f"{name} must be >= 0 (got {value})")
        for name, value in self.fields.items():
            if not value >= 0:
                raise ValueError(f"tolerance of {name} must be >= 0 (got {value})")

    @property
    def exact(self) -> bool:
        """True if no difference is allowed."""
        return not (self.atol or self.fields or self.ignore)

    def ignores(self, topic: str, path: str) -> bool:
        return any(_matches(pattern, topic, path) for pattern in self.ignore)

    def of(self, topic: str, path: str) -> float:
        """Return the absolute tolerance of a field."""
        for pattern, atol in self.fields.items():
            if _matches(pattern, topic, path):
                return atol
        return self.atol


EXACT = Tolerance()


@dataclass
class FieldDifference:
    """The differences of one field of a topic.

    Attributes:
        messages: number of pairs in which the field differs beyond the tolerance.
        first: number of the first such pair, from 1.
        largest: largest difference; nan for non-numbers, and if one of the two values is not finite.
        words: text of the first difference.
    """

    messages: int = 0
    first: int = 0
    largest: float = 0.0
    words: str = ""


@dataclass(frozen=True)
class TopicDifference:
    """The differences of one topic in two bags.

    Attributes:
        first: text of the first difference; empty if the topic is the same in both bags, within the tolerance.
        only_a: messages of the first bag without a partner, when pairing by stamp.
        only_b: messages of the second bag without a partner, when pairing by stamp.
        differing: pairs that differ.
        fields: field → its differences in those pairs.
    """

    topic: str
    count_a: int
    count_b: int
    first: str
    only_a: int = 0
    only_b: int = 0
    differing: int = 0
    fields: dict[str, FieldDifference] = field(default_factory=dict)

    @property
    def same(self) -> bool:
        """True if both bags hold the same messages of the topic: bit for bit, or within the tolerance."""
        return not self.first


def compare(
    a: Path, b: Path, ignore: tuple[str, ...] = (), common: bool = False, tolerance: Tolerance = EXACT
) -> list[TopicDifference]:
    """Compare every topic of two bags, sorted by name.

    Args:
        a: first bag.
        b: second bag.
        ignore: topics to leave out, names or patterns.
        common: compare only topics that both bags have.
        tolerance: allowed differences.

    Raises:
        BagError: a bag cannot be read.
    """
    with BagReader(a) as one, BagReader(b) as two:
        names = [{t.topic for t in reader.topics} for reader in (one, two)]
        topics = names[0] & names[1] if common else names[0] | names[1]
        chosen = [t for t in sorted(topics) if not any(fnmatch.fnmatchcase(t, pattern) for pattern in ignore)]
        return [_Comparison(topic, one, two, tolerance).run() for topic in chosen]


class _Comparison:
    """A comparison of one topic in two bags."""

    def __init__(self, topic: str, one: BagReader, two: BagReader, tolerance: Tolerance) -> None:
        self.topic = topic
        self.tolerance = tolerance
        self.fields: dict[str, FieldDifference] = {}
        self.first = ""
        self._readers = (one, two)
        self._types = [{t.type_name: t for t in reader.topics if t.topic == topic} for reader in (one, two)]
        self._decoders: dict[tuple[int, str], Any] = {}

    def run(self) -> TopicDifference:
        if all(self._types) and set(self._types[0]) != set(self._types[1]):
            self.first = "types " + " and ".join(", ".join(sorted(types)) for types in self._types)
        only_a = only_b = both = differing = 0
        for left, right in self._pairs():
            if left is not None and right is not None:
                both += 1
                difference = self._difference(left, right, both)
                differing += bool(difference)
                self._note(f"message {both}: {difference}" if difference else "")
            elif missing := left or right:
                only_a, only_b = only_a + (left is not None), only_b + (right is not None)
                name = "first" if left is not None else "second"
                if self.tolerance.stamp_s is not None:
                    self._note(f"the message at {missing.stamp_ns / 1e9:.6f} s is only in the {name} bag")
        if only_a != only_b:
            self._note(f"{both + only_a} and {both + only_b} messages")
        counts = (both + only_a, both + only_b)
        return TopicDifference(self.topic, *counts, self.first, only_a, only_b, differing, self.fields)

    def _note(self, text: str) -> None:
        self.first = self.first or text

    def _pairs(self) -> Iterator[tuple[BagMessage | None, BagMessage | None]]:
        """Pair messages by order or by stamp; None stands for a missing partner."""
        one, two = (reader.messages({self.topic}) for reader in self._readers)
        if self.tolerance.stamp_s is None:
            yield from itertools.zip_longest(one, two)
            return
        within_ns = int(self.tolerance.stamp_s * 1e9)
        left, right = next(one, None), next(two, None)
        while left is not None or right is not None:
            gap_ns = math.inf if left is None else -math.inf if right is None else left.stamp_ns - right.stamp_ns
            in_a, in_b = gap_ns <= within_ns, gap_ns >= -within_ns
            yield left if in_a else None, right if in_b else None
            left, right = next(one, None) if in_a else left, next(two, None) if in_b else right

    def _difference(self, left: BagMessage, right: BagMessage, number: int) -> str:
        """Describe how two messages differ, and count the differing fields; empty if the messages are the same."""
        if self.tolerance.stamp_s is None and left.stamp_ns != right.stamp_ns:
            return f"stamps differ by {(right.stamp_ns - left.stamp_ns) / 1e9:+.9f} s"
        if left.payload == right.payload:
            return ""
        if left.type_name != right.type_name:
            return f"{left.type_name} and {right.type_name}"
        try:
            found = self._differing_fields(self._decode(0, left), self._decode(1, right))
        except BagError:
            return f"the bytes differ; {left.type_name} is unknown here"
        for name, (text, size) in found.items():
            entry = self.fields.setdefault(name, FieldDifference(0, number, size, text))
            entry.messages += 1
            entry.largest = max(entry.largest, size) if entry.largest == entry.largest else entry.largest
        if not found and self.tolerance.exact:
            return "the bytes differ, but no field does (padding)"
        return next(iter(found.values()))[0] if found else ""

    def _decode(self, which: int, message: BagMessage) -> Any:
        key = (which, message.type_name)
        if key not in self._decoders:
            self._decoders[key] = self._readers[which].decoder(self._types[which][message.type_name])
        return self._decoders[key](message.payload)

    def _differing_fields(self, a: Any, b: Any) -> dict[str, tuple[str, float]]:
        """Return field → (text, size) of the differences beyond the tolerance; in a list, its largest."""
        found: dict[str, tuple[str, float]] = {}
        for path, x, y in _leaves(a, b, ""):
            name = re.sub(r"\[\d+\]", "[]", path)
            if self.tolerance.ignores(self.topic, name):
                continue
            difference = _difference(x, y, self.tolerance.of(self.topic, name))
            if difference is not None:
                text, size = f"{path}{difference[0]}", difference[1]
                if name not in found or size > found[name][1]:
                    found[name] = (found[name][0] if name in found else text, size)
        return found


def _leaves(a: Any, b: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield path and both values of every field that is not itself a message."""
    if dataclasses.is_dataclass(a):
        for item in dataclasses.fields(a):
            if not item.name.startswith("__"):
                inner = f"{path}.{item.name}" if path else item.name
                yield from _leaves(getattr(a, item.name), getattr(b, item.name, None), inner)
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        for index, (x, y) in enumerate(zip(a, b, strict=True)):
            yield from _leaves(x, y, f"{path}[{index}]")
    else:
        yield path, a, b


def _difference(a: Any, b: Any, atol: float) -> tuple[str, float] | None:
    """Return the difference of two values as text and number (nan for non-numbers); None within the tolerance.

    Without a tolerance, numbers are compared bit for bit: -0.0 differs from 0.0, and two nan with the same bits are
    equal.
    """
    if isinstance(a, np.ndarray | list) and isinstance(b, np.ndarray | list) and len(a) != len(b):
        return f" has {len(a)} and {len(b)} entries", math.nan
    if not (_numeric(a) and _numeric(b)):
        return None if a == b else (f" is {a!r} and {b!r}", math.nan)
    x, y = np.ravel(a), np.ravel(b)
    if not x.size:
        return None
    wide = (x.astype(np.float64), y.astype(np.float64))
    with np.errstate(invalid="ignore"):  # inf - inf
        gap = np.abs(wide[0] - wide[1])
        if atol:
            equal = (x == y) | (np.isnan(wide[0]) & np.isnan(wide[1])) | (gap <= atol)
        else:
            bits = [np.ascontiguousarray(value).view(np.uint8).reshape(value.size, -1) for value in (x, y)]
            equal = (bits[0] == bits[1]).all(axis=1)
    different = np.flatnonzero(~equal)
    if not different.size:
        return None
    index, size = int(different[0]), float(np.max(gap[different]))
    values = f" is {x[index].item()!r} and {y[index].item()!r}"
    if not isinstance(a, np.ndarray):
        return values, size
    return f"[{index}]{values} ({different.size} of {x.size} entries differ)", size


def _numeric(value: Any) -> bool:
    return isinstance(value, np.ndarray) or (isinstance(value, int | float) and not isinstance(value, bool))


@functools.lru_cache(maxsize=10_000)  # called for each field of each message
def _matches(pattern: str, topic: str, path: str) -> bool:
    if pattern.startswith("/"):
        wanted, _, pattern = pattern.partition(":")
        if not fnmatch.fnmatchcase(topic, wanted):
            return False
    plain = pattern.replace("[]", "")
    # A field, or one inside it; brackets may be omitted.
    whole = fnmatch.translate(plain)[:-2] + r"(\..*)?\Z"
    return re.match(whole, path.replace("[]", "")) is not None
