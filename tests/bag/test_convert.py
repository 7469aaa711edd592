"""Bags of others become ours: ROS 1, SQLite, bare files; merged, filtered, renamed, split."""

from pathlib import Path

import foxglove
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from instant_ic.bag import BagError, BagReader, BagWriter
from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.compare import compare
from instant_ic.bag.convert import ConvertOptions, convert
from instant_ic.bag.metadata import own_schema
from instant_ic.bag.recover import recover
from instant_ic.bus import LATCHED, SENSOR
from instant_ic.msg import Bool, deserialize, scan_message, serialize, typestore

BOOL, SCAN, STRING = "std_msgs/msg/Bool", "sensor_msgs/msg/LaserScan", "std_msgs/msg/String"
S = 1_000_000_000


def scan(value: float) -> bytes:
    return bytes(serialize(scan_message(np.full(4, value, np.float32), -1.0, 0.5, 0.1, 30.0, "velodyne", 5 * S + 7)))


@pytest.fixture
def ros1(tmp_path: Path) -> Path:
    """Scans (a header with ``seq``), a latched transform of ROS 1's old type, and a type that nobody else knows."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("Header header\nfloat64[] volts\nstring name", "rover_msgs/msg/Cells"))
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf/msg/tfMessage"))
    types = store.types
    header = types["std_msgs/msg/Header"](3, types["builtin_interfaces/msg/Time"](5, 7), "velodyne")
    path = tmp_path / "old.bag"
    writer = Ros1Writer(path)
    writer.set_compression(Ros1Writer.CompressionFormat.LZ4)
    with writer:
        scans = writer.add_connection("/scan", SCAN, typestore=store)
        cells = writer.add_connection("/cells", "rover_msgs/msg/Cells", typestore=store)
        fixed = writer.add_connection("/tf_static", "tf/msg/tfMessage", typestore=store, latching=1)
        vector, turn = (
            types["geometry_msgs/msg/Vector3"](1.0, 2.0, 3.0),
            types["geometry_msgs/msg/Quaternion"](0, 0, 0, 1),
        )
        move = types["geometry_msgs/msg/Transform"](vector, turn)
        moved = types["geometry_msgs/msg/TransformStamped"](header, "camera", move)
        writer.write(fixed, S, store.serialize_ros1(types["tf/msg/tfMessage"]([moved]), "tf/msg/tfMessage"))
        for index in range(3):
            numbers = np.full(4, index, np.float32)
            message = types[SCAN](header, -1.0, 1.0, 0.5, 0.0, 0.0, 0.1, 30.0, numbers, np.zeros(0, np.float32))
            writer.write(scans, (1 + index) * S, store.serialize_ros1(message, SCAN))
        message = types["rover_msgs/msg/Cells"](header, np.array([3.5, 3.6]), "pack")
        writer.write(cells, 2 * S, store.serialize_ros1(message, "rover_msgs/msg/Cells"))
    return path


def test_ros1_bag_becomes_ours(ros1: Path, tmp_path: Path) -> None:
    result = convert([ros1], tmp_path / "new")
    assert result.counts == {"/scan": 3, "/cells": 1, "/tf_static": 1} and result.skipped == {}
    with BagReader(tmp_path / "new") as reader:
        told = {t.topic: (t.type_name, t.qos.name) for t in reader.topics}
        assert told == {
            "/cells": ("rover_msgs/msg/Cells", "reliable"),
            "/scan": (SCAN, "reliable"),
            "/tf_static": ("tf2_msgs/msg/TFMessage", "latched"),
        }
        got = [deserialize(m.payload, m.type_name) for m in reader.messages({"/scan"})]
        assert [(m.header.frame_id, m.header.stamp.sec, m.ranges.tolist()) for m in got] == [
            ("velodyne", 5, [i] * 4) for i in range(3)
        ]
        (fixed,) = [deserialize(m.payload, m.type_name) for m in reader.messages({"/tf_static"})]
        assert fixed.transforms[0].child_frame_id == "camera" and fixed.transforms[0].transform.translation.z == 3.0
        assert [m.stamp_ns for m in reader.messages()] == [S, S, 2 * S, 2 * S, 3 * S]
    # An independent reader decodes the foreign type by the definition that came along.
    with AnyReader([tmp_path / "new"]) as plain:
        (cells,) = [plain.deserialize(raw, c.msgtype) for c, _, raw in plain.messages() if c.topic == "/cells"]
        assert (cells.volts.tolist(), cells.name) == ([3.5, 3.6], "pack")  # type: ignore[attr-defined]
        assert {c.msgtype: c.digest for c in plain.connections}[SCAN] == typestore().hash_rihs01(SCAN)


def test_ros1_bag_is_read_as_it_is(ros1: Path, tmp_path: Path) -> None:
    convert([ros1], tmp_path / "new")
    assert all(topic.same for topic in compare(ros1, tmp_path / "new"))
    with BagReader(ros1) as reader:
        assert (reader.count, reader.start_ns, reader.end_ns) == (5, S, 3 * S)
        assert [m.stamp_ns for m in reader.messages({"/scan"}, 2 * S, 3 * S)] == [2 * S]


def test_broken_ros1_bag_is_told(ros1: Path) -> None:
    ros1.write_bytes(ros1.read_bytes()[:300])
    with pytest.raises(BagError, match="cannot be read"):
        BagReader(ros1)
    ros1.write_bytes(b"")
    with pytest.raises(BagError, match="cannot be read"):
        BagReader(ros1)


@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_sqlite_bag_becomes_ours(tmp_path: Path, mode: CompressionMode) -> None:
    writer = Writer(tmp_path / "old", version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/scan", SCAN, typestore=typestore())
        for index in range(4):
            writer.write(connection, index * S, scan(index))
    assert convert([tmp_path / "old"], tmp_path / "new").counts == {"/scan": 4}
    with BagReader(tmp_path / "new") as reader:
        assert [m.payload for m in reader.messages()] == [scan(i) for i in range(4)]


def test_bare_mcap_of_another_writer(tmp_path: Path) -> None:
    """foxglove-sdk's file has another profile and no QoS; its CDR messages are read, others are an error."""
    with foxglove.open_mcap(str(tmp_path / "their.mcap")):
        schema = foxglove.Schema(name=SCAN, encoding="ros2msg", data=own_schema(SCAN).text.encode())
        channel = foxglove.Channel("/convert_scan", schema=schema, message_encoding="cdr")
        other = foxglove.Channel("/convert_json", message_encoding="json")
        for index in range(3):
            channel.log(scan(index), log_time=(1 + index) * S)
        other.log(b"{}", log_time=S)
    with BagReader(tmp_path / "their.mcap") as reader:
        assert {topic.topic: topic.count for topic in reader.topics} == {"/convert_scan": 3, "/convert_json": 1}
        assert [m.payload for m in reader.messages({"/convert_scan"})] == [scan(i) for i in range(3)]
        with pytest.raises(BagError, match=r"/convert_json: its messages are 'json', not CDR.* ic bag recover"):
            list(reader.messages())
    result = recover(tmp_path / "their.mcap", tmp_path / "new")
    assert result.skipped == {"/convert_json": "encoding 'json'"} and result.stopped_by == ""
    with BagReader(tmp_path / "new") as reader:
        assert [(m.topic, m.type_name, m.payload) for m in reader.messages()] == [
            ("/convert_scan", SCAN, scan(i)) for i in range(3)
        ]


def ours(path: Path, offset: int = 0) -> Path:
    with BagWriter(path) as writer:
        writer.set_custom("instant_ic.lost", '{"/scan": 2}')
        for stop, stamp in ((False, 0), (True, 3)):
            writer.write("/estop", BOOL, bytes(serialize(Bool(data=stop))), stamp * S + offset, LATCHED)
        for index in range(10):
            writer.write("/scan", SCAN, scan(index), index * S + offset, SENSOR)
    return path


def test_span_of_time_begins_with_the_latched_values(tmp_path: Path) -> None:
    options = ConvertOptions(start_s=4.0, end_s=7.0)
    convert([ours(tmp_path / "bag")], tmp_path / "new", options)
    with BagReader(tmp_path / "new") as reader:
        got = [(m.topic, m.stamp_ns // S) for m in reader.messages()]
        stops = [deserialize(m.payload, BOOL).data for m in reader.messages({"/estop"})]
        assert reader.custom["converted_from"] == "bag" and reader.custom["instant_ic.lost"] == '{"/scan": 2}'
    assert got == [("/estop", 4), ("/scan", 4), ("/scan", 5), ("/scan", 6)] and stops == [True]


def test_topics_are_chosen_and_renamed(tmp_path: Path) -> None:
    bag = ours(tmp_path / "bag")
    options = ConvertOptions(choice=TopicChoice(("/s*",)), remap={"/scan": "/front/scan"})
    assert convert([bag], tmp_path / "new", options).counts == {"/front/scan": 10}
    with pytest.raises(BagError, match="none of the selected topics"):
        convert([bag], tmp_path / "none", ConvertOptions(choice=TopicChoice(("/nothing",))))
    assert not (tmp_path / "none").exists()


def test_merged_split_and_compressed(tmp_path: Path) -> None:
    one, two = ours(tmp_path / "one"), ours(tmp_path / "two", offset=S // 2)
    options = ConvertOptions(compressed=True, max_duration_s=5.0)
    shares: list[float] = []
    result = convert([one, two], tmp_path / "new", options, shares.append)
    assert (result.counts["/scan"], result.files) == (20, 2) and shares[-1] == 1.0 and shares == sorted(shares)
    with BagReader(tmp_path / "new") as reader:
        assert [m.stamp_ns for m in reader.messages({"/scan"})] == [i * S // 2 for i in range(20)]
        assert reader.count == 24 and reader.compression == "zstd"


def test_types_that_nobody_knows_are_named(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/odd", "their_msgs/msg/Odd", b"x", 1, SENSOR)
        writer.write("/scan", SCAN, scan(1), 1, SENSOR)
    with pytest.raises(BagError, match=r"no definition of their_msgs/msg/Odd \(/odd\).*--skip-unknown"):
        convert([tmp_path / "bag"], tmp_path / "new")
    result = convert([tmp_path / "bag"], tmp_path / "new", ConvertOptions(skip_unknown=True))
    assert result.counts == {"/scan": 1} and result.skipped == {"their_msgs/msg/Odd": ["/odd"]}


def test_type_of_another_definition_keeps_its_own(tmp_path: Path) -> None:
    """A robot's own Keyframe is not ours: it must be decoded by its own definition, and named."""
    from instant_ic.bag import Schema
    from instant_ic.bag.metadata import with_hash

    theirs = with_hash(Schema("instant_ic_msgs/msg/Keyframe", "ros2msg", "uint8 number\n", ""))
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/keyframe", theirs.name, b"\x00\x01\x00\x00\x2a", 1, LATCHED, theirs)
    convert([tmp_path / "bag"], tmp_path / "new")
    with BagReader(tmp_path / "new") as reader:
        assert reader.differing_types() == ["instant_ic_msgs/msg/Keyframe"]
        (message,) = reader.messages()
        assert reader.decoder(reader.topics[0])(message.payload).number == 42


def test_nothing_to_convert(tmp_path: Path) -> None:
    BagWriter(tmp_path / "empty").close()
    with pytest.raises(BagError, match="no messages to convert"):
        convert([tmp_path / "empty"], tmp_path / "new")
    with pytest.raises(BagError, match="does not exist"):
        convert([tmp_path / "nowhere"], tmp_path / "new")
