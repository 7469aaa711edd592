"""Reads ROS 1 ``.bag`` files as ROS 2: types are renamed, definitions and bytes converted message by message."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rosbags.convert.converter import STATIC_MSGTYPE_RENAMES, is_same_wireformat, migrate_bytes
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from instant_ic.bag.errors import BagError
from instant_ic.bag.metadata import ros_qos
from instant_ic.bus.qos import LATCHED, RELIABLE
from instant_ic.msg import typestore


class Ros1Source:
    """Reads one ROS 1 bag, with the interface of `rosbags`' rosbag2 reader.

    Types that ROS 2 or this project has are converted, field by field where they changed (``Header.seq`` is dropped,
    ``tfMessage`` becomes ``TFMessage``). All others use the definitions in the bag.
    """

    compression_mode = None

    def __init__(self, path: Path) -> None:
        self.path = path
        self.is_open = False
        self.storage = SimpleNamespace(metadata=None)
        self.connections: list[Connection] = []
        self._bag = AnyReader([path])
        self._converters: dict[str, Callable[[bytes], bytes]] = {}

    def open(self) -> None:
        """Read index and types.

        Raises:
            BagError: the file is not a ROS 1 bag, or has no index.
        """
        try:
            self._bag.open()
        except (AnyReaderError, AssertionError) as error:
            raise BagError(
                f"bag {self.path} cannot be read: {error}; for a truncated ROS 1 bag run ROS 1's rosbag reindex"
            ) from None
        self.is_open = True
        target = self._target_store()
        for source in self._bag.connections:
            name = _ros2_name(source.msgtype)
            text, type_hash = target.generate_msgdef(name, ros_version=2)[0], target.hash_rihs01(name)
            qos = LATCHED if getattr(source.ext, "latching", 0) else RELIABLE
            self.connections.append(
                source._replace(
                    msgtype=name,
                    msgdef=MessageDefinition(MessageDefinitionFormat.MSG, text),
                    digest=type_hash,
                    ext=ConnectionExtRosbag2("cdr", [ros_qos(qos)]),
                )
            )
            self._converters[source.msgtype] = self._converter(target, source.msgtype, name)

    def close(self) -> None:
        self._bag.close()
        self.is_open = False

    @property
    def start_time(self) -> int:
        return self._bag.start_time

    @property
    def end_time(self) -> int:
        """One past the last stamp."""
        return self._bag.end_time

    @property
    def message_count(self) -> int:
        return self._bag.message_count

    def messages(
        self, connections: list[Connection], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield the messages as CDR, in stamp order."""
        chosen = {c.id: c for c in connections}
        sources = [c for c in self._bag.connections if c.id in chosen]
        for source, stamp_ns, raw in self._bag.messages(sources, start, stop):
            yield chosen[source.id], stamp_ns, self._converters[source.msgtype](raw)

    def _target_store(self) -> Any:
        """Return a type store with our types and the bag's types that we do not have."""
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store = get_typestore(Stores.EMPTY)
        # Registered types are compiled; those of our store already are.
        store.fielddefs.update(typestore().fielddefs)
        store.types.update(typestore().types)
        for source in self._bag.connections:
            name = _ros2_name(source.msgtype)
            if name not in store.fielddefs:
                text = self._bag.typestore.generate_msgdef(source.msgtype, ros_version=2)[0]
                found = get_types_from_msg(text, name)
                store.register({inner: fields for inner, fields in found.items() if inner not in store.fielddefs})
        return store

    def _converter(self, target: Any, source_name: str, name: str) -> Callable[[bytes], bytes]:
        source = self._bag.typestore
        if is_same_wireformat(source, target, source_name, name):
            return lambda raw: bytes(target.ros1_to_cdr(raw, name))
        cache: dict[str, object] = {}
        return lambda raw: bytes(
            migrate_bytes(source, target, source_name, name, cache, raw, src_is2=False, dst_is2=True)
        )


def _ros2_name(ros1_name: str) -> str:
    return STATIC_MSGTYPE_RENAMES.get(ros1_name, ros1_name)
