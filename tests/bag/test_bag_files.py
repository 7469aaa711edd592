from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from instant_ic.bag import BagError, BagReader, BagWriter
from instant_ic.bag.recover import recover
from instant_ic.bus import LATCHED, SENSOR
from instant_ic.msg import (
    Bool,
    Keyframe,
    compressed_image_message,
    header,
    image_message,
    pose_message,
    scan_message,
    serialize,
    typestore,
)

SCAN, BOOL, KEYFRAME = "sensor_msgs/msg/LaserScan", "std_msgs/msg/Bool", "instant_ic_msgs/msg/Keyframe"
VELODYNE = "velodyne_msgs/msg/VelodyneScan"


def scan(value: float, stamp_ns: int = 5) -> bytes:
    ranges = np.full(8, value, np.float32)
    return bytes(serialize(scan_message(ranges, -1.0, 0.25, 0.1, 30.0, "velodyne", stamp_ns)))


def keyframe() -> bytes:
    depth = image_message(np.arange(8, dtype=np.float32).reshape(2, 4), "32FC1", "camera", 7)
    message = Keyframe(
        header=header("map", 7),
        id=3,
        pose=pose_message(np.eye(4)),
        panorama=compressed_image_message(b"\xff\xd8jpeg", "camera", 7),
        depth=depth,
        sigma=image_message(np.ones((2, 4), np.uint8), "mono8", "camera", 7),
        source="fused",
        scale=1.5,
        quality=0.9,
        relative_sigma=0.1,
        fit=True,
        message="good",
    )
    return bytes(serialize(message))


def make_bag(path: Path, count: int = 20, value: float = 1.0) -> Path:
    with BagWriter(path) as writer:
        writer.write("/operator/estop", BOOL, bytes(serialize(Bool(data=True))), 1_000_000_000, LATCHED)
        for index in range(count):
            writer.write("/scan", SCAN, scan(value + index), 1_000_000_000 + index * 100_000_000, SENSOR)
        writer.write("/keyframe", KEYFRAME, keyframe(), 1_500_000_000, LATCHED)
    return path


def test_rosbags_reads_it_back_with_types_and_qos(tmp_path: Path) -> None:
    bag = make_bag(tmp_path / "bag")
    # AnyReader takes the types from the definitions in the bag, not from our store.
    with AnyReader([bag]) as reader:
        got = {}
        for connection, stamp_ns, payload in reader.messages():
            got.setdefault(connection.topic, []).append(
                (stamp_ns, reader.deserialize(payload, connection.msgtype), payload)
            )
    assert {topic: len(messages) for topic, messages in got.items()} == {
        "/operator/estop": 1,
        "/scan": 20,
        "/keyframe": 1,
    }
    stamp_ns, message, payload = got["/keyframe"][0]
    assert stamp_ns == 1_500_000_000 and payload == keyframe()
    assert (message.id, message.fit, message.message) == (3, True, "good")
    assert message.depth.data.view(np.float32).tolist() == [0, 1, 2, 3, 4, 5, 6, 7]
    assert [m.ranges[0] for _, m, _ in got["/scan"]] == [1.0 + i for i in range(20)]
    with Reader(bag) as plain:
        profiles = {c.topic: c.ext.offered_qos_profiles[0] for c in plain.connections}  # type: ignore[union-attr]
    assert (profiles["/scan"].reliability.name, profiles["/scan"].durability.name) == ("BEST_EFFORT", "VOLATILE")
    assert (profiles["/keyframe"].reliability.name, profiles["/keyframe"].durability.name) == (
        "RELIABLE",
        "TRANSIENT_LOCAL",
    )


def test_type_hash_is_that_of_ros(tmp_path: Path) -> None:
    bag = make_bag(tmp_path / "bag")
    with Reader(bag) as reader:
        digests = {c.msgtype: c.digest for c in reader.connections}
    assert digests[KEYFRAME] == typestore().hash_rihs01(KEYFRAME)
    # Published hash of std_msgs/msg/Bool in ROS 2 Jazzy.
    assert digests[BOOL] == "RIHS01_feb91e995ff9ebd09c0cb3d2aed18b11077585839fb5db80193b62d74528f6c9"


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (lambda p: BagReader(p / "nothing"), "does not exist"),
        (lambda p: BagReader(p), "no metadata.yaml"),
        (lambda p: BagWriter(p), "already exists"),
        (lambda p: recover(p, p / "new"), "no .mcap file found"),
    ],
)
def test_what_cannot_be_done_is_told(tmp_path: Path, action: object, message: str) -> None:
    with pytest.raises(BagError, match=message):
        action(tmp_path)  # type: ignore[operator]
