"""Makes a readable bag of one that was cut short (power loss, full disk, killed recorder), or writes its index anew."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from mcap.reader import make_reader
from rosbags.rosbag2.storage_mcap import McapReader

from instant_ic.bag.errors import BagError
from instant_ic.bag.mcap_scan import McapScan
from instant_ic.bag.mcap_writer import Schema
from instant_ic.bag.metadata import PartInfo, Topic, preset_of, preset_of_text, schema_of, with_hash, write_metadata
from instant_ic.bag.writer import CUSTOM_RECORD, BagWriter
from instant_ic.bus.qos import QoS


@dataclass(frozen=True)
class Recovered:
    """What came out.

    Attributes:
        count: messages written.
        stopped_by: what stopped the reading, in words; empty when every file was whole.
        damaged: chunks that were left out, in words.
        skipped: topic → why its messages were left out: they are no CDR.
    """

    count: int
    stopped_by: str
    damaged: list[str]
    skipped: dict[str, str]


def recover(source: Path, target: Path, compressed: bool = False) -> Recovered:
    """Copies every message that can be read into a new bag: all whole chunks, and of a cut one the whole messages.

    Args:
        source: bag folder or ``.mcap`` file.
        target: folder of the new bag, which must not exist.
        compressed: compress the new one.

    Raises:
        BagError: nothing to read, or the target cannot be written.
    """
    files = mcap_files(source)
    stopped_by: list[str] = []
    damaged: list[str] = []
    skipped: dict[str, str] = {}
    # Sorted only within its chunks, which a recorder may overlap by a little: readers sort by the new index.
    with BagWriter(target, compressed) as writer:
        for number, file in enumerate(files):
            scan = McapScan(file)
            for message in scan.messages():
                if message.encoding != "cdr":
                    skipped[message.topic] = f"encoding {message.encoding!r}"
                elif not message.repeated:  # the writer repeats by itself
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
        raise BagError(f"{source}: no message could be recovered ({why or '; '.join(damaged) or 'it holds none'})")
    return Recovered(count, why, damaged, skipped)


def reindex(folder: Path) -> tuple[int, int]:
    """Writes ``metadata.yaml`` of a folder anew from what its MCAP files tell of themselves.

    Returns:
        Files and messages.

    Raises:
        BagError: no MCAP files in it, or one that was cut: that is for :func:`recover`.
    """
    if not folder.is_dir():
        raise BagError(f"{folder} is no folder; a single file needs no index beside it")
    parts: list[PartInfo] = []
    topics: dict[Topic, tuple[QoS, Schema]] = {}
    custom: dict[str, str] = {}
    for file in mcap_files(folder):
        try:
            parts.append(_part(file, topics, custom))
        except Exception as error:  # noqa: BLE001 - whatever a parser raises on bytes that are no bag
            raise BagError(f"{file} is not whole: {error}; ic bag recover {folder}") from None
    try:
        write_metadata(folder, parts, topics, custom)
    except OSError as error:
        raise BagError(f"{folder}/metadata.yaml cannot be written: {error.strerror}") from None
    return len(parts), sum(part.count - sum(part.repeated.values()) for part in parts)


def _part(file: Path, topics: dict[Topic, tuple[QoS, Schema]], custom: dict[str, str]) -> PartInfo:
    """What a file tells of itself; its topics and custom data go into those given."""
    part = PartInfo(file.name)
    reader = McapReader(file)
    reader.open()
    try:
        for connection in reader.connections:
            key = (connection.topic, connection.msgtype)
            part.counts[key] = part.counts.get(key, 0) + connection.msgcount
            qos = preset_of(connection.ext.offered_qos_profiles)  # type: ignore[union-attr]
            topics.setdefault(key, (qos, schema_of(connection)))
        if reader.metadata.message_count:
            part.start_ns, part.end_ns = reader.metadata.start_time, reader.metadata.end_time - 1
    finally:
        reader.close()
    for message in McapScan(file).messages():
        if not message.repeated:  # those that are stand first
            break
        part.repeated[message.topic] = part.repeated.get(message.topic, 0) + 1
        part.repeated_ns = message.stamp_ns
    with file.open("rb") as stream:
        records = {record.name: record.metadata for record in make_reader(stream).iter_metadata()}
    custom.update(records.get(CUSTOM_RECORD, {}))
    return part


def mcap_files(source: Path) -> list[Path]:
    """The MCAP files of a bag in the order of their numbers; a file alone.

    Raises:
        BagError: there is none.
    """
    files = sorted(source.glob("*.mcap"), key=_number) if source.is_dir() else [source]
    if not files or not files[0].is_file():
        raise BagError(f"{source}: there is no .mcap file")
    return files


def _number(file: Path) -> tuple[int, str]:
    found = re.search(r"_(\d+)$", file.stem)
    return (int(found[1]) if found else -1, file.name)
