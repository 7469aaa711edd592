"""rmw_zenoh's conventions as strings and bytes: data keys, attachments, liveliness tokens (rmw_zenoh, docs/design.md).

ROS 2 nodes (Jazzy and newer) on rmw_zenoh exchange CDR, as our bus does. A program that follows these conventions
takes part in their graph. Nothing here needs Zenoh itself. Each function raises :class:`FormatError` for text or bytes
that do not follow the conventions.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Literal

from instant_ic.bus.qos import LATCHED, RELIABLE, SENSOR, QoS

ADMIN_SPACE = "@ros2_lv"
GID_SIZE = 16
"""Bytes of a publisher's id."""

SENDER_SIZE = 8
"""Leading bytes of the id that all publishers of one of our sessions share. They show that a drive command and the
release of an emergency stop come from the same sender. ROS 2's own publishers share no bytes of their ids."""

QOS_TEXT = {SENSOR: "2::,5:,:,:,,", RELIABLE: "::,10:,:,:,,", LATCHED: ":1:,1:,:,:,,"}
"""QoS of each preset in a token, ``reliability:durability:history,depth:deadline:lifespan:liveliness``. An empty field
is the default; reliability 2 is best effort, durability 1 is transient local."""

_ATTACHMENT = struct.Struct("<qqB16s")
_DDS_TYPE = re.compile(r"(\w+)::(\w+)::dds_::(\w+)_\Z")
_ROS_TYPE = re.compile(r"(\w+)/(\w+)/(\w+)\Z")

Kind = Literal["NN", "MP", "MS"]
"""Node, publisher, subscription."""


class FormatError(ValueError):
    """Bytes or a key that do not follow rmw_zenoh's conventions."""


@dataclass(frozen=True)
class Attachment:
    """Metadata of a message.

    Attributes:
        sequence: increases by one with each message of a publisher, from 1.
        source_ns: time of publication by the sender's clock.
        gid: 16-byte id of the publisher, new with every start.
    """

    sequence: int
    source_ns: int
    gid: bytes

    @property
    def sender(self) -> str:
        """First bytes of the publisher's id, in hex; shared by one session of ours."""
        return self.gid[:SENDER_SIZE].hex()

    def pack(self) -> bytes:
        """Return the 33 bytes, as Zenoh's serializer writes ``(i64, i64, bytes)``."""
        return _ATTACHMENT.pack(self.sequence, self.source_ns, GID_SIZE, self.gid)

    @classmethod
    def unpack(cls, data: bytes) -> Attachment:
        """Decode the 33 bytes."""
        if len(data) != _ATTACHMENT.size:
            raise FormatError(f"attachment of {len(data)} bytes, {_ATTACHMENT.size} expected")
        sequence, source_ns, size, gid = _ATTACHMENT.unpack(data)
        if size != GID_SIZE:
            raise FormatError(f"publisher id of {size} bytes, {GID_SIZE} expected")
        return cls(sequence, source_ns, gid)


def dds_type(type_name: str) -> str:
    """Return the DDS name of a type: ``std_msgs::msg::dds_::String_`` for ``std_msgs/msg/String``."""
    if not (match := _ROS_TYPE.match(type_name)):
        raise FormatError(f"type name {type_name!r} does not look like std_msgs/msg/String")
    return "{}::{}::dds_::{}_".format(*match.groups())


def ros_type(dds_name: str) -> str:
    """Return the ROS name of a type; the inverse of :func:`dds_type`."""
    if not (match := _DDS_TYPE.match(dds_name)):
        raise FormatError(f"type name {dds_name!r} does not look like std_msgs::msg::dds_::String_")
    return "{}/{}/{}".format(*match.groups())


def data_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    """Return the key of a topic's messages."""
    return f"{domain}/{topic.strip('/')}/{dds_type(type_name)}/{type_hash}"


def closest_qos(text: str) -> QoS:
    """Return the preset that is closest to a token's QoS."""
    parts = text.split(":")
    if len(parts) != 6:
        raise FormatError(f"quality of service {text!r} has {len(parts)} parts, 6 expected")
    if parts[1] == "1":
        return LATCHED
    return SENSOR if parts[0] == "2" else RELIABLE


@dataclass(frozen=True)
class Token:
    """One entity of the ROS graph, as described by its liveliness token.

    Attributes:
        kind: node, publisher or subscription.
        domain: ROS domain.
        session: id of the Zenoh session, in hex.
        node_id, entity_id: numbers within the session; equal for a node.
        namespace: the node's namespace, ``/robot1``; ``/`` is the root.
        topic, type_name, type_hash, qos: empty for a node.
    """

    kind: Kind
    domain: int
    session: str
    node_id: int
    entity_id: int
    namespace: str
    node: str
    topic: str = ""
    type_name: str = ""
    type_hash: str = ""
    qos: QoS = RELIABLE

    def key(self) -> str:
        """Return the token's key."""
        head = f"{ADMIN_SPACE}/{self.domain}/{self.session}/{self.node_id}/{self.entity_id}/{self.kind}"
        node = f"{head}/%/{self.namespace.replace('/', '%')}/{self.node}"
        if self.kind == "NN":
            return node
        topic = self.topic.replace("/", "%")
        return (
            f"{node}/{topic}/{dds_type(self.type_name)}/{self.type_hash}/{QOS_TEXT.get(self.qos, QOS_TEXT[RELIABLE])}"
        )

    @classmethod
    def parse(cls, key: str) -> Token | None:
        """Parse the token of a node, publisher or subscription; return None for a service's, which is not used here."""
        parts = key.split("/")
        kind = parts[5] if len(parts) >= 9 and parts[0] == ADMIN_SPACE and all(parts) else ""
        if kind in ("SS", "SC"):
            return None
        if not (kind == "NN" or (kind in ("MP", "MS") and len(parts) == 13)):
            raise FormatError(f"{key!r} is not a liveliness token of rmw_zenoh")
        try:
            domain, node_id, entity_id = (int(parts[index]) for index in (1, 3, 4))
        except ValueError:
            raise FormatError(f"{key!r}: domain and ids must be numbers") from None
        namespace, node = (parts[index].replace("%", "/") for index in (7, 8))
        entity = (domain, parts[2], node_id, entity_id, namespace, node)
        if kind == "NN":
            return cls("NN", *entity)
        endpoint = (parts[9].replace("%", "/"), ros_type(parts[10]), parts[11], closest_qos(parts[12]))
        return cls("MP" if kind == "MP" else "MS", *entity, *endpoint)
