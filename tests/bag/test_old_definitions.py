"""Bags recorded before a type grew: they are listed, read, played and replayed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from instant_ic.bag import BagReader, BagWriter, Schema
from instant_ic.bag.metadata import own_schema, store_of, with_hash
from instant_ic.bag.upgrade import upgrade_of
from instant_ic.bus import LATCHED
from instant_ic.msg import ControlState, deserialize, header, pose_message, serialize, twist_message

NAME = "instant_ic_msgs/msg/ControlState"
S = 1_000_000_000


def old_schema() -> Schema:
    """ControlState as it was before ``reason_code``."""
    lines = own_schema(NAME).text.split("\n")
    lines = [line for line in lines if not line.startswith(("uint8 reason_code", "uint8 REASON_", "string holder"))]
    return with_hash(Schema(NAME, "ros2msg", "\n".join(lines), ""))


def old_payload(mode: int) -> bytes:
    pose, still = pose_message(np.eye(4)), twist_message()
    fields = dict.fromkeys(("robot_pose", "vbot_start", "vbot_pose", "vbot_target"), pose)
    fields |= dict.fromkeys(("operator_command", "applied_command", "robot_twist"), still)
    fields |= dict.fromkeys(("pose_gap_m", "yaw_gap_rad", "time_to_obstacle_s", "vbot_limit_m_s"), 0.25)
    message = ControlState(
        header=header("map", 7), mode=mode, reason="stopped: no camera image for 1.6 s", estop=True, blocked=False,
        transitions=3, shown=0, vbot_action=0, reason_code=74, holder="", **fields,
    )  # fmt: skip
    return bytes(serialize(message))[:-9]  # the code, and an aligned empty text


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    schema = old_schema()
    assert schema.type_hash != own_schema(NAME).type_hash
    with BagWriter(tmp_path / "bag") as writer:
        for k in range(3):
            writer.write("/ic/state", NAME, old_payload(k), (k + 1) * S, LATCHED, schema)
    return tmp_path / "bag"


def test_an_older_message_is_read_as_the_present_one_with_an_unknown_code(bag: Path) -> None:
    with BagReader(bag) as reader:
        assert [topic.problem for topic in reader.topics] == [""]
        found = [deserialize(m.payload, m.type_name) for m in reader.messages(current=True)]
        assert [message.mode for message in found] == [0, 1, 2]
        assert {(m.reason, m.estop, m.reason_code) for m in found} == {
            ("stopped: no camera image for 1.6 s", True, ControlState.REASON_UNKNOWN)
        }
        # As they are recorded, too.
        (first, *_) = reader.messages()
        assert first.payload == old_payload(0)
        assert reader.decoder(reader.topics[0])(first.payload).reason == "stopped: no camera image for 1.6 s"


def test_fields_that_a_type_has_lost_at_its_end_are_dropped() -> None:
    own = own_schema("std_msgs/msg/ColorRGBA")
    grown = with_hash(Schema(own.name, "ros2msg", own.text + "\nfloat32 depth_near_m\nuint8[] depth_png\n", ""))
    upgrade = upgrade_of(grown)
    assert upgrade is not None
    store = store_of(grown)
    kind = store.types[own.name]
    before = kind(r=0.1, g=0.2, b=0.3, a=0.4, depth_near_m=7.0, depth_png=np.arange(3, dtype=np.uint8))
    after = deserialize(upgrade(bytes(store.serialize_cdr(before, own.name))), own.name)
    assert (after.r, after.g, after.b, after.a) == pytest.approx((0.1, 0.2, 0.3, 0.4))


@pytest.mark.parametrize(
    "text",
    [
        "uint8 mode\nstd_msgs/Header header\n",  # another order
        "std_msgs/Header header\nuint8 other\n",  # another name
        "not a definition",
    ],
)
def test_any_other_difference_is_not_converted(text: str) -> None:
    nested = "\n" + "=" * 80 + "\n"
    header_text = "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    time_text = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    assert upgrade_of(Schema(NAME, "ros2msg", text + nested + header_text + nested + time_text, "other")) is None
    assert upgrade_of(own_schema(NAME)) is None
