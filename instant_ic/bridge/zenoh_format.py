"""rmw_zenoh's conventions as strings and bytes: data keys, attachments, liveliness tokens (rmw_zenoh, docs/design.md).

ROS 2 nodes (Jazzy and newer) that run on rmw_zenoh carry CDR, as our bus does. Whoever keeps these conventions is one
of them. Nothing here needs Zenoh itself.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Literal

ADMIN_SPACE = "@ros2_lv"
GID_SIZE = 16
"""Bytes of a publisher's id."""

SENDER_SIZE = 8
"""Bytes at its head that all publishers of one session of ours share: by them a drive command and the release of an
emergency stop are known to be of one sender. Publishers of ROS 2 have ids of their own throughout."""

_ATTACHMENT = struct.Struct("<qqB16s")
_DDS_TYPE = re.compile(r"(\w+)::(\w+)::dds_::(\w+)_\Z")
_ROS_TYPE = re.compile(r"(\w+)/(\w+)/(\w+)\Z")
_ENDPOINT_PARTS = 13
_DEFAULT_DEPTH = 42

Kind = Literal["NN", "MP", "MS"]
"""Node, publisher, subscription."""


class FormatError(ValueError):
    """Bytes or a key that rmw_zenoh would not have made."""


@dataclass(frozen=True)
class Attachment:
    """What goes with every message.

    Attributes:
        sequence: grows by one with each message of a publisher, from 1.
        source_ns: time of publication by the sender's clock.
        gid: 16 bytes that name the publisher, new with every start.
    """

    sequence: int
    source_ns: int
    gid: bytes

    @property
    def sender(self) -> str:
        """The head of the publisher's id, hex digits."""
        return self.gid[:SENDER_SIZE].hex()

    def pack(self) -> bytes:
        """The 33 bytes, as Zenoh's serializer writes ``(i64, i64, bytes)``.

        Raises:
            FormatError: the id has another length, or a number does not fit.
        """
        if len(self.gid) != GID_SIZE:
            raise FormatError(f"publisher id of {len(self.gid)} bytes, {GID_SIZE} expected")
        try:
            return _ATTACHMENT.pack(self.sequence, self.source_ns, GID_SIZE, self.gid)
        except struct.error as error:
            raise FormatError(f"attachment: {error}") from None

    @classmethod
    def unpack(cls, data: bytes) -> Attachment:
        """Reads the 33 bytes.

        Raises:
            FormatError: another length, outside or of the id.
        """
        if len(data) != _ATTACHMENT.size:
            raise FormatError(f"attachment of {len(data)} bytes, {_ATTACHMENT.size} expected")
        sequence, source_ns, size, gid = _ATTACHMENT.unpack(data)
        if size != GID_SIZE:
            raise FormatError(f"publisher id of {size} bytes, {GID_SIZE} expected")
        return cls(sequence, source_ns, gid)


def dds_type(type_name: str) -> str:
    """``std_msgs/msg/String`` as ``std_msgs::msg::dds_::String_``.

    Raises:
        FormatError: not a full type name.
    """
    if not (match := _ROS_TYPE.match(type_name)):
        raise FormatError(f"type name {type_name!r} does not look like std_msgs/msg/String")
    return "{}::{}::dds_::{}_".format(*match.groups())


def ros_type(dds_name: str) -> str:
    """The way back from :func:`dds_type`.

    Raises:
        FormatError: not such a name.
    """
    if not (match := _DDS_TYPE.match(dds_name)):
        raise FormatError(f"type name {dds_name!r} does not look like std_msgs::msg::dds_::String_")
    return "{}/{}/{}".format(*match.groups())


def data_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    """Key that a topic's messages are put under."""
    return f"{domain}/{topic.strip('/')}/{dds_type(type_name)}/{type_hash}"


def mangled(name: str) -> str:
    """A name as one part of a token: ``/`` becomes ``%``, an empty name ``%``."""
    return name.replace("/", "%") or "%"


@dataclass(frozen=True)
class TopicQoS:
    """The part of ROS 2's quality of service that a token tells of here; the rest is the default.

    Attributes:
        reliable: else best effort.
        latched: transient local: a late joiner gets the last ``depth`` messages; else volatile.
        depth: messages kept; 0 keeps all.
    """

    reliable: bool = True
    latched: bool = False
    depth: int = _DEFAULT_DEPTH

    def encode(self) -> str:
        """``<reliability>:<durability>:<history>,<depth>:<deadline>:<lifespan>:<liveliness>``; empty where default."""
        reliability = "" if self.reliable else "2"
        durability = "1" if self.latched else ""
        depth = "" if self.depth == _DEFAULT_DEPTH else str(self.depth)
        history = f",{depth}" if self.depth else "2,"
        return f"{reliability}:{durability}:{history}:,:,:,,"

    @classmethod
    def decode(cls, text: str) -> TopicQoS:
        """Reads a token's part.

        Raises:
            FormatError: not six parts, or a depth that is no number.
        """
        parts = text.split(":")
        if len(parts) != 6:
            raise FormatError(f"quality of service {text!r} has {len(parts)} parts, 6 expected")
        history, _, depth = parts[2].partition(",")
        if not (depth.isascii() and depth.isdecimal()) and depth:
            raise FormatError(f"quality of service {text!r}: depth {depth!r} is not a number")
        keep_all = history == "2"
        return cls(
            reliable=parts[0] != "2",
            latched=parts[1] == "1",
            depth=0 if keep_all else int(depth) if depth else _DEFAULT_DEPTH,
        )


@dataclass(frozen=True)
class Token:
    """One entity of the ROS graph, as its liveliness token tells it.

    Attributes:
        kind: node, publisher or subscription.
        domain: ROS domain.
        session: id of the Zenoh session, hex digits.
        node_id, entity_id: numbers within the session; the same for a node.
        namespace: of the node, ``/robot1``; ``/`` is the root.
        node: its name.
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
    qos: TopicQoS = TopicQoS()

    def key(self) -> str:
        """The token's key."""
        head = f"{ADMIN_SPACE}/{self.domain}/{self.session}/{self.node_id}/{self.entity_id}/{self.kind}"
        node = f"{head}/%/{mangled(self.namespace)}/{mangled(self.node)}"
        if self.kind == "NN":
            return node
        return f"{node}/{mangled(self.topic)}/{dds_type(self.type_name)}/{self.type_hash}/{self.qos.encode()}"

    @classmethod
    def parse(cls, key: str) -> Token | None:
        """Reads a node's, publisher's or subscription's token; None for a service's, which nobody here asks for.

        Raises:
            FormatError: not a token of rmw_zenoh.
        """
        parts = key.split("/")
        if len(parts) < 9 or parts[0] != ADMIN_SPACE or not all(parts):
            raise FormatError(f"{key!r} is not a liveliness token of rmw_zenoh")
        kind = parts[5]
        if kind in ("SS", "SC"):
            return None
        try:
            numbers = [int(parts[index]) for index in (1, 3, 4)]
        except ValueError:
            raise FormatError(f"{key!r}: domain and ids must be numbers") from None
        namespace, node = (parts[index].replace("%", "/") for index in (7, 8))
        domain, node_id, entity_id = numbers
        if kind == "NN":
            return cls("NN", domain, parts[2], node_id, entity_id, namespace, node)
        if kind not in ("MP", "MS") or len(parts) != _ENDPOINT_PARTS:
            raise FormatError(f"{key!r} is not a liveliness token of rmw_zenoh")
        return cls(
            "MP" if kind == "MP" else "MS",
            domain,
            parts[2],
            node_id,
            entity_id,
            namespace,
            node,
            topic=parts[9].replace("%", "/"),
            type_name=ros_type(parts[10]),
            type_hash=parts[11],
            qos=TopicQoS.decode(parts[12]),
        )
