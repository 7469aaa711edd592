"""Writing of rosbag2 folders with one or more MCAP files, each of which begins with the latched values."""

from __future__ import annotations

import errno
import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rosbags.rosbag2.metadata import dump_qos_v9

from instant_ic.bag.latched import LatchedValues
from instant_ic.bag.mcap_writer import Buffer, McapWriter
from instant_ic.bag.message import BagError, BagMessage, DiskFullError, Schema, Topic
from instant_ic.bag.metadata import Topics, ros_qos, schema_or_unknown
from instant_ic.bus.qos import SENSOR, QoS
from instant_ic.config.yaml_text import dump_yaml
from instant_ic.util.closing import Closing
from instant_ic.util.files import replacing
from instant_ic.util.private import make_folder, sync_folder

log = logging.getLogger(__name__)

_FULL = (errno.ENOSPC, errno.EDQUOT)

_NO_START = (1 << 63) - 1
"""Start of an empty bag, as rosbag2 writes it."""

CUSTOM_RECORD = "instant_ic"
"""Name of the metadata record that holds ``custom_data`` in a file while the bag is being written."""


class BagWriter(Closing):
    """Writer of a bag folder; a context manager; not thread-safe.

    Each completed file is listed in ``metadata.yaml`` immediately. A killed recorder leaves a readable bag and one file
    to recover.

    Args:
        path: the folder, which must not exist; only its owner can read it.
        compressed: compress chunks with zstd, for archiving or sending; halves the size of point packets.
        max_bytes: file size at which a new file starts; 0 sets no limit.
        max_duration_s: duration by message stamps after which a new file starts; 0 sets no limit.
        create: call :meth:`create` at once; otherwise the caller must call it before any other method.

    Raises:
        DiskFullError: in all methods: the disk is full. ``lost`` counts the lost messages, and the current file ends
            with its last complete chunk. The bag can be closed, or continued in another file once there is space.
        BagError: in all methods: the disk failed. Here also: the folder exists or cannot be created.
    """

    def __init__(
        self,
        path: Path,
        compressed: bool = False,
        max_bytes: int = 0,
        max_duration_s: float = 0.0,
        create: bool = True,
    ) -> None:
        self.path = path
        self.compressed = compressed
        self.max_bytes = max_bytes
        self.max_duration_ns = int(max_duration_s * 1e9)
        self.bytes = 0
        self.lost: Counter[str] = Counter()
        """Messages by topic that :meth:`write` accepted but that did not reach the disk; replaced, never changed."""
        self._topics: Topics = {}
        self._latched = LatchedValues()
        self._custom: dict[str, str] = {}
        self._done: list[McapWriter] = []
        self._file: McapWriter | None = None
        self._opened = 0  # number of files, including abandoned ones
        self._closed = False
        if create:
            self.create()

    def create(self) -> None:
        """Create the folder and the first file."""
        try:
            make_folder(self.path)
        except FileExistsError:
            raise BagError(f"bag {self.path} cannot be created: {self.path} already exists") from None
        except OSError as error:
            raise BagError(f"bag {self.path} cannot be created: {error.strerror or error}") from None
        self._file = self._open_file()

    @property
    def count(self) -> int:
        """Number of messages so far, including latched values repeated in later files."""
        written = sum(file.counts.total() for file in self._done)
        return written + (self._file.given.total() if self._file is not None else 0)

    @property
    def files(self) -> int:
        """Number of files so far."""
        return len(self._done) + (self._file is not None)

    def write(
        self,
        topic: str,
        type_name: str,
        payload: Buffer,
        stamp_ns: int,
        qos: QoS = SENSOR,
        schema: Schema | None = None,
        publisher: str = "",
    ) -> None:
        """Append one message.

        Args:
            topic: name of the topic.
            type_name: type of the topic.
            payload: CDR bytes; copied.
            stamp_ns: nanoseconds since the epoch.
            qos: QoS of the topic; used the first time that the topic appears.
            schema: definition of the type; default ours. If it is unknown, the bytes are still recorded.
            publisher: name of the publisher. Each publisher of a latched topic has its own current value.
        """
        if self._closed:
            raise BagError(f"bag {self.path} is closed")
        stamp_ns, key = max(0, stamp_ns), (topic, type_name)
        qos = self._add(key, qos, schema)
        try:
            file = self._file_for(stamp_ns)
        except BagError:
            self.lost = self.lost + Counter([topic])
            raise
        finally:
            if qos.latched:
                self._latched.put(BagMessage(topic, type_name, bytes(payload), stamp_ns, qos, publisher))
        with self._giving_up(topic):
            file.write(key, stamp_ns, payload)
        self.bytes += len(payload)

    def remember(self, message: BagMessage) -> None:
        """Store a latched message for the start of the next file without writing it now."""
        self._add((message.topic, message.type_name), message.qos)
        self._latched.put(message)

    def add_topic(self, topic: str, type_name: str, qos: QoS) -> None:
        """Add a topic, which the bag then lists even if it has no messages."""
        self._add((topic, type_name), qos)
        if self._file is not None:
            with self._giving_up(topic):
                self._file.add_topic((topic, type_name))

    def set_custom(self, key: str, value: str) -> None:
        self._custom[key] = value

    def keep_custom(self) -> None:
        """Write the current ``custom_data`` into the file itself, so that a recovery can read it."""
        if self._file is not None and self._file.given:
            with self._giving_up("metadata"):
                self._file.add_metadata(CUSTOM_RECORD, self._custom)

    def flush(self) -> None:
        """Pass all messages so far to the operating system, so that they survive the end of this process."""
        if self._file is not None:
            with self._giving_up("flush"):
                self._file.flush()

    def sync(self) -> None:
        """Write all flushed messages to the disk itself, so that they survive a power failure."""
        if self._file is not None:
            with self._giving_up("sync"):
                self._file.sync()
                sync_folder(self.path)

    def end_file(self) -> None:
        """Complete the current file and list it in ``metadata.yaml``. The next message starts another file."""
        try:
            if self._file is not None:
                self._finish_file(self._file)
        except BagError:
            with suppress(BagError):  # the first error is more useful
                self._write_metadata()
            raise
        self._write_metadata()

    def close(self) -> None:
        """Write index and metadata. Idempotent."""
        if not self._closed:
            self._closed = True
            self._latched = LatchedValues()  # a recorder keeps the writers of its snapshots
            self.end_file()

    # -- internals -------------------------------------------------------------------------------

    def _add(self, topic: Topic, qos: QoS, schema: Schema | None = None) -> QoS:
        """Store QoS and type of a topic at its first message, and return its QoS."""
        if topic not in self._topics:
            schema = schema or schema_or_unknown(topic[1])
            if not schema.encoding:
                log.warning("%s: type %s is unknown here and is recorded without its definition", *topic)
            self._topics[topic] = (qos, schema)
        return self._topics[topic][0]

    def _file_for(self, stamp_ns: int) -> McapWriter:
        """Return the file for a message. If the current file is full, start the next with the latched values."""
        if self._file is not None and self._is_full(self._file, stamp_ns):
            self.end_file()
        if self._file is None:
            self._file = self._open_file()
        file = self._file
        if self._opened > 1 and file.first_ns is None:
            with self._giving_up("latched values"):
                for value in self._latched.values():
                    file.write((value.topic, value.type_name), stamp_ns, value.payload)
        return file

    def _is_full(self, file: McapWriter, stamp_ns: int) -> bool:
        if file.first_ns is None:
            return False
        if self.max_bytes and file.size >= self.max_bytes:
            return True
        # A clock step in either direction ends a file.
        return 0 < self.max_duration_ns <= abs(stamp_ns - file.first_ns)

    def _open_file(self) -> McapWriter:
        number, self._opened = self._opened, self._opened + 1
        numbered = number > 0 or self.max_bytes > 0 or self.max_duration_ns > 0
        name = f"{self.path.name}_{number}.mcap" if numbered else f"{self.path.name}.mcap"
        try:
            return McapWriter(self.path / name, self._topics, self.compressed)
        except OSError as error:
            if error.errno in _FULL:
                raise DiskFullError(f"bag {self.path}: {error.strerror}") from error
            raise BagError(f"bag {self.path} cannot be created: {error.strerror or error}") from None

    def _finish_file(self, file: McapWriter) -> None:
        with self._giving_up("end of the file"):
            file.flush()
            file.add_metadata(CUSTOM_RECORD, self._custom)
            file.finish()
        self._file = None
        if not file.path.exists():
            file.counts.clear()
            self.lost = self.lost + file.lost
            raise BagError(f"bag {self.path}: {file.path.name} was removed while it was being recorded")
        self._done.append(file)

    @contextmanager
    def _giving_up(self, what: str) -> Iterator[None]:
        """Abandon the current file after a disk error, and count its lost messages."""
        try:
            yield
        except OSError as error:
            if self._file is not None:
                self.lost = self.lost + self._file.lost
            self._file = None
            text = f"bag {self.path}, {what}: {error.strerror}; run ic bag recover {self.path}"
            raise (DiskFullError if error.errno in _FULL else BagError)(text) from error

    def _write_metadata(self) -> None:
        try:
            write_metadata(self.path, self._done, self._topics, self._custom)
        except OSError as error:
            hint = f"; free some space, then run ic bag recover {self.path}" if error.errno in _FULL else ""
            raise BagError(f"bag {self.path}: metadata.yaml cannot be written: {error.strerror}{hint}") from error


def write_metadata(folder: Path, files: Sequence[McapWriter], topics: Topics, custom: Mapping[str, str]) -> None:
    """Write ``metadata.yaml`` (rosbag2, version 9) atomically: readers see either the old or the new file.

    Raises:
        OSError: the file cannot be written.
    """
    information = {
        "version": 9,
        "storage_identifier": "mcap",
        "relative_file_paths": [file.path.name for file in files],
        **_span(files),
        "message_count": sum(file.counts.total() for file in files),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": type_name,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": dump_qos_v9([ros_qos(qos)]),
                    "type_description_hash": schema.type_hash,
                },
                "message_count": sum(file.counts[topic, type_name] for file in files),
            }
            for (topic, type_name), (qos, schema) in topics.items()
        ],
        "compression_format": "",
        "compression_mode": "",
        "files": [{"path": file.path.name, **_span([file]), "message_count": file.counts.total()} for file in files],
        "custom_data": dict(custom) or None,
        "ros_distro": "jazzy",
    }
    text = dump_yaml({"rosbag2_bagfile_information": information}, width=1000)
    with replacing(folder / "metadata.yaml", private=True, sync=True) as stream:
        stream.write(text.encode())


def _span(files: Sequence[McapWriter]) -> dict[str, Any]:
    spans = [file.span_ns for file in files if file.counts]
    start_ns = min((start_ns for start_ns, _ in spans), default=_NO_START)
    end_ns = max((end_ns for _, end_ns in spans), default=_NO_START)
    return {
        "duration": {"nanoseconds": end_ns - start_ns},
        "starting_time": {"nanoseconds_since_epoch": start_ns},
    }
