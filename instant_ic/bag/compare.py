"""Compares two bags: topics, counts, stamps, bytes; and names the first field that differs."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.bag.files import BagMessage, BagReader
from instant_ic.msg import deserialize


@dataclass(frozen=True)
class TopicDifference:
    """One topic of two bags.

    Attributes:
        topic: its name.
        count_a: messages in the first bag.
        count_b: messages in the second bag.
        first: in words, the first difference; empty where the topic is the same in both.
    """

    topic: str
    count_a: int
    count_b: int
    first: str

    @property
    def same(self) -> bool:
        """Whether both bags hold the same messages of the topic, bit for bit."""
        return not self.first


def compare(a: Path, b: Path, ignore: tuple[str, ...] = (), common: bool = False) -> list[TopicDifference]:
    """Every topic of two bags, by name.

    Args:
        a: first bag.
        b: second bag.
        ignore: topics to leave out.
        common: only topics that both bags have.

    Raises:
        BagError: one of them cannot be read.
    """
    with BagReader(a) as one, BagReader(b) as two:
        names = [{t.topic for t in reader.topics} for reader in (one, two)]
        topics = (names[0] & names[1] if common else names[0] | names[1]) - set(ignore)
        return [_compare_topic(topic, one, two) for topic in sorted(topics)]


def digest(bag: Path) -> str:
    """SHA-256 over topics, types, stamps and bytes of all messages, in the order of the bag."""
    total = hashlib.sha256()
    with BagReader(bag) as reader:
        for message in reader.messages():
            total.update(f"{message.topic} {message.type_name} {message.stamp_ns} {len(message.payload)}\n".encode())
            total.update(message.payload)
    return total.hexdigest()


def _compare_topic(topic: str, one: BagReader, two: BagReader) -> TopicDifference:
    counts = [0, 0]
    first = ""
    types = [{t.type_name for t in reader.topics if t.topic == topic} for reader in (one, two)]
    if all(types) and types[0] != types[1]:
        first = f"types {', '.join(sorted(types[0]))} and {', '.join(sorted(types[1]))}"
    pair: list[Iterator[BagMessage]] = [reader.messages({topic}) for reader in (one, two)]
    while True:
        left, right = next(pair[0], None), next(pair[1], None)
        if left is None and right is None:
            break
        counts[0] += left is not None
        counts[1] += right is not None
        if first or left is None or right is None:
            continue
        if left.stamp_ns != right.stamp_ns:
            first = f"message {counts[0]}: stamps differ by {(right.stamp_ns - left.stamp_ns) / 1e9:+.9f} s"
        elif left.payload != right.payload:
            first = f"message {counts[0]}: {_first_field(left, right)}"
    if not first and counts[0] != counts[1]:
        first = f"{counts[0]} and {counts[1]} messages"
    return TopicDifference(topic, counts[0], counts[1], first)


def _first_field(left: BagMessage, right: BagMessage) -> str:
    found = _difference(deserialize(left.payload, left.type_name), deserialize(right.payload, right.type_name), "")
    return found or "bytes differ, yet no field does (padding)"


def _difference(a: Any, b: Any, path: str) -> str:
    """In words, the first field in which two values differ; empty where none does."""
    if dataclasses.is_dataclass(a) and not isinstance(a, type):
        for item in dataclasses.fields(a):
            if item.name.startswith("__"):
                continue
            inner = f"{path}.{item.name}" if path else item.name
            if found := _difference(getattr(a, item.name), getattr(b, item.name), inner):
                return found
        return ""
    if isinstance(a, np.ndarray):
        return _array_difference(a, b, path)
    if isinstance(a, list):
        if len(a) != len(b):
            return f"{path} has {len(a)} and {len(b)} entries"
        for index, (x, y) in enumerate(zip(a, b, strict=True)):
            if found := _difference(x, y, f"{path}[{index}]"):
                return found
        return ""
    same = a == b or (isinstance(a, float) and np.isnan(a) and np.isnan(b))
    return "" if same else f"{path} is {a!r} and {b!r}"


def _array_difference(a: np.ndarray, b: np.ndarray, path: str) -> str:
    if a.shape != b.shape:
        return f"{path} has {a.size} and {b.size} entries"
    unequal = np.flatnonzero(a.view(np.uint8).reshape(a.size, -1) != b.view(np.uint8).reshape(b.size, -1))
    if not unequal.size:
        return ""
    different = np.unique(unequal // a.itemsize)
    index = int(different[0])
    return f"{path}[{index}] is {a.flat[index]!r} and {b.flat[index]!r} ({different.size} of {a.size} entries differ)"
