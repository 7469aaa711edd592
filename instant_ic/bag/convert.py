"""Converts bags into one of ours: reads ROS 1 and SQLite bags and bare files; filters, cuts, merges, splits."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
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
    """What to copy, and how to write it.

    Attributes:
        choice: topics to copy, by their names in the source.
        start_s: skip this many seconds from the start of the earliest bag; latched values from that part are kept.
        end_s: stop this many seconds after that start; 0 copies everything.
        remap: topic → new name.
        skip_unknown: skip topics of unknown type instead of failing.
        compressed: compress with zstd.
        max_bytes: file size at which a new file starts; 0 writes one file.
        max_duration_s: duration in seconds after which a new file starts; 0 writes one file.
    """

    choice: TopicChoice = EVERYTHING
    start_s: float = 0.0
    end_s: float = 0.0
    remap: Mapping[str, str] = field(default_factory=dict)
    skip_unknown: bool = False
    compressed: bool = False
    max_bytes: int = 0
    max_duration_s: float = 0.0


@dataclass
class Converted:
    """Result of a conversion: messages by (new) topic, files, and skipped types with their topics."""

    counts: Counter[str] = field(default_factory=Counter)
    files: int = 0
    skipped: dict[str, list[str]] = field(default_factory=dict)


def convert(
    sources: Sequence[Path],
    target: Path,
    options: ConvertOptions | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Converted:
    """Write the messages of one or more bags into a new bag, in stamp order.

    Args:
        sources: anything that :class:`BagReader` opens.
        target: folder of the new bag, which must not exist.
        on_progress: called with the completed share, 0 to 1.

    Raises:
        BagError: a bag cannot be read or written, no topic was selected, or a type is unknown.
    """
    options = options or ConvertOptions()
    result = Converted()
    with ExitStack() as stack:
        readers = [stack.enter_context(BagReader(source)) for source in sources]
        filled = [reader for reader in readers if reader.count]
        if not filled:
            raise BagError(f"{', '.join(map(str, sources))}: no messages to convert")
        begin_ns = min(reader.start_ns for reader in filled)
        last_ns = max(reader.end_ns for reader in filled)
        start_ns = begin_ns + int(options.start_s * 1e9)
        stop_ns = begin_ns + int(options.end_s * 1e9) if options.end_s else last_ns + 1
        chosen = [_chosen(reader, options, result) for reader in filled]
        if not any(chosen):
            raise BagError("none of the selected topics is in it")
        writer = stack.enter_context(BagWriter(target, options.compressed, options.max_bytes, options.max_duration_s))
        for reader in filled:
            for key, value in reader.custom.items():
                if key != REPEATED:
                    writer.set_custom(key, value)
        writer.set_custom("converted_from", ", ".join(source.name for source in sources))

        def write(message: BagMessage, topic: TopicSummary, stamp_ns: int) -> None:
            name = options.remap.get(message.topic, message.topic)
            writer.write(name, message.type_name, message.payload, stamp_ns, topic.qos, topic.schema)
            result.counts[name] += 1

        for topic in (topic for topics in chosen for topic in topics.values()):
            writer.add_topic(options.remap.get(topic.topic, topic.topic), topic.type_name, topic.qos, topic.schema)
        if start_ns > begin_ns:
            for reader, topics in zip(filled, chosen, strict=True):
                for held in _latched(reader, topics, start_ns):
                    write(held, topics[held.topic, held.type_name], start_ns)
        streams = [
            ((m.stamp_ns, number, m) for m in reader.messages({t[0] for t in topics}, start_ns, stop_ns))
            for number, (reader, topics) in enumerate(zip(filled, chosen, strict=True))
        ]
        span_ns = max(1, min(stop_ns, last_ns) - start_ns)
        for stamp_ns, number, message in heapq.merge(*streams, key=lambda entry: entry[0]):
            if (summary := chosen[number].get((message.topic, message.type_name))) is None:
                continue
            write(message, summary, stamp_ns)
            if on_progress is not None:
                on_progress(min(1.0, (stamp_ns - start_ns) / span_ns))
        result.files = writer.parts
    return result


def _chosen(reader: BagReader, options: ConvertOptions, result: Converted) -> dict[tuple[str, str], TopicSummary]:
    wanted = [topic for topic in reader.topics if options.choice.takes(topic.topic)]
    unknown = [topic for topic in wanted if not topic.schema.encoding]
    if unknown and not options.skip_unknown:
        named = ", ".join(f"{topic.type_name} ({topic.topic})" for topic in unknown)
        raise BagError(
            f"bag {reader.path} has no definition of {named}, and the type is unknown; use --skip-unknown to skip it"
        )
    for topic in unknown:
        result.skipped.setdefault(topic.type_name, []).append(topic.topic)
    return {(topic.topic, topic.type_name): topic for topic in wanted if topic.schema.encoding}


def _latched(reader: BagReader, topics: dict[tuple[str, str], TopicSummary], start_ns: int) -> list[BagMessage]:
    """The latched values valid at the start of the selected span."""
    values = LatchedValues()
    latched = {topic.topic for topic in topics.values() if topic.qos.latched}
    for message in reader.messages(latched, None, start_ns) if latched else ():
        if (message.topic, message.type_name) in topics:
            values.put(message)
    return values.values()
