"""QoS profiles and type definitions of the topics in a bag."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Collection
from typing import Any

import yaml
from rosbags.interfaces import (
    Connection,
    MessageDefinitionFormat,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos
from rosbags.typesys import TypesysError

from instant_ic.bag.message import Schema, Topic
from instant_ic.bus.qos import LATCHED, RELIABLE, SENSOR, QoS
from instant_ic.config.yaml_text import dump_yaml, read_yaml
from instant_ic.msg import MessageError, message_type, type_hash, typestore

Topics = dict[Topic, tuple[QoS, Schema]]
"""QoS and type of the topics of a bag."""

_FOREVER = QosTime(2147483647, 4294967295)
"""The value that DDS writes for "no limit"."""


@functools.cache
def own_schema(type_name: str) -> Schema:
    """Return the definition of a type of this project.

    Raises:
        MessageError: the type is unknown.
    """
    message_type(type_name)
    text, _ = typestore().generate_msgdef(type_name, ros_version=2)
    return Schema(type_name, "ros2msg", text, type_hash(type_name))


def schema_or_unknown(type_name: str) -> Schema:
    """Return the definition of a type; an empty definition if the type is unknown, as rosbag2 writes it."""
    try:
        return own_schema(type_name)
    except (MessageError, TypesysError):  # TypesysError: one of our types under a wrong full name
        return Schema(type_name, "", "", "")


@functools.lru_cache(maxsize=200)
def store_of(schema: Schema) -> Any:
    """Return a type store with the types that a bag's definition contains."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema.text, schema.name))
    return store


@functools.lru_cache(maxsize=200)
def with_hash(schema: Schema) -> Schema:
    """Add the RIHS01 hash of a definition. A missing definition is replaced by ours; a damaged one is emptied."""
    if not schema.encoding or not schema.text:  # old SQLite bags store no definitions
        return schema_or_unknown(schema.name)
    if schema.type_hash or schema.encoding != "ros2msg":
        return schema
    try:
        return dataclasses.replace(schema, type_hash=store_of(schema).hash_rihs01(schema.name))
    except Exception:  # noqa: BLE001 - a parser may raise anything on a damaged definition
        return Schema(schema.name, "", "", "")


def schema_of(connection: Connection) -> Schema:
    """Return the type definition of a topic as read by `rosbags`."""
    encodings = {MessageDefinitionFormat.MSG: "ros2msg", MessageDefinitionFormat.IDL: "ros2idl"}
    encoding = encodings.get(connection.msgdef.format, "")
    return with_hash(Schema(connection.msgtype, encoding, connection.msgdef.data, connection.digest))


def channel_metadata(qos: QoS) -> dict[str, str]:
    """Return the metadata that rosbag2 stores with a topic in an MCAP file."""
    return {"offered_qos_profiles": dump_yaml(dump_qos_v9([ros_qos(qos)])).strip()}


def ros_qos(qos: QoS) -> Qos:
    """Return the ROS 2 profile of one of our presets."""
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


def profiles_of(profiles: list[Any] | str) -> list[Qos]:
    """Return the QoS profiles of a topic for `rosbags`, whose own YAML parser takes milliseconds per topic and file.

    Args:
        profiles: YAML text from an MCAP or SQLite file, or the parsed value from ``metadata.yaml``.

    Raises:
        ReaderError: the text is not a list in YAML.
    """
    return list(_profiles(profiles)) if isinstance(profiles, str) else parse_qos(profiles)


@functools.lru_cache(maxsize=200)
def _profiles(text: str) -> tuple[Qos, ...]:
    try:
        found = read_yaml(text)
    except yaml.YAMLError as error:
        raise ReaderError(f"offered_qos_profiles is not YAML: {error}") from None
    if not isinstance(found, list | None):
        raise ReaderError("offered_qos_profiles is not a list")
    return tuple(parse_qos(found or []))


@functools.lru_cache(maxsize=200)  # called once per message
def preset_of_text(profiles: str) -> QoS:
    """Return the closest preset for the QoS text of an MCAP file; ``reliable`` if the text is damaged."""
    try:
        return preset_of(profiles_of(profiles))
    except Exception:  # noqa: BLE001 - a parser may raise anything on damaged YAML
        return RELIABLE


def preset_of(profiles: Collection[Qos]) -> QoS:
    """Return the preset closest to a topic's offered QoS; ``reliable`` if the bag stores no QoS."""
    profile = next(iter(profiles), None)
    if profile is None:
        return RELIABLE
    if profile.durability is QosDurability.TRANSIENT_LOCAL:
        return LATCHED
    return SENSOR if profile.reliability is QosReliability.BEST_EFFORT else RELIABLE
