"""Copies bags into one of ours: from SQLite and bare files, filtered, cut, merged."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from instant_ic.bag.choice import EVERYTHING, TopicChoice
from instant_ic.bag.errors import BagError
from instant_ic.bag.files import BagReader, TopicSummary
from instant_ic.bag.latched import LatchedValues
from instant_ic.bag.message import BagMessage
from instant_ic.bag.metadata import REPEATED
from instant_ic.bag.writer import BagWriter


@dataclass(frozen=True)
class ConvertOptions:
    """Selection of messages, and how to write them.

    Attributes:
        choice: topics to copy.
        start_s: skip this many seconds from the start of the earliest bag; latched values from that part are kept.
        end_s: stop this many seconds after that start; 0 copies everything.
        compressed: compress with zstd.
    """

    choice: TopicChoice = EVERYTHING
    start_s: float = 0.0
    end_s: float = 0.0
    compressed: bool = False


def convert(
    sources: Sequence[Path],
    target: Path,
    options: ConvertOptions | None = None,
    on_progress: Callable[[float], None] = lambda share: None,
) -> Counter[str]:
    """Write the messages of one or more bags into a new bag, in stamp order.

    Args:
        sources: bags that :class:`BagReader` opens.
        target: folder of the new bag, which must not exist.
        options: what to copy; default everything.
        on_progress: called with the completed share, 0 to 1.

    Returns:
        Messages by topic.

    Raises:
        BagError: a bag cannot be read or written, or no topic was selected.
    """
    options = options or ConvertOptions()
    counts: Counter[str] = Counter()
    with ExitStack() as stack:
        readers = [stack.enter_context(BagReader(source)) for source in sources]
        filled = [reader for reader in readers if reader.count]
        if not filled:
            raise BagError(f"{', '.join(map(str, sources))}: no messages to convert")
        begin_ns = min(reader.start_ns for reader in filled)
        last_ns = max(reader.end_ns for reader in filled)
        start_ns = begin_ns + int(options.start_s * 1e9)
        stop_ns = begin_ns + int(options.end_s * 1e9) if options.end_s else last_ns + 1
        chosen = [[topic for topic in reader.topics if options.choice.takes(topic.topic)] for reader in filled]
        if not any(chosen):
            raise BagError("none of the selected topics is in it")
        writer = stack.enter_context(BagWriter(target, options.compressed))
        writer.set_custom("converted_from", ", ".join(source.name for source in sources))
        for reader, topics in zip(filled, chosen, strict=True):
            _prepare(writer, reader, topics)
        streams = [
            _messages(reader, topics, start_ns if options.start_s else None, stop_ns)
            for reader, topics in zip(filled, chosen, strict=True)
        ]
        span_ns = max(1, min(stop_ns, last_ns) - start_ns)
        for message in heapq.merge(*streams, key=lambda message: message.stamp_ns):
            writer.write(message.topic, message.type_name, message.payload, message.stamp_ns)
            counts[message.topic] += 1
            on_progress(min(1.0, (message.stamp_ns - start_ns) / span_ns))
    return counts


def _prepare(writer: BagWriter, reader: BagReader, topics: Sequence[TopicSummary]) -> None:
    """Add the topics and the custom data of a bag."""
    for key, value in reader.custom.items():
        if key != REPEATED:
            writer.set_custom(key, value)
    for topic in topics:
        writer.add_topic(topic.topic, topic.type_name, topic.qos, topic.schema)


def _messages(
    reader: BagReader, topics: Sequence[TopicSummary], start_ns: int | None, stop_ns: int
) -> Iterator[BagMessage]:
    """Yield the selected messages, preceded by the latched values valid at ``start_ns``, with that stamp."""
    if start_ns is not None:
        values = LatchedValues()
        latched = {topic.topic for topic in topics if topic.qos.latched}
        for message in reader.messages(latched, None, start_ns) if latched else ():
            values.put(message)
        for value in values.values():
            yield replace(value, stamp_ns=start_ns)
    yield from reader.messages({topic.topic for topic in topics}, start_ns, stop_ns)
