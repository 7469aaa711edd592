"""Makes a readable bag out of one that was cut short (power loss, full disk, killed recorder)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from instant_ic.bag.files import BagError, BagWriter, preset_of


@dataclass(frozen=True)
class Recovered:
    """What came out: messages written, and what stopped the reading (empty when the file was whole)."""

    count: int
    stopped_by: str


def recover(source: Path, target: Path) -> Recovered:
    """Copies every message before the cut into a new bag.

    Args:
        source: bag folder or ``.mcap`` file.
        target: folder of the new bag, which must not exist.

    Raises:
        BagError: nothing to read, or the target cannot be written.
    """
    files = sorted(source.glob("*.mcap")) if source.is_dir() else [source]
    if not files or not files[0].is_file():
        raise BagError(f"{source}: there is no .mcap file")
    stopped_by = ""
    # Sorted only within its chunks, which a recorder may overlap by a little: readers sort by the new index.
    with BagWriter(target) as writer:
        for file in files:
            tail = _Tail()
            for schema, channel, message in _records(file, tail):
                qos = preset_of(_profiles(channel.metadata))
                writer.write(channel.topic, schema.name, message.data, message.log_time, qos)
            stopped_by = stopped_by or tail.why
        if writer.count == 0:
            raise BagError(f"{source}: no message could be recovered ({stopped_by or 'the file holds none'})")
        writer.set_custom("recovered_from", source.name)
        return Recovered(writer.count, stopped_by)


@dataclass
class _Tail:
    why: str = ""


def _records(file: Path, tail: _Tail) -> Iterator[tuple[Any, Any, Any]]:
    from mcap.exceptions import McapError
    from mcap.reader import NonSeekingReader

    try:
        with file.open("rb") as stream:
            yield from NonSeekingReader(stream).iter_messages(log_time_order=False)
    except (McapError, EOFError, ValueError, IndexError) as error:
        tail.why = f"{file.name}: {type(error).__name__}: {error}"
    except Exception as error:  # noqa: BLE001 - struct.error and friends of a parser on cut bytes; told to the user
        tail.why = f"{file.name}: {type(error).__name__}: {error}"


def _profiles(metadata: dict[str, str]) -> list[Any]:
    from rosbags.rosbag2.metadata import parse_qos

    return parse_qos(metadata.get("offered_qos_profiles", ""))
