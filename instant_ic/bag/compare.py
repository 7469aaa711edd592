"""Compares two bags topic by topic, message by message, field by field, with optional tolerances."""

from __future__ import annotations

import dataclasses
import fnmatch
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
        stamp_s: pair the messages of a topic by stamp, where stamps may differ by this many seconds; None pairs them by
            order and requires equal stamps.

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
    """How one field of a topic differs.

    Attributes:
        messages: number of pairs in which it differs beyond the tolerance.
        first: number of the first such pair, from 1.
        largest: largest difference; nan for non-numbers, and where one of the two values is not finite.
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
        first: text of the first difference; empty where the topic is the same in both bags, within the tolerance.
        only_a: messages of the first bag without a partner, when pairing by stamp.
        only_b: messages of the second bag without a partner, when pairing by stamp.
        differing: pairs that differ.
        fields: field → how it differs in those pairs.
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
    """Compare every topic of two bags, in the order of the names.

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
    """One topic of two bags."""

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
            self.first = " and ".join(", ".join(sorted(types)) for types in self._types)
            self.first = f"types {self.first}"
        counts, only, number, differing = [0, 0], [0, 0], 0, 0
        for left, right in self._pairs():
            counts[0] += left is not None
            counts[1] += right is not None
            if left is None or right is None:
                only[left is None] += 1
                missing = left or right
                if self.tolerance.stamp_s is not None and missing is not None:
                    name = "first" if left is not None else "second"
                    self.first = (
                        self.first or f"the message at {missing.stamp_ns / 1e9:.6f} s is only in the {name} bag"
                    )
                continue
            number += 1
            differing += self._differ(left, right, number)
        if not self.first and counts[0] != counts[1]:
            self.first = f"{counts[0]} and {counts[1]} messages"
        return TopicDifference(self.topic, counts[0], counts[1], self.first, only[0], only[1], differing, self.fields)

    def _pairs(self) -> Iterator[tuple[BagMessage | None, BagMessage | None]]:
        one, two = (reader.messages({self.topic}) for reader in self._readers)
        left, right = next(one, None), next(two, None)
        within = None if self.tolerance.stamp_s is None else int(self.tolerance.stamp_s * 1e9)
        while left is not None or right is not None:
            if left is not None and right is not None and within is not None:
                gap = left.stamp_ns - right.stamp_ns
                if gap < -within:
                    yield left, None
                    left = next(one, None)
                    continue
                if gap > within:
                    yield None, right
                    right = next(two, None)
                    continue
            yield left, right
            left, right = next(one, None), next(two, None)

    def _differ(self, left: BagMessage, right: BagMessage, number: int) -> bool:
        if self.tolerance.stamp_s is None and left.stamp_ns != right.stamp_ns:
            apart = f"stamps differ by {(right.stamp_ns - left.stamp_ns) / 1e9:+.9f} s"
            self.first = self.first or f"message {number}: {apart}"
            return True
        if left.payload == right.payload:
            return False
        if left.type_name != right.type_name:
            self.first = self.first or f"message {number}: {left.type_name} and {right.type_name}"
            return True
        try:
            decoded = [self._decode(which, message) for which, message in enumerate((left, right))]
        except BagError:
            self.first = self.first or f"message {number}: the bytes differ; {left.type_name} is unknown here"
            return True
        found = dict(self._values(decoded[0], decoded[1], ""))
        for path, (words, size) in found.items():
            entry = self.fields.setdefault(path, FieldDifference(0, number, size, words))
            entry.messages += 1
            entry.largest = max(entry.largest, size) if entry.largest == entry.largest else entry.largest
        if found:
            self.first = self.first or f"message {number}: {next(iter(found.values()))[0]}"
        elif self.tolerance.exact:
            self.first = self.first or f"message {number}: the bytes differ, but no field does (padding)"
        return bool(found) or self.tolerance.exact

    def _decode(self, which: int, message: BagMessage) -> Any:
        key = (which, message.type_name)
        if key not in self._decoders:
            self._decoders[key] = self._readers[which].decoder(self._types[which][message.type_name])
        return self._decoders[key](message.payload)

    def _values(self, a: Any, b: Any, path: str) -> Iterator[tuple[str, tuple[str, float]]]:
        """Yield each field that differs beyond the tolerance: path → (text, size); a list gives its largest."""
        if path and self.tolerance.ignores(self.topic, path):
            return
        if dataclasses.is_dataclass(a) and not isinstance(a, type):
            for item in dataclasses.fields(a):
                if not item.name.startswith("__"):
                    inner = f"{path}.{item.name}" if path else item.name
                    yield from self._values(getattr(a, item.name), getattr(b, item.name, None), inner)
        elif isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
            yield from self._arrays(a, b, path)
        elif isinstance(a, list) and isinstance(b, list):
            if len(a) != len(b):
                yield path, (f"{path} has {len(a)} and {len(b)} entries", float("nan"))
                return
            largest: dict[str, tuple[str, float]] = {}
            for index, (x, y) in enumerate(zip(a, b, strict=True)):
                for inner, (words, size) in self._values(x, y, f"{path}[]"):
                    text = words.replace(f"{path}[]", f"{path}[{index}]", 1)
                    if inner not in largest or size > largest[inner][1]:
                        largest[inner] = (largest.get(inner, (text, 0.0))[0], size)
            yield from largest.items()
        elif isinstance(a, float) and isinstance(b, float) and not isinstance(a, bool):
            yield from self._arrays(np.array([a]), np.array([b]), path, scalar=True)
        elif a != b:
            atol = self.tolerance.of(self.topic, path)
            numbers = isinstance(a, int) and isinstance(b, int) and not isinstance(a, bool)
            size = float(abs(a - b)) if numbers else float("nan")
            if not (numbers and size <= atol):
                yield path, (f"{path} is {a!r} and {b!r}", size)

    def _arrays(
        self, a: np.ndarray, b: np.ndarray, path: str, scalar: bool = False
    ) -> Iterator[tuple[str, tuple[str, float]]]:
        if a.shape != b.shape:
            yield path, (f"{path} has {a.size} and {b.size} entries", float("nan"))
            return
        if not a.size:
            return
        a, b = a.ravel(), b.ravel()
        atol = self.tolerance.of(self.topic, path)
        wide = (a.astype(np.float64), b.astype(np.float64))
        with np.errstate(invalid="ignore"):  # inf - inf
            gap = np.abs(wide[0] - wide[1])
            if atol:
                equal = (a == b) | (np.isnan(wide[0]) & np.isnan(wide[1])) | (gap <= atol)
            else:  # bit for bit: -0.0 differs from 0.0, and two nan are equal only when their bits are
                bits = [np.ascontiguousarray(x).view(np.uint8).reshape(a.size, -1) for x in (a, b)]
                equal = (bits[0] == bits[1]).all(axis=1)
        different = np.flatnonzero(~equal)
        if not different.size:
            return
        index, size = int(different[0]), float(np.max(gap[different]))
        x, y = a[index].item(), b[index].item()
        if scalar:
            yield path, (f"{path} is {x!r} and {y!r}", size)
        else:
            many = f"({different.size} of {a.size} entries differ)"
            yield path, (f"{path}[{index}] is {x!r} and {y!r} {many}", size)


def _matches(pattern: str, topic: str, path: str) -> bool:
    if pattern.startswith("/"):
        wanted, _, pattern = pattern.partition(":")
        if not fnmatch.fnmatchcase(topic, wanted):
            return False
    plain = pattern.replace("[]", "")
    # A field, or one inside it; brackets may be omitted.
    whole = fnmatch.translate(plain)[:-2] + r"(\..*)?\Z"
    return re.match(whole, path.replace("[]", "")) is not None
