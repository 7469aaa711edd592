"""Reads an MCAP file sequentially, without its index, as far as possible: complete, truncated or damaged."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode

from instant_ic.bag.mcap_records import MESSAGE_HEAD, Definitions, chunk_content, mapped, records_of
from instant_ic.bag.mcap_writer import LIBRARY, MAGIC, Schema

_MOST_DAMAGED = 1000
"""Damaged records that are listed; a hostile file may contain nothing else."""


@dataclass(frozen=True)
class ScannedMessage:
    """A message in an MCAP file.

    Attributes:
        encoding: encoding of the payload; ``cdr`` in ROS 2 bags.
        metadata: metadata of its topic, where rosbag2 stores the QoS.
        stamp_ns: log time.
        repeated: whether it repeats a latched value of an earlier file of the bag.
    """

    topic: str
    schema: Schema
    encoding: str
    metadata: dict[str, str]
    stamp_ns: int
    payload: bytes
    repeated: bool


class McapScan:
    """One pass over a file. The attributes are complete once :meth:`messages` is exhausted.

    Raises:
        BagError: the file cannot be opened, or is not an MCAP file.

    Attributes:
        whole: whether the end of the file is intact.
        stopped_by: reason why reading stopped before the end of the file; empty when it did not.
        damaged: descriptions of damaged chunks that were skipped.
        library: the writer that the header names.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.whole = False
        self.stopped_by = ""
        self.damaged: list[str] = []
        self._definitions = Definitions()
        self._data = mapped(path)

    @property
    def library(self) -> str:
        return self._definitions.library

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records, name → values; the last record of each name."""
        return self._definitions.metadata

    def messages(self) -> Iterator[ScannedMessage]:
        """Yield every readable message, in file order."""
        data = self._data
        for at, opcode, body, complete in records_of(data, len(MAGIC), len(data)):
            if not opcode:
                self._stop(at, "no valid record begins here")
                return
            if opcode == Opcode.CHUNK:
                yield from self._chunk(body, at, complete)
            elif opcode == Opcode.DATA_END:
                self.whole = complete and data[-len(MAGIC) :] == MAGIC
                if not self.whole:
                    self._stop(at, "the index after the messages is truncated")
                return
            elif complete:
                yield from self._record(opcode, body, f"record at byte {at}")
            if not complete:
                self._stop(at, "the file ends inside a record")
                return
        self._stop(len(data), "the file ends without an index")

    def _damage(self, text: str) -> None:
        if len(self.damaged) < _MOST_DAMAGED:
            self.damaged.append(text)

    def _stop(self, at: int, why: str) -> None:
        self.stopped_by = f"{self.path.name}, byte {at}: {why}"

    def _chunk(self, body: memoryview, at: int, complete: bool) -> Iterator[ScannedMessage]:
        try:
            _, content = chunk_content(body, complete)
        except ValueError as error:
            if complete:
                self._damage(f"chunk at byte {at}: {error}")
            return
        for _, opcode, record, record_complete in records_of(content, 0, len(content)):
            if not (opcode and record_complete):
                return
            yield from self._record(opcode, record, f"record in the chunk at byte {at}")

    def _record(self, opcode: int, body: memoryview, place: str) -> Iterator[ScannedMessage]:
        definitions = self._definitions
        try:
            if opcode != Opcode.MESSAGE:
                definitions.take(opcode, body)
                return
            number, _, stamp_ns, publish_ns = MESSAGE_HEAD.unpack_from(body)
            if number not in definitions.channels:
                raise ValueError(f"a message of unknown channel {number} (its definition was damaged)")
            channel = definitions.channels[number]
            schema = definitions.schema_of(channel)
        except (struct.error, ValueError) as error:  # UnicodeDecodeError is a ValueError
            self._damage(f"{place}: {error}")
            return
        repeated = self.library == LIBRARY and publish_ns != stamp_ns
        payload = bytes(body[MESSAGE_HEAD.size :])
        yield ScannedMessage(
            channel.topic, schema, channel.message_encoding, channel.metadata, stamp_ns, payload, repeated
        )
