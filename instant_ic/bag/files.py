"""Reading of bags as bytes with `rosbags`: rosbag2 folders (MCAP and SQLite), single ``.mcap`` and ``.db3`` files."""

from __future__ import annotations

import heapq
import logging
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, ReaderError

from instant_ic.bag.bounded import guard_rosbags
from instant_ic.bag.latched import Repetitions
from instant_ic.bag.message import BagError, BagMessage, Schema
from instant_ic.bag.metadata import preset_of, schema_of, schema_or_unknown, store_of
from instant_ic.bag.upgrade import upgrade_of
from instant_ic.bus.qos import QoS
from instant_ic.msg import deserialize
from instant_ic.util.closing import Closing

guard_rosbags()
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TopicSummary:
    """A topic in a bag."""

    topic: str
    type_name: str
    count: int
    qos: QoS
    schema: Schema = field(repr=False)

    @property
    def problem(self) -> str:
        """Reason why our nodes cannot read the topic's messages; empty if they can."""
        own = schema_or_unknown(self.type_name)
        if not own.encoding and self.schema.encoding != "ros2msg":
            return "its type is unknown, and the bag has no definition of it"
        if own.encoding and self.schema.type_hash not in ("", own.type_hash) and upgrade_of(self.schema) is None:
            return "the bag defines its type differently"
        return ""


class BagReader(Closing):
    """Reader of a bag; a context manager.

    A recorder repeats latched values at the start of each file. They are returned once.

    Args:
        path: rosbag2 folder, ``.mcap`` or ``.db3`` file.

    Raises:
        BagError: there is no bag at the path, or the bag is truncated.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.exists():
            raise BagError(f"bag {path} does not exist")
        if path.suffix == ".bag":
            raise BagError(f"{path} is a ROS 1 bag; convert it first: rosbags-convert --src {path} --dst {path.stem}")
        self._reader: Any
        try:
            self._reader = Reader(path)
            self._reader.open()
        except FileNotFoundError:
            raise BagError(self._why_no_metadata()) from None
        except BagError:
            raise
        except Exception as error:  # noqa: BLE001 - a parser may raise anything on bytes that are not a bag
            why = error if isinstance(error, ReaderError | OSError) else f"{type(error).__name__}: {error}"
            raise BagError(f"bag {path} cannot be read: {why}; if it was cut: ic bag recover {path}") from None
        for connection in self._reader.connections:
            if not (isinstance(connection.topic, str) and isinstance(connection.msgtype, str)):
                self._reader.close()
                raise BagError(f"bag {path} is damaged: topic {connection.topic!r} has the type {connection.msgtype!r}")
        for file in self.unlisted:
            log.warning("%s is not in metadata.yaml: its recording was cut short. Run ic bag recover %s", file, path)

    def close(self) -> None:
        if self._reader.is_open:
            self._reader.close()

    @property
    def start_ns(self) -> int:
        """Stamp of the first message; 0 in an empty bag."""
        return int(self._reader.start_time) if self.count else 0

    @property
    def end_ns(self) -> int:
        """Stamp of the last message; 0 in an empty bag."""
        return int(self._reader.end_time) - 1 if self.count else 0

    @property
    def count(self) -> int:
        """Number of messages, including latched values repeated at the start of each file."""
        return int(self._reader.message_count)

    @property
    def custom(self) -> dict[str, str]:
        """Text that the recorder stored in the metadata."""
        metadata = getattr(self._reader.storage, "metadata", None)
        return dict(getattr(metadata, "custom", None) or {})

    @property
    def topics(self) -> list[TopicSummary]:
        """Topics of the bag, by name."""
        counts: Counter[tuple[str, str]] = Counter()
        first: dict[tuple[str, str], Connection] = {}
        for connection in self._reader.connections:
            key = (connection.topic, connection.msgtype)
            first.setdefault(key, connection)
            try:
                counts[key] += int(connection.msgcount)
            except (TypeError, ValueError, OverflowError):
                raise BagError(
                    f"{self.path}: metadata.yaml: message_count of {connection.topic} is {connection.msgcount!r}, "
                    "not a whole number; ic bag recover makes a new bag"
                ) from None
        return [TopicSummary(*key, counts[key], _qos(first[key]), schema_of(first[key])) for key in sorted(counts)]

    @property
    def files(self) -> list[Path]:
        """Message files, in order."""
        if self.path.is_file():
            return [self.path]
        return [Path(storage.path) for storage in self._storages]

    @property
    def compression(self) -> str:
        """Compression of the messages: ``zstd``, ``lz4`` or empty."""
        kinds = {str(self._reader.compression_format or "")}
        kinds |= {chunk.compression for storage in self._storages for chunk in getattr(storage, "chunks", ())}
        return ", ".join(sorted(kinds - {""}))

    @property
    def unlisted(self) -> list[Path]:
        """Files in the folder that ``metadata.yaml`` does not list, such as the last file of a killed recorder."""
        if self.path.is_file():
            return []
        listed = {file.name for file in self.files}
        return sorted(file for file in self.path.glob("*.mcap") if file.name not in listed)

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
        current: bool = False,
    ) -> Iterator[BagMessage]:
        """Yield the messages in stamp order.

        Args:
            topics: topics to read; default all.
            start_ns: first stamp, inclusive.
            stop_ns: last stamp, exclusive.
            current: convert messages of older definitions to the present one (``upgrade.py``).

        Raises:
            BagError: a file is damaged.
        """
        connections = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if not connections:
            return
        for connection in connections:
            encoding = getattr(connection.ext, "serialization_format", "cdr")
            if encoding != "cdr" and connection.msgcount:
                raise BagError(
                    f"bag {self.path}, topic {connection.topic}: the messages are {encoding!r}, not CDR. Choose other "
                    f"topics, or copy the CDR topics into a new bag: ic bag recover {self.path}"
                )
        presets = {(c.topic, c.msgtype): _qos(c) for c in connections}
        upgrades = (
            {(topic.topic, topic.type_name): upgrade_of(topic.schema) for topic in self.topics} if current else {}
        )
        try:
            repetitions = Repetitions(int(storage.metadata.start_time) for storage in self._storages[1:])
            with closing(self._raw(connections, start_ns, stop_ns)) as raw:
                for connection, stamp_ns, payload in raw:
                    key = (connection.topic, connection.msgtype)
                    upgrade = upgrades.get(key)
                    message = BagMessage(*key, payload if upgrade is None else upgrade(payload), stamp_ns, presets[key])
                    if not repetitions.repeats(message):
                        yield message
        except Exception as error:  # noqa: BLE001 - a parser or decompressor may raise anything on damaged bytes
            raise BagError(f"bag {self.path} is damaged: {error}; try ic bag recover {self.path}") from None

    def decoder(self, topic: TopicSummary) -> Callable[[bytes], Any]:
        """Return a function that decodes a topic's bytes by our type, or by the bag's definition if the two differ.

        Raises:
            BagError: the type is unknown.
        """
        own = schema_or_unknown(topic.type_name)
        if own.encoding and topic.schema.type_hash in ("", own.type_hash):
            return lambda payload: deserialize(payload, topic.type_name)
        if topic.schema.encoding != "ros2msg":
            raise BagError(f"bag {self.path}, topic {topic.topic}: type {topic.type_name} is unknown")
        store = store_of(topic.schema)
        return lambda payload: store.deserialize_cdr(payload, topic.type_name)

    # -- internals -------------------------------------------------------------------------------

    @property
    def _storages(self) -> list[Any]:
        return list(getattr(self._reader.storage, "storages", [self._reader.storage]))

    def _raw(
        self, connections: list[Connection], start_ns: int | None, stop_ns: int | None
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        if self._reader.compression_mode == "message":
            yield from self._reader.messages(connections, start_ns, stop_ns)
            return
        # Merge by stamp: files are out of stamp order if a clock was set back or files overlap.
        wanted = {(c.topic, c.msgtype) for c in connections}
        chosen = [(s, [c for c in s.connections if (c.topic, c.msgtype) in wanted]) for s in self._storages]
        streams = [storage.messages(its, start_ns, stop_ns) for storage, its in chosen if its]
        yield from heapq.merge(*streams, key=lambda entry: entry[1])

    def _why_no_metadata(self) -> str:
        if any(self.path.glob("*.mcap")):
            return (
                f"{self.path} has no metadata.yaml: the recording was interrupted, or the file was lost. Run "
                f"ic bag recover {self.path}"
            )
        return f"{self.path} has no metadata.yaml and no MCAP files: it is not a bag"


def _qos(connection: Connection) -> QoS:
    return preset_of(connection.ext.offered_qos_profiles)  # type: ignore[union-attr]
