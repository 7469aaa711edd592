"""rmw_zenoh's conventions: against its documented examples, Zenoh's own serializer, and zenoh-ros2-sdk's codecs."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instant_ic.bridge.zenoh_format import (
    QOS_TEXT,
    Attachment,
    Token,
    closest_qos,
    data_key,
    dds_type,
    ros_type,
)
from instant_ic.bus import LATCHED, RELIABLE, SENSOR
from instant_ic.msg import type_hash

zenoh = pytest.importorskip("zenoh")
I64 = st.integers(-(2**63), 2**63 - 1)
NAMES = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)
TOPICS = st.lists(NAMES, min_size=1, max_size=4).map(lambda parts: "/" + "/".join(parts))
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


def test_data_key_of_the_documented_example():
    key = f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert data_key(0, "/chatter", "std_msgs/msg/String", type_hash("std_msgs/msg/String")) == key


def test_tokens_of_the_documented_examples():
    node = "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    assert Token("NN", 0, "aac3178e146ba6f1fc6e6a4085e77f21", 0, 0, "/", "listener").key() == node
    assert Token.parse(node) == Token("NN", 0, "aac3178e146ba6f1fc6e6a4085e77f21", 0, 0, "/", "listener")
    publisher = (
        "@ros2_lv/0/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
        f"{STRING_HASH}/::,10:,:,:,,"
    )
    token = Token(
        *("MP", 0, "8b20917502ee955ac4476e0266340d5c", 0, 10, "/", "talker"),
        *("/chatter", "std_msgs/msg/String", STRING_HASH, RELIABLE),
    )
    assert token.key() == publisher
    assert Token.parse(publisher) == token
    in_namespace = Token("NN", 3, "ab", 1, 1, "/fleet/robot1", "arbiter")
    assert in_namespace.key() == "@ros2_lv/3/ab/1/1/NN/%/%fleet%robot1/arbiter"


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (RELIABLE, "::,:,:,:,,"),  # RELIABLE, VOLATILE, KEEP_LAST 42: all default
        (RELIABLE, "::2,:,:,:,,"),  # KEEP_ALL
        (SENSOR, "2::,100:,:,:,,"),
        (LATCHED, ":1:,5:,:,:,,"),
        (LATCHED, "2:1:,5:,:,:,,"),
    ],
)
def test_any_quality_of_service_is_the_closest_preset(qos, text):
    assert closest_qos(text) == qos
    assert closest_qos(QOS_TEXT[qos]) == qos


@given(I64, I64, st.binary(min_size=16, max_size=16))
def test_attachment_is_what_zenoh_itself_serializes(sequence, source_ns, gid):
    packed = Attachment(sequence, source_ns, gid).pack()
    assert len(packed) == 33
    parts = (zenoh.ext.Int64(sequence), zenoh.ext.Int64(source_ns), gid)
    assert packed == zenoh.ext.z_serialize(parts).to_bytes()
    assert Attachment.unpack(packed) == Attachment(sequence, source_ns, gid)


@given(
    st.sampled_from(["MP", "MS"]),
    st.integers(0, 232),
    st.integers(0, 9999),
    st.one_of(st.just("/"), TOPICS),
    NAMES,
    TOPICS,
    st.sampled_from([SENSOR, RELIABLE, LATCHED]),
)
def test_endpoint_token_is_what_the_independent_client_makes_and_comes_back(
    kind, domain, number, namespace, node, topic, qos
):
    from zenoh_ros2_sdk import qos as sdk_qos
    from zenoh_ros2_sdk.discovery import _parse_liveliness_keyexpr
    from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
    from zenoh_ros2_sdk.keyexpr import endpoint_liveliness_keyexpr, node_liveliness_keyexpr

    token = Token(
        kind, domain, "ab12", number, number + 1, namespace, node, topic, "std_msgs/msg/Bool", STRING_HASH, qos
    )
    other = NodeEntity(domain, "ab12", number, node, namespace)
    theirs = EndpointEntity(
        other, number + 1, EntityKind(kind), topic, dds_type("std_msgs/msg/Bool"), STRING_HASH, QOS_TEXT[qos]
    )
    assert token.key() == endpoint_liveliness_keyexpr(theirs)
    assert Token.parse(token.key()) == token
    assert Token("NN", domain, "ab12", number, number, namespace, node).key() == node_liveliness_keyexpr(other)
    assert _parse_liveliness_keyexpr(token.key())["qualified_name"] == topic
    decoded = sdk_qos.QosProfile.decode(QOS_TEXT[qos])
    assert (decoded.reliability.name == "RELIABLE") == qos.reliable
    assert (decoded.durability.name == "TRANSIENT_LOCAL") == qos.latched


@given(st.from_regex(r"[a-z_]{1,10}/(msg|srv)/[A-Za-z0-9]{1,10}", fullmatch=True))
def test_type_names_come_back(name):
    assert ros_type(dds_type(name)) == name
