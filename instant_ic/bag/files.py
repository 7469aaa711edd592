"""rosbag2 folders: serialized messages in and out, never decoded.

The format is the work of `rosbags`; here are our QoS presets, words for what can go wrong, and a writer that loses at
most a second when its process is killed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import (
    CompressionFormat,
    CompressionMode,
    Reader,
    ReaderError,
    StoragePlugin,
    Writer,
    WriterError,
)

from instant_ic.bus.qos import LATCHED, RELIABLE, SENSOR, QoS
from instant_ic.msg import MessageError, message_type, typestore

# What DDS writes for "no limit".
_FOREVER = QosTime(2147483647, 4294967295)


class BagError(RuntimeError):
    """A bag that cannot be written or read; the message says why and what to do."""


@dataclass(frozen=True)
class BagMessage:
    """A message as it stands in a bag.

    Attributes:
        topic: name of the topic.
        type_name: for example ``sensor_msgs/msg/Image``.
        payload: CDR bytes.
        stamp_ns: when it was published, nanoseconds since the epoch.
        qos: the preset that comes closest to what its publisher offered.
    """

    topic: str
    type_name: str
    payload: bytes
    stamp_ns: int
    qos: QoS


@dataclass(frozen=True)
class TopicSummary:
    """A topic in a bag."""

    topic: str
    type_name: str
    count: int
    qos: QoS


class BagWriter:
    """Writes a bag folder; a context manager.

    Args:
        path: the folder, which must not exist yet.
        compressed: chunks are compressed by zstd, for bags to keep or send: half the size for point packets.

    Raises:
        BagError: it exists, or cannot be made.
    """

    def __init__(self, path: Path, compressed: bool = False) -> None:
        self.path = path
        self.count = 0
        self.bytes = 0
        self._connections: dict[tuple[str, str], Connection] = {}
        try:
            self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
            if compressed:
                self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except (WriterError, OSError) as error:
            raise BagError(f"bag {path} cannot be made: {error}") from None

    def __enter__(self) -> BagWriter:
        """The writer itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the bag properly, also when something else went wrong: half a recording is worth having."""
        self.close()

    def write(self, topic: str, type_name: str, payload: bytes | memoryview, stamp_ns: int, qos: QoS = SENSOR) -> None:
        """Appends one message.

        Args:
            topic: its topic.
            type_name: its type; known to ROS 2 Jazzy or one of ours.
            payload: CDR bytes.
            stamp_ns: nanoseconds since the epoch.
            qos: told with the topic, the first time that it comes.

        Raises:
            BagError: unknown type, or the disk is full.
        """
        try:
            connection = self._connections.get((topic, type_name)) or self._connect(topic, type_name, qos)
            self._writer.write(connection, stamp_ns, payload)
        except (WriterError, OSError) as error:
            raise BagError(f"bag {self.path}, topic {topic}: {error}") from error
        self.count += 1
        self.bytes += len(payload)

    def add_topic(self, topic: str, type_name: str, qos: QoS) -> None:
        """Notes a topic that may never carry a message.

        Raises:
            BagError: unknown type.
        """
        if (topic, type_name) not in self._connections:
            self._connect(topic, type_name, qos)

    def set_custom(self, key: str, value: str) -> None:
        """Puts text into the metadata (``custom_data``)."""
        self._writer.set_custom_data(key, value)

    def flush(self) -> None:
        """Hands to the system what has come so far: from here on it survives the end of this process."""
        storage: Any = self._writer.storage
        if storage is None:
            return
        if storage.chunk.msgs:
            storage.close_chunk()
        storage.bio.flush()

    def close(self) -> None:
        """Writes index and metadata; twice does no harm.

        Raises:
            BagError: the disk is full.
        """
        if self._writer.storage is None:
            return
        try:
            self._writer.close()
        except OSError as error:
            with suppress(OSError):
                self._writer.abort()
            raise BagError(f"bag {self.path} cannot be completed: {error}; try ic bag recover") from error

    def _connect(self, topic: str, type_name: str, qos: QoS) -> Connection:
        try:
            message_type(type_name)
        except MessageError as error:
            raise BagError(f"bag {self.path}, topic {topic}: {error}") from None
        connection = self._writer.add_connection(
            topic, type_name, typestore=typestore(), offered_qos_profiles=[ros_qos(qos)]
        )
        self._connections[topic, type_name] = connection
        return connection


class BagReader:
    """Reads a bag folder, or a bare ``.mcap`` file; a context manager.

    Args:
        path: folder or file.

    Raises:
        BagError: no bag there, or one that was cut short.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.exists():
            raise BagError(f"bag {path} does not exist")
        try:
            self._reader = Reader(path)
            self._reader.open()
        except FileNotFoundError:
            hint = f": ic bag recover {path}" if any(path.glob("*.mcap")) else ""
            raise BagError(f"{path} has no metadata.yaml, so it is no bag or was cut short{hint}") from None
        except (ReaderError, OSError) as error:
            raise BagError(f"bag {path} cannot be read: {error}; if it was cut: ic bag recover {path}") from None

    def __enter__(self) -> BagReader:
        """The reader itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the files."""
        self.close()

    def close(self) -> None:
        """Closes the files; twice does no harm."""
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
        """Messages in the bag."""
        return int(self._reader.message_count)

    @property
    def custom(self) -> dict[str, str]:
        """Text that the recorder put into the metadata."""
        return dict(self._reader.storage.metadata.custom or {})

    @property
    def topics(self) -> list[TopicSummary]:
        """Its topics, by name."""
        return sorted(
            (
                TopicSummary(c.topic, c.msgtype, int(c.msgcount), preset_of(c.ext.offered_qos_profiles))  # type: ignore[union-attr]
                for c in self._reader.connections
            ),
            key=lambda summary: (summary.topic, summary.type_name),
        )

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[BagMessage]:
        """Messages in the order of their stamps.

        Args:
            topics: only these; default all.
            start_ns: from this stamp on.
            stop_ns: before this stamp.

        Raises:
            BagError: a damaged file.
        """
        connections = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if not connections:
            return
        presets = {c.id: preset_of(c.ext.offered_qos_profiles) for c in connections}  # type: ignore[union-attr]
        try:
            for connection, stamp_ns, payload in self._reader.messages(connections, start_ns, stop_ns):
                yield BagMessage(connection.topic, connection.msgtype, payload, stamp_ns, presets[connection.id])
        except ReaderError as error:
            raise BagError(f"bag {self.path} is damaged: {error}; try ic bag recover {self.path}") from None


def ros_qos(qos: QoS) -> Qos:
    """ROS 2's profile for one of our presets."""
    return Qos(
        QosHistory.KEEP_LAST,
        qos.depth,
        QosReliability.RELIABLE if qos.reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if qos.latched else QosDurability.VOLATILE,
        _FOREVER,
        _FOREVER,
        QosLiveliness.AUTOMATIC,
        _FOREVER,
        False,
    )


def preset_of(profiles: Collection[Qos]) -> QoS:
    """Our preset that comes closest to what a bag's topic was offered with; ``reliable`` where it does not say."""
    profile = next(iter(profiles), None)
    if profile is None:
        return RELIABLE
    if profile.durability is QosDurability.TRANSIENT_LOCAL:
        return LATCHED
    return SENSOR if profile.reliability is QosReliability.BEST_EFFORT else RELIABLE
