"""Recovery of truncated bags, as left by a power loss, a full disk or a killed recorder."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from instant_ic.bag.latched import Repetitions
from instant_ic.bag.mcap_scan import McapScan
from instant_ic.bag.message import BagError, BagMessage
from instant_ic.bag.metadata import preset_of_text, with_hash
from instant_ic.bag.writer import CUSTOM_RECORD, BagWriter


@dataclass(frozen=True)
class Recovered:
    """Result of a recovery.

    Attributes:
        stopped_by: reason why reading stopped early; empty if every file was complete.
        damaged: descriptions of skipped chunks.
        skipped: topic → encoding of its messages, which were skipped because they are not CDR.
    """

    count: int
    stopped_by: str
    damaged: list[str]
    skipped: dict[str, str]


def recover(source: Path, target: Path) -> Recovered:
    """Copy every readable message into a new bag, including the complete messages of a truncated chunk.

    Args:
        source: bag folder or ``.mcap`` file.
        target: folder of the new bag, which must not exist.

    Raises:
        BagError: no message can be read, or the target cannot be written.
    """
    files = mcap_files(source)
    stopped_by: list[str] = []
    damaged: list[str] = []
    skipped: dict[str, str] = {}
    repetitions = Repetitions()
    count = 0
    # Messages are sorted within chunks, but a recorder's chunks may overlap slightly. Readers sort by the new index.
    with BagWriter(target) as writer:
        for number, file in enumerate(files):
            scan = McapScan(file)
            for position, found in enumerate(scan.messages()):
                channel, schema = found.channel, with_hash(found.schema)
                if channel.message_encoding != "cdr":
                    skipped[channel.topic] = f"encoding {channel.message_encoding!r}"
                    continue
                if number and not position:
                    repetitions.starts_ns.add(found.stamp_ns)
                qos = preset_of_text(channel.metadata.get("offered_qos_profiles", ""))
                message = BagMessage(channel.topic, schema.name, found.payload, found.stamp_ns, qos)
                if not repetitions.repeats(message):  # the writer repeats latched values itself
                    writer.write(message.topic, message.type_name, message.payload, message.stamp_ns, qos, schema)
                    count += 1
            for key, value in scan.metadata.get(CUSTOM_RECORD, {}).items():
                writer.set_custom(key, value)
            damaged += [f"{file.name}, {words}" for words in scan.damaged]
            stopped_by += [scan.stopped_by] if scan.stopped_by else []
            if number < len(files) - 1:
                writer.end_file()
        writer.set_custom("recovered_from", source.name)
    why = "; ".join(stopped_by)
    if count == 0:
        for left in (*target.glob("*.mcap"), *target.glob("*.yaml")):
            left.unlink()
        target.rmdir()
        raise BagError(f"{source}: no message could be recovered ({why or '; '.join(damaged) or 'it contains none'})")
    return Recovered(count, why, damaged, skipped)


def mcap_files(source: Path) -> list[Path]:
    """Return the MCAP files of a bag in numeric order, or the file itself.

    Raises:
        BagError: there is no MCAP file.
    """
    files = sorted(source.glob("*.mcap"), key=_number) if source.is_dir() else [source]
    if not files or not files[0].is_file():
        raise BagError(f"{source}: no .mcap file found")
    return files


def _number(file: Path) -> tuple[int, str]:
    found = re.search(r"_(\d+)$", file.stem)
    return (int(found[1]) if found else -1, file.name)
