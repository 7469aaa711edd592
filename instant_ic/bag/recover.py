"""Recovers truncated bags (power loss, full disk, killed recorder) and rebuilds ``metadata.yaml``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from instant_ic.bag.errors import BagError
from instant_ic.bag.mcap_scan import McapScan
from instant_ic.bag.mcap_writer import Schema
from instant_ic.bag.metadata import PartInfo, Topic, preset_of_text, with_hash, write_metadata
from instant_ic.bag.writer import CUSTOM_RECORD, BagWriter
from instant_ic.bus.qos import QoS


@dataclass(frozen=True)
class Recovered:
    """Result of a recovery.

    Attributes:
        stopped_by: reason why reading stopped early; empty when every file was complete.
        damaged: descriptions of skipped chunks.
        skipped: topic → why its messages were skipped: they are not CDR.
    """

    count: int
    stopped_by: str
    damaged: list[str]
    skipped: dict[str, str]


def recover(source: Path, target: Path) -> Recovered:
    """Copy every readable message into a new bag: all complete chunks, and the complete messages of a truncated chunk.

    Args:
        source: bag folder or ``.mcap`` file.
        target: folder of the new bag, which must not exist.

    Raises:
        BagError: nothing can be read, or the target cannot be written.
    """
    files = mcap_files(source)
    stopped_by: list[str] = []
    damaged: list[str] = []
    skipped: dict[str, str] = {}
    # Sorted only within chunks, and chunks of a recorder may overlap slightly: readers sort by the new index.
    with BagWriter(target) as writer:
        for number, file in enumerate(files):
            scan = McapScan(file)
            for message in scan.messages():
                if message.encoding != "cdr":
                    skipped[message.topic] = f"encoding {message.encoding!r}"
                elif not message.repeated:  # the writer adds its own repetitions
                    qos = preset_of_text(message.metadata.get("offered_qos_profiles", ""))
                    schema = with_hash(message.schema)
                    writer.write(message.topic, schema.name, message.payload, message.stamp_ns, qos, schema)
            for key, value in scan.metadata.get(CUSTOM_RECORD, {}).items():
                writer.set_custom(key, value)
            damaged += [f"{file.name}, {words}" for words in scan.damaged]
            stopped_by += [scan.stopped_by] if scan.stopped_by else []
            if number < len(files) - 1:
                writer.end_part()
        count = writer.count
        writer.set_custom("recovered_from", source.name)
    why = "; ".join(stopped_by)
    if count == 0:
        for left in (*target.glob("*.mcap"), *target.glob("*.yaml")):
            left.unlink()
        target.rmdir()
        raise BagError(f"{source}: no message could be recovered ({why or '; '.join(damaged) or 'it contains none'})")
    return Recovered(count, why, damaged, skipped)


def reindex(folder: Path) -> tuple[int, int]:
    """Rebuild ``metadata.yaml`` of a folder from its MCAP files.

    Returns:
        Number of files and of messages.

    Raises:
        BagError: the folder has no MCAP files, or one is truncated (use :func:`recover`).
    """
    if not folder.is_dir():
        raise BagError(f"{folder} is not a folder; a single file needs no metadata.yaml")
    parts: list[PartInfo] = []
    topics: dict[Topic, tuple[QoS, Schema]] = {}
    custom: dict[str, str] = {}
    for file in mcap_files(folder):
        try:
            parts.append(_part(file, topics, custom))
        except ValueError as error:
            raise BagError(f"{file} is incomplete: {error}; ic bag recover {folder}") from None
    try:
        write_metadata(folder, parts, topics, custom)
    except OSError as error:
        raise BagError(f"{folder}/metadata.yaml cannot be written: {error.strerror}") from None
    return len(parts), sum(part.count - sum(part.repeated.values()) for part in parts)


def _part(file: Path, topics: dict[Topic, tuple[QoS, Schema]], custom: dict[str, str]) -> PartInfo:
    """Summarise one file; its topics and custom data are added to ``topics`` and ``custom``.

    Raises:
        ValueError: it is truncated or damaged.
    """
    part, scan = PartInfo(file.name), McapScan(file)
    stamps: list[int] = []
    for message in scan.messages():
        topic = (message.topic, message.schema.name)
        part.counts[topic] = part.counts.get(topic, 0) + 1
        stamps.append(message.stamp_ns)
        if message.repeated:
            part.repeated[message.topic] = part.repeated.get(message.topic, 0) + 1
            part.repeated_ns = message.stamp_ns
    if problem := scan.stopped_by or "; ".join(scan.damaged):
        raise ValueError(problem)
    for channel in scan.channels.values():
        schema = with_hash(scan.schema_of(channel))
        qos = preset_of_text(channel.metadata.get("offered_qos_profiles", ""))
        topics.setdefault((channel.topic, schema.name), (qos, schema))
    if stamps:
        part.start_ns, part.end_ns = min(stamps), max(stamps)
    custom.update(scan.metadata.get(CUSTOM_RECORD, {}))
    return part


def mcap_files(source: Path) -> list[Path]:
    """Return the MCAP files of a bag in numeric order, or the file itself.

    Raises:
        BagError: there is none.
    """
    files = sorted(source.glob("*.mcap"), key=_number) if source.is_dir() else [source]
    if not files or not files[0].is_file():
        raise BagError(f"{source}: no .mcap file found")
    return files


def _number(file: Path) -> tuple[int, str]:
    found = re.search(r"_(\d+)$", file.stem)
    return (int(found[1]) if found else -1, file.name)
